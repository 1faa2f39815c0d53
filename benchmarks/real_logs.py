"""What the diagnosis says of measured flights of two drones.

``python -m benchmarks.real_logs [--data ../shared/data]`` writes docs/results/real_logs_diagnosis.md. Two
crafts: a Crazyflie 2.1 flown by learned policies (some policies are held out), and an acro flight of a
Betaflight quadcopter. The answers to commands are compared with a plain regression.
Where the data or the reader of Betaflight logs are absent, it says so and writes nothing.
"""

import argparse
import os
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.report import RESULTS, ROOT, table
from flytrack_env.files import write_atomically
from flytrack_sysid import Diagnosis, FlightLog, LogError, diagnose, import_log
from flytrack_sysid.diagnosis import joined

RESULT = RESULTS / "real_logs_diagnosis.md"
VARIABLE = "FLYTRACK_SHARED_DATA"
CRAZYFLIE, BETAFLIGHT = "crazyflie_rate_flights", "betaflight_acro_log"
# Every third policy, by its number, is for judging.
LEARNT = ("48", "49", "52", "53", "67", "68", "70", "71")
JUDGED = ("50", "66", "69")
QUAD = """[rows]
from_s = 2.0  # it stands on the ground before
every = 4

[craft]
mass_kg = 0.7  # a guess: the log does not say
"""
SHOWN_ROWS = (1, 2, 3, 5, 10, 20, 29)


class Craft(NamedTuple):
    """A craft's diagnosis: the log, rows held out, (num_rows,) bool, and how long it took, CPU s."""

    found: Diagnosis
    log: FlightLog
    held_out: np.ndarray | None
    cpu_s: float


def timed(log: FlightLog, model: object, held_out: np.ndarray | None) -> Craft:
    """Return a log's diagnosis."""
    started = time.process_time()
    found = diagnose(log, model, held_out)
    return Craft(found, log, held_out, time.process_time() - started)


def crazyflie(data: Path) -> Craft:
    """Return the diagnosis of the Crazyflie's flights; held out are those of some policies."""

    def imported(policies: Iterable[str]) -> tuple:
        files = [file for policy in policies for file in sorted(data.glob(f"seed000{policy}_*.csv.gz"))]
        found = import_log(files, "csv", "crazyflie_phoenix")
        return found.log, found.nominal_model()

    (learnt, model), (judged, _) = imported(LEARNT), imported(JUDGED)
    log = joined([learnt, judged])
    return timed(log, model, np.arange(len(log)) >= len(learnt))


def betaflight(data: Path) -> Craft:
    """Return the diagnosis of the Betaflight log; held out are the last of every four blocks."""
    with TemporaryDirectory() as folder:
        mapping = Path(folder) / "quad.toml"
        mapping.write_text(QUAD, encoding="utf-8")
        found = import_log(data / "shortLog.BFL", "betaflight", mapping)
    return timed(found.log, found.nominal_model(), None)


def number(value: float | None, unit: str = "1") -> str:
    """Return three digits, and the unit if there is one."""
    text = "none" if value is None or not np.isfinite(value) else f"{value:.3g}"
    return text if unit == "1" else f"{text} {unit}"


def causes_table(found: Diagnosis) -> str:
    """Return the causes with intervals, gains and what they may be confused with."""
    rows = []
    for cause in found.causes:
        values = "<br>".join(
            f"{name} {number(one.value, one.unit)} ({' to '.join(map(number, one.ci95))})"
            for name, one in cause.parameters.items()
        )
        against = f"no (closest: {cause.closest})" if cause.closest else "not tried"
        gains = (cause.chi2_gain, cause.heldout_gain, cause.lambda_, cause.lambda_sep)
        alike = ", ".join(cause.equivalent) or against
        rows.append([f"`{cause.effect}`", values, *map(number, gains), alike])
    header = "cause | values, 95 % intervals | chi2_gain | heldout_gain | lambda | lambda_sep | alike?"
    return table(header, rows)


def errors_table(found: Diagnosis) -> str:
    """Return the errors of the models on held-out rows."""
    models = list(found.error.values())
    rows = [
        [f"{name}, one step, NRMSE", *(number(one.one_step_nrmse[name]) for one in models)]
        for name in models[0].one_step_nrmse
    ]
    rows += [
        [f"position after {name} s, m", *(number(one.position_m[name]) for one in models)]
        for name in models[0].position_m
    ]
    return table(["error on held-out rows", *(name.replace("_", " ") for name in found.error)], rows)


def unseen_table(found: Diagnosis) -> str:
    """Return what the log could not have shown."""
    rows = [
        [f"`{one.effect}`", number(one.smallest, one.unit), ", ".join(one.confused_with) or "noise"]
        for one in found.not_identifiable
    ]
    return table("effect | seen for sure from | looks like", rows)


def section(craft: Craft) -> str:
    """Return what was found on one craft."""
    found, left = craft.found, craft.found.unexplained
    shares = ", ".join(
        f"{name} ({number(share)} times the sensor's noise)" for name, share in left.shares.items()
    )
    parts = [
        f"{len(craft.log)} rows; verdict `{found.verdict}`; {craft.cpu_s:.0f} CPU s, compilation included.",
        causes_table(found),
        errors_table(found),
        f"Unexplained: {shares or 'nothing'}.",
        *found.warnings,
        "What this log could not have shown:",
        unseen_table(found),
    ]
    return "\n\n".join(parts)


ANSWER_ROWS = 30  # 0.3 s at 100 Hz: how far back a command still acts


def answers(log: FlightLog, held_out: np.ndarray) -> tuple[Mapping[str, np.ndarray], Mapping[str, float]]:
    """Return what a step of a command leads to, by regression, and the error of that on held-out rows.

    Body rates by their own stick, rad/s per unit, and voltage by the squared thrust stick ((1 + u)/2)^2, V:
    (ANSWER_ROWS + 1,), the sum of the regression's weights up to each row. Errors: rms over the spread.
    """
    squared = ((1.0 + log["u"][:, 3]) / 2.0) ** 2
    pairs = {
        name: (log["u"][:, axis], log["w"][:, axis]) for axis, name in enumerate(("roll", "pitch", "yaw"))
    }
    pairs["voltage"] = (squared, log["v_bat"][:, 0])
    starts = np.maximum.accumulate(np.where(log.is_start(), np.arange(len(log)), 0))
    rows = np.flatnonzero(np.arange(len(log)) - starts >= ANSWER_ROWS)
    steps, errors = {}, {}
    for name, (command, measured) in pairs.items():
        past = np.stack(
            [command[rows - lag] for lag in range(ANSWER_ROWS + 1)] + [np.ones(len(rows))], axis=1
        )
        out, wanted = held_out[rows], measured[rows]
        weights = np.linalg.lstsq(past[~out], wanted[~out], rcond=None)[0]
        left = (wanted - past @ weights)[out]
        steps[name] = np.cumsum(weights[:-1])
        errors[name] = float(np.sqrt(np.mean(left**2)) / wanted[out].std())
    return steps, errors


def velocity_scale(log: FlightLog) -> tuple[float, float]:
    """Return distances flown in a second over those of the integrated velocity, horizontal and vertical.

    The geometric mean of both regressions, as either channel is noisy.
    """
    rows = round(1.0 / float(np.median(np.diff(log.time))))
    one_flight = log.segment[rows:] == log.segment[:-rows]
    integral = np.cumsum(log["v"], axis=0) / rows
    moved, integral = ((values[rows:] - values[:-rows])[one_flight] for values in (log["p"], integral))
    horizontal = np.sum(moved[:, :2] ** 2) / np.sum(integral[:, :2] ** 2)
    upward = np.sum(moved[:, 2] ** 2) / np.sum(integral[:, 2] ** 2)
    return float(np.sqrt(horizontal)), float(np.sqrt(upward))


ANSWERS = """A check that shares nothing with the diagnosis: a linear regression on the commands of the last
0.3 s, fitted to the same flights, judged on the same held-out ones. Commands repeat the row before in
{held:.1f} % of the rows. Answers to a step of one full stick (voltage: no thrust to all), after:"""

VELOCITY = """Position and velocity do not agree either: over a second, the drone moves {0:.2f} times as far
as its logged velocity says horizontally, and {1:.2f} times upwards. No effect of the list is an error of
the velocity."""


def answers_part(craft: Craft) -> str:
    """Return the regression's answers to steps of the Crazyflie's commands."""
    steps, errors = answers(craft.log, craft.held_out)
    commands = craft.log["u"]
    held = float(np.mean(np.all(np.diff(commands, axis=0) == 0.0, axis=1)))
    step_s = float(np.median(np.diff(craft.log.time)))
    header = ["answer", *(f"{1e3 * step_s * row:.0f} ms" for row in SHOWN_ROWS), "NRMSE, held out"]
    units = {"roll": "rad/s", "pitch": "rad/s", "yaw": "rad/s", "voltage": "V"}
    rows = [
        [f"{name}, {units[name]}", *(number(values[row]) for row in SHOWN_ROWS), number(errors[name])]
        for name, values in steps.items()
    ]
    parts = (
        ANSWERS.format(held=100 * held),
        table(header, rows),
        VELOCITY.format(*velocity_scale(craft.log)),
    )
    return "\n\n".join(parts)


HEAD = """# The diagnosis on measured flights

Written by `python -m benchmarks.real_logs`; do not edit. The flights were measured by others and are not part
of this repository: they are read from `../shared/data`, or the folder that `FLYTRACK_SHARED_DATA` names
([real logs](../real_logs.md)). How to read this page: [the diagnosis](../diagnosis.md). jax {jax}."""

CRAZYFLIE_HEAD = """## Crazyflie 2.1, flown by learned policies

Held out are the flights of policies {policies}: the model is judged on other policies, which command
differently.

```
FLIGHTS=../shared/data/{folder}
flytrack-sysid import $FLIGHTS/seed000{{{learnt}}}_*.csv.gz --format csv \\
    --map crazyflie_phoenix --out learnt.npz --model-out crazyflie.json
flytrack-sysid import $FLIGHTS/seed000{{{judged}}}_*.csv.gz --format csv \\
    --map crazyflie_phoenix --out judged.npz
flytrack-sysid diagnose learnt.npz --model crazyflie.json --hold-out judged.npz --out report
```"""

CRAZYFLIE_LIMITS = """\
**How far to trust it.** The nominal model is no model of this drone: lags and the shape of its thrust are
those of a racing quadcopter, so that base parameters are named is no surprise. The policies fly in closed
loop: what they command answers to what disturbed the drone a moment before, and residuals correlate with
commands that come *after* them. A regression and a fit of a model that lacks something are both biased by
this. Body rates here are rates of Euler angles, and velocity and attitude are those of the firmware's
estimator, so that a lag of the estimator looks like a lag of the drone (`tau_thrust` above all, as no
accelerometer was logged). Voltage is read under load: it dips because the motors pull, and the thrust map
that takes it as a cause can get a wrong sign for its voltage terms; `voltage_sag` is the cause to expect.
The regression answers to sticks after 20 to 30 ms only: a dead time, for which `command_delay` is the name.
Where one of the two is not in the table, the search has missed it. All policies fly the same circle, at
about 1 m height and below 2 m/s: drag, lift, ground effect and wind hardly show. Mass is a guess within 10
%, and with it all thrust. Motor commands were logged but are not read."""

BETAFLIGHT_HEAD = """## Betaflight quadcopter, one acro flight

`quad.toml`:

```toml
{quad}```

```
flytrack-sysid import ../shared/data/{folder}/shortLog.BFL --format betaflight \\
    --map quad.toml --out quad.npz --model-out quad.json
flytrack-sysid diagnose quad.npz --model quad.json --out report
```"""

BETAFLIGHT_LIMITS = """\
**How far to trust it.** Rate setpoints go through a feed-forward controller before they are rates: that the
rates follow within a few milliseconds says how well it is tuned, and is no property of the frame. The
flight is short, and the held-out part has no flips in roll: what is gained there is a test of pitch and yaw
on a few flips. There is no attitude, velocity or position: drag, wind, lift and everything that depends on
where up is cannot show, and a force in proportion to airspeed in a fast flip can pass for an accelerometer
that sits off the centre of mass (`imu_offset`). A stochastic rest is to be expected, as the accelerometer
shakes with the rotors. The mass is a guess, so thrust is known per mass only."""


def page(flown: Craft, acro: Craft) -> str:
    """Return the page on both crafts."""
    learnt, judged = ",".join(LEARNT), ",".join(JUDGED)
    parts = [
        HEAD.format(jax=jax.__version__),
        CRAZYFLIE_HEAD.format(folder=CRAZYFLIE, learnt=learnt, judged=judged, policies=", ".join(JUDGED)),
        section(flown),
        answers_part(flown),
        CRAZYFLIE_LIMITS,
        BETAFLIGHT_HEAD.format(folder=BETAFLIGHT, quad=QUAD),
        section(acro),
        BETAFLIGHT_LIMITS,
    ]
    return "\n\n".join(parts) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page, or say why not."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = os.environ.get(VARIABLE, ROOT.parent / "shared" / "data")
    parser.add_argument("--data", type=Path, default=default, help="default: %(default)s")
    data = Path(parser.parse_args(arguments).data)
    for folder in (CRAZYFLIE, BETAFLIGHT):
        if not (data / folder).is_dir():
            sys.exit(
                f"skipped: no measured flights at {data / folder}; --data or {VARIABLE} names their folder"
            )
    try:
        acro = betaflight(data / BETAFLIGHT)
    except LogError as error:
        sys.exit(f"skipped: {error}")
    write_atomically(RESULT, page(crazyflie(data / CRAZYFLIE), acro).encode())
    print(f"written: {RESULT}")


if __name__ == "__main__":
    main()
