"""What is left that no effect of the list explains: whether it is there, and what it depends on."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage, stats

from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.lanes import lead_in_of
from flytrack_sysid.diagnosis.problem import Problem, blocks_of
from flytrack_sysid.diagnosis.regressors import BUMP_SIZE, SIDES, Flown, bumps, dependences
from flytrack_sysid.diagnosis.result import Unexplained
from flytrack_sysid.diagnosis.search import Found
from flytrack_sysid.diagnosis.sides import Side, flight_of, seen, whitened

CHANCE = 1e-6  # of a flag where nothing is left, for each dependence
MATERIAL = 0.08  # of the sensor's noise, rms: less is left alone
OF_NAMED = 0.15  # of what the named causes do, rms: laws of the list are not exact
OF_WANDERING = 0.45  # of the disturbance that is there, rms: a dependence that explains less is a coincidence
MOST_DEPENDENCES = 3
PERIODIC_HZ = (0.3, 25.0)
LINE = 28.0  # power of a line over that of its neighbourhood: e^-28 by chance
NEIGHBOURS = 40  # frequencies on each side
STOCHASTIC_GAIN, STOCHASTIC_SHARE = 50.0, 0.15  # of minus twice the log likelihood; of the sensor's noise
FELT = 0.3  # coupling from which a disturbance is the drone's and not the sensor's


class Dependence(NamedTuple):
    """A dependence found on one side: its name, gain over its inflation, and rms over the sensor's noise."""

    name: str
    side: str
    gain: float
    share: float
    columns: np.ndarray


class Feature(NamedTuple):
    """What an unknown effect may do: smooth functions in the world frame, and whitened by blocks.

    tries: among how many of its kind it was chosen.
    """

    name: str
    features_w: np.ndarray
    columns: np.ndarray
    tries: int = 1


def _rms(features_w: np.ndarray, step: np.ndarray, counts: np.ndarray) -> float:
    """Return the rms size of a fitted effect over the rows that count, in its own unit."""
    signal = np.tensordot(step, features_w, axes=1)[counts]
    signal = signal - signal.mean(axis=0)
    return float(np.sqrt(np.mean(np.sum(signal**2, axis=-1))))


def _named_size(problem: Problem, found: Found, base: np.ndarray, side: str) -> float:
    """Return the rms of what named causes change in a side's direct channel."""
    if not found.chosen:
        return 0.0
    left = problem.left(np.stack([found.vector, base]))
    change = (left[1] - left[0])[..., SIDES[side], 0][problem.lanes.counts.any(axis=(2, 3))]
    return float(np.sqrt(np.mean(np.sum(change**2, axis=-1))))


def _wandering(noise: noises.Noise, axes: slice) -> float:
    """Return the standard deviation of a disturbance that the drone feels, over all axes of a side."""
    felt = np.asarray(noise.coupling)[axes] > FELT
    return float(np.sqrt(np.sum((np.asarray(noise.disturbance)[axes] * felt) ** 2)))


def depends_on(
    problem: Problem, found: Found, base: np.ndarray, extra: Mapping[str, np.ndarray] | None = None
) -> list[Dependence]:
    """Return dependences of what a model leaves, the clearest first, on each side at most three."""
    flight = flight_of(problem, found)
    left, slopes = seen(problem, found)
    features = dependences(flight)
    noise = noises.noise_of(problem.noise)
    result = []
    for side, axes in SIDES.items():
        if not problem.lanes.counts[..., axes, :].any():
            continue
        sums = Side(problem, side, left, slopes)
        if extra is not None and side in extra:
            sums.given = np.concatenate(
                [sums.given, blocks_of(whitened(problem, extra[side], side) * sums.root)], axis=1
            )
        own_noise = float(np.sqrt(np.mean(np.asarray(noise.direct[axes]) ** 2)))
        least = max(
            MATERIAL * own_noise,
            OF_NAMED * _named_size(problem, found, base, side),
            OF_WANDERING * _wandering(noise, axes),
        )
        looked_at = [
            Feature(name, one, blocks_of(whitened(problem, one, side) * sums.root))
            for name, one in features[side].items()
        ]
        around = bumps(flight) if side == "force" and flight.pos_w.any() else None
        places = None
        if around is not None:
            places = Feature("position", around, blocks_of(whitened(problem, around, side) * sums.root))
        result += _greedy(sums, side, looked_at, places, flight, least, own_noise)
    return sorted(result, key=lambda one: -one.gain)


def _greedy(
    sums: Side,
    side: str,
    looked_at: Sequence[Feature],
    places: Feature | None,
    flight: Flown,
    least: float,
    own_noise: float,
) -> list[Dependence]:
    """Return dependences one after the other, each besides those before."""
    result: list[Dependence] = []
    while len(result) < MOST_DEPENDENCES:
        best: Dependence | None = None
        for one in (*looked_at, *([] if places is None else [_best_bump(sums, places)])):
            if any(one.name == earlier.name for earlier in result):
                continue
            chi2, inflation, step = sums.gain(one.columns)
            count, size = one.columns.shape[1], _rms(one.features_w, step, flight.counts)
            if chi2 / inflation < stats.chi2.isf(CHANCE / one.tries, count) or size < least:
                continue
            gain = chi2 / inflation - 2.0 * count
            if best is None or gain > best.gain:
                best = Dependence(one.name, side, gain, size / own_noise, one.columns)
        if best is None:
            break
        result.append(best)
        sums.given = np.concatenate([sums.given, best.columns], axis=1)
    return result


def _best_bump(sums: Side, places: Feature) -> Feature:
    """Return the bump about a place that explains most."""
    group = sums.best_group(places.columns, BUMP_SIZE)
    part = slice(group * BUMP_SIZE, (group + 1) * BUMP_SIZE)
    tries = places.columns.shape[1] // BUMP_SIZE
    return Feature(places.name, places.features_w[part], places.columns[:, part], tries)


def lines(problem: Problem, found: Found) -> list[tuple[str, float, float]]:
    """Return side, frequency in Hz and amplitude over the sensor's noise of what is periodic, body frame."""
    flight = flight_of(problem, found)
    left = problem.left(found.vector[None])[0]
    noise = noises.noise_of(problem.noise)
    result = []
    for side, axes in SIDES.items():
        counts = problem.lanes.counts[..., axes, 0].all(axis=-1)
        if not counts.any():
            continue
        body = np.einsum("rlji,rlj->rli", flight.body_to_world, left[..., axes, 0]) * counts[..., None]
        series = np.swapaxes(body[lead_in_of(len(body)) :], 0, 1).reshape(-1, 3)
        step_s = float(np.median(noises.step_to(problem.lanes)))
        power = (np.abs(np.fft.rfft(series, axis=0)) ** 2).max(axis=1)
        frequency = np.fft.rfftfreq(len(series), step_s)
        usual = ndimage.median_filter(power, 2 * NEIGHBOURS + 1, mode="nearest")
        inside = (frequency > PERIODIC_HZ[0]) & (frequency < PERIODIC_HZ[1])
        ratio = np.where(inside, power / np.maximum(usual, 1e-300), 0.0)
        peak = int(np.argmax(ratio))
        if ratio[peak] > LINE:
            size = 2.0 * np.sqrt(power[peak]) / counts.sum()
            own = float(np.sqrt(np.mean(np.asarray(noise.direct[axes]) ** 2)))
            result.append((side, float(frequency[peak]), float(size / own)))
    return result


def stochastic(problem: Problem, found: Found) -> dict[str, float]:
    """Return, by side, the size over the sensor's noise of a disturbance that is clearly there."""
    result = {}
    left = problem.left(found.vector[None])[0]
    noise = noises.noise_of(problem.noise)
    felt = np.asarray(noise.coupling) > FELT
    share = np.asarray(noise.disturbance / noise.direct)
    gain = noises.disturbance_gain(problem.lanes, left, problem.noise)
    for side, axes in SIDES.items():
        here = felt[axes] & (gain[axes] > STOCHASTIC_GAIN)
        size = float(np.sqrt(np.sum((share[axes] * here) ** 2)))
        if size > STOCHASTIC_SHARE:
            result[side] = size
    return result


def look(problem: Problem, found: Found, base: np.ndarray) -> tuple[Unexplained, list[Dependence]]:
    """Return what a model leaves unexplained, and the dependences that a veto may use."""
    periodic = lines(problem, found)
    found_on = depends_on(problem, found, base, _waves(problem, found, periodic))
    shares = {f"{side}: periodic at {hz:.3g} Hz": size for side, hz, size in periodic}
    shares |= {f"{one.side}: {one.name}": one.share for one in found_on}
    if not shares:
        shares |= {f"{side}: stochastic": size for side, size in stochastic(problem, found).items()}
    names = [name.split(": ", 1)[1] for name in shares]
    return Unexplained(bool(shares), tuple(dict.fromkeys(names)), shares), found_on


def _waves(
    problem: Problem, found: Found, periodic: Sequence[tuple[str, float, float]]
) -> dict[str, np.ndarray]:
    """Return sine and cosine at the frequencies found, along the body's axes, by side."""
    flight = flight_of(problem, found)
    body = np.moveaxis(flight.body_to_world, -1, 0)
    result = {}
    for side, hz, _ in periodic:
        phase = 2.0 * np.pi * hz * flight.time_s
        both = np.stack([np.sin(phase), np.cos(phase)])
        product = both[:, None, ..., None] * body[None]
        result[side] = product.reshape(-1, *product.shape[2:])
    return result
