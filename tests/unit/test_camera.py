"""What the camera shows: corners and masks against rays cast apart; the detector; gradients."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL.Image import open as open_image

from benchmarks.hidden import ray_caster
from benchmarks.hidden.ray_caster import Image
from flytrack_env import FlyTrack, camera
from flytrack_env.flown_camera import film
from flytrack_env.pictures import make_flight, write_camera_view
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.state import Action
from flytrack_env.viz_rerun import Trajectory, write_recording
from flytrack_env.wrappers import (
    NOISY_DETECTOR,
    CornersParams,
    DetectorRandomization,
    GateCorners,
    GateMask,
    ObservationNoise,
    StateObservation,
)
from tests.support.coasting import Coasting, coasting_env, drone_at
from tests.support.compiling import quick_jit
from tests.support.tables import table
from tests.support.wrapped_flights import arrays

FRAME_TOLERANCE_PX, MASK_AGREEMENT = 0.01, 0.999
DETECTED = [*range(8, 12), *range(20, 24)]  # rows of the observation
NEXT_STEPS = 30


@cache
def poses(count):
    """Return gates, and positions, quaternions and gates' indices of poses, float32."""
    gates = ray_caster.read_gates(FlyTrack().track)
    positions, quaternions, indices = ray_caster.draw_poses(1, count, gates)
    return gates, positions.astype(np.float32), quaternions.astype(np.float32), indices


def corners_at(image, position, quaternion, gate):
    """Return the corners of a gate, right and down in px, (4, 2), and whether they are visible."""
    lens = camera.make_lens(
        image.field_of_view_deg, float(image.width), float(image.height), image.k1, image.k2
    )
    axes = camera.camera_axes(Quaternion(*quaternion), image.pitch_deg)
    corners = camera.opening_corners(axes, Vec3(*position), gate)
    pixels = [camera.project(corner, lens) for corner in corners]
    return jnp.stack([jnp.stack(p[:2]) for p in pixels]), jnp.stack([p[2] for p in pixels])


IMAGES = {
    "default": Image(120.0, 40.0, 640, 480),
    "barrel": Image(100.0, 25.0, 320, 240, -0.2, 0.02),
    "pincushion": Image(90.0, -10.0, 640, 480, 0.1, 0.05),
}


@pytest.mark.parametrize("name", IMAGES)
def test_corners_are_where_rays_cast_apart_meet_the_image(name, params):
    image, (gates, positions, quaternions, indices) = IMAGES[name], poses(1000)
    find = quick_jit(jax.vmap(lambda p, q, i: corners_at(image, p, q, params.course.gate(i))))
    pixels, is_visible = find(positions, quaternions, indices)
    arguments = positions.astype(float), quaternions.astype(float), gates, indices
    expected, _ = ray_caster.find_corners(*arguments, image)
    beyond_px = (np.abs(expected) - 0.5 * np.array([image.width, image.height])).max(axis=-1)
    is_on_edge = np.abs(beyond_px) < FRAME_TOLERANCE_PX
    assert_array_equal(np.asarray(is_visible)[~is_on_edge], (beyond_px <= 0.0)[~is_on_edge])
    errors_px = np.abs(pixels - expected)[np.asarray(is_visible)]
    assert 500 < is_visible.sum() < is_visible.size and errors_px.max() < FRAME_TOLERANCE_PX


def test_masks_are_those_of_rays_cast_apart():
    gates, positions, quaternions, _ = poses(100)
    image = Image(120.0, 40.0, 64, 40)
    env = GateMask(FlyTrack(), size=(image.height, image.width))
    lens = env.own_defaults()._replace(
        field_of_view_deg=image.field_of_view_deg, pitch_deg=image.pitch_deg
    )
    params = env.with_own_params(env.default_params, lens)
    draw = quick_jit(jax.vmap(lambda p, q: env.compose([*p, *q], params)))
    masks = np.asarray(draw(positions, quaternions))
    assert set(np.unique(masks)) == {0, 255} and masks.shape[1:] == env.observation_space().shape
    expected = ray_caster.cast_masks(
        positions.astype(float), quaternions.astype(float), gates, image
    )
    assert expected.mean() > 0.05 and np.mean((masks[..., 0] > 0) == expected) >= MASK_AGREEMENT


# --- The detector -------------------------------------------------------------------------------


@cache
def coasting():
    """Return the environment of a drone that coasts towards gates far away."""
    return GateCorners(coasting_env(30.0, 40.0), CornersParams(pitch_deg=0.0))


@cache
def observations_of(**detector):
    """Return the observations of a coasting flight of 30 steps in many environments, (T, N, 31)."""
    env = coasting()
    params = env.with_own_params(env.default_params, env.own_defaults()._replace(**detector))
    return np.asarray(_flight()(arrays(params), jnp.arange(256, dtype=jnp.uint32)))


@cache
def _flight():
    env, drone = coasting(), drone_at((0.0, 0.5, 2.2), (20.0, 1.0, -0.5))

    def fly(params, seed):
        state = env.begin(drone, 0, params, seed)

        def advance(state, _):
            observation, state, *_ = env.step_env(None, state, jnp.zeros(4), params)
            return state, observation

        first = env.observe(None, state, None, params)
        return jnp.concatenate([first[None], jax.lax.scan(advance, state, None, NEXT_STEPS)[1]])

    return quick_jit(jax.vmap(fly, in_axes=(None, 0), out_axes=1))


def test_frames_are_late_and_held_at_their_rate():
    perfect = observations_of()[:, 0, :24]
    assert np.abs(np.diff(perfect[:, 0])).min() > 0.0
    steps = np.arange(NEXT_STEPS + 1)
    for rate_hz, latency_s in ((50.0, 0.0), (50.0, 0.02), (25.0, 0.0), (100.0, 0.03)):
        rows = observations_of(frame_rate_hz=rate_hz, latency_s=latency_s)[:, 0, :24]
        period, late = round(100.0 / rate_hz), round(100.0 * latency_s)
        exposed = np.maximum((steps - late) // period * period, 0)
        assert_allclose(rows, perfect[exposed], atol=1e-6)


def test_noise_misses_and_swaps_are_as_often_and_as_large_as_asked():
    perfect = observations_of()
    noisy = observations_of(noise_px=2.0)
    errors_px = (noisy - perfect)[1:, :, :8].reshape(-1, 4, 2) * np.array([320.0, 240.0])
    assert_allclose(errors_px.std(axis=0), 2.0, rtol=0.03)
    assert_allclose(np.corrcoef(errors_px.reshape(len(errors_px), -1).T), np.eye(8), atol=0.05)
    assert_allclose(noisy[..., 24:], perfect[..., 24:], atol=0.0)
    missed = observations_of(missed=0.05)
    assert perfect[..., DETECTED].min() == 1.0
    assert_allclose(1.0 - missed[..., DETECTED].mean(), 0.05, atol=0.005)
    assert not missed[..., :2][missed[..., 8] == 0.0].any()
    swapped = observations_of(swapped=0.2)
    is_top, is_bottom = (
        np.abs(swapped[..., first] - perfect[..., first + 2]) < 1e-6 for first in (0, 4)
    )
    assert_allclose([is_top.mean(), is_bottom.mean()], 0.1, atol=0.02)
    assert not (is_top & is_bottom).any()
    # A frame that is held is held with its errors; every frame has its own.
    held = observations_of(noise_px=2.0, frame_rate_hz=50.0)
    assert_array_equal(held[2::2][:5], held[3::2][:5])
    assert (held[2] != held[4])[:, 0].all() and len(np.unique(held[2, :, 0])) > 100


def test_nothing_of_the_camera_survives_an_episode_and_settings_do_not_compile_again():
    env, key = coasting(), jax.random.key(0)
    step = quick_jit(env.step)
    params = arrays(env.default_params)
    state = env.begin(drone_at((0.0, 0.0, 2.0), (20.0, 0.0, 0.0)), 0, params, jnp.uint32(0))
    for _ in range(2):
        state = step(key, state, np.zeros(4, np.float32), params)[1]
    assert [past.pos_w.x for past in state.past] == pytest.approx([0.2, 0.0, 0.0])
    detector = env.own_params(params)._replace(
        latency_s=jnp.float32(0.02), width_px=jnp.float32(320.0)
    )
    num_programs = step._cache_size()
    _, state, _, terminated, *_ = step(
        key, state, np.full(4, np.nan, np.float32), env.with_own_params(params, detector)
    )
    assert terminated and state.steps == 0 and step._cache_size() == num_programs
    begun = env.drone(state)
    assert all(past == (begun.pos_w, begun.quat) for past in state.past)


def test_gradients_of_corners_are_those_of_finite_differences(params):
    image, weights = IMAGES["barrel"], np.random.default_rng(3).normal(size=(4, 2))
    gate = jax.tree.map(lambda leaf: np.asarray(leaf[0], float), params.course.gates)

    def value(pose):
        quaternion = Quaternion(*pose[3:]).normalize()
        return (weights * corners_at(image, pose[:3], quaternion, gate)[0]).sum()

    with jax.enable_x64(True):
        start = np.array([15.0, 2.3, 1.0, 0.1, 0.05, -0.1, 0.99])
        gradient = jax.jit(jax.grad(value))(start)
        shifted = jax.jit(jax.vmap(value))
        numeric = (shifted(start + 1e-6 * np.eye(7)) - shifted(start - 1e-6 * np.eye(7))) / 2e-6
    assert np.abs(numeric).min() > 1e-3
    assert_allclose(gradient, numeric, rtol=1e-4)


@pytest.mark.parametrize(("changes", "message"), table("cameras")["refused"])
def test_cameras_that_show_nothing_are_refused_by_the_name_of_the_field(changes, message):
    env = GateCorners(FlyTrack(plant=Coasting()))
    detector = env.own_defaults()._replace(**changes)
    with pytest.raises(ValueError, match=rf"params\.wrappers\['gate_corners'\]\.{message}"):
        env.reset(jax.random.key(0), env.with_own_params(env.default_params, detector))


@pytest.mark.parametrize(("size", "side"), [((7, 64), "height"), ((64, 4), "width")])
def test_masks_that_are_too_small_are_refused(size, side):
    with pytest.raises(ValueError, match=f"size: {side}_px: found"):
        GateMask(FlyTrack(), size=size)


# --- Around the detector ------------------------------------------------------------------------


def test_a_detector_is_drawn_for_an_episode_within_its_ranges():
    env = DetectorRandomization(GateCorners(coasting_env(30.0, 40.0), NOISY_DETECTOR))
    params, drone = env.default_params, drone_at((0.0, 0.0, 2.0), (20.0, 0.0, 0.0))

    def detectors(seed):
        state = env.begin(drone, 0, params, seed)
        later = env.advance(state, Action(0.0, 0.0, 0.0, 0.0), params)[0]
        return env.detector(state, params), env.detector(later, params)

    first, later = quick_jit(jax.vmap(detectors))(jnp.arange(500, dtype=jnp.uint32))
    for name, value in first._asdict().items():
        assert_array_equal(value, getattr(later, name))
        nominal = getattr(NOISY_DETECTOR, name)
        if name in ("noise_px", "missed", "swapped", "latency_s"):
            low, high = 0.0, nominal
        else:
            margin = {"pitch_deg": 3.0, "field_of_view_deg": 5.0}.get(name, 0.0)
            low, high = nominal - margin, nominal + margin
        assert_allclose([value.min(), value.max()], [low, high], atol=0.02 * (high - low))
    wide = params.wrappers["detector_randomization"]._replace(field_of_view_deg=60.0)
    with pytest.raises(ValueError, match="field_of_view_deg: found 180"):
        env.check_params(params.replace(wrappers={**params.wrappers, env.key: wide}))


def test_the_state_beside_corners_is_that_of_the_drone():
    plain = FlyTrack(plant=Coasting())
    env = StateObservation(ObservationNoise(GateCorners(plain)))
    drone = drone_at((14.0, 2.5, 1.5), (-8.0, 1.0, 0.5))
    rows = env.observe(None, env.begin(drone, 0, env.default_params), None, env.default_params)
    state = plain.begin(drone, 0, plain.default_params)
    assert_allclose(rows[31:], plain.observe(None, state, None, plain.default_params), atol=1e-6)


def test_what_a_camera_saw_is_shown_in_recordings_and_pictures(tmp_path):
    track = FlyTrack().track
    states, actions = ghost_rollout(shipped_references(track, ("nominal",)), 24)
    flight = make_flight("ghost", states, actions, track)
    with open_image(write_camera_view(flight, tmp_path)) as gif:
        assert gif.n_frames == 4 and gif.size == (800, 300)
    sizes = []
    for with_camera in (False, True):
        path = tmp_path / f"{with_camera}.rrd"
        flown = [Trajectory("ghost", states, actions)]
        write_recording(path, flown, track, with_camera=with_camera)
        sizes.append(path.stat().st_size)
    seen = film(states, flight.race.gate, track)
    assert sizes[1] > sizes[0] + 64 and seen.is_visible[0].any() and seen.masks[0].any()
