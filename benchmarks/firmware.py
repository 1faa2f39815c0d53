"""How well changes of real firmware and its body are named, given the log and the model of before.

``python -m benchmarks.firmware [--matched 2] [--single 4] [--pairs 8] [--champion 256]`` flies
Betaflight (docs/firmware.md), makes a model of a nominal set-up from its log, changes a setting or
the body, and shows ``diagnose_change`` the model and the logs before and after. It appends a line
each to docs/results/firmware.jsonl, and writes tables of the last commit's lines between the marks
of docs/results/firmware.md.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import asdict

from baselines.purejaxrl_ppo import load_checkpoint
from benchmarks import report
from benchmarks.champion import CHAMPION
from benchmarks.report import Line
from firmware import Betaflight, Body
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import BY_NAME
from flytrack_env.files import write_atomically
from flytrack_env.state import POSITION
from flytrack_loop.stages import measure_gap
from flytrack_sysid import Diagnosis, FlightLog, collect, diagnose, diagnose_change
from flytrack_sysid.diagnosis import Cause
from flytrack_sysid.excitation import script as excitation_script
from flytrack_sysid.inference.score_test import Candidate
from flytrack_sysid.manoeuvres import flights_of, hover_action
from flytrack_sysid.script_file import build_script

LINES, PAGE = report.RESULTS / "firmware.jsonl", report.RESULTS / "firmware.md"
MARKS = "<!-- benchmarks.firmware -->", "<!-- end -->"
ROWS = ("matched", "single", "pair")
SEED = 35  # no rule was made on it
PLAIN = {"anti_gravity_gain": 0, "rc_smoothing": "OFF", "f_roll": 0, "f_pitch": 0, "f_yaw": 0}
# Straight sticks but for "curved", the rates that Betaflight comes with.
OWN_RATES = {
    f"{axis}_{name}": value
    for axis in ("roll", "pitch", "yaw")
    for name, value in (("rc_rate", 7), ("srate", 67))
}
SETUPS: dict[str, Mapping[str, Any]] = {"stock": {}, "plain": PLAIN, "curved": OWN_RATES}
GENTLE = ("headings", "speeds", "thrust_steps")
FLIGHTS, SECOND = 24, 100  # rows
NOTABLE = 0.02  # of the way flown in a second: a change that moves the craft less does not matter
LOOP_GROUPS = BY_NAME["betaflight_loop"].search.groups[:7]
GAINS, LATE, CENTER, *MOTORS = (f"betaflight_loop.{group[0]}" for group in LOOP_GROUPS)
RESPONSE = ("second_order_rates", "rate_slew_limit", "command_delay", GAINS, LATE)
THRUST = ("thrust_curve", "thrust_scale")
Rng = np.random.Generator


class Kind(NamedTuple):
    """Something that changes: how it is drawn, its names, and others that fly alike.

    Attributes:
        draw: settings and fields of the body.
    """

    draw: Callable[[Rng], dict[str, Any]]
    names: tuple[str, ...]
    alike: tuple[str, ...] = ()


def _both(rng: Rng, factor: tuple[float, float], **stock: float) -> dict[str, Any]:
    """Return settings of roll and pitch, all times one factor."""
    times = rng.uniform(*factor)
    return {
        f"{name}_{axis}": round(times * value)
        for name, value in stock.items()
        for axis in ("roll", "pitch")
    }


def _rates(rng: Rng, center: tuple[float, float], full: tuple[float, float]) -> dict[str, Any]:
    most = round(rng.uniform(*full))
    least = round(rng.uniform(*center) * most)
    return {"roll_rc_rate": least, "roll_srate": most, "pitch_rc_rate": least, "pitch_srate": most}


KINDS = {
    "expo": Kind(lambda rng: _rates(rng, (0.35, 0.65), (62, 62)), ("rate_expo",)),
    "rates": Kind(lambda rng: _rates(rng, (1, 1), (70, 85)), ("rate_scale",), ("gyro_scale",)),
    "P and D term": Kind(lambda rng: _both(rng, (0.4, 0.65), p=45, d=30), (GAINS,), RESPONSE),
    "filters": Kind(
        # A dynamic filter would take the static one's place.
        lambda rng: {"gyro_lpf1_dyn_min_hz": 0, "gyro_lpf1_static_hz": int(rng.uniform(25, 50))},
        (LATE,),
        RESPONSE,
    ),
    "thrust linearisation": Kind(lambda rng: {"thrust_linear": int(rng.uniform(60, 120))}, THRUST),
    "motor output limit": Kind(
        lambda rng: {"motor_output_limit": int(rng.uniform(70, 88))}, THRUST
    ),
    "a weak motor": Kind(
        lambda rng: {"health": tuple(rng.permutation([rng.uniform(0.7, 0.85), 1, 1, 1]).tolist())},
        (),  # the motor that is drawn: see ``names_of``
        ("motor_imbalance", *MOTORS, *THRUST),
    ),
    "drag": Kind(
        lambda rng: {"linear_drag": (*[float(rng.uniform(0.15, 0.4))] * 2, 0.1)},
        ("linear_drag",),
        ("rotor_drag", "quadratic_drag"),
    ),
    "sag": Kind(
        lambda rng: {"resistance_ohm": float(rng.uniform(0.012, 0.03))}, ("voltage_sag",), THRUST
    ),
    "mass": Kind(lambda rng: {"mass_kg": float(rng.uniform(1.1, 1.35))}, THRUST),
    "thrust curve": Kind(lambda rng: {"linear": float(rng.uniform(0.3, 0.7))}, THRUST),
    "bent thrust": Kind(
        lambda rng: {
            "thrust_tilt_rad": (float(rng.choice([-1, 1]) * rng.uniform(0.04, 0.08)), 0.0)
        },
        ("thrust_tilt",),
    ),
    "centre of mass": Kind(
        lambda rng: {"center_of_mass_m": (float(rng.uniform(0.01, 0.02)), 0.0)},
        (CENTER,),
        ("motor_imbalance", *MOTORS, *THRUST),
    ),
}


class Trial(NamedTuple):
    """One flown set-up.

    It has a row (matched, single or pair), a nominal set-up, an excitation, changes, a number and
    the benchmark's seed.
    """

    row: str
    setup: str
    flown: str
    kinds: tuple[str, ...]
    number: int
    seed: int


class Known(NamedTuple):
    """What a team knows of its nominal set-up: log, model, and where the sticks take it (m)."""

    log: FlightLog
    model: Any
    places_m: np.ndarray


def fly(settings: Mapping[str, Any], body: Body, flown: str, seed: int) -> tuple[FlightLog, Any]:
    """Return a noisy log of a minute, and the model to fit from."""
    with Betaflight(settings, body) as plant:
        model = plant.nominal_model()
        script = None
        if flown == "gentle":
            script = build_script(flights_of(GENTLE, hover_action(model), seed))
        return collect(plant, 1.0, seed, 1.0, script=script), model


@cache
def know(setup: str, flown: str, seed: int) -> Known:
    """Return what is known of a nominal set-up after it was flown and diagnosed."""
    log, start = fly(SETUPS[setup], Body(), flown, seed)
    model = diagnose(log, start, motion=start.motion).extended
    return Known(log, model, places(SETUPS[setup], Body(), seed))


def places(settings: Mapping[str, Any], body: Body, seed: int) -> np.ndarray:
    """Return displacements after a second of ``collect``'s excitation, (flights, 3), m."""
    hover = hover_action(nominal_parameters())
    flights = build_script(excitation_script(FLIGHTS, hover, np.random.default_rng(seed)))
    with Betaflight(settings, body) as plant:
        states = plant.fly(flights.starts, flights.commands[:, :SECOND])
    return states[:, -1, POSITION] - flights.starts[:, POSITION]


def grade_trial(trial: Trial) -> dict[str, Any]:
    """Fly a changed set-up and return how its diagnosis did."""
    seed, known = trial.seed, know(trial.setup, trial.flown, trial.seed)
    numbers = [list(KINDS).index(kind) for kind in trial.kinds]
    rng = np.random.default_rng([seed, trial.number, *numbers])
    changes = dict(SETUPS[trial.setup])
    for kind in trial.kinds:
        changes |= KINDS[kind].draw(rng)
    settings, fields = of_settings_and_body(changes)
    body = Body(**fields)
    log, _ = fly(settings, body, trial.flown, seed + 1000 + trial.number)
    apart = np.linalg.norm(places(settings, body, seed) - known.places_m, axis=1)
    started = time.process_time()
    diagnosis = diagnose_change(log, known.log, known.model, motion=known.model.motion)
    named: dict[str, dict[str, list[float]]] = {}
    for cause in diagnosis.causes:
        named |= values_by_name(cause)
    return {
        "settings": settings,
        "body": fields,
        "apart": round(float(np.median(apart / np.linalg.norm(known.places_m, axis=1))), 4),
        "verdict": diagnosis.verdict,
        "found": named,
        "negligible": [cause.effect for cause in diagnosis.negligible],
        **grade([names_of(kind, body) for kind in trial.kinds], [*named]),
        "error": error_ratios(diagnosis),
        "cpu_s": round(time.process_time() - started, 1),
    }


def of_settings_and_body(changes: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return those changes that are settings of the firmware, and those that are of the body."""
    nominal = asdict(Body())
    return (
        {name: value for name, value in changes.items() if name not in nominal},
        {name: value for name, value in changes.items() if name in nominal},
    )


def values_by_name(cause: Cause) -> dict[str, dict[str, list[float]]]:
    """Return a cause's parameters, each with its value and interval, by name.

    Those of the loop are grouped by the settings that change together, under the first of them.
    """
    values = {name: [x.value, *x.ci95] for name, x in cause.parameters.items()}
    if cause.effect != "betaflight_loop":
        return {cause.effect: values}
    values = {f"{cause.effect}.{name}": value for name, value in values.items()}
    groups = Candidate(cause.effect, tuple(values)).groups
    return {group[0]: {field: values[field] for field in group} for group in groups}


def names_of(kind: str, body: Body) -> tuple[set[str], set[str]]:
    """Return the names of a change, and those with others that fly alike."""
    exact = set(KINDS[kind].names) or {MOTORS[int(np.argmin(body.health))]}
    return exact, exact | set(KINDS[kind].alike)


def grade(changes: Sequence[tuple[set[str], set[str]]], names: list[str]) -> dict[str, bool]:
    """Return whether the names are exact, exact up to their classes, and whether one is false.

    Args:
        changes: as of ``names_of``. Each has at least one of its names, and each name belongs to a
            change.
    """
    named = set(names)
    exact, equivalent = zip(*changes, strict=True) if changes else ((), ())

    def fits(classes: Sequence[set[str]]) -> bool:
        return all(named & one for one in classes) and named <= set().union(*classes)

    return {
        "is_exact": fits(exact),
        "is_in_class": fits(equivalent),
        "is_false": not named <= set().union(*equivalent),
    }


def error_ratios(found: Diagnosis) -> dict[str, float]:
    """Return held-out position errors, extended over refitted model, by horizon."""
    errors = {name: one.get("position_m", {}) for name, one in found.prediction.errors.items()}
    base = errors.get("refitted_base", {})
    return {
        horizon: round(errors["extended"][horizon] / size, 4)
        for horizon, size in base.items()
        if size
    }


def figures(by_row: Mapping[str, list[Line]]) -> list[report.Figure]:
    """Return the figures of graded set-ups."""
    is_named = [bool(line["found"]) for line in by_row["matched"]]
    result = [report.share_figure("matched set-up: any name", "", is_named)]
    for row in ROWS[1:]:
        notable = [line for line in by_row[row] if line["apart"] >= NOTABLE]
        for flag in ("is_exact", "is_in_class", "is_false"):
            name = f"{row} that matters: {flag[3:].replace('_', ' ')}"
            result.append(report.share_figure(name, "", [line[flag] for line in notable]))
    changed = [*by_row["single"], *by_row["pair"]]
    errors = [line["error"] for line in changed if line["found"] and line["error"]]
    largest = [max(ratios.values()) for ratios in errors]
    after_1_s = [ratios["1"] for ratios in errors if "1" in ratios]
    seconds = [line["cpu_s"] for lines in by_row.values() for line in lines]
    ratio = "extended over refitted"
    if errors:
        result += [
            report.Figure(
                f"{ratio}: largest at any horizon", "", f"{max(largest):.3f}", len(largest)
            ),
            report.Figure(
                f"{ratio} after 1 s: median", "", f"{np.median(after_1_s):.3f}", len(after_1_s)
            ),
        ]
    median_s = f"{np.median(seconds):.0f}"
    return [*result, report.Figure("CPU s of a diagnosis: median", "", median_s, len(seconds))]


def kinds_table(singles: list[Line]) -> str:
    """Return how each kind of change is named."""
    rows = []
    for kind, about in KINDS.items():
        lines = report.select(singles, kinds=[kind])
        named = sorted({" + ".join(line["found"]) or "nothing" for line in lines})
        sizes = report.spread([100.0 * line["apart"] for line in lines], ".1f") if lines else ""
        is_right = report.share([line["is_in_class"] for line in lines])
        names = ", ".join(about.names) or "that motor"
        rows.append([kind, sizes, names, *is_right, "; ".join(named)])
    header = "changed | flies apart, % | its names | in class | n | what was named"
    return report.table(header, rows)


def tables(lines: list[Line]) -> str:
    """Return the results as tables in Markdown."""
    by_row = {row: report.select(lines, row=row) for row in ROWS}
    champions = [
        f"The shipped champion, blind: {line['success']:.1%} of {line['episodes']} starts finish "
        f"3 laps; {line['gates']:.1f} of 24 gates in the mean."
        for line in report.select(lines, row="champion")
    ]
    parts = [report.figures_table(figures(by_row)), kinds_table(by_row["single"]), *champions]
    return "\n\n".join(parts)


def main(
    matched: int = 2, single: int = 4, pairs: int = 8, champion: int = 256, seed: int = SEED
) -> None:
    """Fly, diagnose, and write the lines and the tables.

    Args:
        matched: flights of each set-up and excitation.
        single: draws of each kind of change.
        pairs: set-ups with two changes.
        champion: starts of it, 0 for none.
    """
    trials = [
        Trial("matched", setup, flown, (), number, seed)
        for setup, flown, number in product(SETUPS, ("full", "gentle"), range(matched))
    ]
    changes = [(kind,) for kind in KINDS for _ in range(single)]
    kinds = [kind for kind in KINDS if kind != "expo"]  # it is made of the settings of the rates
    rng = np.random.default_rng([seed, 7])
    changes += [tuple(rng.choice(kinds, 2, replace=False).tolist()) for _ in range(pairs)]
    for number, change in enumerate(changes):
        trials.append(Trial(ROWS[len(change)], "stock", "full", change, 10 + number, seed))
    if champion:
        commit = report.commit_of_checkout()
        with Betaflight() as plant:
            raced = measure_gap(load_checkpoint(CHAMPION), plant, seed, champion).plant
        line = {"commit": commit, "row": "champion", "episodes": champion, **raced._asdict()}
        report.append_line(LINES, line)
    report.record_trials(LINES, trials, grade_trial)
    write_tables(seed)


def write_tables(seed: int) -> None:
    """Write the tables of the last commit's lines into the page."""
    lines = report.lines_of_commit(LINES)
    record = report.provenance("scipy") | {"commit": lines[-1]["commit"]}
    results = tables(report.good_lines(lines))
    before, _, after = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    after = after.partition(MARKS[1])[2]
    text = f"{results}\n\nSeed {seed}. {report.provenance_line(record)}"
    write_atomically(PAGE, f"{before}{MARKS[0]}\n\n{text}\n\n{MARKS[1]}{after}".encode())


if __name__ == "__main__":
    report.command(main)
