"""Names for what a settled model has beyond the nominal one: effects, and base parameters that differ."""

from collections.abc import Mapping, Sequence

import numpy as np

from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.base import Covered, contradiction
from flytrack_sysid.diagnosis.candidates import BASE_CAUSES
from flytrack_sysid.diagnosis.lanes import SIZES
from flytrack_sysid.diagnosis.linear import Outlook, solve
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import Cause, Estimated
from flytrack_sysid.diagnosis.search import Found, threshold
from flytrack_sysid.diagnosis.weigh import SAME, Weighed, separations
from flytrack_sysid.parameters import unit_of

TWO_SIDED_95 = 1.959964
CHANNELS = (("rates", "attitude"), ("force", "velocity"), (None, "battery"))
BY_CHANCE = 3.0  # times SAME: so much a chi2 that is expected below SAME hardly ever is
# A gain on held-out rows is wrong for a true cause where it lies so many standard deviations below what the
# cause would gain there, and less than that share of its size is there: laws are not exact where they are
# flown harder than before.
HELD_OUT_SIGMAS, HELD_OUT_SHARE = 4.0, 0.35
SHOWN = 20.0  # of chi2: rows that would not show so much say nothing against a cause
OF_LAW = 0.01  # of an effect's gain: no more is its law's remainder
LOOSE = 0.5  # of what was known beforehand: a parameter known no better is not determined by the log
# Equal but for a name: mass, payload, battery and motors all scale the thrust over the mass.
SCALE_TWINS = ("thrust_curve",)


def estimates(
    problem: Problem, outlook: Outlook, found: Found, fields: Sequence[str]
) -> dict[str, Estimated]:
    """Return values and 95 % intervals of parameters that the log determines, by name without the effect."""
    halves = Covered(outlook, found, fields).half_widths()
    result, least = {}, halves.min()  # of each effect one parameter at least is told
    for field, half in zip(fields, halves, strict=True):
        place = problem.names.index(field)
        value = float(found.vector[place])
        width = problem.high[place] - problem.low[place]
        if "." in field and half > LOOSE * width and half > least:
            continue
        ends = max(value - half, problem.low[place]), min(value + half, problem.high[place])
        result[field.split(".")[-1]] = Estimated(value, (float(ends[0]), float(ends[1])), unit_of(field))
    return result


def channel_of(problem: Problem, less: np.ndarray, full: np.ndarray) -> str:
    """Return the channel in which two models differ most, by what the log says of each."""
    white = problem.whiten(problem.left(np.stack([less, full])))
    by_axis = np.square(white[1] - white[0]).sum(axis=(0, 1))
    edges = np.cumsum([0, *SIZES])
    power = {
        CHANNELS[side][channel]: by_axis[edges[side] : edges[side + 1], channel].sum()
        for side in range(len(SIZES))
        for channel in range(2)
        if CHANNELS[side][channel] is not None
    }
    return max(power, key=power.get)


def _is_same(worse: float, left_beside: float) -> bool:
    """Return whether a log cannot tell a rival apart: it explains as much, or chance alone decides.

    worse: the rival's model, of chi2. left_beside: of lambda, with the rival taken out.
    """
    return worse < SAME or (left_beside < SAME and worse < BY_CHANCE * SAME)


def held_out_gain(held_out: Problem, less: np.ndarray, full: np.ndarray) -> tuple[float, float]:
    """Return what a model gains over a lesser one on other rows, and what it would if it were right there."""
    white = held_out.whiten(held_out.left(np.stack([less, full])))
    gain = float(np.sum(white[0] ** 2) - np.sum(white[1] ** 2))
    return gain, float(np.sum((white[0] - white[1]) ** 2))


def effect_causes(
    problem: Problem,
    held_out: Problem,
    outlook: Outlook,
    found: Found,
    weighed: Mapping[str, Weighed],
) -> list[Cause]:
    """Return the effects of a model as causes, those that explain most first."""
    causes = []
    for one in found.chosen:
        weight = weighed[one.effect]
        lambda_, beside = separations(problem, outlook, found, one.effect)
        twins = tuple(
            rival
            for rival, worse in sorted(weight.rivals.items(), key=lambda pair: pair[1])
            if rival in weight.swaps and _is_same(worse, beside.get(rival, lambda_))
        )
        # Refitted where that was worth it, else to first order.
        rivals = {name: min(weight.rivals.get(name, size), size) for name, size in beside.items()}
        closest = min(rivals, key=rivals.get, default="")
        causes.append(
            Cause(
                effect=one.effect,
                equivalent=twins,
                channel=channel_of(problem, weight.less.vector, found.vector),
                parameters=estimates(problem, outlook, found, one.fields),
                chi2_gain=weight.gain,
                heldout_gain=held_out_gain(held_out, weight.less.vector, found.vector)[0],
                lambda_=lambda_,
                lambda_sep=max(rivals.get(closest, lambda_), 0.0),
                closest=closest,
            )
        )
    kept = [
        cause
        for cause in causes
        # Found in place of a thrust curve.
        if cause.effect != "thrust_scale" or not _is_remainder(cause.chi2_gain, cause.channel, causes)
    ]
    return sorted(kept, key=lambda cause: -cause.chi2_gain)


def is_contradicted(gain: float, expected: float, inflation: float) -> bool:
    """Return whether a gain on held-out rows says that what was found is not there.

    expected: what it would be if it were; the spread is that of a chi2 about it.
    """
    if expected < SHOWN * inflation:
        return False
    spread = 2.0 * np.sqrt(expected * inflation)
    share = 0.5 * (1.0 + gain / expected)
    return gain < expected - HELD_OUT_SIGMAS * spread and share < HELD_OUT_SHARE


def base_causes(
    problem: Problem,
    held_out: Problem,
    outlook: Outlook,
    found: Found,
    doubtful: Sequence[str],
    effects: Sequence[Cause],
) -> tuple[list[Cause], list[str]]:
    """Return base parameters that the log contradicts, as causes, and names that held-out rows take back.

    doubtful: names that are not given. effects: causes that were found; their laws are not exact, and what
    gains next to nothing beside one that shows in the same place is its remainder.
    """
    causes: list[Cause] = []
    lost: list[str] = []
    for name, fields in BASE_CAUSES.items():
        wrong = contradiction(problem, outlook, found, fields)
        if wrong is None or name in doubtful:
            continue
        acting, covered, gain = wrong
        places = problem.index(acting)
        nominal = found.vector.copy()
        nominal[places] = problem.start[places]
        held, expected = _refitted_gain(held_out, problem, outlook, found, places, nominal)
        if is_contradicted(held, expected, covered.inflation):
            lost.append(name)
            continue
        channel = channel_of(problem, nominal, found.vector)
        if _is_remainder(gain, channel, effects):
            continue
        parameters, twins = estimates(problem, outlook, found, acting), ()
        if name == "thrust_curve":
            scaled = _as_scale(problem.start[places], found.vector[places], covered)
            if scaled is not None:
                name, parameters, twins = "thrust_scale", {"factor": scaled}, SCALE_TWINS
        causes.append(Cause(name, twins, channel, parameters, gain, held, lambda_=gain, lambda_sep=gain))
    return sorted(causes, key=lambda cause: -cause.chi2_gain), lost


def _is_remainder(gain: float, channel: str, others: Sequence[Cause]) -> bool:
    """Return whether a gain is next to nothing beside that of a cause that shows in the same place."""
    side = next(names for names in CHANNELS if channel in names)
    return gain < OF_LAW * max((one.chi2_gain for one in others if one.channel in side), default=0.0)


def _refitted_gain(
    held_out: Problem,
    problem: Problem,
    outlook: Outlook,
    found: Found,
    places: Sequence[int],
    nominal: np.ndarray,
) -> tuple[float, float]:
    """Return ``held_out_gain`` over the model with some parameters at nominal and the rest fitted again."""
    others = [place for place in found.places if place not in set(places)]
    columns = [outlook.places.index(place) for place in others]
    own = [outlook.places.index(place) for place in places]
    change = nominal[list(places)] - found.vector[list(places)]
    score = outlook.score[columns] - outlook.total[np.ix_(columns, own)] @ change
    less = nominal.copy()
    less[others] += solve(outlook.total[np.ix_(columns, columns)], score)
    return held_out_gain(held_out, problem.clipped(less[None])[0], found.vector)


def _as_scale(nominal: np.ndarray, values: np.ndarray, covered: Covered) -> Estimated | None:
    """Return the factor between two thrust curves, if one explains all that the log says of them."""
    along = nominal @ covered.information
    known = float(along @ nominal)
    if known <= 0.0:
        return None  # a curve of zeros
    factor = float(along @ values) / known
    rest = values - factor * nominal
    if rest @ covered.information @ rest / covered.inflation > threshold(len(values) - 1):
        return None
    half = TWO_SIDED_95 * float(np.sqrt(covered.inflation / known))
    return Estimated(factor, (factor - half, factor + half), "1")


def sensor_noise(problem: Problem) -> dict[str, list[float]]:
    """Return the standard deviations of the sensors as found, by channel and axis (world frame)."""
    noise = noises.noise_of(problem.noise)
    edges = np.cumsum([0, *SIZES])
    found = {}
    for side, names in enumerate(CHANNELS):
        for name, values in zip(names, (noise.direct, noise.level), strict=True):
            axes = slice(edges[side], edges[side + 1])
            if name is not None and problem.counts[..., axes, (*names,).index(name)].any():
                own = np.asarray(values)[axes]
                found[name] = [float(f"{value:.4g}") for value in own]
    return found
