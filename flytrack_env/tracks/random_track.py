"""Courses drawn at random, of which only feasible ones are returned."""

import math
from collections import Counter

import jax
import numpy as np

from flytrack_env.tracks.feasibility import Limits, find_problems
from flytrack_env.tracks.track import Gate, Track, TrackError

OPENING_M, FRAME_M = 1.5, 2.7  # those of the FlyTrack course
WALL_MARGIN_M = 5.0  # between bounds and the gates' centres, as on the FlyTrack course
START_DISTANCE_M = 6.0
START_HEIGHT_M = 0.1
YAW_NOISE_DEG = 20.0
CROSSING_SHARE = 0.5
MAX_ATTEMPTS = 300
PLACING_TRIES = 100  # per gate
GRID_DIGITS = 2  # positions in whole centimetres read well in a file
MAX_SEED = 2**32 - 1


def random_track(
    key: jax.Array | int,
    num_gates: int = 8,
    size: tuple[float, float] = (30.0, 40.0),
    heights: tuple[float, float] = (0.5 * FRAME_M, 4.0),
    limits: Limits | None = None,
) -> Track:
    """Return a course without ``find_problems``'s problems, a function of the arguments alone.

    The gates stand at random, at least ``limits.min_spacing`` apart as seen from above, are flown
    in the order of a short round trip (half of the drawn ones with a stretch turned round, so that
    the way crosses itself), and face about halfway between the ways to and from them.

    Args:
        key: one JAX key, typed or legacy; an int is the key ``jax.random.key(int)``. Concrete: not
            under ``jit``.
        num_gates: at least 3.
        size: of the arena along x and y, m; the gates' centres keep 5 m from its walls.
        heights: lowest and highest centre of a gate, m.
        limits: what the course must keep, the spacing of the gates among it; ``Limits()`` if None.

    Raises:
        TrackError: arguments out of range, or no feasible course after many attempts; the message
            says which demand failed most often.
    """
    _check_arguments(num_gates, size, heights)
    limits = Limits() if limits is None else limits
    words = _words_of(key)
    # numpy's, because JAX is slow at single numbers; only ``random`` is drawn, PCG64's plainest
    # output.
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))
    name = "random_" + "_".join(f"{word:x}" for word in words)
    failed: Counter[str] = Counter()
    for _ in range(MAX_ATTEMPTS):
        centres = _draw_centres(generator, num_gates, size, heights, limits.min_spacing)
        if centres is None:
            failed["spacing"] += 1
            continue
        track = _track_through(generator, name, _order(generator, centres), size, heights[1])
        problems = find_problems(track, limits)
        if not problems:
            return track
        failed.update(dict.fromkeys((problem.demand for problem in problems), 1))
    demand, count = failed.most_common(1)[0]
    raise TrackError(
        f"random_track: no feasible course of {num_gates} gates in {size[0]:g} m x {size[1]:g} m "
        f"in {MAX_ATTEMPTS} attempts; the demand that failed most often: {demand} ({count} times); "
        "expected fewer gates, a larger arena or wider limits"
    )


def _check_arguments(
    num_gates: int, size: tuple[float, float], heights: tuple[float, float]
) -> None:
    """Raise TrackError for arguments that no course can have."""
    if num_gates < 3:
        raise TrackError(f"num_gates: found {num_gates}, expected at least 3")
    if not all(2.0 * WALL_MARGIN_M < edge < math.inf for edge in size):
        raise TrackError(f"size: found {size}, expected more than {2.0 * WALL_MARGIN_M:g} m each")
    if not 0.5 * FRAME_M <= heights[0] <= heights[1] < math.inf:
        raise TrackError(
            f"heights: found {heights}, expected a range from {0.5 * FRAME_M:g} m upwards"
        )


def _words_of(key: jax.Array | int) -> list[int]:
    """Return the words of a concrete key."""
    if isinstance(key, (int, np.integer)):
        if not 0 <= key <= MAX_SEED:
            raise TrackError(f"key: found {key}, expected 0 to {MAX_SEED}")
        key = jax.random.key(np.uint32(key))
    if jax.numpy.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jax.random.key_data(key)
    words = np.asarray(key)
    if words.ndim != 1 or words.dtype != np.uint32:
        raise TrackError(
            f"key: found {words.dtype} of shape {words.shape}, expected one key, not a batch"
        )
    return words.tolist()


def _draw_centres(
    generator: np.random.Generator,
    num_gates: int,
    size: tuple[float, float],
    heights: tuple[float, float],
    spacing: float,
) -> np.ndarray | None:
    """Return centres (num_gates, 3) that far apart horizontally, None if there was no room."""
    low = np.array([WALL_MARGIN_M, WALL_MARGIN_M, heights[0]])
    high = np.array([size[0] - WALL_MARGIN_M, size[1] - WALL_MARGIN_M, heights[1]])
    centres = np.empty((0, 3))
    for _ in range(num_gates):
        for _ in range(PLACING_TRIES):
            centre = np.round(low + (high - low) * generator.random(3), GRID_DIGITS)
            if (np.hypot(*(centres - centre)[:, :2].T) >= spacing).all():
                break
        else:
            return None
        centres = np.vstack([centres, centre])
    return centres


def _order(generator: np.random.Generator, centres: np.ndarray) -> np.ndarray:
    """Return centres (N, 3) in flying order: a short round trip, or one that crosses itself.

    By 2-opt: reverse stretches as long as that shortens the trip (G. A. Croes, 1958).
    """
    trip = centres.copy()
    count = len(trip)
    pairs = [(i, j) for i in range(1, count) for j in range(i + 1, count)]
    is_shorter = True
    while is_shorter:
        is_shorter = False
        for i, j in pairs:
            before, after = trip[i - 1], trip[(j + 1) % count]
            now = math.dist(before, trip[i]) + math.dist(trip[j], after)
            then = math.dist(before, trip[j]) + math.dist(trip[i], after)
            # The margin: rounding must not make it go round in circles.
            if then < now - 1e-9:
                trip[i : j + 1] = trip[i : j + 1][::-1].copy()
                is_shorter = True
    if generator.random() < CROSSING_SHARE:
        i, j = pairs[int(generator.random() * len(pairs))]
        trip[i : j + 1] = trip[i : j + 1][::-1].copy()
    # The gate that was drawn first is still the first one; only the sense of the trip is open.
    return trip if generator.random() < 0.5 else trip[::-1]


def _track_through(
    generator: np.random.Generator,
    name: str,
    centres: np.ndarray,
    size: tuple[float, float],
    top: float,
) -> Track:
    """Return the course through centres (N, 3) in that order, with a start on the ground."""
    chord = np.roll(centres, -1, axis=0)[:, :2] - centres[:, :2]
    ways = chord / np.linalg.norm(chord, axis=1, keepdims=True)
    facing = np.roll(ways, 1, axis=0) + ways
    noise = np.radians(YAW_NOISE_DEG) * (2.0 * generator.random(len(centres)) - 1.0)
    headings = np.arctan2(facing[:, 1], facing[:, 0]) + noise
    signs = np.where(generator.random(len(centres)) < 0.5, -1.0, 1.0)
    gates = tuple(
        # Local y, a quarter turn from x, is the direction of flight or its opposite.
        Gate(i, tuple(centre), _yaw(heading - sign * 0.5 * math.pi), sign, OPENING_M, FRAME_M)
        for i, (centre, heading, sign) in enumerate(
            zip(centres.tolist(), headings.tolist(), signs.tolist(), strict=True)
        )
    )
    ahead = np.array([math.cos(headings[0]), math.sin(headings[0])])
    start = np.round(centres[0, :2] - START_DISTANCE_M * ahead, GRID_DIGITS)
    return Track(
        name=name,
        gates=gates,
        start_position=(*start.tolist(), START_HEIGHT_M),
        start_quaternion=_yaw(float(headings[0])),
        bounds_low=(0.0, 0.0, 0.0),
        bounds_high=(float(size[0]), float(size[1]), float(top) + WALL_MARGIN_M),
    )


def _yaw(angle: float) -> tuple[float, float, float, float]:
    """Return the quaternion of a turn about the world's z, rad."""
    return math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle)
