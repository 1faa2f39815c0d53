"""Identify a plant and diagnose a model: collect, import, fit, validate, diagnose, plan.

Each command is a dataclass of its flags around a function of ``flytrack_sysid``.
"""

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg, create_mutex_group, subcommand

from flytrack_env import Motion, blackbox, load_model, load_provenance, save_model
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.model_file import ModelFileError
from flytrack_env.plants import Plant
from flytrack_sysid.collect import CollectError, collect
from flytrack_sysid.diagnosis import diagnose, diagnose_change, joined, motion_of, write_diagnosis
from flytrack_sysid.diagnosis import text_of as text_of_diagnosis
from flytrack_sysid.diagnosis.identifiability import next_flight
from flytrack_sysid.diagnosis.report import traces_of
from flytrack_sysid.fit import fit, what_is_fitted
from flytrack_sysid.flight_recording import write_flight_recording
from flytrack_sysid.importing import import_log
from flytrack_sysid.log import FlightLog
from flytrack_sysid.log_file import check_name, describe, load_log, save_log
from flytrack_sysid.plausibility import check_plausible
from flytrack_sysid.progress import ProgressBar
from flytrack_sysid.script_file import check_name as check_script_name
from flytrack_sysid.script_file import load_script, save_script
from flytrack_sysid.split import HELD_OUT_EVERY, held_out_rows
from flytrack_sysid.validate import validate
from flytrack_sysid.validation_report import text_of, write_validation

PROG = "flytrack-sysid"
RECORDING_NAME = "flight.rrd"
EXCITATION_OR_SCRIPT = create_mutex_group(required=False)
NO_HINT = "(optional)"  # tyro would print "(default: None)"
Paths = Positional[tuple[Path, ...]]
OptionalPath = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint=NO_HINT)]


def load_plant(where: str) -> Any:
    """Return the plant in an artifact, or the object that ``module:name`` names."""
    module, colon, name = where.partition(":")
    if not colon or Path(where).exists():
        return blackbox.load(where)
    sys.path.insert(0, str(Path.cwd()))  # stays there: the module may import later
    try:
        found = attrgetter(name)(importlib.import_module(module))
    except Exception as error:  # whatever a user's module raises
        reason = f"{type(error).__name__}: {error}"
        raise CollectError(f"--black-box {where}: cannot be imported: {reason}") from error
    if not callable(found) and not isinstance(found, Plant):
        raise CollectError(
            f"--black-box {where}: found {type(found).__name__}, expected step(x, u) or a plant"
        )
    return found


MotionName = Literal["auto", "handout", "semi_implicit", "continuous"]


@dataclass(frozen=True)
class Collect:
    """Fly an excitation or a script on a plant and write the flight log."""

    black_box: str
    """The plant: an acro_step.bin, or module:name of a function step(x, u) or of a plant."""
    out: Path
    """The log, .npz or .csv."""
    minutes: Annotated[float, EXCITATION_OR_SCRIPT] = 2.0
    """Duration of the excitation, at least 1."""
    script: Annotated[OptionalPath, EXCITATION_OR_SCRIPT] = None
    """A script to fly instead, .npz, as `plan` writes it."""
    seed: int = 0
    """Seed of the excitation and of the noise."""
    noise: float = 0.0
    """0 logs the state itself, 1 what common sensors measure; other levels scale their noise."""

    def run(self) -> None:
        """Fly, and write the log."""
        check_name(self.out)
        script = None if self.script is None else load_script(self.script)
        plant = load_plant(self.black_box)
        log = collect(plant, self.minutes, self.seed, self.noise, ProgressBar("flights"), script)
        save_log(self.out, log)
        print(describe(load_log(self.out)))


@dataclass(frozen=True)
class Import:
    """Convert logs of real flights into a flight log."""

    files: Annotated[Paths, arg(metavar="FILE [FILE ...]", help_behavior_hint="(at least one)")]
    """Logs of one craft."""
    format: Literal["csv", "ulog", "betaflight", "usd", "bag"]
    """Their format."""
    out: Path
    """The log, .npz or .csv."""
    map: Annotated[str | None, arg(metavar="MAPPING", help_behavior_hint=NO_HINT)] = None
    """A mapping file, .toml, or the name of a shipped one; CSV, uSD logs and bags need it."""
    model_out: OptionalPath = None
    """Also write the nominal model of this craft, .json."""
    keep_clocks: FlagCreatePairsOff[bool] = False
    """Report offsets between the sensors' clocks without correcting them."""

    def run(self) -> None:
        """Read the logs, and write them as one with its details beside it."""
        check_name(self.out)
        if self.model_out is not None:
            check_model_name(self.model_out)
        found = import_log(self.files, self.format, self.map, not self.keep_clocks)
        written = [self.out, self.out.with_suffix(".import.json")]
        model = None if self.model_out is None else found.nominal_model()  # before anything is written
        save_log(self.out, found.log)
        found.save_details(written[1])
        if self.model_out and model:
            provenance = {
                "nominal": "generic quadcopter, scaled to the craft",
                "imported_from": [Path(source).name for source in found.sources],
            }
            save_model(self.model_out, model, provenance)
            written.append(self.model_out)
        print(found.describe())
        print_written(written)


@dataclass(frozen=True)
class Fit:
    """Identify a model from a flight log."""

    log: Positional[Path]
    """The flight log."""
    out: Path
    """The model, .json."""
    fix: UseAppendAction[Annotated[tuple[str, ...], arg(metavar="NAME=VALUE")]] = ()
    """Hold a parameter at a value; may be repeated."""
    start: Annotated[str | None, arg(name="from", metavar="MODEL", help_behavior_hint=NO_HINT)] = None
    """Start from the values of this model; default: the nominal model."""
    effect: UseAppendAction[Annotated[tuple[str, ...], arg(metavar="NAME")]] = ()
    """Identify the parameters of this effect too; may be repeated."""
    hold_out_every: int = HELD_OUT_EVERY
    """Hold out the last of every so many blocks; 0: none."""
    motion: MotionName = "auto"
    """How the craft moves within a step: as drones do (continuous), or by a simulator's step; auto: what the
    log shows."""

    def run(self) -> None:
        """Fit the model and write it."""
        check_model_name(self.out)  # before the work
        fixed = fixed_values(self.fix)
        start = nominal_parameters() if self.start is None else load_model(self.start)
        log = load_log(self.log)
        what_is_fitted(log, start, fixed, self.effect, self.hold_out_every)  # refuses before the work
        start = start._replace(motion=motion_of(log, start) if self.motion == "auto" else Motion(self.motion))
        found = fit(log, start, fixed, self.effect, self.hold_out_every, ProgressBar("rounds"))
        provenance = found.provenance()
        provenance["started_from"] = "nominal parameters" if self.start is None else Path(self.start).name
        provenance["fixed"] = fixed
        save_model(self.out, found.model, provenance)
        print(f"motion: {start.motion.value}")
        print(found.describe())
        print_written([self.out])


@dataclass(frozen=True)
class Validate:
    """Judge a model on flight that it was not fitted to."""

    model: Positional[Path]
    """The model, .json."""
    log: Positional[Path]
    """The flight log."""
    out: Path
    """The folder of the report."""

    def run(self) -> None:
        """Validate the model and write the report."""
        model = load_model(self.model)
        log = load_log(self.log)
        check_plausible(log)
        rows, note = judged_rows(self.model, log)
        found = validate(model, log, rows)
        found = found._replace(notes=(note, *found.notes))
        written = write_validation(self.out, found, self.model.name, log)
        print(text_of(found, self.model.name, log))
        print_written(written)


@dataclass(frozen=True)
class Diagnose:
    """Name what a model gets wrong about flights, and write a report and the extended model."""

    logs: Annotated[Paths, arg(metavar="LOG [LOG ...]", help_behavior_hint="(at least one)")]
    """Flight logs to learn from."""
    out: Path
    """The folder of the report."""
    model: OptionalPath = None
    """The model to diagnose, .json; default: the nominal model."""
    hold_out: Annotated[tuple[Path, ...], arg(metavar="LOG [LOG ...]", help_behavior_hint=NO_HINT)] = ()
    """Logs to judge by and not to learn from; default: the last of every four blocks of the others."""
    before: Annotated[tuple[Path, ...], arg(metavar="LOG [LOG ...]", help_behavior_hint=NO_HINT)] = ()
    """Logs of the craft as the model knows it: causes are then only what has changed since."""
    motion: MotionName = "auto"
    """How the craft moves within a step: as drones do (continuous), or by a simulator's step; auto: what the
    logs show."""

    def run(self) -> None:
        """Diagnose the model; write the report, the extended model and a recording."""
        if not self.logs:
            raise ValueError("LOG: found none, expected at least one flight log")
        train, test = [load_log(path) for path in self.logs], [load_log(path) for path in self.hold_out]
        logs, before = [*train, *test], [load_log(path) for path in self.before]
        for one in (*logs, *before):
            check_plausible(one)
        log = joined(logs)
        held_out = np.arange(len(log)) >= sum(map(len, train)) if test else None
        model = None if self.model is None else load_model(self.model)
        motion = None if self.motion == "auto" else Motion(self.motion)
        rest = (model, held_out, ProgressBar("stages"), motion)
        found = diagnose_change(logs, before, *rest) if before else diagnose(logs, *rest)
        written = write_diagnosis(self.out, found, log)
        print(text_of_diagnosis(found))
        recording = self.out / RECORDING_NAME
        models = {"nominal": found.nominal, "extended": found.extended}
        reason = write_flight_recording(recording, log, models, traces_of(found, log))
        print_written([*written, *[recording] * (not reason)])
        if reason:
            print(f"{recording}: left out: {reason}")


@dataclass(frozen=True)
class Plan:
    """Write a script of flights that settle what a log could not show."""

    diagnosis: Positional[Path]
    """The diagnosis, diagnosis.json."""
    out: Path
    """The script, .npz, for `collect --script`."""
    model: OptionalPath = None
    """The model whose hovering thrust the flights start with, .json; default: the nominal model."""
    seed: int = 0
    """Seed of the flights."""

    def run(self) -> None:
        """Plan the flights, write their script and print what they are for."""
        check_script_name(self.out)
        model = nominal_parameters() if self.model is None else load_model(self.model)
        found = next_flight(self.diagnosis, model, self.seed)
        save_script(self.out, found.script)
        print(found.describe())
        print_written([self.out])


Command = (
    Annotated[Collect, subcommand("collect")]
    | Annotated[Import, subcommand("import")]
    | Annotated[Fit, subcommand("fit")]
    | Annotated[Validate, subcommand("validate")]
    | Annotated[Diagnose, subcommand("diagnose")]
    | Annotated[Plan, subcommand("plan")]
)


def check_model_name(path: Path) -> None:
    """Raise ModelFileError for a model file that is not .json, lest a log is overwritten."""
    if path.suffix != ".json":
        raise ModelFileError(f"{path}: found suffix {path.suffix!r}, expected .json")


def fixed_values(pairs: Sequence[str]) -> dict[str, float]:
    """Return NAME=VALUE pairs as a dictionary; raises ValueError for a missing name or number."""
    try:
        return {name.strip(): float(value) for name, value in (pair.split("=") for pair in pairs)}
    except ValueError as error:
        raise ValueError(f"--fix {' '.join(pairs)}: expected NAME=VALUE, as in tau_yaw=0.05") from error


def judged_rows(model_path: Path, log: FlightLog) -> tuple[np.ndarray | None, str]:
    """Return the rows of a log that a model was not fitted to, (num_rows,) bool, None for all, and a note.

    Raises ModelFileError for a split that cannot be read, or a model fitted to the whole log.
    """
    provenance = load_provenance(model_path)
    data, split = provenance.get("data"), provenance.get("split")
    if not isinstance(data, dict) or data.get("sha256") != log.sha256:  # fitted to another log
        return None, f"all rows are judged: {model_path.name} was not fitted to {Path(log.source).name}"
    every = split.get("held_out_every") if isinstance(split, dict) else None
    if not isinstance(every, int) or every < 2:
        hint = (
            "fitted to the whole log; validate it on another log" if every == 0 else "expected 0, 2, 3, ..."
        )
        raise ModelFileError(f"{model_path}: split: held_out_every: found {every!r}, {hint}")
    return held_out_rows(log, every), f"held-out part: the last of every {every} blocks"


def print_written(paths: Sequence[Path]) -> None:
    """Print which files were written."""
    print(f"written: {', '.join(map(str, paths))}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; what it refuses ends with one line and exit status 2."""
    command = tyro.cli(Command, prog=PROG, description=__doc__.partition("\n")[0], args=arguments)
    try:
        command.run()
    except (ValueError, OSError) as error:
        print(f"{PROG}: error: {error}", file=sys.stderr)
        raise SystemExit(2) from error


if __name__ == "__main__":
    main()
