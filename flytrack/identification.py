"""The functions that run ``flytrack``'s commands ``collect`` to ``plan``, and ``import``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flytrack.flags import Check, Collect, Diagnose, Fit, Import, Plan, Validate
from flytrack_env import Motion, blackbox, load_model, load_provenance, save_model
from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.extras import import_object
from flytrack_env.files import write_atomically
from flytrack_env.model_file import ModelFileError
from flytrack_env.plants import Plant
from flytrack_env.progress import ProgressBar, waiting
from flytrack_sysid.check import Check as CheckOfLog
from flytrack_sysid.check import check_environment, check_log, check_plant, write_check
from flytrack_sysid.check import text_of as text_of_check
from flytrack_sysid.check.fix import fix_mapping, text_of_fix
from flytrack_sysid.check.plant import load_layout
from flytrack_sysid.collect import CollectError, collect
from flytrack_sysid.diagnosis import (
    NOT_CHECKED,
    diagnose,
    diagnose_change,
    first_look,
    joined,
    motion_of,
    write_diagnosis,
)
from flytrack_sysid.diagnosis import text_of as text_of_diagnosis
from flytrack_sysid.diagnosis.identifiability import next_flight
from flytrack_sysid.diagnosis.report import collect_traces
from flytrack_sysid.fit import fit, what_is_fitted
from flytrack_sysid.fleet import diagnose_fleet, expand, find_flights
from flytrack_sysid.fleet_page import format_page, write_fleet
from flytrack_sysid.flight_recording import write_flight_recording
from flytrack_sysid.importing import import_log
from flytrack_sysid.importing.mapping import SHIPPED
from flytrack_sysid.log import FlightLog
from flytrack_sysid.log_file import check_name, describe, load_log, save_log
from flytrack_sysid.log_motion import required_motion
from flytrack_sysid.plausibility import check_plausible
from flytrack_sysid.script_file import check_name as check_script_name
from flytrack_sysid.script_file import load_script, save_script
from flytrack_sysid.split import held_out_rows
from flytrack_sysid.validate import validate
from flytrack_sysid.validation_report import text_of, write_validation

RECORDING_NAME = "flight.rrd"
PLANT_MINUTES = 1.0  # of excitation, to check a plant


def load_plant(where: str) -> Any:
    """Return the plant in an artifact, or the object that ``module:name`` names."""
    if ":" not in where or Path(where).exists():
        return blackbox.load(where)
    found = import_object(where, "--black-box", CollectError)
    if not callable(found) and not isinstance(found, Plant):
        raise CollectError(
            f"--black-box {where}: found {type(found).__name__}, expected step(x, u) or a plant"
        )
    return found


def run_collect(flags: Collect) -> None:
    """Fly, and write the log."""
    check_name(flags.out)
    script = None if flags.script is None else load_script(flags.script)
    plant = load_plant(flags.black_box or str(blackbox.SHIPPED))
    log = collect(plant, flags.minutes, flags.seed, flags.noise, ProgressBar("flights"), script)
    save_log(flags.out, log)
    print(f"flown: {flags.black_box or 'the shipped black box'}")
    print(describe(load_log(flags.out)))
    print_written([flags.out])


def run_import(flags: Import) -> None:
    """Read the logs, and write them as one with its details beside it."""
    check_name(flags.out)
    if flags.model_out is not None:
        check_model_name(flags.model_out)
    with waiting(f"read {len(flags.files)} file{'s' * (len(flags.files) > 1)}"):
        found = import_log(flags.files, flags.format, flags.map, not flags.keep_clocks)
    written = [flags.out, flags.out.with_suffix(".import.json")]
    model = None if flags.model_out is None else found.nominal_model()  # before anything is written
    save_log(flags.out, found.log)
    found.save_details(written[1])
    if flags.model_out and model:
        provenance = {
            "nominal": "generic quadcopter, scaled to the craft",
            "imported_from": [Path(source).name for source in found.sources],
        }
        save_model(flags.model_out, model, provenance)
        written.append(flags.model_out)
    print(found.describe())
    print_written(written)


def run_check(flags: Check) -> int:
    """Check a log or a plant; the exit status is 1 if something contradicts."""
    if (flags.log is None) == (flags.plant is None):
        raise ValueError("LOG or --plant: expected one of the two")
    if flags.fix is not None and flags.map is None:
        raise ValueError("--fix: found without --map, expected the mapping to correct")
    model = None if flags.model is None else load_model(flags.model)
    with waiting("check"):
        if flags.plant is not None:
            found, log = check_of_plant(flags.plant, flags.layout), None
        else:
            assert flags.log is not None
            log = (
                load_log(flags.log)
                if flags.map is None
                else import_log(flags.log, flags.format, flags.map).log
            )
            found = check_log(log, model)
    print(text_of_check(found))
    if flags.out is not None:
        print_written(write_check(flags.out, found, found.corrected if log is None else log))
    if flags.fix is not None and any(found.explanations):
        write_fix(str(flags.map), flags.fix, found)
    return int(found.contradicts)


def check_of_plant(where: str, layout: Path | None) -> CheckOfLog:
    """Return the check of a plant, a function or an environment that ``where`` names."""
    plant = import_object(where, "--plant", CollectError) if ":" in where else load_plant(where)
    if isinstance(plant, Plant):
        return check_log(collect(plant, PLANT_MINUTES, 0))
    if hasattr(plant, "action_space"):
        if layout is None:
            raise ValueError("--layout: missing, expected what an observation's numbers are")
        return check_environment(plant, load_layout(layout))
    if not callable(plant):
        found = type(plant).__name__
        raise CollectError(f"--plant {where}: found {found}, expected step(x, u) or an environment")
    return check_plant(plant, None if layout is None else load_layout(layout))


def write_fix(mapping: str, out: Path, found: CheckOfLog) -> None:
    """Write the mapping by which a log agrees; what several explanations say is left."""
    certain = [
        change
        for change in found.explanations[0]
        if all(change in one for one in found.explanations)
    ]
    path = Path(mapping) if Path(mapping).exists() else SHIPPED / f"{mapping}.toml"
    fix = fix_mapping(path.read_text(encoding="utf-8"), certain)
    write_atomically(out, fix.text.encode())
    if len(found.explanations) > 1:
        print("left: what only some of the explanations say")
    print(text_of_fix(fix))
    print_written([out])


def run_fit(flags: Fit) -> None:
    """Fit the model and write it."""
    check_model_name(flags.out)  # before the work
    fixed = fixed_values(flags.fix)
    start = nominal_parameters() if flags.start is None else load_model(flags.start)
    log = load_log(flags.log)
    what_is_fitted(log, start, fixed, flags.effect, flags.hold_out_every, accept=flags.accept)
    requested = None if flags.motion == "auto" else Motion(flags.motion)
    told = start.motion
    if required_motion(log, requested) is None:
        with waiting("find how the craft moves within a step"):
            start = start._replace(motion=motion_of(log, start))
    every, bar = flags.hold_out_every, ProgressBar("rounds")
    found = fit(log, start, fixed, flags.effect, every, bar, requested, accept=True)  # checked
    provenance = found.provenance()
    provenance["started_from"] = (
        "nominal parameters" if flags.start is None else Path(flags.start).name
    )
    provenance["fixed"] = fixed
    save_model(flags.out, found.model, provenance)
    is_other = flags.start is not None and start.motion is not told
    print(
        f"motion: {found.model.motion.value}" + f", by the log; --from says {told.value}" * is_other
    )
    print(found.describe())
    print_written([flags.out])


def run_validate(flags: Validate) -> None:
    """Validate the model and write the report."""
    model = load_model(flags.model)
    log = load_log(flags.log)
    rows, note = judged_rows(flags.model, log)
    check_plausible(log, flags.accept, model)
    with waiting("fly the model beside the log"):
        found = validate(model, log, rows)
    found = found._replace(notes=(note, *found.notes))
    written = write_validation(flags.out, found, flags.model.name, log)
    print(text_of(found, flags.model.name, log))
    print_written(written)


def read_logs(
    flags: Diagnose, model: ModelParameters | None
) -> tuple[list[FlightLog], list[FlightLog], np.ndarray | None]:
    """Read and describe the logs of a diagnosis.

    Returns:
        The logs to diagnose, those of earlier flights, and which rows of the former are held out
        (None if none was given for that).
    """
    train, test, before = (
        [load_log(path) for path in paths] for paths in (flags.logs, flags.hold_out, flags.before)
    )
    for one in train + test + before:
        check_plausible(one, flags.accept, model)
        print(describe(one), flush=True)  # what follows takes a while
    rows = np.arange(sum(map(len, train + test)))
    return train + test, before, rows >= sum(map(len, train)) if test else None


def run_diagnose(flags: Diagnose) -> None:
    """Diagnose the model; write the report, the extended model and a recording."""
    if not flags.logs:
        raise ValueError("LOG: found none, expected at least one flight log")
    if flags.fleet:
        run_fleet(flags)
        return
    model = None if flags.model is None else load_model(flags.model)
    motion = None if flags.motion == "auto" else Motion(flags.motion)
    if flags.quick:
        if flags.before:
            raise ValueError("--quick: found beside --before, expected one of the two")
        logs, _, held_out = read_logs(flags, model)
        with waiting("first look"):
            look = first_look(logs, model, held_out, motion)
        print(f"{look.text()}\n{NOT_CHECKED}")
        return
    if flags.out is None:
        raise ValueError("--out: missing, expected a folder for the report, or --quick")
    logs, before, held_out = read_logs(flags, model)
    log = joined(logs)
    bar = ProgressBar("stages")
    if before:
        diagnosis = diagnose_change(logs, before, model, held_out, bar, motion)
    else:
        diagnosis = diagnose(
            logs, model, held_out, bar, motion, lambda look: bar.write(look.text())
        )
    with waiting("draw the report"):
        written = write_diagnosis(flags.out, diagnosis, log)
    print(text_of_diagnosis(diagnosis))
    recording = flags.out / RECORDING_NAME
    models = {"nominal": diagnosis.nominal, "extended": diagnosis.extended}
    reason = write_flight_recording(recording, log, models, collect_traces(diagnosis, log))
    print_written([*written, *[recording] * (not reason)])
    if reason:
        print(f"{recording}: left out: {reason}")


def run_fleet(flags: Diagnose) -> None:
    """Diagnose every log of a fleet that OUT has no result of, and write the fleet's page."""
    if flags.out is None:
        raise ValueError("--out: missing, expected a folder for results and page")
    if flags.quick or flags.hold_out or flags.before or flags.accept or flags.motion != "auto":
        raise ValueError("--fleet: found beside a flag of single logs, expected --model at most")
    for name, value in (("--workers", flags.workers), ("--limit", flags.limit)):
        if not value > 0:
            raise ValueError(f"{name}: found {value:g}, expected more than 0")
    flights = find_flights(expand(flags.logs, flags.out), flags.model, flags.out)
    bars: list[ProgressBar] = []

    def report(done: int, total: int) -> None:
        if total and (not bars or bars[-1].bar.total != total):
            bars.append(ProgressBar("comparisons" if bars else "logs"))
        if total:
            bars[-1](done, total)

    results, changes = diagnose_fleet(
        flights, flags.out, flags.limit, flags.workers, flags.address, report
    )
    written = write_fleet(flags.out, flights, results, changes)
    print(format_page(flights, results, changes))
    print_written(written)


def run_plan(flags: Plan) -> None:
    """Plan the flights, write their script and print what they are for."""
    check_script_name(flags.out)
    model = nominal_parameters() if flags.model is None else load_model(flags.model)
    with waiting("fly every manoeuvre in simulation"):
        found = next_flight(flags.diagnosis, model, flags.seed)
    save_script(flags.out, found.script)
    print(found.describe())
    print_written([flags.out])


def check_model_name(path: Path) -> None:
    """Raise ModelFileError for a model file that is not .json, lest a log is overwritten."""
    if path.suffix != ".json":
        raise ModelFileError(f"{path}: found suffix {path.suffix!r}, expected .json")


def fixed_values(pairs: Sequence[str]) -> dict[str, float]:
    """Return NAME=VALUE pairs as a dictionary; raises ValueError for a missing name or number."""
    try:
        return {name.strip(): float(value) for name, value in (pair.split("=") for pair in pairs)}
    except ValueError as error:
        raise ValueError(
            f"--fix {' '.join(pairs)}: expected NAME=VALUE, as in tau_yaw=0.05"
        ) from error


def judged_rows(model_path: Path, log: FlightLog) -> tuple[np.ndarray | None, str]:
    """Return the rows of a log that a model was not fitted to, and a note.

    The rows are (num_rows,) bool, or None for all.

    Raises ModelFileError for a split that cannot be read, or a model fitted to the whole log.
    """
    provenance = load_provenance(model_path)
    data, split = provenance.get("data"), provenance.get("split")
    if not isinstance(data, dict) or data.get("sha256") != log.sha256:  # fitted to another log
        return (
            None,
            f"all rows are judged: {model_path.name} was not fitted to {Path(log.source).name}",
        )
    every = split.get("held_out_every") if isinstance(split, dict) else None
    if not isinstance(every, int) or every < 2:
        hint = (
            "fitted to the whole log; validate it on another log"
            if every == 0
            else "expected 0, 2, 3, ..."
        )
        raise ModelFileError(f"{model_path}: split: held_out_every: found {every!r}, {hint}")
    return held_out_rows(log, every), f"held-out part: the last of every {every} blocks"


def print_written(paths: Sequence[Path]) -> None:
    """Print which files were written."""
    print(f"written: {', '.join(map(str, paths))}")
