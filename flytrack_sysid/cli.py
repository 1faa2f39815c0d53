"""The command ``flytrack-sysid``: collect, import, fit, validate, diagnose, plan; skins over functions."""

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env import blackbox, load_model, load_provenance, save_model
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.model_file import ModelFileError
from flytrack_env.plants import Plant
from flytrack_sysid.collect import CollectError, collect
from flytrack_sysid.diagnosis import diagnose, joined, write_diagnosis
from flytrack_sysid.diagnosis import text_of as text_of_diagnosis
from flytrack_sysid.diagnosis.next_flight import next_flight
from flytrack_sysid.diagnosis.report import traces_of
from flytrack_sysid.fit import fit
from flytrack_sysid.flight_recording import write_flight_recording
from flytrack_sysid.importing import FORMATS, import_log
from flytrack_sysid.log import FlightLog
from flytrack_sysid.log_file import check_name, describe, load_log, save_log
from flytrack_sysid.plausibility import check_plausible
from flytrack_sysid.progress import ProgressBar
from flytrack_sysid.script_file import check_name as check_script_name
from flytrack_sysid.script_file import load_script, save_script
from flytrack_sysid.split import HELD_OUT_EVERY, held_out_rows
from flytrack_sysid.validate import validate
from flytrack_sysid.validation_report import text_of, write_validation

RECORDING_NAME = "flight.rrd"


def load_plant(where: str) -> Any:
    """Return the plant in an artifact, or the object that ``module:name`` names.

    Importing a module runs it, as importing does; the working directory is searched first.

    Raises:
        BlackBoxError: an artifact that cannot be used.
        CollectError: a module or name that cannot be imported.
    """
    module, colon, name = where.partition(":")
    if not colon or Path(where).exists():
        return blackbox.load(where)
    sys.path.insert(0, str(Path.cwd()))  # and it stays: the module may import later
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except Exception as error:  # whatever a user's module raises
        said = f"{type(error).__name__}: {error}"
        raise CollectError(f"--black-box {where}: cannot be imported: {said}") from error
    if not isinstance(found, Plant) and not callable(found):
        raise CollectError(
            f"--black-box {where}: found {type(found).__name__}, expected step(x, u) or a plant"
        )
    return found


def run_collect(arguments: argparse.Namespace) -> None:
    """Fly the excitation, or a script, and write the log."""
    check_name(arguments.out)
    script = None if arguments.script is None else load_script(arguments.script)
    plant = load_plant(arguments.black_box)
    log = collect(plant, arguments.minutes, arguments.seed, arguments.noise, ProgressBar("flights"), script)
    save_log(arguments.out, log)
    print(describe(load_log(arguments.out)))


def run_import(arguments: argparse.Namespace) -> None:
    """Read measured flights and write them as a log, with what the log cannot hold beside it."""
    check_name(arguments.out)
    if arguments.model_out is not None:
        check_model_name(arguments.model_out)
    found = import_log(arguments.files, arguments.format, arguments.map, not arguments.keep_clocks)
    written = [arguments.out, arguments.out.with_suffix(".import.json")]
    model = None if arguments.model_out is None else found.nominal_model()  # before anything is written
    save_log(arguments.out, found.log)
    found.save_details(written[1])
    if model is not None:
        about = {
            "nominal": "generic quadcopter, scaled to the craft",
            "imported_from": [Path(source).name for source in found.sources],
        }
        save_model(arguments.model_out, model, about)
        written.append(arguments.model_out)
    print(found.describe())
    print(f"written: {', '.join(str(path) for path in written)}")


def check_model_name(path: Path) -> None:
    """Raise ModelFileError for a model's file that is not .json, lest a log is overwritten."""
    if path.suffix != ".json":
        raise ModelFileError(f"{path}: found suffix {path.suffix!r}, expected .json")


def fixed_values(pairs: Sequence[str]) -> dict[str, float]:
    """Return NAME=VALUE pairs as a dictionary.

    Raises:
        ValueError: no name, or no number.
    """
    values = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        try:
            values[name.strip()] = float(text)
        except ValueError as error:
            raise ValueError(
                f"--fix {pair}: expected NAME=VALUE with a number, as in tau_yaw=0.05"
            ) from error
    return values


def run_fit(arguments: argparse.Namespace) -> None:
    """Identify a model and write it."""
    check_model_name(arguments.out)  # before the work
    fixed = fixed_values(arguments.fix)
    start = None if arguments.start is None else load_model(arguments.start)
    log = load_log(arguments.log)
    found = fit(log, start, fixed, arguments.effect, arguments.hold_out_every, ProgressBar("rounds"))
    provenance = found.provenance()
    provenance["started_from"] = "nominal parameters" if start is None else Path(arguments.start).name
    provenance["fixed"] = fixed
    save_model(arguments.out, found.model, provenance)
    print(found.describe())
    print(f"written: {arguments.out}")


def judged_rows(model_path: str | Path, log: FlightLog) -> tuple[Any, str]:
    """Return the rows of a log that a model was not fitted to, (num_rows,) bool, and a sentence on them.

    All rows of a log that the fit did not see, as its file's hash tells.

    Raises:
        ModelFileError: a model file whose split cannot be read.
    """
    provenance = load_provenance(model_path)
    data, split = provenance.get("data"), provenance.get("split")
    if not isinstance(data, dict) or data.get("sha256") != log.sha256:
        names = Path(log.source).name, Path(model_path).name
        return None, f"all rows are judged: {names[0]} is not what {names[1]} was fitted to"
    every = split.get("held_out_every") if isinstance(split, dict) else None
    if not isinstance(every, int) or isinstance(every, bool) or every < 0 or every == 1:
        raise ModelFileError(f"{model_path}: split: held_out_every: found {every!r}, expected 0, 2, 3, ...")
    if every == 0:
        raise ModelFileError(f"{model_path}: fitted to all of {log.source}; validate it on another log")
    return held_out_rows(log, every), f"held-out part: the last of every {every} blocks"


def run_validate(arguments: argparse.Namespace) -> None:
    """Judge a model on what it was not fitted to, and write the report."""
    model = load_model(arguments.model)
    log = load_log(arguments.log)
    check_plausible(log)
    rows, which = judged_rows(arguments.model, log)
    found = validate(model, log, rows)
    found = found._replace(notes=(which, *found.notes))
    written = write_validation(arguments.out, found, Path(arguments.model).name, log)
    print(text_of(found, Path(arguments.model).name, log))
    print(f"written: {', '.join(str(path) for path in written)}")


def run_diagnose(arguments: argparse.Namespace) -> None:
    """Say what a model gets wrong about flights, and write the report and the extended model."""
    learnt, judged = ([load_log(path) for path in paths] for paths in (arguments.logs, arguments.hold_out))
    logs = [*learnt, *judged]
    for one in logs:
        check_plausible(one)
    log = joined(logs)
    count = sum(len(one) for one in learnt)
    held_out = np.arange(len(log)) >= count if judged else None
    model = None if arguments.model is None else load_model(arguments.model)
    found = diagnose(logs, model, held_out, ProgressBar("stages"))
    written = write_diagnosis(arguments.out, found, log)
    print(text_of_diagnosis(found))
    recording = arguments.out / RECORDING_NAME
    models = {"nominal": found.nominal, "extended": found.extended}
    reason = write_flight_recording(recording, log, models, traces_of(found, log))
    print(f"written: {', '.join(str(path) for path in [*written, *[recording] * (not reason)])}")
    if reason:
        print(f"{recording}: left out: {reason}")


def run_plan(arguments: argparse.Namespace) -> None:
    """Write the script of what a diagnosis asks to fly, and say why."""
    check_script_name(arguments.out)
    model = nominal_parameters() if arguments.model is None else load_model(arguments.model)
    found = next_flight(arguments.diagnosis, model, arguments.seed)
    save_script(arguments.out, found.script)
    print(found.describe())
    print(f"written: {arguments.out}")


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    parser = argparse.ArgumentParser(prog="flytrack-sysid", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    one = commands.add_parser("collect", help="fly an excitation on a plant and write a flight log")
    one.add_argument("--black-box", required=True, help="an acro_step.bin, or module:step with step(x, u)")
    one.add_argument("--out", type=Path, required=True, help="the log, .npz or .csv")
    either = one.add_mutually_exclusive_group()
    either.add_argument("--minutes", type=float, default=2.0, help="of excitation; default: %(default)s")
    either.add_argument("--script", type=Path, help="fly this instead, .npz, as from plan")
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--noise", type=float, default=0.0, help="0: the state itself; 1: common sensors")
    one.set_defaults(run=run_collect)

    one = commands.add_parser("import", help="turn logs of real flights into a flight log")
    one.add_argument("files", type=Path, nargs="+", metavar="FILE")
    one.add_argument("--format", required=True, choices=FORMATS)
    one.add_argument("--map", metavar="MAPPING", help="a mapping file, .toml, or the name of a shipped one")
    one.add_argument("--out", type=Path, required=True, help="the log, .npz or .csv")
    one.add_argument("--model-out", type=Path, help="also write the nominal model of this craft, .json")
    one.add_argument("--keep-clocks", action="store_true", help="report clock offsets, correct none")
    one.set_defaults(run=run_import)

    one = commands.add_parser("fit", help="identify a model from a flight log")
    one.add_argument("log", type=Path)
    one.add_argument("--out", type=Path, required=True, help="the model, .json")
    one.add_argument("--fix", action="append", default=[], metavar="NAME=VALUE", help="hold a parameter")
    one.add_argument("--from", dest="start", metavar="MODEL", help="start from this model's values")
    one.add_argument("--effect", action="append", default=[], metavar="NAME", help="identify it too")
    every = one.add_argument("--hold-out-every", type=int, default=HELD_OUT_EVERY, metavar="N")
    every.help = "hold out the last of every N blocks, none if 0; default: %(default)s"
    one.set_defaults(run=run_fit)

    one = commands.add_parser("validate", help="judge a model on held-out flight")
    one.add_argument("model", type=Path)
    one.add_argument("log", type=Path)
    one.add_argument("--out", type=Path, required=True, help="a folder for the report")
    one.set_defaults(run=run_validate)

    one = commands.add_parser("diagnose", help="name what a model gets wrong about flights")
    one.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    one.add_argument("--model", help="what is held against the logs, .json; default: the nominal model")
    hold_out = one.add_argument("--hold-out", type=Path, nargs="+", default=[], metavar="LOG")
    hold_out.help = "logs to judge by and not to learn from; default: the last of every four blocks"
    one.add_argument("--out", type=Path, required=True, help="a folder for the report")
    one.set_defaults(run=run_diagnose)

    one = commands.add_parser("plan", help="write a script of flights that settle what a log did not show")
    one.add_argument("diagnosis", type=Path, help="diagnosis.json")
    one.add_argument("--out", type=Path, required=True, help="the script, .npz, for collect --script")
    one.add_argument("--model", type=Path, help="whose hovering thrust to begin with; default: nominal")
    one.add_argument("--seed", type=int, default=0)
    one.set_defaults(run=run_plan)
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; what cannot be used is said in one line, with exit status 2."""
    parser = make_parser()
    parsed = parser.parse_args(arguments)
    try:
        parsed.run(parsed)
    except (ValueError, OSError) as error:
        parser.exit(2, f"flytrack-sysid: error: {error}\n")


if __name__ == "__main__":
    main()
