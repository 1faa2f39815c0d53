"""Flights of one craft, diagnosed apart: ``python -m benchmarks.repeatability``.

Each measured flight is diagnosed alone, with the nominal model that is imported with it. A name is
a statement about the craft only if another flight of the same craft gives it too. Plants, each with
an effect of the list and another law outside it, fly twice for a minute, differently. Flights of
one craft are also diagnosed in one go (``--together``): do they agree? Then flights of craft that
differ, or do not, are compared by ``diagnose_change`` (``--changes``). Results are appended to
docs/results/repeatability.jsonl, together.jsonl and changes.jsonl, and a later run of the same
commit resumes there; ``--page`` writes docs/results/repeatability.md from them.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from scipy.constants import g as GRAVITY
from scipy.signal import lfilter, savgol_filter
from scipy.spatial.transform import Rotation

from benchmarks import hidden
from benchmarks.diagnosis import AMPLITUDES, SECONDS, model_of
from benchmarks.hidden.oracle import known
from benchmarks.report import (
    IN_THIS_PROCESS,
    RESULTS,
    JobFlags,
    Line,
    command,
    fill_page,
    good_lines,
    lines_of_commit,
    record_trials,
    select,
    table,
)
from benchmarks.seams.measured import measured_flights
from flytrack_env.dynamics import ModelParameters
from flytrack_env.motion import Motion
from flytrack_sysid import Diagnosis, FlightLog, Imported, diagnose, diagnose_change
from flytrack_sysid.inference.parameters import STICKS
from flytrack_sysid.log import median_step
from flytrack_sysid.split import held_out_rows

LINES, CHANGE_LINES = RESULTS / "repeatability.jsonl", RESULTS / "changes.jsonl"
TOGETHER_LINES = RESULTS / "together.jsonl"
SHORTEST_S = 14.0
RATE_POLICIES = "Crazyflie, rate policies"
CRAFT = {  # and the beginnings of its flights' names
    RATE_POLICIES: ("crazyflie_rate_flights/",),
    "Crazyflie, angle mode, two days": ("cf_utias_angle/",),
    "Crazyflie of ARPL, motors": ("cf_arpl_motors/",),
    "NanoBench, one trajectory twice": ("nanobench/B3_", "nanobench/B9_"),
}
TOGETHER = {  # craft or days -> the beginnings of its flights' names
    "Crazyflie, one policy": ("crazyflie_rate_flights/seed00048_",),
    "Crazyflie, three policies": tuple(
        f"crazyflie_rate_flights/seed000{policy}_log1" for policy in (68, 69, 70)
    ),
    **{name: CRAFT[name] for name in [*CRAFT][1:]},
}
PLANT = "plant "  # begins the name of a simulated craft
SEED = 57  # no rule was made on it
VISIBLE, SEPARABLE = 30.0, 20.0  # lambda and lambda_sep of an effect that a log can show
SMOOTHED_ROWS = 9  # of the velocity whose slope is the acceleration
LAGS_S, DELAYS = (0.02, 0.03, 0.04, 0.05, 0.06), range(8)  # of thrust; delays in rows


LEE, UPGRADED = "cf_lee_standard/log", "cf_lee_upgraded/log"
CHANGES = {  # earlier and later flight -> what differs; empty: nothing that is known
    (LEE + "182", LEE + "183"): "",
    (UPGRADED + "29", UPGRADED + "30"): "",
    (UPGRADED + "202", UPGRADED + "203"): "",
    (LEE + "182", UPGRADED + "202"): "5 g on a cable",
    (LEE + "183", UPGRADED + "203"): "5 g on a cable",
    (LEE + "182", UPGRADED + "45"): "motors and propellers",
    (LEE + "183", UPGRADED + "30"): "motors and propellers",
    (LEE + "182", UPGRADED + "108"): "motors and propellers",
}
OF_THRUST = {"thrust_curve": "thrust_curve.mean_factor", "thrust_scale": "thrust_scale.factor"}


class Trial(NamedTuple):
    """A flight to diagnose, and the craft that flew it."""

    craft: str
    flight: str


class TogetherTrial(NamedTuple):
    """Flights of one craft to diagnose in one go."""

    craft: str


class ChangeTrial(NamedTuple):
    """Two flights to compare."""

    before: str
    after: str


class Flight(NamedTuple):
    """A flight, the model that its team believes in, and what the log could show of the truth.

    Attributes:
        log: the flight.
        model: nominal.
        effect: the hidden effect that the log can show; empty if it cannot, or nobody knows.
    """

    log: FlightLog
    model: ModelParameters
    effect: str


def flights() -> dict[str, Imported]:
    """Return the measured flights that are long enough, by name."""
    return {
        name: flight
        for name, flight in measured_flights().items()
        if flight.log.time[-1] - flight.log.time[0] > SHORTEST_S
    }


def simulated(trial: Trial) -> Flight:
    """Return a flight of a plant with an effect of the list and a law outside it."""
    plant, flight = int(trial.craft.removeprefix(PLANT)), int(trial.flight)
    rng = np.random.default_rng([SEED, plant])
    truth = replace(hidden.draw_truth(rng, 1), motion="fine", step_s=0.01)
    amplitude = hidden.log_uniform(*AMPLITUDES, rng)
    outside = hidden.draw_outside(rng, amplitude=amplitude)
    rng = np.random.default_rng([SEED, plant, flight])
    listed = hidden.fly(truth, SECONDS, rng)
    log = hidden.measure(listed, "sensors", rng)
    model = model_of(truth)
    true_model = model._replace(motion=Motion.CONTINUOUS)
    ((effect, shown),) = known(listed, log, ~held_out_rows(log), true_model, truth.effects).items()
    is_shown = shown.lambda_ > VISIBLE and shown.lambda_sep > SEPARABLE
    rng = np.random.default_rng([SEED, plant, flight])
    clean = hidden.fly(replace(truth, outside=outside), SECONDS, rng)
    log = hidden.measure(clean, "sensors", rng)
    return Flight(log, model, effect if is_shown else "")


def measured(trial: Trial) -> Flight:
    """Return a measured flight with its nominal model."""
    flight = flights()[trial.flight]
    return Flight(flight.log, flight.nominal_model(), "")


def trials(plants: int) -> list[Trial]:
    """Return the flights of each craft, two of each plant."""
    simulated = [
        Trial(f"{PLANT}{plant}", str(flight)) for plant in range(plants) for flight in range(2)
    ]
    return simulated + [
        Trial(craft, name)
        for craft, beginnings in CRAFT.items()
        for name in flights()
        if name.startswith(beginnings)
    ]


def measure_change(trial: ChangeTrial) -> Line:
    """Compare two flights: what changed, and by how much the thrust did without the simulator."""
    before, after = (measured_flights()[name] for name in trial)
    diagnosis = diagnose_change(after.log, before.log, before.nominal_model())
    return {
        "verdict": diagnosis.verdict,
        "causes": [cause.effect for cause in diagnosis.causes],
        "values": cause_values(diagnosis),
        "without_model": thrust_over_stick(after.log) / thrust_over_stick(before.log),
    }


def cause_values(diagnosis: Diagnosis) -> dict[str, list[float]]:
    """Return the values of causes with their intervals, by ``effect.parameter``."""
    return {
        f"{cause.effect}.{name}": [value.value, *value.ci95]
        for cause in diagnosis.causes
        for name, value in cause.parameters.items()
    }


def measure(trial: Trial) -> Line:
    """Diagnose a flight: causes with their classes, values and times to half response."""
    flight = (simulated if trial.craft.startswith(PLANT) else measured)(trial)
    start = process_time()
    diagnosis = diagnose(flight.log, flight.model)
    return {
        "effect": flight.effect,
        "cpu_s": process_time() - start,
        "verdict": diagnosis.verdict,
        "causes": {
            cause.effect: sorted({*cause.equivalent, *cause.family}) for cause in diagnosis.causes
        },
        "negligible": [cause.effect for cause in diagnosis.negligible],
        "unsettled": [*diagnosis.unsettled, *(cause.effect for cause in diagnosis.beyond)],
        "values": cause_values(diagnosis),
        "lift": {
            name: [value.value, *value.ci95]
            for lift in [diagnosis.lift.get("extended")]
            if lift is not None
            for name, value in (("ratio", lift.thrust_to_weight), ("hover", lift.hover))
        },
        "half_responses_s": {
            stick: [response.time, *response.ci95]
            for stick, response in diagnosis.half_response_s.get("extended", {}).items()
            if response.ci95 is not None and np.isfinite(response.ci95[1])
        },
    }


def measure_together(trial: TogetherTrial) -> Line:
    """Diagnose the flights of a craft in one go: do their values agree?"""
    if trial.craft.startswith(PLANT):
        of_craft = [simulated(Trial(trial.craft, str(flight))) for flight in range(2)]
    else:
        names = [name for name in flights() if name.startswith(TOGETHER[trial.craft])]
        of_craft = [measured(Trial(trial.craft, name)) for name in names]
    diagnosis = diagnose([flight.log for flight in of_craft], of_craft[0].model)
    return {
        "verdict": diagnosis.verdict,
        "causes": {
            cause.effect: {
                "birge_ratio": cause.birge_ratio,
                "by_flight": {
                    name: [value.value for value in values]
                    for name, values in cause.by_flight.items()
                },
            }
            for cause in diagnosis.causes
        },
    }


def named_classes(line: Line) -> set[str]:
    """Return the causes of a line with their equivalents."""
    return {*line["causes"]}.union(*line["causes"].values())


def is_same_class(first: Line, second: Line) -> bool:
    """Return whether each cause of either is a cause, or of the class of one, of the other."""
    is_first_covered = first["causes"].keys() <= named_classes(second)
    return is_first_covered and second["causes"].keys() <= named_classes(first)


def agree(first: Line, second: Line) -> bool:
    """Return whether neither names what the other neither names nor leaves open."""

    def leaves_open(line: Line) -> set[str]:
        return named_classes(line).union(line["unsettled"])

    is_first_open = first["causes"].keys() <= leaves_open(second)
    return is_first_open and second["causes"].keys() <= leaves_open(first)


def overlaps(first: list[float], second: list[float]) -> bool:
    """Return whether two intervals overlap; each is a value, its lowest and its highest."""
    return first[1] <= second[2] and second[1] <= first[2]


def pairs_of(lines: Sequence[Line]) -> list[tuple[Line, Line]]:
    """Return pairs of flights of one craft."""
    return [pair for pair in combinations(lines, 2) if pair[0]["craft"] == pair[1]["craft"]]


def compare_values(pairs: Iterable[tuple[Line, Line]]) -> list[tuple[str, bool]]:
    """Return the name of each value that both flights of a pair have, and whether they overlap."""
    return [
        (key, overlaps(one[name][key], other[name][key]))
        for one, other in pairs
        for name in ("values", "lift", "half_responses_s")
        for key in one[name].keys() & other[name].keys()
        if not is_coefficient(key)
    ]


def compare(lines: Sequence[Line]) -> list[Any]:
    """Return a row of the page: how alike the flights of a craft are."""
    pairs = pairs_of(lines)
    flags = [
        [first["causes"].keys() == second["causes"].keys() for first, second in pairs],
        [is_same_class(*pair) for pair in pairs],
        [agree(*pair) for pair in pairs],
        [is_alike for _, is_alike in compare_values(pairs)],
    ]
    return [
        len(lines),
        *(f"{sum(are_alike)} of {len(are_alike)}" for are_alike in flags),
        *(half_responses(lines, stick) for stick in STICKS),
    ]


def half_responses(lines: Sequence[Line], stick: str) -> str:
    """Return the median half-width of a stick's times to half response, and pairs that overlap."""
    known = [line for line in lines if stick in line["half_responses_s"]]
    intervals = [line["half_responses_s"][stick] for line in known]
    if not intervals:
        return "none"
    half_ms = 1e3 * float(np.median([0.5 * (high - low) for _, low, high in intervals]))
    are_alike = [
        overlaps(*(line["half_responses_s"][stick] for line in pair)) for pair in pairs_of(known)
    ]
    return f"± {half_ms:.1f}; {sum(are_alike)} of {len(are_alike)}"


def felt_along_z(log: FlightLog) -> np.ndarray:
    """Return the specific force along the body's z axis by differences of the velocity, m/s^2."""
    acceleration = savgol_filter(
        log["v"], SMOOTHED_ROWS, 2, deriv=1, delta=median_step(log), axis=0
    )
    felt = acceleration + np.array([0.0, 0.0, GRAVITY])
    up = Rotation.from_quat(log["q"], scalar_first=True).apply([0.0, 0.0, 1.0])
    return np.sum(felt * up, axis=1)


def thrust_over_stick(log: FlightLog) -> float:
    """Return the mean specific force over the mean stick from idle, m/s^2."""
    return float(felt_along_z(log).mean() / (0.5 * (1.0 + log["u"][:, 3])).mean())


def hover_without_model(log: FlightLog) -> float:
    """Return the stick at which a log's drone neither climbs nor sinks, without the simulator.

    The acceleration along the body's z axis, by differences of the velocity, is fitted by a
    parabola of the stick after a lag and a delay, the best of a grid.
    """
    thrust, fits = felt_along_z(log), []
    for lag_s in LAGS_S:
        decay = np.exp(-median_step(log) / lag_s)
        stick = lfilter([0.0, 1.0 - decay], [1.0, -decay], log["u"][:, 3])
        for delay in DELAYS:
            fitted = np.polynomial.Polynomial.fit(stick[: len(stick) - delay], thrust[delay:], 2)
            error = np.mean(np.square(fitted(stick[: len(stick) - delay]) - thrust[delay:]))
            fits.append((error, fitted))
    _, best = min(fits, key=lambda one: one[0])
    sticks = np.linspace(-1.0, 1.0, 2001)
    return float(sticks[np.argmin(np.abs(best(sticks) - GRAVITY))])


def compare_hovers(lines: Sequence[Line]) -> tuple[list[float], float]:
    """Return each flight's hover without a model, and its correlation with the diagnosed one."""
    hovers = [hover_without_model(flights()[line["flight"]].log) for line in lines]
    diagnosed = [line["lift"]["hover"][0] for line in lines]
    return hovers, float(np.corrcoef(hovers, diagnosed)[0, 1])


def list_changes(lines: Sequence[Line]) -> str:
    """Return a table of pairs of flights: what differs, and what was named."""
    rows = []
    for line in lines:
        before, after = line["before"], line["after"]
        shown = [line["values"][key] for key in OF_THRUST.values() if key in line["values"]]
        factor = "-" if not shown else "{:.2f} ({:.2f} to {:.2f})".format(*shown[0])
        named = ", ".join(f"`{name}`" for name in line["causes"]) or "nothing"
        differs = CHANGES[before, after] or "nothing that is known"
        rows.append([before, after, differs, named, factor, f"{line['without_model']:.2f}"])
    header = (
        "before | after | what differs | what is named | thrust, factor | without the simulator"
    )
    return table(header, rows)


def list_together(lines: Sequence[Line]) -> str:
    """Return a table of flights of one craft that were diagnosed in one go: values by flight."""
    rows = []
    for line in lines:
        for name, cause in line["causes"].items():
            values = "; ".join(
                f"{parameter} {', '.join(f'{value:.3g}' for value in of_flights)}"
                for parameter, of_flights in cause["by_flight"].items()
            )
            rows.append([line["craft"], f"`{name}`", values, f"{cause['birge_ratio']:.2g}"])
    return table("flights | cause | values by flight | Birge ratio", rows)


def is_in_class(line: Line) -> bool:
    """Return whether the effect that a log shows is a cause, an equivalent or negligible."""
    return line["effect"] in named_classes(line).union(line["negligible"])


def is_coefficient(name: str) -> bool:
    """Return whether a value is a coefficient of the thrust curve: these trade off."""
    return name.startswith("thrust_curve.c")


def write_page() -> None:
    """Write docs/results/repeatability.md from the lines of the last commit."""
    lines = good_lines(lines_of_commit(LINES))
    changes, together = lines_of_commit(CHANGE_LINES), good_lines(lines_of_commit(TOGETHER_LINES))
    of_plants = [line for line in together if line["craft"].startswith(PLANT)]
    ratios = [cause["birge_ratio"] for line in of_plants for cause in line["causes"].values()]
    by_craft = {craft: select(lines, craft=craft) for craft in CRAFT}
    apart = Counter(
        name
        for craft in CRAFT
        for name, is_alike in compare_values(pairs_of(by_craft[craft]))
        if not is_alike
    )
    hovers, correlation = compare_hovers(by_craft[RATE_POLICIES])
    plants = [line for line in lines if line["craft"].startswith(PLANT)]
    by_craft["Simulated, each plant twice"] = plants
    shown = [line for line in plants if line["effect"]]
    header = "craft | flights | pairs with the same names | the same class | none denied"
    header += " | values that overlap"
    header += "".join(f" | {stick}, ms" for stick in STICKS)
    names = Counter(name for line in lines if line["craft"] in CRAFT for name in line["causes"])
    fill_page(
        RESULTS / "repeatability.md",
        "repeatability",
        changes=list_changes(changes),
        together=list_together([line for line in together if line not in of_plants]),
        agreeing=ratios.count(1.0),
        compared=len(ratios),
        commit_together=together[-1]["commit"],
        crafts=table(header, [[craft, *compare(of)] for craft, of in by_craft.items() if of]),
        names=", ".join(f"`{name}` {count}" for name, count in names.most_common()),
        shortest=f"{SHORTEST_S:g}",
        length=f"{SECONDS:g}",
        seed=SEED,
        visible=f"{VISIBLE:g}",
        separable=f"{SEPARABLE:g}",
        found=sum(map(is_in_class, shown)),
        shown=len(shown),
        apart=", ".join(f"`{name}` {count}" for name, count in apart.most_common(5)),
        lowest=f"{min(hovers):.2f}",
        highest=f"{max(hovers):.2f}",
        correlation=f"{correlation:.2f}",
        num_flights=len(hovers),
        seconds=f"{np.median([line['cpu_s'] for line in lines]):.0f}",
        commit=lines[-1]["commit"],
        commit_of_changes=changes[-1]["commit"],
    )


def main(
    page: bool = False,
    changes: bool = False,
    together: bool = False,
    plants: int = 10,
    jobs: JobFlags = IN_THIS_PROCESS,
) -> None:
    """Diagnose flights.

    Args:
        page: write the page from the lines instead.
        changes: compare pairs of flights instead.
        together: diagnose the flights of each craft in one go instead.
        plants: the number of simulated craft.
    """
    if page:
        write_page()
    elif changes:
        pairs = [ChangeTrial(*pair) for pair in CHANGES if measured_flights().keys() >= {*pair}]
        record_trials(CHANGE_LINES, pairs, measure_change, jobs=jobs)
    elif together:
        crafts = [*(f"{PLANT}{plant}" for plant in range(plants)), *TOGETHER]
        record_trials(TOGETHER_LINES, map(TogetherTrial, crafts), measure_together, jobs=jobs)
    else:
        record_trials(LINES, trials(plants), measure, jobs=jobs)


if __name__ == "__main__":
    command(main)
