"""What no effect of the list explains: whether residuals exceed noise, and on what they depend."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage, stats
from scipy.spatial.transform import Rotation

from flytrack_env.state import ACTION_SIZE
from flytrack_sysid.diagnosis.result import Unexplained
from flytrack_sysid.inference import noise as noises
from flytrack_sysid.inference.chunks import AXES, count_lead_in
from flytrack_sysid.inference.parameters import TAUS
from flytrack_sysid.inference.problem import Problem, robust_weight, split_blocks
from flytrack_sysid.inference.score_test import estimate_inflation, solve, threshold
from flytrack_sysid.inference.search import FittedModel

SIDES = {"rate": AXES[0], "force": AXES[1]}  # axes of a residual
RIDGE = 1e-6  # of each column's diagonal: features are nearly collinear if the flight covers little
FALSE_POSITIVE_RATE = 1e-6  # of a flag for each dependence if the residuals are noise
MATERIAL = 0.08  # of the sensor's noise, RMS: a smaller dependence is not reported
OF_NAMED = 0.15  # of the named causes' RMS contribution: laws of the list are not exact
# of the wandering disturbance, RMS: a dependence that explains less is a coincidence
OF_WANDERING = 0.45
MAX_DEPENDENCES = 3  # of a side
PERIODIC_HZ = (0.3, 25.0)  # of a line: slower ones are drifts
LINE = 28.0  # power of a line over that of its neighbourhood: probability e^-28 under noise
NEIGHBOURS = 40  # frequencies of the neighbourhood on each side of a line
STOCHASTIC_GAIN, STOCHASTIC_SHARE = (
    50.0,
    0.15,
)  # of minus twice the log likelihood; of the sensor's noise
# of a base change's signature beside a steady force: a base change is like a drift if a smaller
# share of it remains beside a drifting force
DRIFT_SHARE = 0.1
FELT = 0.3  # coupling above which a disturbance moves the drone and not only the sensor
# Waves of a smooth function: of the time, of the rank of a value and of its change, of the
# heading, and along each axis of the place.
TIME_WAVES, RANK_WAVES, CHANGE_WAVES, HEADING_WAVES, PLACE_WAVES = 8, 6, 4, 4, 2
TINY_SPEED = 0.3  # m/s: slower flight has no direction
# Bumps about positions of the flight: number of positions, and widths (m).
BUMP_PLACES, BUMP_WIDTHS_M = 24, (3.0, 8.0)
BUMP_SIZE = 3  # features of one bump: a force along each world axis


class FlightVariables(NamedTuple):
    """The variables that a force or rate may depend on, at the step to each row.

    Attributes:
        body_to_world: rotation matrices, (rows, chunks, 3, 3).
        pos_w: position (m), (rows, chunks, 3).
        vel_w: velocity (m/s), (rows, chunks, 3).
        applied: commands after the lags, (rows, chunks, 4).
        change: derivative of ``applied`` (1/s), (rows, chunks, 4).
        time_s: time, (rows, chunks).
        is_counted: rows that are scored, (rows, chunks).
    """

    body_to_world: np.ndarray
    pos_w: np.ndarray
    vel_w: np.ndarray
    applied: np.ndarray
    change: np.ndarray
    time_s: np.ndarray
    is_counted: np.ndarray


def build_flight_variables(problem: Problem, model: FittedModel) -> FlightVariables:
    """Return the variables of a flight, with a model's lags between commands and applied action."""
    chunks, tau = problem.chunks, model.vector[problem.parameter_indices(TAUS)]

    def previous(values: np.ndarray) -> np.ndarray:  # a step begins at the row before
        return np.concatenate([values[:1], values[:-1]])

    record = chunks.record
    quat = previous(record.quat).reshape(-1, 4)
    rotation = (
        Rotation.from_quat(quat, scalar_first=True).as_matrix().reshape(*chunks.row.shape, 3, 3)
    )
    applied = _lagged(record.command, record.step_s, tau)
    change = (record.command - applied) / tau
    time_s = np.where(chunks.row >= 0, chunks.row, 0) * float(np.median(noises.step_to(chunks)))
    is_counted = np.asarray(chunks.counts.any(axis=(2, 3)))
    return FlightVariables(
        rotation,
        previous(record.pos_w),
        previous(record.vel_w),
        applied,
        previous(change),
        time_s,
        is_counted,
    )


def _lagged(command: np.ndarray, step_s: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return commands after a first-order lag; its start decays within the lead-in of chunks."""
    applied = command.copy()
    for row in range(1, len(command)):
        decay = np.exp(-step_s[row - 1, :, None] / tau)
        applied[row] = command[row - 1] + decay * (applied[row - 1] - command[row - 1])
    return applied


def _rank_waves(values: np.ndarray, is_counted: np.ndarray, count: int) -> np.ndarray:
    """Return cosines of the rank of a value, as a share of the flight, (count, rows, chunks)."""
    share = np.zeros(values.shape)
    share[is_counted] = (stats.rankdata(values[is_counted]) - 0.5) / max(int(is_counted.sum()), 1)
    return np.stack([np.cos(np.pi * order * share) for order in range(1, count + 1)])


def _place_waves(flight: FlightVariables) -> np.ndarray:
    """Return products of cosines of the ranks of x, y and z, (products, rows, chunks)."""
    axes = [
        _rank_waves(flight.pos_w[..., axis], flight.is_counted, PLACE_WAVES) for axis in range(3)
    ]
    axes = [np.concatenate([np.ones_like(waves[:1]), waves]) for waves in axes]
    orders = np.argwhere(np.indices((PLACE_WAVES + 1,) * 3).sum(axis=0) <= PLACE_WAVES)
    return np.stack([axes[0][i] * axes[1][j] * axes[2][k] for i, j, k in orders if i + j + k > 0])


def bumps(flight: FlightVariables) -> np.ndarray:
    """Return forces that act only near some positions of the flight, like a thermal.

    Returns:
        Forces in the world frame, (bumps * BUMP_SIZE, rows, chunks, 3). The axes of a bump are
        adjacent.
    """
    positions = flight.pos_w[flight.is_counted]
    indices = np.linspace(0, len(positions) - 1, 2 * BUMP_PLACES + 1).astype(int)[1::2]
    waves = []
    for centre in positions[indices]:
        squared = np.square(flight.pos_w - centre).sum(axis=-1)
        waves += [np.exp(-0.5 * squared / width**2) for width in BUMP_WIDTHS_M]
    world = np.broadcast_to(np.eye(BUMP_SIZE)[:, None, None, :], (BUMP_SIZE, *waves[0].shape, 3))
    return _along(np.stack(waves), world)


def _along(waves: np.ndarray, vectors_w: np.ndarray) -> np.ndarray:
    """Multiply features by world vectors.

    Args:
        waves: features, (features, rows, chunks).
        vectors_w: vectors, (directions, rows, chunks, 3).

    Returns:
        Products, (features * directions, rows, chunks, 3).
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
    """Return the possible forms of an unknown effect, by side (rate, force) and dependence.

    Returns:
        Features of unit size in the world frame, (features, rows, chunks, 3) each.
    """
    is_counted = flight.is_counted
    body = np.moveaxis(flight.body_to_world, -1, 0)  # body axes in the world
    world = np.broadcast_to(np.eye(3)[:, None, None, :], body.shape)
    heading = np.arctan2(flight.body_to_world[..., 1, 0], flight.body_to_world[..., 0, 0])
    orders = range(1, HEADING_WAVES + 1)
    heading_waves = np.stack([wave(n * heading) for n in orders for wave in (np.sin, np.cos)])
    tilt = _rank_waves(flight.body_to_world[..., 2, 2], is_counted, RANK_WAVES)
    airspeed = _rank_waves(np.linalg.norm(flight.vel_w, axis=-1), is_counted, RANK_WAVES)
    position = _place_waves(flight)
    command_waves = ((flight.applied, RANK_WAVES), (flight.change, CHANGE_WAVES))
    sticks = [
        np.concatenate(
            [_rank_waves(values[..., stick], is_counted, count) for values, count in command_waves]
        )
        for stick in range(ACTION_SIZE)
    ]
    rate = {
        "position": _along(position, body),
        "time": time_features(flight),
        "heading": _along(heading_waves, body),
        "airspeed": _along(airspeed, body),
        "attitude": _along(tilt, body),
        "command": np.concatenate(
            [_along(sticks[axis], body[axis : axis + 1]) for axis in range(3)]
        ),
    }
    force = rate | {
        "position": _along(position, world),
        "airspeed": _along(airspeed, np.stack([_direction(flight), body[2]])),
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
    """A significant dependence on one side.

    Attributes:
        name: what the residuals depend on.
        side: rate or force.
        gain: gained chi-squared over its inflation, less twice the number of features.
        share: RMS over the sensor's noise.
        columns: whitened features by blocks.
    """

    name: str
    side: str
    gain: float
    share: float
    columns: np.ndarray


class Feature(NamedTuple):
    """A possible form of an unknown effect.

    Attributes:
        name: what the effect depends on.
        features_w: smooth functions in the world frame, (features, rows, chunks, 3).
        columns: the same whitened, by blocks.
        tries: number of alternatives among which this one was chosen.
    """

    name: str
    features_w: np.ndarray
    columns: np.ndarray
    tries: int = 1


class SideFit(NamedTuple):
    """Features fitted on one side.

    Attributes:
        step: coefficients of the features.
        errors: standard errors of the coefficients.
        given: step of the given columns beside them.
        chi2: gained chi-squared.
        inflation: ratio of the variance of the scores to the information.
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


def fitted_on(side: str, slopes: np.ndarray) -> np.ndarray:
    """Return which parameters a side determines: those that act on it, and mostly on it.

    A test of one side holds the others, which the other side determines. Free on a side where it
    hardly acts, the thrust, for example, would explain any motor imbalance.

    Args:
        side: rate or force.
        slopes: whitened columns of the parameters, (count, rows, chunks, NUM_AXES, 2).

    Returns:
        (count,) bool.
    """
    squared = np.square(slopes).sum(axis=(1, 2, 4))
    on_side = squared[:, SIDES[side]].sum(axis=1)
    return np.asarray((on_side > 0.0) & (on_side >= 0.5 * squared.sum(axis=1)))


class SideTest(NamedTuple):
    """Score test on the axes of one side, rotation or force; all by blocks of a second.

    Attributes:
        root: square roots of the robust weights.
        rest: weighted residuals.
        given: columns that are free already.
    """

    root: np.ndarray
    rest: np.ndarray
    given: np.ndarray

    @classmethod
    def of(cls, side: str, white: np.ndarray, slopes: np.ndarray) -> "SideTest":
        """Build the test of whitened residuals beside the parameters that the side determines.

        Args:
            side: rate or force.
            white: whitened residuals, (rows, chunks, NUM_AXES, 2).
            slopes: whitened columns of the free parameters, (count, rows, chunks, NUM_AXES, 2).
        """
        axes = SIDES[side]
        side_white = white[..., axes, :]
        root = np.sqrt(robust_weight(side_white))
        given = slopes[fitted_on(side, slopes)][..., axes, :]
        return cls(root, split_blocks(side_white * root), split_blocks(given * root))

    def given_also(self, *columns: np.ndarray) -> "SideTest":
        """Return the test with more columns that are free already."""
        return self._replace(given=np.concatenate([self.given, *columns], axis=1))

    def of_blocks(self, is_kept: np.ndarray) -> "SideTest":
        """Return the test on some blocks, (blocks,) bool."""
        return self._replace(rest=self.rest[is_kept], given=self.given[is_kept])

    def projected(
        self, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Project the given columns out of other columns.

        Returns:
            Shares of the given columns in the others, the others' information and score after the
            projection, and the step along the given columns alone.
        """
        across = np.einsum("bgn,bfn->gf", self.given, columns, optimize=True)
        inner = np.einsum("bgn,bhn->gh", self.given, self.given, optimize=True)
        inner += RIDGE * np.diag(np.maximum(np.diag(inner), 1.0))
        share = solve(inner, across)
        total = np.einsum("bfn,bhn->fh", columns, columns, optimize=True)
        information = total - across.T @ share + RIDGE * np.diag(np.diag(total))
        given_score = np.einsum("bgn,bn->g", self.given, self.rest, optimize=True)
        score = np.einsum("bfn,bn->f", columns, self.rest, optimize=True) - share.T @ given_score
        return share, information, score, solve(inner, given_score)

    def fit(self, columns: np.ndarray, min_independent: float = 0.0) -> SideFit:
        """Fit features beside the given columns.

        Args:
            columns: whitened features by blocks.
            min_independent: the coefficient of a column stays 0 if the share of its information
                that is independent of the given columns is smaller. A feature that is nearly a
                given column only moves the model's forces to another instant of the step.
        """
        share, information, score, given_step = self.projected(columns)
        total = np.einsum("bfn,bfn->f", columns, columns, optimize=True)
        is_independent = np.diag(information) >= min_independent * total
        share, score, columns = (
            share[:, is_independent],
            score[is_independent],
            columns[:, is_independent],
        )
        information = information[np.ix_(is_independent, is_independent)]
        information += np.eye(len(information))  # a weak prior: features of size 1
        step = solve(information, score)
        given = given_step - share @ step
        after = (
            self.rest
            - np.einsum("bfn,f->bn", columns, step)
            - np.einsum("bgn,g->bn", self.given, given)
        )
        blocks = (
            np.einsum("bfn,bn->bf", columns, after)
            - np.einsum("bgn,bn->bg", self.given, after) @ share
        )
        inflation = estimate_inflation(information, blocks) if is_independent.any() else 1.0
        fit = SideFit(
            np.zeros(len(is_independent)),
            np.zeros(len(is_independent)),
            given,
            float(score @ step),
            inflation,
        )
        fit.step[is_independent], fit.errors[is_independent] = (
            step,
            np.sqrt(np.diag(np.linalg.pinv(information)) * inflation),
        )
        return fit

    def noncentrality(self, columns: np.ndarray, size: np.ndarray) -> float:
        """Return the squared signature of slopes at a size, refitted beside the given columns."""
        _, information, score, _ = self.projected(columns)
        refitted = size - solve(information, score)
        return float(refitted @ information @ refitted)


def whitened(problem: Problem, features_w: np.ndarray, side: str) -> np.ndarray:
    """Return the whitened residuals on a side's axes that features would cause.

    Args:
        features_w: unit forces or rates in the world frame, (count, rows, chunks, 3).
        side: rate or force.
    """
    step_s = noises.step_to(problem.chunks)[..., None]
    joined = features_w * problem.chunks.is_joined[..., None]
    return problem.whiten(np.stack([joined, joined * step_s], axis=-1), SIDES[side])


def linearized_residuals(problem: Problem, model: FittedModel) -> tuple[np.ndarray, np.ndarray]:
    """Return a model's whitened residuals, and their slopes along its free parameters."""
    slopes = problem.slopes(model.vector, model.indices)
    return problem.whiten(slopes.residuals[None])[0], problem.whiten(slopes.columns)


def _rms(features_w: np.ndarray, step: np.ndarray, is_counted: np.ndarray) -> float:
    """Return the RMS size of a fitted effect over the rows that are scored, in its own unit."""
    signal = np.tensordot(step, features_w, axes=1)[is_counted]
    signal = signal - signal.mean(axis=0)
    return float(np.sqrt(np.mean(np.sum(signal**2, axis=-1))))


def _named_size(problem: Problem, model: FittedModel, base: np.ndarray, side: str) -> float:
    """Return the RMS change that the named causes make in a side's direct channel."""
    if not model.candidates:
        return 0.0
    residuals = problem.residuals(np.stack([model.vector, base]))
    change = (residuals[1] - residuals[0])[..., SIDES[side], 0][problem.counts.any(axis=(2, 3))]
    return float(np.sqrt(np.mean(np.sum(change**2, axis=-1))))


def _sensor_noise(noise: noises.Noise, axes: slice) -> float:
    """Return the RMS standard deviation of a side's direct sensor."""
    return float(np.sqrt(np.mean(np.asarray(noise.direct[axes]) ** 2)))


def _wandering(noise: noises.Noise, axes: slice) -> float:
    """Return the standard deviation over a side's axes of a disturbance that moves the drone."""
    is_felt = np.asarray(noise.coupling)[axes] > FELT
    return float(np.sqrt(np.sum((np.asarray(noise.disturbance)[axes] * is_felt) ** 2)))


def find_dependences(
    problem: Problem, model: FittedModel, base: np.ndarray, waves: Mapping[str, np.ndarray]
) -> list[Dependence]:
    """Return the dependences of a model's residuals, largest gain first.

    Each side has at most ``MAX_DEPENDENCES``.

    Args:
        base: vector of the refitted model without effects.
        waves: periodic features that are given, by side.
    """
    flight = build_flight_variables(problem, model)
    features = dependences(flight)
    white, slopes = linearized_residuals(problem, model)
    result = []
    for side, axes in SIDES.items():
        if not problem.counts[..., axes, :].any():
            continue
        test = SideTest.of(side, white, slopes)

        def feature(
            name: str, candidate: np.ndarray, side: str = side, test: SideTest = test
        ) -> Feature:
            return Feature(
                name, candidate, split_blocks(whitened(problem, candidate, side) * test.root)
            )

        if side in waves:
            test = test.given_also(feature("periodic", waves[side]).columns)
        noise = _sensor_noise(problem.fitted_noise, axes)
        min_size = max(
            MATERIAL * noise,
            OF_NAMED * _named_size(problem, model, base, side),
            OF_WANDERING * _wandering(problem.fitted_noise, axes),
        )
        smooth = [feature(name, candidate) for name, candidate in features[side].items()]
        has_places = side == "force" and flight.pos_w.any()
        bump_pool = feature("position", bumps(flight)) if has_places else None
        result += _greedy(test, side, smooth, bump_pool, flight, min_size, noise)
    return sorted(result, key=lambda candidate: -candidate.gain)


def is_like_drift(problem: Problem, model: FittedModel, fields: Sequence[str]) -> bool:
    """Return whether a force drift explains 90 % of a base change that no steady force explains.

    Within one flight the voltage falls with the time, so that a change of the thrust curve can
    stand in for motors that warm up.
    """
    axes, flight = SIDES["force"], build_flight_variables(problem, model)
    residuals, slopes = linearized_residuals(problem, model)
    indices = problem.parameter_indices(fields)
    rows = [model.indices.index(index) for index in indices]
    test = SideTest.of("force", residuals, np.delete(slopes, rows, axis=0))
    columns, size = (
        split_blocks(slopes[rows][..., axes, :] * test.root),
        (model.vector - problem.start)[indices],
    )

    def noncentrality_beside(*features_w: np.ndarray) -> float:
        given = [
            split_blocks(whitened(problem, features, "force") * test.root)
            for features in features_w
        ]
        return test.given_also(*given).noncentrality(columns, size)

    steady = constants(flight, "force")
    alone = noncentrality_beside(steady)
    return (
        alone >= threshold(len(fields))
        and noncentrality_beside(steady, time_features(flight)) < DRIFT_SHARE * alone
    )


def _greedy(
    test: SideTest,
    side: str,
    smooth: Sequence[Feature],
    bump_pool: Feature | None,
    flight: FlightVariables,
    min_size: float,
    noise: float,
) -> list[Dependence]:
    """Select dependences by forward selection, each fitted beside the earlier ones."""
    result: list[Dependence] = []
    while len(result) < MAX_DEPENDENCES:
        best: Dependence | None = None
        for feature in (*smooth, *([] if bump_pool is None else [_best_bump(test, bump_pool)])):
            if any(feature.name == earlier.name for earlier in result):
                continue
            fit = test.fit(feature.columns)
            count, size = (
                feature.columns.shape[1],
                _rms(feature.features_w, fit.step, flight.is_counted),
            )
            if (
                fit.gain < stats.chi2.isf(FALSE_POSITIVE_RATE / feature.tries, count)
                or size < min_size
            ):
                continue
            gain = fit.gain - 2.0 * count
            if best is None or gain > best.gain:
                best = Dependence(feature.name, side, gain, size / noise, feature.columns)
        if best is None:
            break
        result.append(best)
        test = test.given_also(best.columns)
    return result


def _best_bump(test: SideTest, bump_pool: Feature) -> Feature:
    """Return the bump about a position with the largest gain by itself."""
    _, information, score, _ = test.projected(bump_pool.columns)
    parts = [slice(start, start + BUMP_SIZE) for start in range(0, len(score), BUMP_SIZE)]
    chi2 = [
        score[part] @ solve(information[part, part] + np.eye(BUMP_SIZE), score[part])
        for part in parts
    ]
    part = parts[int(np.argmax(chi2))]
    return Feature(
        bump_pool.name, bump_pool.features_w[part], bump_pool.columns[:, part], len(parts)
    )


class Line(NamedTuple):
    """A line in the spectrum of a side's residuals, body frame.

    Attributes:
        share: amplitude over the sensor's noise.
    """

    side: str
    frequency_hz: float
    share: float


def find_lines(problem: Problem, model: FittedModel) -> list[Line]:
    """Return the spectral lines of a model's residuals, at most one on each side."""
    flight = build_flight_variables(problem, model)
    residuals = problem.residuals(model.vector[None])[0]
    result = []
    for side, axes in SIDES.items():
        counts = np.asarray(problem.counts[..., axes, 0].all(axis=-1))
        if not counts.any():
            continue
        body = (
            np.einsum("rlji,rlj->rli", flight.body_to_world, residuals[..., axes, 0])
            * counts[..., None]
        )
        series = np.swapaxes(body[count_lead_in(len(body)) :], 0, 1).reshape(-1, 3)
        step_s = float(np.median(noises.step_to(problem.chunks)))
        power = (np.abs(np.fft.rfft(series, axis=0)) ** 2).max(axis=1)
        frequency = np.fft.rfftfreq(len(series), step_s)
        background = ndimage.median_filter(power, 2 * NEIGHBOURS + 1, mode="nearest")
        inside = (frequency > PERIODIC_HZ[0]) & (frequency < PERIODIC_HZ[1])
        ratio = np.where(inside, power / np.maximum(background, 1e-300), 0.0)
        peak = int(np.argmax(ratio))
        if ratio[peak] > LINE:
            amplitude = 2.0 * np.sqrt(power[peak]) / counts.sum()
            share = float(amplitude / _sensor_noise(problem.fitted_noise, axes))
            result.append(Line(side, float(frequency[peak]), share))
    return result


def build_waves(
    problem: Problem, model: FittedModel, lines: Sequence[Line]
) -> dict[str, np.ndarray]:
    """Return sine and cosine at the frequencies of lines, along the body's axes, by side."""
    flight = build_flight_variables(problem, model)
    body = np.moveaxis(flight.body_to_world, -1, 0)
    result = {}
    for line in lines:
        phase = 2.0 * np.pi * line.frequency_hz * flight.time_s
        result[line.side] = _along(np.stack([np.sin(phase), np.cos(phase)]), body)
    return result


def stochastic_shares(problem: Problem, model: FittedModel) -> dict[str, float]:
    """Return the size of a clear wandering disturbance over the sensor's noise, by side."""
    residuals = problem.residuals(model.vector[None])[0]
    noise = problem.fitted_noise
    is_felt = np.asarray(noise.coupling) > FELT
    share = np.asarray(noise.disturbance / noise.direct)
    gain = noises.disturbance_gain(problem.chunks, residuals, problem.noise)
    result = {}
    for side, axes in SIDES.items():
        size = float(np.sqrt(np.sum((share * (is_felt & (gain > STOCHASTIC_GAIN)))[axes] ** 2)))
        if size > STOCHASTIC_SHARE:
            result[side] = size
    return result


def find_unexplained(
    problem: Problem, model: FittedModel, base: np.ndarray
) -> tuple[Unexplained, list[Dependence]]:
    """Return what a model leaves unexplained, and its dependences, which a veto may use.

    Args:
        base: vector of the refitted model without effects.
    """
    lines = find_lines(problem, model)
    clear = find_dependences(problem, model, base, build_waves(problem, model, lines))
    shares = {
        f"{pattern.side}: periodic at {pattern.frequency_hz:.3g} Hz": pattern.share
        for pattern in lines
    }
    shares |= {f"{pattern.side}: {pattern.name}": pattern.share for pattern in clear}
    patterned = {name.partition(":")[0] for name in shares}
    shares |= {
        f"{side}: stochastic": size
        for side, size in stochastic_shares(problem, model).items()
        if side not in patterned
    }
    names = [name.split(": ", 1)[1] for name in shares]
    return Unexplained(bool(shares), tuple(dict.fromkeys(names)), shares), clear
