"""What no effect of the list explains: whether something is left, and what it depends on."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage, stats

from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.lanes import AXES, lead_in_of
from flytrack_sysid.diagnosis.problem import Problem, blocks_of, robust_weight
from flytrack_sysid.diagnosis.regressors import BUMP_SIZE, Flown, bumps, dependences, flown
from flytrack_sysid.diagnosis.result import Unexplained
from flytrack_sysid.diagnosis.score_test import inflation_of, solve
from flytrack_sysid.diagnosis.search import FittedModel
from flytrack_sysid.parameters import TAUS

SIDES = {"rate": AXES[0], "force": AXES[1]}  # axes of a residual
RIDGE = 1e-6  # of each column's own: features are nearly dependent where little was flown
CHANCE = 1e-6  # of a flag where nothing is left, for each dependence
MATERIAL = 0.08  # of the sensor's noise, rms: less is left alone
OF_NAMED = 0.15  # of what the named causes do, rms: laws of the list are not exact
OF_WANDERING = 0.45  # of the wandering disturbance, rms: a dependence that explains less is a coincidence
MOST_DEPENDENCES = 3
PERIODIC_HZ = (0.3, 25.0)
LINE = 28.0  # power of a line over that of its neighbourhood: e^-28 by chance
NEIGHBOURS = 40  # frequencies on each side
STOCHASTIC_GAIN, STOCHASTIC_SHARE = 50.0, 0.15  # of minus twice the log likelihood; of the sensor's noise
FELT = 0.3  # coupling from which a disturbance moves the drone and not only the sensor


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


class SideTest(NamedTuple):
    """Score test on the axes of one side, rotation or force; all by blocks of a second.

    root: of the robust weights. rest: weighted residuals. given: columns that are free already.
    """

    root: np.ndarray
    rest: np.ndarray
    given: np.ndarray

    @classmethod
    def of(cls, side: str, white: np.ndarray, slopes: np.ndarray) -> "SideTest":
        """Return the test of whitened residuals (rows, lanes, NUM_AXES, 2) beside slopes (count, ...)."""
        axes = SIDES[side]
        own = white[..., axes, :]
        root = np.sqrt(robust_weight(own))
        given = slopes[..., axes, :]
        acting = np.abs(given).reshape(len(given), -1).max(axis=1) > 0.0
        return cls(root, blocks_of(own * root), blocks_of(given[acting] * root))

    def given_also(self, *columns: np.ndarray) -> "SideTest":
        """Return the test with more columns that are free already."""
        return self._replace(given=np.concatenate([self.given, *columns], axis=1))

    def _projected(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return shares of given columns in others, information and score with those projected out.

        Last, the step along the given columns alone.
        """
        across = np.einsum("bgn,bfn->gf", self.given, columns, optimize=True)
        inner = np.einsum("bgn,bhn->gh", self.given, self.given, optimize=True)
        inner += RIDGE * np.diag(np.maximum(np.diag(inner), 1.0))
        share = solve(inner, across)
        total = np.einsum("bfn,bhn->fh", columns, columns, optimize=True)
        own = total - across.T @ share + RIDGE * np.diag(np.diag(total))
        given = np.einsum("bgn,bn->g", self.given, self.rest, optimize=True)
        score = np.einsum("bfn,bn->f", columns, self.rest, optimize=True) - share.T @ given
        return share, own, score, solve(inner, given)

    def gain(self, columns: np.ndarray) -> tuple[float, float, np.ndarray]:
        """Return chi2 of features besides what is given, its inflation, and their coefficients."""
        share, own, score, alone = self._projected(columns)
        own += np.eye(len(own))  # a weak prior: features of size 1
        step = solve(own, score)
        given = alone - share @ step
        after = self.rest - np.einsum("bfn,f->bn", columns, step) - np.einsum("bgn,g->bn", self.given, given)
        blocks = np.einsum("bfn,bn->bf", columns, after) - np.einsum("bgn,bn->bg", self.given, after) @ share
        return float(score @ step), inflation_of(own, blocks), step

    def best_group(self, columns: np.ndarray, size: int) -> int:
        """Return which group of so many consecutive features explains most by itself."""
        _, own, score, _ = self._projected(columns)
        inner = [slice(start, start + size) for start in range(0, len(score) - size + 1, size)]
        chi2 = [score[part] @ solve(own[part, part] + np.eye(size), score[part]) for part in inner]
        return int(np.argmax(chi2))

    def noncentrality(self, columns: np.ndarray, size: np.ndarray) -> float:
        """Return the squared signature of slopes at a size, fitted again beside what is given."""
        _, own, score, _ = self._projected(columns)
        again = size - solve(own, score)
        return float(again @ own @ again)


def whitened(problem: Problem, features_w: np.ndarray, side: str) -> np.ndarray:
    """Return whitened what features (count, rows, lanes, 3) would leave on a side's axes."""
    step_s = noises.step_to(problem.lanes)[..., None]
    joined = features_w * problem.lanes.is_joined[..., None]
    return problem.whiten(np.stack([joined, joined * step_s], axis=-1), SIDES[side])


def flight_of(problem: Problem, model: FittedModel) -> Flown:
    """Return what was flown, with the lags of a model."""
    return flown(problem.lanes, model.vector[problem.index(TAUS)])


def linearized_residuals(problem: Problem, model: FittedModel) -> tuple[np.ndarray, np.ndarray]:
    """Return a model's residuals, and their slopes along what is free, whitened."""
    slopes = problem.slopes(model.vector, model.places)
    return problem.whiten(slopes.residuals[None])[0], problem.whiten(slopes.columns)


def _rms(features_w: np.ndarray, step: np.ndarray, is_counted: np.ndarray) -> float:
    """Return the rms size of a fitted effect over the rows that count, in its own unit."""
    signal = np.tensordot(step, features_w, axes=1)[is_counted]
    signal = signal - signal.mean(axis=0)
    return float(np.sqrt(np.mean(np.sum(signal**2, axis=-1))))


def _named_size(problem: Problem, model: FittedModel, base: np.ndarray, side: str) -> float:
    """Return the rms of what named causes change in a side's direct channel."""
    if not model.candidates:
        return 0.0
    left = problem.residuals(np.stack([model.vector, base]))
    change = (left[1] - left[0])[..., SIDES[side], 0][problem.counts.any(axis=(2, 3))]
    return float(np.sqrt(np.mean(np.sum(change**2, axis=-1))))


def _sensor_noise(noise: noises.Noise, axes: slice) -> float:
    """Return the rms standard deviation of a side's direct sensor."""
    return float(np.sqrt(np.mean(np.asarray(noise.direct[axes]) ** 2)))


def _wandering(noise: noises.Noise, axes: slice) -> float:
    """Return the standard deviation of a disturbance that moves the drone, over all axes of a side."""
    felt = np.asarray(noise.coupling)[axes] > FELT
    return float(np.sqrt(np.sum((np.asarray(noise.disturbance)[axes] * felt) ** 2)))


def find_dependences(
    problem: Problem, model: FittedModel, base: np.ndarray, waves: Mapping[str, np.ndarray]
) -> list[Dependence]:
    """Return dependences of what a model leaves, the clearest first, on each side at most three.

    base: vector of the refitted model without effects. waves: features that are given, by side.
    """
    flight = flight_of(problem, model)
    features = dependences(flight)
    white, slopes = linearized_residuals(problem, model)
    result = []
    for side, axes in SIDES.items():
        if not problem.counts[..., axes, :].any():
            continue
        test = SideTest.of(side, white, slopes)

        def feature(name: str, one: np.ndarray, side: str = side, test: SideTest = test) -> Feature:
            return Feature(name, one, blocks_of(whitened(problem, one, side) * test.root))

        if side in waves:
            test = test.given_also(feature("periodic", waves[side]).columns)
        noise = _sensor_noise(problem.fitted_noise, axes)
        least = max(
            MATERIAL * noise,
            OF_NAMED * _named_size(problem, model, base, side),
            OF_WANDERING * _wandering(problem.fitted_noise, axes),
        )
        smooth = [feature(name, one) for name, one in features[side].items()]
        has_places = side == "force" and flight.pos_w.any()
        places = feature("position", bumps(flight)) if has_places else None
        result += _greedy(test, side, smooth, places, flight, least, noise)
    return sorted(result, key=lambda one: -one.gain)


def _greedy(
    test: SideTest,
    side: str,
    smooth: Sequence[Feature],
    places: Feature | None,
    flight: Flown,
    least: float,
    noise: float,
) -> list[Dependence]:
    """Return dependences one after the other, each besides those before."""
    result: list[Dependence] = []
    while len(result) < MOST_DEPENDENCES:
        best: Dependence | None = None
        for one in (*smooth, *([] if places is None else [_best_bump(test, places)])):
            if any(one.name == earlier.name for earlier in result):
                continue
            chi2, inflation, step = test.gain(one.columns)
            number, size = one.columns.shape[1], _rms(one.features_w, step, flight.is_counted)
            if chi2 / inflation < stats.chi2.isf(CHANCE / one.tries, number) or size < least:
                continue
            gain = chi2 / inflation - 2.0 * number
            if best is None or gain > best.gain:
                best = Dependence(one.name, side, gain, size / noise, one.columns)
        if best is None:
            break
        result.append(best)
        test = test.given_also(best.columns)
    return result


def _best_bump(test: SideTest, places: Feature) -> Feature:
    """Return the bump about a place that explains most."""
    group = test.best_group(places.columns, BUMP_SIZE)
    part = slice(group * BUMP_SIZE, (group + 1) * BUMP_SIZE)
    tries = places.columns.shape[1] // BUMP_SIZE
    return Feature(places.name, places.features_w[part], places.columns[:, part], tries)


class Line(NamedTuple):
    """A line in the spectrum of a side's residuals, body frame; share: amplitude over the sensor's noise."""

    side: str
    frequency_hz: float
    share: float


def find_lines(problem: Problem, model: FittedModel) -> list[Line]:
    """Return what is periodic in a model's residuals, at most one line on each side."""
    flight = flight_of(problem, model)
    left = problem.residuals(model.vector[None])[0]
    result = []
    for side, axes in SIDES.items():
        counts = np.asarray(problem.counts[..., axes, 0].all(axis=-1))
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
            share = float(size / _sensor_noise(problem.fitted_noise, axes))
            result.append(Line(side, float(frequency[peak]), share))
    return result


def waves_of(problem: Problem, model: FittedModel, lines: Sequence[Line]) -> dict[str, np.ndarray]:
    """Return sine and cosine at the frequencies of lines, along the body's axes, by side."""
    flight = flight_of(problem, model)
    body = np.moveaxis(flight.body_to_world, -1, 0)
    result = {}
    for line in lines:
        phase = 2.0 * np.pi * line.frequency_hz * flight.time_s
        both = np.stack([np.sin(phase), np.cos(phase)])
        product = both[:, None, ..., None] * body[None]
        result[line.side] = product.reshape(-1, *product.shape[2:])
    return result


def stochastic_shares(problem: Problem, model: FittedModel) -> dict[str, float]:
    """Return, by side, the size over the sensor's noise of a wandering disturbance that is clearly there."""
    assert problem.noise is not None
    left = problem.residuals(model.vector[None])[0]
    noise = problem.fitted_noise
    felt = np.asarray(noise.coupling) > FELT
    share = np.asarray(noise.disturbance / noise.direct)
    gain = noises.disturbance_gain(problem.lanes, left, problem.noise)
    result = {}
    for side, axes in SIDES.items():
        size = float(np.sqrt(np.sum((share * (felt & (gain > STOCHASTIC_GAIN)))[axes] ** 2)))
        if size > STOCHASTIC_SHARE:
            result[side] = size
    return result


def find_unexplained(
    problem: Problem, model: FittedModel, base: np.ndarray
) -> tuple[Unexplained, list[Dependence]]:
    """Return what a model leaves unexplained, and its dependences, which a veto may use.

    base: vector of the refitted model without effects.
    """
    lines = find_lines(problem, model)
    found = find_dependences(problem, model, base, waves_of(problem, model, lines))
    shares = {f"{one.side}: periodic at {one.frequency_hz:.3g} Hz": one.share for one in lines}
    shares |= {f"{one.side}: {one.name}": one.share for one in found}
    if not shares:
        stochastic = stochastic_shares(problem, model)
        shares = {f"{side}: stochastic": size for side, size in stochastic.items()}
    names = [name.split(": ", 1)[1] for name in shares]
    return Unexplained(bool(shares), tuple(dict.fromkeys(names)), shares), found
