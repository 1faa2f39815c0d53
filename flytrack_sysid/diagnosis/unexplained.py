"""What no effect of the list explains: whether something is left, and what it depends on."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage, stats
from scipy.spatial.transform import Rotation

from flytrack_env.state import ACTION_SIZE
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.chunks import AXES, lead_in_of
from flytrack_sysid.diagnosis.problem import Problem, blocks_of, robust_weight
from flytrack_sysid.diagnosis.result import Unexplained
from flytrack_sysid.diagnosis.score_test import inflation_of, solve, threshold
from flytrack_sysid.diagnosis.search import FittedModel
from flytrack_sysid.parameters import TAUS

SIDES = {"rate": AXES[0], "force": AXES[1]}  # axes of a residual
RIDGE = 1e-6  # of each column's own: features are nearly dependent where little was flown
FALSE_POSITIVE_RATE = 1e-6  # of a flag where nothing is left, for each dependence
MATERIAL = 0.08  # of the sensor's noise, rms: less is left alone
OF_NAMED = 0.15  # of what the named causes do, rms: laws of the list are not exact
# of the wandering disturbance, rms: a dependence that explains less is a coincidence
OF_WANDERING = 0.45
MAX_DEPENDENCES = 3
PERIODIC_HZ = (0.3, 25.0)
LINE = 28.0  # power of a line over that of its neighbourhood: e^-28 by chance
NEIGHBOURS = 40  # frequencies on each side
STOCHASTIC_GAIN, STOCHASTIC_SHARE = (
    50.0,
    0.15,
)  # of minus twice the log likelihood; of the sensor's noise
# of a base change beside a steady force: it keeps less beside one that drifts, too
DRIFT_SHARE = 0.1
FELT = 0.3  # coupling from which a disturbance moves the drone and not only the sensor
TIME_WAVES, RANK_WAVES, CHANGE_WAVES, HEADING_WAVES, PLACE_WAVES = 8, 6, 4, 4, 2
TINY_SPEED = 0.3  # m/s: slower flight has no direction
# Bumps about places on the way: how many places, and widths, m.
BUMP_PLACES, BUMP_WIDTHS_M = 24, (3.0, 8.0)
BUMP_SIZE = 3  # features of one bump: a force along each world axis


class FlightVariables(NamedTuple):
    """The flight at the step to each row: what a force or rate may depend on, (rows, chunks, ...).

    body_to_world: (rows, chunks, 3, 3). applied: action, and change: its derivative, 1/s; (rows,
    chunks, 4). is_counted: bool, rows that are judged.
    """

    body_to_world: np.ndarray
    pos_w: np.ndarray
    vel_w: np.ndarray
    applied: np.ndarray
    change: np.ndarray
    time_s: np.ndarray
    is_counted: np.ndarray


def flight_of(problem: Problem, model: FittedModel) -> FlightVariables:
    """Return what was flown, with the lags of a model between commands and applied action."""
    chunks, tau = problem.chunks, model.vector[problem.indices_of(TAUS)]

    def before(values: np.ndarray) -> np.ndarray:  # a step begins at the row before
        return np.concatenate([values[:1], values[:-1]])

    record = chunks.record
    quat = before(record.quat).reshape(-1, 4)
    rotation = (
        Rotation.from_quat(quat, scalar_first=True).as_matrix().reshape(*chunks.row.shape, 3, 3)
    )
    applied = _lagged(record.command, record.step_s, tau)
    change = (record.command - applied) / tau
    time_s = np.where(chunks.row >= 0, chunks.row, 0) * float(np.median(noises.step_to(chunks)))
    is_counted = np.asarray(chunks.counts.any(axis=(2, 3)))
    return FlightVariables(
        rotation,
        before(record.pos_w),
        before(record.vel_w),
        applied,
        before(change),
        time_s,
        is_counted,
    )


def _lagged(command: np.ndarray, step_s: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return commands after a first-order lag, whose start the lead-in of chunks forgets."""
    applied = command.copy()
    for row in range(1, len(command)):
        keep = np.exp(-step_s[row - 1, :, None] / tau)
        applied[row] = command[row - 1] + keep * (applied[row - 1] - command[row - 1])
    return applied


def _rank_waves(values: np.ndarray, is_counted: np.ndarray, number: int) -> np.ndarray:
    """Return cosines of the rank of a value, as a share of the flight, (number, rows, chunks)."""
    share = np.zeros(values.shape)
    share[is_counted] = (stats.rankdata(values[is_counted]) - 0.5) / max(int(is_counted.sum()), 1)
    return np.stack([np.cos(np.pi * order * share) for order in range(1, number + 1)])


def _place_waves(flight: FlightVariables) -> np.ndarray:
    """Return products of cosines of the ranks of x, y and z, (number, rows, chunks)."""
    axes = [
        _rank_waves(flight.pos_w[..., axis], flight.is_counted, PLACE_WAVES) for axis in range(3)
    ]
    axes = [np.concatenate([np.ones_like(waves[:1]), waves]) for waves in axes]
    orders = np.argwhere(np.indices((PLACE_WAVES + 1,) * 3).sum(axis=0) <= PLACE_WAVES)
    return np.stack([axes[0][i] * axes[1][j] * axes[2][k] for i, j, k in orders if i + j + k > 0])


def bumps(flight: FlightVariables) -> np.ndarray:
    """Return forces that act only near some places of the flight, like a thermal.

    (bumps * BUMP_SIZE, rows, chunks, 3), world frame; all axes of a bump in a row.
    """
    where = flight.pos_w[flight.is_counted]
    chosen = np.linspace(0, len(where) - 1, 2 * BUMP_PLACES + 1).astype(int)[1::2]
    waves = []
    for place in where[chosen]:
        squared = np.square(flight.pos_w - place).sum(axis=-1)
        waves += [np.exp(-0.5 * squared / width**2) for width in BUMP_WIDTHS_M]
    world = np.broadcast_to(np.eye(BUMP_SIZE)[:, None, None, :], (BUMP_SIZE, *waves[0].shape, 3))
    return _along(np.stack(waves), world)


def _along(waves: np.ndarray, vectors_w: np.ndarray) -> np.ndarray:
    """Multiply features by world vectors (directions, rows, chunks, 3).

    Returns:
        (features, rows, chunks, 3), a row for each feature and direction.
    """
    product = waves[:, None, ..., None] * vectors_w[None]
    return product.reshape(-1, *product.shape[2:])


def time_features(flight: FlightVariables) -> np.ndarray:
    """Return smooth functions of time along the body's axes, (features, rows, chunks, 3).

    They are in the world frame.
    """
    span = max(float(flight.time_s[flight.is_counted].max(initial=0.0)), 1e-9)
    times = np.stack([np.cos(np.pi * n * flight.time_s / span) for n in range(1, TIME_WAVES + 1)])
    return _along(times, np.moveaxis(flight.body_to_world, -1, 0))


def dependences(flight: FlightVariables) -> Mapping[str, Mapping[str, np.ndarray]]:
    """Return by side (rate, force) and dependence what an unknown effect might add, of unit size.

    (features, rows, chunks, 3), world frame.
    """
    counted = flight.is_counted
    body = np.moveaxis(flight.body_to_world, -1, 0)  # body axes in the world
    world = np.broadcast_to(np.eye(3)[:, None, None, :], body.shape)
    heading = np.arctan2(flight.body_to_world[..., 1, 0], flight.body_to_world[..., 0, 0])
    orders = range(1, HEADING_WAVES + 1)
    turns = np.stack([wave(n * heading) for n in orders for wave in (np.sin, np.cos)])
    tilt = _rank_waves(flight.body_to_world[..., 2, 2], counted, RANK_WAVES)
    fast = _rank_waves(np.linalg.norm(flight.vel_w, axis=-1), counted, RANK_WAVES)
    place = _place_waves(flight)
    moves = ((flight.applied, RANK_WAVES), (flight.change, CHANGE_WAVES))
    sticks = [
        np.concatenate(
            [_rank_waves(values[..., stick], counted, number) for values, number in moves]
        )
        for stick in range(ACTION_SIZE)
    ]
    rate = {
        "position": _along(place, body),
        "time": time_features(flight),
        "heading": _along(turns, body),
        "airspeed": _along(fast, body),
        "attitude": _along(tilt, body),
        "command": np.concatenate(
            [_along(sticks[axis], body[axis : axis + 1]) for axis in range(3)]
        ),
    }
    force = rate | {
        "position": _along(place, world),
        "airspeed": _along(fast, np.stack([_direction(flight), body[2]])),
        "command": _along(sticks[3], body[2:]),
    }
    return {"rate": rate, "force": force}


def constants(flight: FlightVariables, side: str) -> np.ndarray:
    """Return unit rates along the body's axes, or unit forces along fixed directions.

    The forces are along the body's and the world's axes, and the direction of flight.
    """
    body = np.moveaxis(flight.body_to_world, -1, 0)
    world = np.broadcast_to(np.eye(3)[:, None, None, :], body.shape)
    return body if side == "rate" else np.concatenate([body, world, _direction(flight)[None]])


def _direction(flight: FlightVariables) -> np.ndarray:
    """Return the direction of flight, world frame, (rows, chunks, 3).

    Its length is below 1 where the drone hardly moves.
    """
    speed = np.linalg.norm(flight.vel_w, axis=-1)
    return flight.vel_w / np.maximum(speed, TINY_SPEED)[..., None]


class Dependence(NamedTuple):
    """A dependence found on one side.

    gain: over its inflation. share: rms over the sensor's noise.
    """

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


class SideFit(NamedTuple):
    """Features fitted on one side.

    step, errors: coefficients and standard errors. given: the step of what is given beside them.

    chi2: gained. inflation: how much more scores vary than information says.
    """

    step: np.ndarray
    errors: np.ndarray
    given: np.ndarray
    chi2: float
    inflation: float

    @property
    def gain(self) -> float:
        """Return chi2 over its inflation."""
        return self.chi2 / self.inflation


class SideTest(NamedTuple):
    """Score test on the axes of one side, rotation or force; all by blocks of a second.

    root: of the robust weights. rest: weighted residuals. given: columns that are free already.
    """

    root: np.ndarray
    rest: np.ndarray
    given: np.ndarray

    @classmethod
    def of(cls, side: str, white: np.ndarray, slopes: np.ndarray) -> "SideTest":
        """Return the test of whitened residuals beside slopes.

        white: (rows, chunks, NUM_AXES, 2). slopes: (count, rows, chunks, NUM_AXES, 2).
        """
        axes = SIDES[side]
        own = white[..., axes, :]
        root = np.sqrt(robust_weight(own))
        given = slopes[..., axes, :]
        acting = np.abs(given).reshape(len(given), -1).max(axis=1) > 0.0
        return cls(root, blocks_of(own * root), blocks_of(given[acting] * root))

    def given_also(self, *columns: np.ndarray) -> "SideTest":
        """Return the test with more columns that are free already."""
        return self._replace(given=np.concatenate([self.given, *columns], axis=1))

    def of_blocks(self, is_kept: np.ndarray) -> "SideTest":
        """Return the test on some blocks, (blocks,) bool."""
        return self._replace(rest=self.rest[is_kept], given=self.given[is_kept])

    def projected(
        self, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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

    def fit(self, columns: np.ndarray, least_own: float = 0.0) -> SideFit:
        """Return features fitted besides what is given.

        least_own: columns with less information of their own, beyond what is given, stay 0. Where a
        feature nearly is what is given, it only moves the model's forces to another instant of the
        step.
        """
        share, own, score, alone = self.projected(columns)
        total = np.einsum("bfn,bfn->f", columns, columns, optimize=True)
        is_own = np.diag(own) >= least_own * total
        share, score, columns = share[:, is_own], score[is_own], columns[:, is_own]
        own = own[np.ix_(is_own, is_own)]
        own += np.eye(len(own))  # a weak prior: features of size 1
        step = solve(own, score)
        given = alone - share @ step
        after = (
            self.rest
            - np.einsum("bfn,f->bn", columns, step)
            - np.einsum("bgn,g->bn", self.given, given)
        )
        blocks = (
            np.einsum("bfn,bn->bf", columns, after)
            - np.einsum("bgn,bn->bg", self.given, after) @ share
        )
        inflation = inflation_of(own, blocks) if is_own.any() else 1.0
        fit = SideFit(
            np.zeros(len(is_own)), np.zeros(len(is_own)), given, float(score @ step), inflation
        )
        fit.step[is_own], fit.errors[is_own] = (
            step,
            np.sqrt(np.diag(np.linalg.pinv(own)) * inflation),
        )
        return fit

    def noncentrality(self, columns: np.ndarray, size: np.ndarray) -> float:
        """Return the squared signature of slopes at a size, fitted again beside what is given."""
        _, own, score, _ = self.projected(columns)
        again = size - solve(own, score)
        return float(again @ own @ again)


def whitened(problem: Problem, features_w: np.ndarray, side: str) -> np.ndarray:
    """Return whitened what features (count, rows, chunks, 3) would leave on a side's axes."""
    step_s = noises.step_to(problem.chunks)[..., None]
    joined = features_w * problem.chunks.is_joined[..., None]
    return problem.whiten(np.stack([joined, joined * step_s], axis=-1), SIDES[side])


def linearized_residuals(problem: Problem, model: FittedModel) -> tuple[np.ndarray, np.ndarray]:
    """Return a model's residuals, and their slopes along what is free, whitened."""
    slopes = problem.slopes(model.vector, model.indices)
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
    """Return the standard deviation over a side's axes of a disturbance that moves the drone."""
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


def is_like_drift(problem: Problem, model: FittedModel, fields: Sequence[str]) -> bool:
    """Return whether a force drift takes up 90 % of a base change that no steady force does.

    Within one flight the voltage falls with the time, so that a thrust curve takes up motors that
    warm up.
    """
    axes, flight = SIDES["force"], flight_of(problem, model)
    left, slopes = linearized_residuals(problem, model)
    indices = problem.indices_of(fields)
    own = [model.indices.index(index) for index in indices]
    test = SideTest.of("force", left, np.delete(slopes, own, axis=0))
    columns, size = (
        blocks_of(slopes[own][..., axes, :] * test.root),
        (model.vector - problem.start)[indices],
    )

    def beside(*features_w: np.ndarray) -> float:
        given = [blocks_of(whitened(problem, one, "force") * test.root) for one in features_w]
        return test.given_also(*given).noncentrality(columns, size)

    steady = constants(flight, "force")
    alone = beside(steady)
    return (
        alone >= threshold(len(fields))
        and beside(steady, time_features(flight)) < DRIFT_SHARE * alone
    )


def _greedy(
    test: SideTest,
    side: str,
    smooth: Sequence[Feature],
    places: Feature | None,
    flight: FlightVariables,
    least: float,
    noise: float,
) -> list[Dependence]:
    """Return dependences one after the other, each besides those before."""
    result: list[Dependence] = []
    while len(result) < MAX_DEPENDENCES:
        best: Dependence | None = None
        for one in (*smooth, *([] if places is None else [_best_bump(test, places)])):
            if any(one.name == earlier.name for earlier in result):
                continue
            fit = test.fit(one.columns)
            number, size = one.columns.shape[1], _rms(one.features_w, fit.step, flight.is_counted)
            if fit.gain < stats.chi2.isf(FALSE_POSITIVE_RATE / one.tries, number) or size < least:
                continue
            gain = fit.gain - 2.0 * number
            if best is None or gain > best.gain:
                best = Dependence(one.name, side, gain, size / noise, one.columns)
        if best is None:
            break
        result.append(best)
        test = test.given_also(best.columns)
    return result


def _best_bump(test: SideTest, places: Feature) -> Feature:
    """Return the bump about a place that explains most by itself."""
    _, own, score, _ = test.projected(places.columns)
    parts = [slice(start, start + BUMP_SIZE) for start in range(0, len(score), BUMP_SIZE)]
    chi2 = [score[part] @ solve(own[part, part] + np.eye(BUMP_SIZE), score[part]) for part in parts]
    part = parts[int(np.argmax(chi2))]
    return Feature(places.name, places.features_w[part], places.columns[:, part], len(parts))


class Line(NamedTuple):
    """A line in the spectrum of a side's residuals, body frame.

    share: amplitude over the sensor's noise.
    """

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
        body = (
            np.einsum("rlji,rlj->rli", flight.body_to_world, left[..., axes, 0]) * counts[..., None]
        )
        series = np.swapaxes(body[lead_in_of(len(body)) :], 0, 1).reshape(-1, 3)
        step_s = float(np.median(noises.step_to(problem.chunks)))
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
        result[line.side] = _along(np.stack([np.sin(phase), np.cos(phase)]), body)
    return result


def stochastic_shares(problem: Problem, model: FittedModel) -> dict[str, float]:
    """Return the size of a clear wandering disturbance over the sensor's noise, by side."""
    left = problem.residuals(model.vector[None])[0]
    noise = problem.fitted_noise
    felt = np.asarray(noise.coupling) > FELT
    share = np.asarray(noise.disturbance / noise.direct)
    gain = noises.disturbance_gain(problem.chunks, left, problem.noise)
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
