"""The flags of ``flytrack``'s commands.

They are dataclasses that need no extra, so that ``--help`` shows them. Those of ``train``, ``eval``
and ``loop`` are where their defaults are, in packages that need one.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg, create_mutex_group

NO_HINT = "(optional)"  # tyro would print {None}|PATH and (default: None)
EXCITATION_OR_SCRIPT = create_mutex_group(required=False)
Paths = Positional[tuple[Path, ...]]
OptionalPath = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint=NO_HINT)]
SomeLogs = Annotated[tuple[Path, ...], arg(metavar="LOG [LOG ...]", help_behavior_hint=NO_HINT)]
MotionName = Literal["auto", "euler", "semi_implicit", "continuous", "handout"]  # handout: euler
LogFormat = Literal["csv", "ulog", "betaflight", "dataflash", "usd", "bag"]
MappingName = Annotated[str | None, arg(metavar="MAPPING", help_behavior_hint=NO_HINT)]


@dataclass(frozen=True)
class Demo:
    """Flags of ``flytrack demo``."""

    black_box: OptionalPath = None
    """The plant, an acro_step.bin; default: the shipped one."""
    out: OptionalPath = None
    """Folder to write to; default: runs/demo, or the next free name."""
    seed: int = 0
    """Seed of flights and training."""
    total_timesteps: Annotated[float | None, arg(metavar="FLOAT", help_behavior_hint=NO_HINT)] = (
        None
    )
    """Environment steps of the training; default: those of `flytrack train`."""
    quick: bool = False
    """Every step once, each as short as it can be, to see that all works: the policy learns
    nothing."""


@dataclass(frozen=True)
class Show:
    """Flags of ``flytrack show``."""

    rollouts: Annotated[Paths, arg(metavar="[ROLLOUT ...]", help_behavior_hint=NO_HINT)] = ()
    """Rollout files (.npy); without any, a time-optimal flight is shown."""
    out: OptionalPath = None
    """Folder to write to; default: runs/show, or the next free name."""
    track: str = "flytrack"
    """Name of a shipped track, or a track file (.toml)."""
    allow_pickle: bool = False
    """Read pickled rollouts. Unpickling runs whatever code a file holds: allow it for files you
    trust."""
    ghost: bool = False
    """Fly the time-optimal flight beside them in the recording."""
    ghost_model: Literal["nominal", "black_box"] = "nominal"
    """Drone for which the time-optimal flight is optimal."""
    camera: bool = False
    """Also show what the drone's camera sees, gates' corners and mask: in the recording, and of
    each as GIF beside the view from behind."""
    animation: bool = False
    """Also write the fastest flying lap of each beside the time-optimal one as GIF."""


@dataclass(frozen=True)
class Collect:
    """Flags of ``flytrack collect``."""

    out: Path
    """The log, .npz or .csv."""
    black_box: Annotated[str | None, arg(metavar="PLANT", help_behavior_hint=NO_HINT)] = None
    """The plant: an acro_step.bin, or module:name of a function step(x, u) or of a plant; default:
    the shipped black box."""
    minutes: Annotated[float, EXCITATION_OR_SCRIPT] = 2.0
    """Duration of the excitation, at least 1."""
    script: Annotated[OptionalPath, EXCITATION_OR_SCRIPT] = None
    """A script to fly instead, .npz, as `flytrack plan` writes it."""
    seed: int = 0
    """Seed of the excitation and of the noise."""
    noise: float = 0.0
    """0 logs the state itself, 1 what common sensors measure; other levels scale their noise."""


@dataclass(frozen=True)
class Import:
    """Flags of ``flytrack import``."""

    files: Annotated[Paths, arg(metavar="FILE [FILE ...]", help_behavior_hint="(at least one)")]
    """Logs of one craft."""
    format: LogFormat
    """Their format."""
    out: Path
    """The log, .npz or .csv."""
    map: MappingName = None
    """A mapping file, .toml, or the name of a shipped one; CSV, uSD logs and bags need it."""
    model_out: OptionalPath = None
    """Also write the nominal model of this craft, .json."""
    keep_clocks: bool = False
    """Report offsets between the sensors' clocks without correcting them."""


@dataclass(frozen=True)
class Check:
    """Flags of ``flytrack check``."""

    log: Annotated[Positional[Path | None], arg(metavar="LOG", help_behavior_hint=NO_HINT)] = None
    """The flight log; with --map, a file of another format."""
    map: MappingName = None
    """A mapping file, .toml, or the name of a shipped one, to import the log with."""
    format: LogFormat = "csv"
    """The format of a log with --map."""
    model: OptionalPath = None
    """A model of the craft, whose lags and full-stick rates are compared with the log."""
    plant: Annotated[str | None, arg(metavar="MODULE:NAME", help_behavior_hint=NO_HINT)] = None
    """Check a simulator instead: a function step(x, u), or an acro_step.bin."""
    layout: OptionalPath = None
    """What the numbers of the plant's state are, .toml; default: the handout's state."""
    out: OptionalPath = None
    """Folder for a report with pictures."""
    fix: OptionalPath = None
    """Write the mapping by which the log agrees, .toml; needs --map."""


@dataclass(frozen=True)
class Fit:
    """Flags of ``flytrack fit``."""

    log: Positional[Path]
    """The flight log."""
    out: Path
    """The model, .json."""
    fix: UseAppendAction[Annotated[tuple[str, ...], arg(metavar="NAME=VALUE")]] = ()
    """Hold a parameter at a value; may be repeated."""
    start: Annotated[str | None, arg(name="from", metavar="MODEL", help_behavior_hint=NO_HINT)] = (
        None
    )
    """Start from the values of this model; default: the nominal model."""
    effect: UseAppendAction[Annotated[tuple[str, ...], arg(metavar="NAME")]] = ()
    """Identify the parameters of this effect too; may be repeated."""
    hold_out_every: int = 4
    """Hold out the last of every so many blocks; 0: none."""
    motion: MotionName = "auto"
    """How the craft moves within a step: as drones do (continuous), or by a simulator's step; auto:
    as drones do if the log is measured, else what the log shows."""
    accept: bool = False
    """Fit a log although its channels contradict each other."""


@dataclass(frozen=True)
class Validate:
    """Flags of ``flytrack validate``."""

    model: Positional[Path]
    """The model, .json."""
    log: Positional[Path]
    """The flight log."""
    out: Path
    """The folder of the report."""
    accept: bool = False
    """Judge a log although its channels contradict each other."""


@dataclass(frozen=True)
class Diagnose:
    """Flags of ``flytrack diagnose``."""

    logs: Annotated[Paths, arg(metavar="LOG [LOG ...]", help_behavior_hint="(at least one)")]
    """Flight logs to learn from."""
    out: OptionalPath = None
    """The folder of the report; without --quick."""
    quick: bool = False
    """Print only the first look, and what it did not check."""
    model: OptionalPath = None
    """The model to diagnose, .json; default: the nominal model."""
    hold_out: SomeLogs = ()
    """Logs to judge by and not to learn from; default: the last of every four blocks of the
    others."""
    before: SomeLogs = ()
    """Logs of the craft as the model knows it: causes are then only what has changed since."""
    motion: MotionName = "auto"
    """How the craft moves within a step: as drones do (continuous), or by a simulator's step; auto:
    as drones do if the logs are measured, else what the logs show."""
    accept: bool = False
    """Diagnose logs although their channels contradict each other."""
    fleet: bool = False
    """Diagnose every log in folders apart, craft by craft (a subfolder each, docs/scaling.md), and
    say which cause began with which flight. A second call goes on where the first one ended."""
    address: Annotated[
        str | None, arg(metavar="HOST:PORT|auto|local", help_behavior_hint=NO_HINT)
    ] = None
    """With --fleet: a Ray cluster; default: processes of this machine."""
    workers: int = 1
    """With --fleet: processes of this machine."""
    limit: float = 900.0
    """With --fleet: longest time of a log, s."""


@dataclass(frozen=True)
class Adapt:
    """Flags of ``flytrack adapt``."""

    log: Positional[Path]
    """Log of the policy's flights on the plant; about ten seconds are enough."""
    out: Path
    """The new policy, .safetensors; the old one where that is better, or nothing differs."""
    checkpoint: Annotated[Path, arg(metavar="PATH|champion|robust")] = Path("champion")
    """The policy: a checkpoint, or a shipped policy's name."""
    model: OptionalPath = None
    """A model with mass, battery, full-stick rates, rate curve and rate loop of the craft; default:
    they are the policy's. `flytrack import --model-out` writes one without curve and loop."""
    seed: int = 0
    """Seed of the drawn plants and of the starts."""
    accept: bool = False
    """Adapt to a log although it contradicts itself or the policy's model."""


@dataclass(frozen=True)
class Plan:
    """Flags of ``flytrack plan``."""

    diagnosis: Positional[Path]
    """The diagnosis, diagnosis.json."""
    out: Path
    """The script, .npz, for `flytrack collect --script`."""
    model: OptionalPath = None
    """The model whose hovering thrust the flights start with, .json; default: the nominal model."""
    seed: int = 0
    """Seed of the flights."""
