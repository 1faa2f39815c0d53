"""Where episodes start: facts about the distribution, and the randomness behind it."""

import jax
import numpy as np
import pytest
from scipy import stats
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from flytrack_env.resets import LAST_SEGMENT_FRACTION, SIDEWAYS_FRACTION, ResetParams
from flytrack_env.state import pack
from flytrack_env.tracks import load_track
from tests.support.coasting import direction_of_flight

NUM_STARTS = 4096


@pytest.fixture(scope="module")
def sample(env, params):
    """A function from fields of ``ResetParams`` to states (N, 21) and gate indices (N,)."""

    reset_many = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))

    def draw(**fields):
        keys = jax.random.split(jax.random.key(0), NUM_STARTS)
        _, state = reset_many(keys, params.replace(reset=ResetParams(**fields)))
        assert not np.asarray(state.time).any()
        return np.asarray(jax.vmap(pack)(state.plant.drone), float), np.asarray(
            state.race.gate_index
        )

    return draw


def assert_uniform(values, low, high):
    """Check a uniform distribution by Kolmogorov and Smirnov's test."""
    assert low - 1e-5 <= values.min() and values.max() <= high + 1e-5
    assert stats.kstest((values - low) / (high - low), "uniform").pvalue > 1e-4


def test_start_pose_is_at_rest_before_gate_zero(sample):
    x, gate_index = sample(course_fraction=0.0)
    noise = ResetParams()
    assert not gate_index.any()
    offset = x[:, 0:3] - load_track("flytrack").start_position
    assert_uniform(offset[:, 0], -noise.start_position_noise, noise.start_position_noise)
    assert_uniform(offset[:, 1], -noise.start_position_noise, noise.start_position_noise)
    assert_uniform(offset[:, 2], 0.0, noise.start_height_noise)
    assert not x[:, 3:9].any() and not x[:, 13:16].any()
    np.testing.assert_array_equal(x[:, 16:20], np.tile([0.0, 0.0, 0.0, -1.0], (NUM_STARTS, 1)))
    assert_uniform(x[:, 20], 23.5, 24.0)


def course_curves(track):
    """Return, per gate, the documented way to it: a curve over [0, 1] from the gate before.

    It leaves and meets the gates along their directions of flight, with tangents as long as the
    gates are apart.
    """
    curves = []
    for index, gate in enumerate(track.gates):
        ends = [track.gates[index - 1], gate]
        centres = np.array([end.position for end in ends])
        length = np.linalg.norm(centres[1] - centres[0])
        tangents = [length * direction_of_flight(end) for end in ends]
        curves.append(CubicHermiteSpline([0.0, 1.0], centres, tangents))
    return curves


def test_course_starts_lie_along_the_curves_between_the_gates(sample):
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


def test_course_starts_have_the_stated_tilt_towards_any_side(sample):
    x, _ = sample(course_fraction=1.0)
    up = Rotation.from_quat(x[:, 9:13], scalar_first=True).apply([0.0, 0.0, 1.0])
    tilt_deg = np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0)))
    assert_uniform(tilt_deg, 0.0, ResetParams().course_tilt_deg)
    assert_uniform(np.arctan2(up[:, 1], up[:, 0]), -np.pi, np.pi)
    np.testing.assert_allclose(np.linalg.norm(x[:, 9:13], axis=1), 1.0, atol=1e-5)


def test_share_of_course_starts(sample):
    share = 0.2
    x, _ = sample(course_fraction=share)
    is_on_course = np.linalg.norm(x[:, 3:6], axis=1) > 0.0
    assert is_on_course.mean() == pytest.approx(share, abs=5 * np.sqrt(0.25 / NUM_STARTS))
