"""Where episodes start: facts about the distribution, and the randomness behind it."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from flytrack_env.env import EnvParams, FlyTrack
from flytrack_env.randomness import Draws, seed_of, seeds_of
from flytrack_env.resets import LAST_SEGMENT_FRACTION, SIDEWAYS_FRACTION, ResetParams
from flytrack_env.state import pack
from flytrack_env.tracks import Track, load_track

NUM_STARTS = 4096
Sample = Callable[..., tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def sample(params: EnvParams, reset_many: Any) -> Sample:
    """A function from fields of ``ResetParams`` to states (N, 21) and gate indices (N,)."""

    def draw(**fields: float) -> tuple[np.ndarray, np.ndarray]:
        keys = jax.random.split(jax.random.key(0), NUM_STARTS)
        _, state = reset_many(keys, params.replace(reset=ResetParams(**fields)))
        assert not np.asarray(state.time).any()
        return np.asarray(jax.vmap(pack)(state.plant.drone), float), np.asarray(state.race.gate_index)

    return draw


@pytest.fixture(scope="module")
def at_pose(sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Starts at the start pose only."""
    return sample(course_fraction=0.0)


@pytest.fixture(scope="module")
def on_course(sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Starts along the course only."""
    return sample(course_fraction=1.0)


def body_axes(x: np.ndarray) -> np.ndarray:
    """Return the body's x and z axes, (2, N, 3)."""
    w, a, b, c = x[:, 9:13].T
    ahead = np.stack([1 - 2 * (b * b + c * c), 2 * (a * b + w * c), 2 * (a * c - w * b)], -1)
    up = np.stack([2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)], -1)
    return np.stack([ahead, up])


def assert_uniform(values: np.ndarray, low: float, high: float) -> None:
    """Check a uniform distribution by Kolmogorov and Smirnov's test."""
    assert low - 1e-5 <= values.min() and values.max() <= high + 1e-5
    assert stats.kstest((values - low) / (high - low), "uniform").pvalue > 1e-4


def test_start_pose_is_at_rest_before_gate_zero(at_pose: tuple[np.ndarray, np.ndarray]) -> None:
    x, gate_index = at_pose
    noise = ResetParams()
    assert not gate_index.any()
    offset = x[:, 0:3] - load_track("flytrack").start_position
    assert_uniform(offset[:, 0], -noise.start_position_noise, noise.start_position_noise)
    assert_uniform(offset[:, 1], -noise.start_position_noise, noise.start_position_noise)
    assert_uniform(offset[:, 2], 0.0, noise.start_height_noise)
    assert not x[:, 3:9].any() and not x[:, 13:16].any()
    np.testing.assert_array_equal(x[:, 16:20], np.tile([0.0, 0.0, 0.0, -1.0], (NUM_STARTS, 1)))
    assert_uniform(x[:, 20], noise.start_battery_low_v, 24.0)


def test_start_pose_faces_gate_zero(at_pose: tuple[np.ndarray, np.ndarray]) -> None:
    noise = ResetParams()
    ahead, up = body_axes(at_pose[0])
    yaw_deg = np.degrees(np.arctan2(-ahead[:, 1], -ahead[:, 0]))
    assert np.abs(yaw_deg).max() < noise.start_yaw_noise_deg + 1.0
    assert np.abs(yaw_deg).max() > noise.start_yaw_noise_deg - 1.0
    tilt_deg = np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0)))
    assert_uniform(tilt_deg, 0.0, noise.start_tilt_noise_deg)


def course_curves(track: Track) -> list[CubicHermiteSpline]:
    """Return, per gate, the documented way to it: a curve over [0, 1] from the gate before.

    It leaves and meets the gates along their directions of flight, with tangents as long as the
    gates are apart.
    """
    centres = np.array([gate.position for gate in track.gates])
    axes = [Rotation.from_quat(g.quaternion, scalar_first=True).as_matrix() for g in track.gates]
    forward = np.array([g.direction * a[:, 1] for g, a in zip(track.gates, axes, strict=True)])
    curves = []
    for i in range(len(centres)):
        ends = [i - 1, i]
        length = np.linalg.norm(centres[i] - centres[i - 1])
        curves.append(CubicHermiteSpline([0.0, 1.0], centres[ends], length * forward[ends]))
    return curves


def test_course_starts_lie_along_the_curves_between_the_gates(sample: Sample) -> None:
    x, gate_index = sample(course_fraction=1.0, course_offset=0.0)
    counts = np.bincount(gate_index, minlength=8)
    assert stats.chisquare(counts).pvalue > 1e-4
    grid = np.linspace(0.0, 1.0, 20_001)
    fractions = np.empty(NUM_STARTS)
    for index, curve in enumerate(course_curves(load_track("flytrack"))):
        rows = np.flatnonzero(gate_index == index)
        distance, nearest = KDTree(curve(grid)).query(x[rows, 0:3])
        assert distance.max() < 2e-3
        fractions[rows] = grid[nearest]
        along = curve(grid[nearest], 1)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        speed = np.sum(x[rows, 3:6] * along, axis=1)
        assert speed.min() > -1e-2
        aside = np.linalg.norm(x[rows, 3:6] - speed[:, None] * along, axis=1)
        assert (aside <= SIDEWAYS_FRACTION * speed + 2e-2).all()
    assert_uniform(fractions / (LAST_SEGMENT_FRACTION + 1e-3), 0.0, 1.0)


def test_offset_from_the_curve_is_within_its_range(
    sample: Sample, on_course: tuple[np.ndarray, np.ndarray]
) -> None:
    offset = on_course[0][:, 0:3] - sample(course_fraction=1.0, course_offset=0.0)[0][:, 0:3]
    for axis in range(3):
        assert_uniform(offset[:, axis], -ResetParams().course_offset, ResetParams().course_offset)


def test_course_starts_are_before_their_gate(
    env: FlyTrack, params: EnvParams, on_course: tuple[np.ndarray, np.ndarray]
) -> None:
    x, gate_index = on_course
    gates = params.course.gates
    forward, centre = np.stack(gates.forward, -1), np.stack(gates.centre, -1)
    distance = np.sum((x[:, 0:3] - centre[gate_index]) * forward[gate_index], axis=1)
    assert (distance < 0.0).mean() > 0.99


def test_course_starts_are_inside_the_bounds(on_course: tuple[np.ndarray, np.ndarray]) -> None:
    track = load_track("flytrack")
    position = on_course[0][:, 0:3]
    assert (position > track.bounds_low).all() and (position < track.bounds_high).all()


def test_course_starts_have_every_speed(on_course: tuple[np.ndarray, np.ndarray]) -> None:
    speed = np.linalg.norm(on_course[0][:, 3:6], axis=1)
    highest = ResetParams().course_speed
    assert speed.max() < highest * np.hypot(1.0, SIDEWAYS_FRACTION)
    assert stats.kstest(speed / highest, "uniform").statistic < 0.05


def test_course_starts_have_the_stated_tilt_towards_any_side(
    on_course: tuple[np.ndarray, np.ndarray],
) -> None:
    x, _ = on_course
    _, up = body_axes(x)
    tilt_deg = np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0)))
    assert_uniform(tilt_deg, 0.0, ResetParams().course_tilt_deg)
    assert_uniform(np.arctan2(up[:, 1], up[:, 0]), -np.pi, np.pi)
    np.testing.assert_allclose(np.linalg.norm(x[:, 9:13], axis=1), 1.0, atol=1e-5)


def test_course_starts_face_along_the_curve(sample: Sample) -> None:
    # The velocity is along the curve up to its sideways part, a share of the speed.
    x, _ = sample(course_fraction=1.0, course_tilt_deg=0.0)
    ahead, up = body_axes(x)
    np.testing.assert_allclose(up[:, 2], 1.0, atol=1e-5)
    moving = np.linalg.norm(x[:, 3:5], axis=1) > 0.1
    cross = ahead[:, 1] * x[:, 3] - ahead[:, 0] * x[:, 4]
    yaw_deg = np.degrees(np.arctan2(cross, np.sum(ahead[:, :2] * x[:, 3:5], axis=1)))[moving]
    widest = ResetParams().course_yaw_deg + np.degrees(np.arctan(SIDEWAYS_FRACTION))
    assert np.abs(yaw_deg).max() < widest + 0.1
    assert yaw_deg.max() > ResetParams().course_yaw_deg - 1.0
    assert yaw_deg.min() < -ResetParams().course_yaw_deg + 1.0


def test_course_starts_have_the_stated_sticks_rates_and_battery(
    params: EnvParams, on_course: tuple[np.ndarray, np.ndarray]
) -> None:
    x, _ = on_course
    ranges = ResetParams()
    for axis in range(3):
        assert_uniform(x[:, 16 + axis], -ranges.course_stick, ranges.course_stick)
    rates = x[:, 16:19] * np.radians(np.asarray(params.model.max_rate, float))
    np.testing.assert_allclose(x[:, 13:16], rates, rtol=1e-5, atol=1e-6)
    assert_uniform(x[:, 19], ranges.course_thrust_low, ranges.course_thrust_high)
    assert_uniform(x[:, 20], ranges.course_battery_low_v, 24.0)


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_share_of_course_starts(share: float, sample: Sample) -> None:
    x, _ = sample(course_fraction=share)
    is_on_course = np.linalg.norm(x[:, 3:6], axis=1) > 0.0
    assert is_on_course.mean() == pytest.approx(share, abs=5 * np.sqrt(0.25 / NUM_STARTS))


def test_without_noise_every_start_is_the_start_pose(sample: Sample) -> None:
    x, gate_index = sample(
        course_fraction=0.0,
        start_position_noise=0.0,
        start_height_noise=0.0,
        start_yaw_noise_deg=0.0,
        start_tilt_noise_deg=0.0,
        start_battery_low_v=24.0,
    )
    expected = np.zeros(21)
    expected[[0, 1, 2, 12, 19, 20]] = (18.6, 2.0, 0.1, 1.0, -1.0, 24.0)
    np.testing.assert_allclose(x, np.tile(expected, (NUM_STARTS, 1)), atol=1e-6)
    assert not gate_index.any()


def test_distinct_keys_give_distinct_starts(on_course: tuple[np.ndarray, np.ndarray]) -> None:
    assert len(np.unique(on_course[0][:, 0:6], axis=0)) == NUM_STARTS


def test_legacy_keys_are_as_good_as_typed_ones(params: EnvParams, reset_many: Any) -> None:
    seeds = range(16)
    typed = reset_many(jnp.stack([jax.random.key(seed) for seed in seeds]), params)
    legacy = reset_many(jnp.stack([jax.random.PRNGKey(seed) for seed in seeds]), params)
    for a, b in zip(jax.tree.leaves(typed), jax.tree.leaves(legacy), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_starts_of_other_tracks_are_on_them(coasting_envs: Any, row_track: Any, make_drone: Any) -> None:
    env = coasting_envs(row_track([0.0, 10.0, 30.0]), "terminate")
    keys = jax.random.split(jax.random.key(1), 256)
    _, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, env.default_params)
    assert set(np.asarray(state.race.gate_index)) == {0, 1, 2}
    assert (np.abs(np.asarray(env.drone(state).pos_w.y)) <= 1.0 + 1e-5).all()


# --- Randomness ---------------------------------------------------------------------------------

NAMES = (
    "kind",
    "gate",
    "roll",
    "pitch",
    "along",
    "offset_x",
    "offset_y",
    "speed",
    "yaw",
    "battery",
)
NUM_WORDS = 20_000
WORDS = {
    "of keys": lambda: jax.vmap(seed_of)(jax.random.split(jax.random.key(0), NUM_WORDS)),
    "of counted keys": lambda: jax.vmap(lambda i: seed_of(jax.random.key(i)))(jnp.arange(NUM_WORDS)),
    "of one key": lambda: seeds_of(jax.random.key(0), jnp.arange(NUM_WORDS)),
    "of a counter": lambda: jnp.arange(NUM_WORDS, dtype=jnp.uint32),
}


@jax.jit
@jax.vmap
def draw_all(word: jax.Array) -> jax.Array:
    """Return a uniform draw per name."""
    return jnp.stack([Draws(word).uniform(name, 0.0, 1.0) for name in NAMES])


@pytest.mark.parametrize("source", WORDS)
def test_draws_are_uniform_and_uncorrelated(source: str) -> None:
    words = WORDS[source]()
    assert words.dtype == jnp.uint32
    values = np.asarray(draw_all(words), float)
    assert values.min() >= 0.0 and values.max() < 1.0
    for column in values.T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    correlation = np.corrcoef(values.T) - np.eye(len(NAMES))
    assert np.abs(correlation).max() < 4.5 / np.sqrt(NUM_WORDS)
    lagged = [np.corrcoef(column[:-1], column[1:])[0, 1] for column in values.T]
    assert np.abs(lagged).max() < 4.5 / np.sqrt(NUM_WORDS)


def test_words_of_one_key_are_distinct_and_differ_between_keys() -> None:
    words = [np.asarray(seeds_of(jax.random.key(seed), jnp.arange(NUM_WORDS))) for seed in range(2)]
    assert len(np.unique(words[0])) == NUM_WORDS
    assert len(np.intersect1d(*words)) < 5


def test_the_same_name_gives_the_same_number() -> None:
    draws = Draws(jnp.uint32(7))
    assert float(draws.uniform("a", 0.0, 1.0)) == float(draws.uniform("a", 0.0, 1.0))
    assert float(draws.uniform("a", 0.0, 1.0)) != float(draws.uniform("b", 0.0, 1.0))
    assert float(draws.uniform("a", 2.0, 6.0)) == pytest.approx(
        2.0 + 4.0 * float(draws.uniform("a", 0.0, 1.0))
    )


@pytest.mark.parametrize("count", [1, 2, 3, 8, 11])
def test_index_is_even_over_its_range(count: int) -> None:
    words = seeds_of(jax.random.key(2), jnp.arange(NUM_WORDS))
    indices = jax.vmap(lambda word: Draws(word).index("gate", count))(words)
    assert indices.dtype == jnp.int32
    counts = np.bincount(np.asarray(indices), minlength=count)
    assert len(counts) == count
    assert count == 1 or stats.chisquare(counts).pvalue > 1e-4
