"""Evaluations of a checkpoint on a black box or on drawn plants, their report and files."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import load_checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import (
    Plants,
    draw_plants,
    plant_env,
    simulated_env,
    with_model_as_given,
)
from baselines.purejaxrl_ppo.config import OptionalInt, OptionalName, OptionalPath
from baselines.purejaxrl_ppo.flights import (
    CANNOT_RECORD,
    Outcomes,
    Rollout,
    can_record,
    fly_episode,
    race_many,
    record_flights,
    save_flight,
    start_keys,
    start_pose_params,
)
from baselines.purejaxrl_ppo.report import (
    compare_with_optimum,
    compute_time_lost,
    describe_flight,
    describe_report,
    summarize,
    summarize_plants,
)
from flytrack_env import EnvParams, blackbox
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.files import fresh_folder, write_atomically
from flytrack_env.progress import ProgressBar
from flytrack_env.references import (
    ReferenceFileError,
    References,
    ghost_rollout,
    is_model_of,
    shipped_references,
)
from flytrack_env.rollout import save_rollout

SCHEMA = 1
DEFAULT_OUT = Path("runs/eval")
DEFAULT_LAPS = 3
MAX_SEED = 2**31
MAX_STEPS = 1_000_000  # hours: the battery is empty after minutes
MAX_LAPS = 100  # their gate times are kept for every flight
MAX_FLIGHTS = 100_000  # so that the gate times of all of them fit into memory
# Models of the time-optimal references, in order of preference.
BLACK_BOX_MODELS, NOMINAL_MODELS = ("black_box", "nominal"), ("nominal",)


@dataclasses.dataclass(frozen=True)
class EvaluationSettings:
    """What is flown, and what is written; the fields are the flags of ``flytrack eval``."""

    checkpoint: Path
    """Checkpoint of a training: final.safetensors."""
    steps: int
    """Time limit of a flight; at 100 Hz, 2000 steps are 20 s."""
    episodes: int = 1
    """Noisy starts, on each plant."""
    laps: OptionalInt = None
    """Laps to complete; by default 3, and no limit for a single flight."""
    plants: OptionalInt = None
    """Fly so many simulated plants, drawn around the checkpoint's model, instead of a black box."""
    black_box: OptionalPath = None
    """File of the black box; by default the shipped one."""
    track: OptionalName = None
    """Name or file of a track; by default the checkpoint's."""
    seed: int = 0
    """Seed of the noisy starts and of the plants."""
    ghost: bool = False
    """Compare with the time-optimal flight, and write it beside the rollout."""
    out: OptionalPath = None
    """Rollout of the first flight, rows [x 21 | u 4]; by default runs/eval/rollout.npy, or that of
    the next free folder."""
    rrd: OptionalPath = None
    """Write a Rerun recording of the first flight."""
    json: OptionalPath = None
    """Write the report as JSON."""

    @property
    def is_single(self) -> bool:
        """Whether there is a single flight, on a black box."""
        return self.episodes == 1 and self.plants is None

    @property
    def num_laps(self) -> int | None:
        """Laps to complete; None: no limit."""
        return DEFAULT_LAPS if self.laps is None and not self.is_single else self.laps

    def check(self) -> None:
        """Raise ValueError, naming the flag, for settings that cannot be used."""
        if self.plants is not None and self.black_box is not None:
            raise ValueError(
                f"--plants: found --black-box {self.black_box} as well, expected one of the two"
            )
        limits = {
            "steps": (1, MAX_STEPS),
            "episodes": (1, MAX_FLIGHTS),
            "laps": (1, MAX_LAPS),
            "plants": (1, MAX_FLIGHTS // max(self.episodes, 1)),
            "seed": (0, MAX_SEED - 1),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"--{name}: found {value}, expected {low} to {high}")
        if self.rrd is not None and not can_record():
            raise ValueError(f"--rrd: {CANNOT_RECORD}")
        ghost = None if self.out is None else ghost_path(self.out)
        paths = (self.checkpoint, self.black_box, self.out, ghost, self.rrd, self.json)
        used = [path.resolve() for path in paths if path is not None]
        if len(set(used)) < len(used):
            raise ValueError(
                "--out, --rrd, --json: found a file that is read or written twice, expected another"
            )


def ghost_path(rollout: Path) -> Path:
    """Return where the time-optimal flight beside a rollout is written."""
    return rollout.with_name(f"{rollout.stem}_ghost.npy")


class Report:
    """An evaluation of a checkpoint, as settings ask for it.

    Args:
        settings: what is flown and written.

    Attributes:
        env: that is flown in.
        params: of the environment.
        plants: that are flown; None: a black box.
        references: time-optimal flights; None: there are none.
        rollout: the first flight, step by step.
        numbers: as JSON values; docs/baseline.md describes each.

    Raises:
        ValueError, OSError: settings or files that cannot be used; nothing is flown yet.
    """

    rollout: Rollout
    numbers: dict[str, Any]

    def __init__(self, settings: EvaluationSettings):
        settings.check()
        self.settings, self.checkpoint = settings, load_checkpoint(settings.checkpoint)
        self.plants: Plants | None = None
        if settings.plants is None:
            black_box = settings.black_box or blackbox.SHIPPED
            self.env = plant_env(self.checkpoint, blackbox.load(black_box), settings.track)
            is_shipped = black_box.read_bytes() == blackbox.SHIPPED.read_bytes()
        else:
            self.env = simulated_env(self.checkpoint, settings.track)
            model = self.env.default_params.model
            self.plants = draw_plants(settings.seed, settings.plants, model)
            is_shipped = is_model_of(self.env.track.name, BLACK_BOX_MODELS[0], model)
        self.params = with_model_as_given(self.env.default_params)
        models = BLACK_BOX_MODELS if is_shipped else NOMINAL_MODELS
        self.references: References | None = None
        try:
            self.references = shipped_references(self.env.track, models)
        except ReferenceFileError:
            if settings.ghost:
                raise

    def fly(self) -> Outcomes:
        """Fly, and return the outcomes of all flights."""
        settings, plants = self.settings, self.plants
        first = self.params if plants is None else self.params.replace(model=plants.model(0))
        self.rollout = self._fly_first(self.env, first)
        num_laps = settings.num_laps or settings.steps
        if settings.is_single:
            return jax.tree.map(lambda leaf: np.asarray(leaf)[None], self.rollout.outcome)
        models = None if plants is None else plants.repeated(settings.episodes)
        rest = (settings.steps, num_laps, self.params, models, ProgressBar("flights"))
        return race_many(self.env, self.checkpoint.policy, self._keys(), *rest)

    def _keys(self) -> jax.Array:
        return start_keys(self.settings.seed, self.settings.episodes * (self.settings.plants or 1))

    def _fly_first(self, env: EpisodicEnvironment, params: EnvParams) -> Rollout:
        """Return the first flight of the evaluation in an environment."""
        settings = self.settings
        key = jax.random.key(settings.seed) if settings.is_single else self._keys()[0]
        params = start_pose_params(params, settings.steps)
        num_laps = settings.num_laps or settings.steps
        return fly_episode(env, self.checkpoint.policy, key, params, settings.steps, num_laps)

    def count(self, outcomes: Outcomes) -> None:
        """Set the numbers of the evaluation."""
        settings, plants, references = self.settings, self.plants, self.references
        first = self.rollout.outcome
        numbers: dict[str, Any] = {
            "schema": SCHEMA,
            "package_version": flytrack_env.__version__,
            "checkpoint": str(settings.checkpoint),
            "env_id": self.checkpoint.env_id,
            "track": self.env.track.name,
            "gates_per_lap": len(self.env.track.gates),
            "black_box": None
            if plants is not None
            else str(settings.black_box or blackbox.SHIPPED),
            "seed": settings.seed,
            "steps_limit": settings.steps,
            "laps": settings.num_laps,
            "episodes": settings.episodes,
            **summarize(outcomes, is_limited=settings.num_laps is not None),
            "plants": None,
            "optimal": None,
            "time_lost_s": None,
            "first_flight": {
                "steps": int(first.steps),
                "gates": int(first.gates_passed),
                "lap_times_s": np.asarray(first.lap_times_s)[: first.laps].tolist(),
                "ended": first.end_reason(),
            },
        }
        if plants is not None:
            is_complete = outcomes.is_complete().reshape(-1, settings.episodes)
            if settings.episodes > 1:  # flights of one plant are not independent
                numbers["success"] |= {"low": None, "high": None}
            numbers["plants"] = summarize_plants(plants.drawn, is_complete)
        if references is not None:
            numbers["optimal"] = compare_with_optimum(numbers, references)
            if settings.ghost:
                gate_ids = [gate.id for gate in self.env.track.gates]
                numbers["time_lost_s"] = compute_time_lost(outcomes, references, gate_ids)
        self.numbers = numbers

    @property
    def text(self) -> str:
        """The report for a terminal."""
        settings, text = self.settings, ""
        if settings.is_single:
            text += describe_flight(self.numbers["first_flight"], float(self.params.dt))
        if settings.num_laps is not None or settings.ghost:
            text += describe_report(self.numbers)
        return text

    def write(self) -> list[str]:
        """Write the files that the settings ask for; return a line about each.

        Raises:
            OSError, ValueError: a file that cannot be written.
        """
        settings, ghost = self.settings, None
        rollout = settings.out or fresh_folder(DEFAULT_OUT) / "rollout.npy"
        save_flight(rollout, self.rollout)
        lines = [f"rollout: {rollout}"]
        if settings.ghost and self.references is not None:
            ghost = ghost_path(rollout)
            save_rollout(
                ghost, *ghost_rollout(self.references, self.numbers["first_flight"]["steps"])
            )
            lines.append(f"ghost: {ghost}")
        if settings.rrd is not None:
            shown = ", ".join(self.record(settings.rrd, with_ghost=settings.ghost))
            lines.append(f"recording: {settings.rrd}, {shown}: {settings.rrd.stat().st_size} bytes")
        if settings.json is not None:
            files = {"rollout": rollout, "ghost": ghost, "recording": settings.rrd}
            names = {name: None if path is None else str(path) for name, path in files.items()}
            content = json.dumps(self.numbers | names, indent=2, allow_nan=False) + "\n"
            write_atomically(settings.json, content.encode())
            lines.append(f"json: {settings.json}")
        return lines

    def record(self, path: Path, with_ghost: bool) -> list[str]:
        """Write a Rerun recording of the first flight, and return the names of the flights in it.

        Beside it is the flight from the same start in the simulator with the model that the policy
        was trained on: it shows what that simulator gets wrong.

        Args:
            path: of the recording.
            with_ghost: whether the time-optimal flight is in it as well.
        """
        flights = {"black box" if self.plants is None else "first plant": self.rollout}
        if "model" in self.checkpoint.meta:
            simulator = simulated_env(self.checkpoint, self.env.track)
            params = with_model_as_given(simulator.default_params)
            flights["simulator"] = self._fly_first(simulator, params)
        ghost = self.references if with_ghost else None
        record_flights(path, flights, self.env.track, ghost)
        return [*flights, *(["time-optimal"] if ghost is not None else [])]


def evaluate(settings: EvaluationSettings) -> Report:
    """Fly a checkpoint and return the report; nothing is written.

    Raises:
        ValueError, OSError: settings or files that cannot be used, before anything is flown.
    """
    report = Report(settings)
    report.count(report.fly())
    return report


def run_evaluation(settings: EvaluationSettings) -> None:
    """Do what ``flytrack eval`` does: fly a checkpoint, print the report and write the files."""
    report = evaluate(settings)
    print(report.text, end="")
    print("\n".join(report.write()))
