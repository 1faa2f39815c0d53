"""Which frames of two channels agree, by the likelihood of one as a linear function of the other.

Channels are compared over windows of 0.1 to 1 s: the change of one with the integral of the other,
so that noise averages out. If an axis is a multiple of another plus Gaussian noise of unknown
variance, the log-likelihood is -n/2 log(1 - r^2) with their correlation r (Mardia, Kent and Bibby,
Multivariate Analysis, 1979, section 6.2). A multiple cannot be negative: an axis that correlates
negatively explains nothing.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid.check.frames import DIRECTIONS, FRAMES
from flytrack_sysid.kinematics import GRAVITY, WEIGHT_W, WINDOWS_S, Windows, cut_windows
from flytrack_sysid.log import FlightLog

MIN_WINDOWS = 10
MARGIN = 10.0  # nats: what is better by this is e^10 times as likely
LASTING_S = 0.5  # errors of an estimator last so long: windows within it are no new evidence
NUM_PARTS = 2  # of a log: a convention is the same in both, a crash is not
# What sensors and estimators are off by, so that slower motion than this shows nothing: m/s^2 (the
# bias of an accelerometer; of an attitude of 3 degrees, and drag), rad/s and m/s.
FORCE_FLOOR, THRUST_FLOOR = 0.5, 1.0
RATE_FLOOR, SPEED_FLOOR = 0.03, 0.03
CONSTANT = 1e-6  # relative: a smaller change is rounding
STILL = 1e-12  # in any unit squared: a smaller variance is none
NOT_FLYING = -1e9  # nats of a frame in which the thrust does not hold the weight
MAX_CORRELATION = 0.99999  # a better one has rounding for its noise
_WHICH = np.argmax(np.abs(FRAMES), axis=2)  # column of each frame's rows, (48, 3)
_SIGN = FRAMES.sum(axis=2)


class Likelihoods(NamedTuple):
    """Log-likelihoods of frames.

    Attributes:
        values: nats, (NUM_PARTS, ...); of which frames depends on the pair.
        correlations: of the three axes as they are logged.
    """

    values: np.ndarray
    correlations: np.ndarray


def most_telling(found: list[Likelihoods]) -> Likelihoods | None:
    """Return the likelihoods by the length of windows that tells most; None if there are none."""
    return max(found, key=lambda one: one.values.sum(axis=0).max(), default=None)


def weight_of(length_s: float) -> float:
    """Return what part of windows of a length is independent evidence."""
    return min(1.0, length_s / LASTING_S)


def parts_of(num_windows: int) -> list[slice]:
    """Return the windows of each part of a log."""
    edges = np.linspace(0, num_windows, NUM_PARTS + 1).astype(int)
    return [slice(start, end) for start, end in itertools.pairwise(edges)]


def useful_windows(log: FlightLog) -> Iterator[tuple[float, Windows]]:
    """Yield lengths, s, and windows of a log, if there are enough."""
    for length_s in WINDOWS_S:
        windows = cut_windows(log, length_s)
        if len(windows.starts) >= MIN_WINDOWS:
            yield length_s, windows


def correlations_of(shown: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the uncentred correlation of each axis with each, (3, 3); 0 for what never changes.

    Args:
        shown: (num_windows, 3).
        measured: (num_windows, 3).
    """
    sizes = np.sqrt(np.outer(np.sum(shown**2, axis=0), np.sum(measured**2, axis=0)))
    products = shown.T @ measured
    changes = [
        np.ptp(one, axis=0) > CONSTANT * np.abs(one).max(axis=0) for one in (shown, measured)
    ]
    is_known = (sizes > STILL) & np.outer(*changes)
    return np.where(is_known, products / np.maximum(sizes, STILL), 0.0)


def by_frame(shown: np.ndarray, measured: np.ndarray, floor: float) -> np.ndarray:
    """Return log-likelihoods of ``shown = frame @ measured``, (48,) nats.

    Args:
        shown: (num_windows, 3).
        measured: (num_windows, 3).
        floor: what ``shown`` is off by.
    """
    correlations = correlations_of(shown, measured)
    positive = np.clip(_SIGN * correlations[np.arange(3), _WHICH], 0.0, MAX_CORRELATION)
    size = np.sum(shown**2, axis=0)
    share = size / (size + len(shown) * floor**2 + STILL)  # that exceeds the floor
    return -0.5 * len(shown) * np.sum(np.log1p(-share * positive**2), axis=1)


def compare(
    log: FlightLog, sums: np.ndarray, rates: np.ndarray, floor: float
) -> Likelihoods | None:
    """Return likelihoods of frames, (48,), by which changes of sums are integrals of rates.

    The length of windows is the one that tells most.

    Args:
        log: the log that holds the rows.
        sums: a quantity, (num_rows, 3).
        rates: a signal that should be its derivative, (num_rows, 3).
        floor: what the change of ``sums`` is off by, a second.

    Returns:
        likelihoods: None if there are too few windows.
    """
    found = []
    for length_s, windows in useful_windows(log):
        shown = windows.mean_rate(sums)
        measured = windows.mean_of(log, rates)
        values = [by_frame(shown[part], measured[part], floor) for part in parts_of(len(shown))]
        found.append(described(values, length_s, shown, measured))
    return most_telling(found)


def described(
    by_part: Sequence[np.ndarray], length_s: float, shown: np.ndarray, measured: np.ndarray
) -> Likelihoods:
    """Return likelihoods with the correlations of two quantities, (num_windows, 3) each.

    Args:
        by_part: nats of each part, as if all windows were independent.
        length_s: of the windows.
        shown: the first quantity.
        measured: the second one.
    """
    values = weight_of(length_s) * np.array(by_part)
    return Likelihoods(values, np.diag(correlations_of(shown, measured)))


def compare_forces(
    log: FlightLog, attitude: Rotation, with_bias: bool = False
) -> Likelihoods | None:
    """Return likelihoods by which velocity, attitude and accelerometer agree, (6, 48, 48).

    The first axis is the direction of up in the attitude's world, the second the frame from the
    velocity's axes to that world, the third from the accelerometer's axes to the attitude's body.
    Scales of velocity and accelerometer are free: the change of the velocity is regressed on the
    rotated force and on gravity.

    Args:
        log: a flight.
        attitude: of its rows.
        with_bias: whether what a bias of the accelerometer explains is no evidence.

    Returns:
        likelihoods: None if there are too few windows.
    """
    found = []
    matrices = attitude.as_matrix()
    products = np.einsum("nij,nk->nijk", matrices, log["f"]).reshape(len(log), 27)
    for length_s, windows in useful_windows(log):
        changes = windows.mean_rate(log["v"])
        means = windows.mean_of(log, products).reshape(-1, 3, 3, 3)
        turned = windows.mean_of(log, matrices.reshape(len(log), 9)).reshape(-1, 3, 3)
        values = [
            _likelihoods_of_forces(changes[part], means[part], turned[part] if with_bias else None)
            for part in parts_of(len(changes))
        ]
        forces = np.einsum("nijj->ni", means) - WEIGHT_W
        found.append(described(values, length_s, changes, forces))
    return most_telling(found)


def _likelihoods_of_forces(
    changes: np.ndarray, means: np.ndarray, turned: np.ndarray | None
) -> np.ndarray:
    """Return likelihoods as ``compare_forces`` does, from means over windows.

    Args:
        changes: of the velocity, over the duration, (num_windows, 3).
        means: of products of the attitude's matrix and the force, (num_windows, 3, 3, 3).
        turned: means of the attitude's matrix, (num_windows, 3, 3), to leave out what a bias
            explains; None to keep it.
    """
    count = len(changes)
    force = np.einsum("nijk,fjk->fni", means, FRAMES)  # (48 of the body, num_windows, 3)
    moved = np.einsum("wij,nj->wni", FRAMES, changes)  # (48 of the world, num_windows, 3)
    up = np.repeat(GRAVITY * DIRECTIONS[:, None], count, axis=1)  # (6, num_windows, 3)
    if turned is not None:
        force, moved, up = (_without_bias(one, turned) for one in (force, moved, up))
    # Moments by axis: (up, world, body, axis), or what of these they depend on.
    yy = np.sum(moved**2, axis=1)[None, :, None]
    xx = np.sum(force**2, axis=1)[None, None]
    yx = np.einsum("wni,fni->wfi", moved, force)[None]
    ye = np.einsum("eni,wni->ewi", up, moved)[:, :, None]
    xe = np.einsum("eni,fni->efi", up, force)[:, None]
    ee = np.sum(up**2, axis=1)[:, None, None]
    # moved = a force - b up: normal equations of all axes together.
    sxx, sxe, see, syx, sye = (one.sum(axis=-1) for one in (xx, xe, ee, yx, ye))
    determinant = np.maximum(sxx * see - sxe**2, STILL)
    a = np.maximum((syx * see - sye * sxe) / determinant, 0.0)[..., None]
    b = np.maximum((syx * sxe - sye * sxx) / determinant, 0.0)[..., None]
    residual = yy - 2.0 * a * yx + 2.0 * b * ye + a**2 * xx - 2.0 * a * b * xe + b**2 * ee
    floor = count * FORCE_FLOOR**2
    return (
        -0.5 * count * np.sum(np.log((np.maximum(residual, 0.0) + floor) / (yy + floor)), axis=-1)
    )


def _without_bias(accelerations: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Return accelerations, (..., num_windows, 3), without what a bias of the body's axes explains.

    The bias has a prior of ``FORCE_FLOOR``, as errors of windows do.
    """
    axes = turned.reshape(-1, 3)
    flat = accelerations.reshape(*accelerations.shape[:-2], -1)
    weights = np.linalg.solve(axes.T @ axes + np.eye(3), axes.T)
    return (flat - flat @ axes @ weights).reshape(accelerations.shape)


def compare_thrust(log: FlightLog, attitude: Rotation) -> Likelihoods | None:
    """Return likelihoods as ``compare_forces`` does, of a thrust along the body's z axis.

    Of the force only the direction is known, and that it is not negative; drag is small beside it.
    """
    found = []
    columns = attitude.as_matrix().reshape(len(log), 9)
    for length_s, windows in useful_windows(log):
        changes = windows.mean_rate(log["v"])
        axes = windows.mean_of(log, columns).reshape(-1, 3, 3)
        values = [
            _likelihoods_of_thrust(changes[part], axes[part]) for part in parts_of(len(changes))
        ]
        thrust = np.sum((changes + WEIGHT_W) * axes[:, :, 2], axis=1)
        forces = thrust[:, None] * axes[:, :, 2] - WEIGHT_W
        found.append(described(values, length_s, changes, forces))
    return most_telling(found)


def _likelihoods_of_thrust(changes: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return likelihoods as ``compare_thrust`` does, from means over windows.

    Args:
        changes: of the velocity, over the duration, (num_windows, 3).
        axes: attitude's matrices, (num_windows, 3, 3).
    """
    count = len(changes)
    moved = np.einsum("wij,nj->wni", FRAMES, changes)
    floor = len(changes) * len("xyz") * THRUST_FLOOR**2
    total = np.sum(changes**2) + floor
    values = np.empty((len(DIRECTIONS), len(FRAMES), len(FRAMES)))
    for direction in DIRECTIONS:  # of the thrust, in the attitude's body
        is_along = np.all(FRAMES[:, :, 2] == direction, axis=1)
        thrust = axes @ direction
        thrust /= np.maximum(np.linalg.norm(thrust, axis=1, keepdims=True), STILL)
        along = np.einsum("wni,ni->wn", moved, thrust)
        across = moved - along[..., None] * thrust
        for up_number, up in enumerate(GRAVITY * DIRECTIONS):
            up_across = up - (thrust @ up)[:, None] * thrust
            size = np.sum(up_across**2)
            scale = np.maximum(-np.einsum("wni,ni->w", across, up_across) / max(size, STILL), 0.0)
            residual = np.sum((across + scale[:, None, None] * up_across) ** 2, axis=(1, 2))
            upward = along + scale[:, None] * (thrust @ up)
            is_flying = upward.mean(axis=1) > upward.std(axis=1)  # it mostly holds the weight
            likelihood = -count * np.log((residual + floor) / total)
            values[up_number][:, is_along] = np.where(is_flying, likelihood, NOT_FLYING)[:, None]
    return values
