"""How well changes of real firmware and its body are named, given the log and the model of before.

``python -m benchmarks.firmware [--matched 2] [--single 4] [--pairs 8] [--champion 256]`` flies
Betaflight (docs/firmware.md), makes a model of a nominal set-up from its log, changes a setting or
the body, and shows ``diagnose_change`` the model and the logs before and after. It appends a line
each to docs/results/firmware.jsonl, and writes tables of the last commit's lines between the marks
of docs/results/firmware.md.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from baselines.purejaxrl_ppo import load_checkpoint
from benchmarks import report
from benchmarks.champion import CHAMPION
from firmware import Betaflight, Body
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import BY_NAME
from flytrack_env.files import write_atomically
from flytrack_env.state import POSITION
from flytrack_loop.stages import measure_gap
from flytrack_sysid import Diagnosis, FlightLog, collect, diagnose, diagnose_change
from flytrack_sysid.diagnosis import Cause
from flytrack_sysid.diagnosis.score_test import Candidate
from flytrack_sysid.excitation import script
from flytrack_sysid.manoeuvres import flights_of, hover_action
from flytrack_sysid.script_file import script_of

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

    draw: of settings and fields of the body.
    """

    draw: Callable[[Rng], tuple[dict[str, Any], dict[str, Any]]]
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
    "expo": Kind(lambda rng: (_rates(rng, (0.35, 0.65), (62, 62)), {}), ("rate_expo",)),
    "rates": Kind(
        lambda rng: (_rates(rng, (1, 1), (70, 85)), {}), ("rate_scale",), ("gyro_scale",)
    ),
    "P and D term": Kind(lambda rng: (_both(rng, (0.4, 0.65), p=45, d=30), {}), (GAINS,), RESPONSE),
    "filters": Kind(
        # A dynamic filter would take the static one's place.
        lambda rng: (
            {"gyro_lpf1_dyn_min_hz": 0, "gyro_lpf1_static_hz": int(rng.uniform(25, 50))},
            {},
        ),
        (LATE,),
        RESPONSE,
    ),
    "thrust linearisation": Kind(
        lambda rng: ({"thrust_linear": int(rng.uniform(60, 120))}, {}), THRUST
    ),
    "motor output limit": Kind(
        lambda rng: ({"motor_output_limit": int(rng.uniform(70, 88))}, {}), THRUST
    ),
    "a weak motor": Kind(
        lambda rng: (
            {},
            {"health": tuple(rng.permutation([rng.uniform(0.7, 0.85), 1.0, 1.0, 1.0]).tolist())},
        ),
        (),  # the motor that is drawn: see ``names_of``
        ("motor_imbalance", *MOTORS, *THRUST),
    ),
    "drag": Kind(
        lambda rng: ({}, {"linear_drag": (*[float(rng.uniform(0.15, 0.4))] * 2, 0.1)}),
        ("linear_drag",),
        ("rotor_drag", "quadratic_drag"),
    ),
    "sag": Kind(
        lambda rng: ({}, {"resistance_ohm": float(rng.uniform(0.012, 0.03))}),
        ("voltage_sag",),
        THRUST,
    ),
    "mass": Kind(lambda rng: ({}, {"mass_kg": float(rng.uniform(1.1, 1.35))}), THRUST),
    "thrust curve": Kind(lambda rng: ({}, {"linear": float(rng.uniform(0.3, 0.7))}), THRUST),
    "bent thrust": Kind(
        lambda rng: (
            {},
            {"thrust_tilt_rad": (float(rng.choice([-1, 1]) * rng.uniform(0.04, 0.08)), 0.0)},
        ),
        ("thrust_tilt",),
    ),
    "centre of mass": Kind(
        lambda rng: ({}, {"center_of_mass_m": (float(rng.uniform(0.01, 0.02)), 0.0)}),
        (CENTER,),
        ("motor_imbalance", *MOTORS, *THRUST),
    ),
}


class Trial(NamedTuple):
    """One flown set-up.

    It has a row (matched, single or pair), a nominal set-up, an excitation, changes and a number.
    """

    row: str
    setup: str
    flown: str
    kinds: tuple[str, ...]
    number: int


class Known(NamedTuple):
    """What a team knows of its nominal set-up: log, model, and where the sticks take it (m)."""

    log: FlightLog
    model: Any
    places_m: np.ndarray


def fly(settings: Mapping[str, Any], body: Body, flown: str, seed: int) -> tuple[FlightLog, Any]:
    """Return a noisy log of a minute, and the model to fit from."""
    with Betaflight(settings, body) as plant:
        model = plant.nominal_model()
        own = None
        if flown == "gentle":
            own = script_of(flights_of(GENTLE, hover_action(model), seed))
        return collect(plant, 1.0, seed, 1.0, script=own), model


def know(setup: str, flown: str, seed: int) -> Known:
    """Return what is known of a nominal set-up after it was flown and diagnosed."""
    log, start = fly(SETUPS[setup], Body(), flown, seed)
    model = diagnose(log, start, motion=start.motion).extended
    return Known(log, model, places(SETUPS[setup], Body(), seed))


def places(settings: Mapping[str, Any], body: Body, seed: int) -> np.ndarray:
    """Return displacements after a second of ``collect``'s excitation, (flights, 3), m."""
    hover = hover_action(nominal_parameters())
    flown = script_of(script(FLIGHTS, hover, np.random.default_rng(seed)))
    with Betaflight(settings, body) as plant:
        states = plant.fly(flown.starts, flown.commands[:, :SECOND])
    return states[:, -1, POSITION] - flown.starts[:, POSITION]


def graded(trial: Trial, known: Known, seed: int) -> dict[str, Any]:
    """Fly a changed set-up and return how its diagnosis did."""
    rng = np.random.default_rng(
        [seed, trial.number, *(list(KINDS).index(kind) for kind in trial.kinds)]
    )
    settings, body = dict(SETUPS[trial.setup]), Body()
    for kind in trial.kinds:
        own, fields = KINDS[kind].draw(rng)
        settings, body = settings | own, replace(body, **fields)
    log, _ = fly(settings, body, trial.flown, seed + 1000 + trial.number)
    apart = np.linalg.norm(places(settings, body, seed) - known.places_m, axis=1)
    started = time.process_time()
    found = diagnose_change(log, known.log, known.model, motion=known.model.motion)
    named = {name: values for one in found.causes for name, values in by_name(one).items()}
    return {
        "settings": settings,
        "body": {
            name: value for name, value in vars(body).items() if value != getattr(Body(), name)
        },
        "apart": round(float(np.median(apart / np.linalg.norm(known.places_m, axis=1))), 4),
        "verdict": found.verdict,
        "found": {k: {p: [v.value, *v.ci95] for p, v in own.items()} for k, own in named.items()},
        "negligible": [one.effect for one in found.negligible],
        **grade([names_of(kind, body) for kind in trial.kinds], [*named]),
        "error": error_ratios(found),
        "cpu_s": round(time.process_time() - started, 1),
    }


def by_name(cause: Cause) -> dict[str, Mapping[str, Any]]:
    """Return a cause's parameters by name.

    Those of the loop are grouped by the settings that change together, under the first of them.
    """
    if cause.effect != "betaflight_loop":
        return {cause.effect: cause.parameters}
    groups = Candidate(
        cause.effect, tuple(f"{cause.effect}.{name}" for name in cause.parameters)
    ).groups
    return {
        own[0]: {field: cause.parameters[field.split(".")[1]] for field in own} for own in groups
    }


def names_of(kind: str, body: Body) -> tuple[set[str], set[str]]:
    """Return the names of a change, and those with others that fly alike."""
    exact = set(KINDS[kind].names) or {MOTORS[int(np.argmin(body.health))]}
    return exact, exact | set(KINDS[kind].alike)


def grade(changes: Sequence[tuple[set[str], set[str]]], names: list[str]) -> dict[str, bool]:
    """Return whether the names are exact, exact up to their classes, and whether one is false.

    changes: as of ``names_of``. Each has at least one of its names, and each name belongs to a
    change.
    """

    def fits(classes: Sequence[set[str]]) -> bool:
        return all(own & set(names) for own in classes) and set(names) <= set().union(*classes)

    exact, alike = ([change[side] for change in changes] for side in (0, 1))
    return {
        "is_exact": fits(exact),
        "is_in_class": fits(alike),
        "is_false": not set(names) <= set().union(*alike),
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


def tables(lines: list[dict[str, Any]]) -> str:
    """Return the results as tables in Markdown."""
    by_row = {row: [line for line in lines if line["row"] == row] for row in ROWS}
    is_named = [bool(line["found"]) for line in by_row["matched"]]
    figures = [report.Figure("matched set-up: any name", "", *report.share(is_named))]
    for row in ROWS[1:]:
        some = [line for line in by_row[row] if line["apart"] >= NOTABLE]
        for figure in ("is_exact", "is_in_class", "is_false"):
            name = f"{row} that matters: {figure[3:].replace('_', ' ')}"
            figures.append(report.Figure(name, "", *report.share([line[figure] for line in some])))
    named = [
        line["error"] for row in ROWS[1:] for line in by_row[row] if line["found"] and line["error"]
    ]
    if named:
        worst, last = (
            [max(one.values()) for one in named],
            [one["1"] for one in named if "1" in one],
        )
        ratio = "extended over refitted"
        figures.append(
            report.Figure(f"{ratio}: largest at any horizon", "", f"{max(worst):.3f}", len(worst))
        )
        figures.append(
            report.Figure(f"{ratio} after 1 s: median", "", f"{np.median(last):.3f}", len(last))
        )
    seconds = [line["cpu_s"] for some in by_row.values() for line in some]
    figures.append(
        report.Figure("CPU s of a diagnosis: median", "", f"{np.median(seconds):.0f}", len(seconds))
    )
    parts = [report.figures_table(figures)]
    cells = []
    for kind, own in KINDS.items():
        some = [line for line in by_row["single"] if line["kinds"] == [kind]]
        said = sorted({" + ".join(line["found"]) or "nothing" for line in some})
        flags = [line["is_in_class"] for line in some]
        sizes = report.spread([100.0 * line["apart"] for line in some], ".1f") if some else ""
        names = ", ".join(own.names) or "that motor"
        cells.append([kind, sizes, names, *report.share(flags), "; ".join(said)])
    header = "changed | flies apart, % | its names | in class | n | what was named"
    parts.append(report.table(header, cells))
    for line in lines:
        if line["row"] == "champion":
            share = f"{line['success']:.1%} of {line['episodes']} starts finish 3 laps"
            parts.append(
                f"The shipped champion, blind: {share}; "
                f"{line['gates']:.1f} of 24 gates in the mean."
            )
    return "\n\n".join(parts)


def main(
    matched: int = 2, single: int = 4, pairs: int = 8, champion: int = 256, seed: int = SEED
) -> None:
    """Fly, diagnose, and write the lines and the tables.

    matched: flights of each set-up and excitation. single: draws of each kind of change. pairs:
    set-ups with two changes. champion: starts of it, 0 for none.
    """
    rng = np.random.default_rng([seed, 7])
    trials = [
        Trial("matched", setup, flown, (), number)
        for setup in SETUPS
        for flown in ("full", "gentle")
        for number in range(matched)
    ]
    sets = [(kind,) for kind in KINDS for _ in range(single)]
    apart = [kind for kind in KINDS if kind != "expo"]  # it is made of the settings of the rates
    sets += [tuple(rng.choice(apart, 2, replace=False).tolist()) for _ in range(pairs)]
    trials += [
        Trial(ROWS[len(own)], "stock", "full", own, 10 + number) for number, own in enumerate(sets)
    ]
    commit = report.commit_of_checkout()
    if champion:
        with Betaflight() as plant:
            raced = measure_gap(load_checkpoint(CHAMPION), plant, seed, champion).plant
        line = {"commit": commit, "row": "champion", "episodes": champion, **raced._asdict()}
        report.append_line(LINES, line)
    known: dict[tuple[str, str], Known] = {}
    for trial in report.progress(trials, "set-ups"):
        key = trial.setup, trial.flown
        known[key] = known.get(key) or know(*key, seed)
        report.append_line(
            LINES, {"commit": commit, **trial._asdict(), **graded(trial, known[key], seed)}
        )
    found = report.lines_of_commit(LINES)
    text = PAGE.read_text(encoding="utf-8")
    before, after = text.split(MARKS[0])[0], text.split(MARKS[1])[1]
    record = report.provenance("scipy") | {"commit": found[-1]["commit"]}
    own = f"{tables(found)}\n\nSeed {seed}. {report.provenance_line(record)}"
    write_atomically(PAGE, f"{before}{MARKS[0]}\n\n{own}\n\n{MARKS[1]}{after}".encode())


if __name__ == "__main__":
    report.command(main)
