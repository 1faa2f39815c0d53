"""What observation noise and the history of actions add."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env.env import FlyTrack
from flytrack_env.wrappers import (
    ActionHistory,
    NoiseParams,
    ObservationNoise,
)
from tests.support.wrapped_flights import NUM_STEPS, fly, wrapped

# --- Observation noise ----------------------------------------------------------------------------


def without_noise() -> dict[str, Any]:
    return {"wrappers": {"observation_noise": NoiseParams(0.0, 0.0, 0.0, 0.0)}}


def test_no_noise_is_the_identity() -> None:
    noisy = fly(wrapped(ObservationNoise), **without_noise())
    plain = fly(wrapped())
    np.testing.assert_array_equal(noisy[0][0], plain[0][0])
    np.testing.assert_array_equal(noisy[2][0], plain[2][0])


def test_noise_has_the_stated_deviations_and_is_white() -> None:
    """In the observation's rows, at rest on the start pose, where the drone itself does not move."""
    env = wrapped(ObservationNoise)
    noise = NoiseParams(position_m=0.1, velocity_m_per_s=0.2, attitude_deg=2.0, rates_rad_per_s=0.3)
    params = env.default_params.replace(wrappers={"observation_noise": noise})
    drone = env.drone(env.reset(jax.random.key(0), params)[1])
    seeds = jnp.arange(4000, dtype=jnp.uint32)

    def observations(seed: jax.Array) -> jax.Array:
        state = env.begin(drone, 0, params, seed)
        first = env.observe(None, state, None, params)
        later = env.advance(state, drone.applied, params)[0]
        return jnp.stack([first, jnp.stack(env.observe_drone(drone, later, params))])

    both = np.asarray(jax.jit(jax.vmap(observations))(seeds), float)
    plain = np.asarray(env.env.observe(None, env.env.begin(drone, 0, params), None, params), float)
    error = both[:, 0] - plain
    for rows, deviation in ((slice(0, 3), 0.1 / 3), (slice(3, 6), 0.2 / 5), (slice(15, 18), 0.3 / 5)):
        np.testing.assert_allclose(error[:, rows].std(axis=0), deviation, rtol=0.05)
        np.testing.assert_allclose(error[:, rows].mean(axis=0), 0.0, atol=0.08 * deviation)
        # White: the next step's noise does not know this one's.
        next_error = both[:, 1, rows] - both[:, 1, rows].mean(axis=0)
        for axis in range(3):
            assert abs(np.corrcoef(error[:, rows][:, axis], next_error[:, axis])[0, 1]) < 0.06
    turned = both[:, 0, 6:15].reshape(-1, 3, 3)
    level = plain[6:15].reshape(3, 3)
    twist = np.einsum("ji,njk->nik", level, turned)
    angle_x = 0.5 * (twist[:, 2, 1] - twist[:, 1, 2])
    assert np.rad2deg(angle_x).std() == pytest.approx(2.0, rel=0.05)
    np.testing.assert_allclose(twist @ twist.transpose(0, 2, 1), np.tile(np.eye(3), (4000, 1, 1)), atol=1e-5)
    assert (error[:, 18:] == 0.0).all()  # applied action, battery and the track are known


def test_noise_stays_inside_the_space_and_off_the_flight() -> None:
    env = wrapped(ObservationNoise)
    loud = {"wrappers": {"observation_noise": NoiseParams(50.0, 50.0, 90.0, 50.0)}}
    noisy, plain = fly(env, **loud), fly(wrapped())
    limit = np.asarray(env.observation_space().high)
    assert (np.abs(np.asarray(noisy[2][0])) <= limit).all()
    attitude = np.asarray(noisy[2][0])[..., 6:15].reshape(-1, 3, 3)
    np.testing.assert_allclose(
        attitude @ attitude.transpose(0, 2, 1), np.tile(np.eye(3), (800, 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(noisy[2][2], plain[2][2], atol=1e-5)  # rewards are of the true flight


@pytest.mark.parametrize(
    ("field", "value"),
    [("position_m", -0.1), ("attitude_deg", np.inf), ("attitude_deg", 181.0), ("rates_rad_per_s", np.nan)],
)
def test_bad_deviations_are_refused(field: str, value: float) -> None:
    env = wrapped(ObservationNoise)
    bad = {"observation_noise": NoiseParams()._replace(**{field: value})}
    with pytest.raises(ValueError, match=rf"\.{field}: found {value}, expected finite"):
        env.reset(jax.random.key(0), env.default_params.replace(wrappers=bad))


# --- Action history -------------------------------------------------------------------------------


def test_one_applied_action_is_the_one_in_the_observation() -> None:
    env = wrapped(partial(ActionHistory, length=1, kind="applied"))
    (first, _), _, outputs = fly(env)
    for observation in (first, outputs[0], outputs[5]["final_observation"]):
        np.testing.assert_array_equal(observation[..., 29:], observation[..., 18:22])


def test_commands_are_remembered_the_latest_first_within_the_episode() -> None:
    env = wrapped(ActionHistory)
    (first, _), actions, outputs = fly(env)
    history = np.asarray(outputs[0])[..., 29:].reshape(NUM_STEPS, -1, 3, 4)
    ended = np.asarray(outputs[3] | outputs[4])
    applied = np.asarray(outputs[0])[..., 18:22]
    expected = np.repeat(np.asarray(first)[:, None, 18:22], 3, axis=1)
    np.testing.assert_array_equal(np.asarray(first)[:, 29:].reshape(-1, 3, 4), expected)
    for i in range(NUM_STEPS):
        shifted = np.concatenate([np.asarray(actions)[i][:, None], expected[:, :-1]], axis=1)
        fresh = np.repeat(applied[i][:, None], 3, axis=1)
        expected = np.where(ended[i][:, None, None], fresh, shifted)
        np.testing.assert_allclose(history[i], expected, atol=1e-6)


def test_what_is_no_number_is_remembered_as_zero() -> None:
    env = wrapped(ActionHistory)
    params = env.default_params
    _, state = env.reset(jax.random.key(0), params)
    action = jnp.array([jnp.nan, 2.0, -jnp.inf, 0.5])
    observation, _, _, terminated, _ = env.step_env(None, state, action, params)
    assert bool(terminated)
    np.testing.assert_allclose(observation[29:33], [0.0, 1.0, -1.0, 0.5])
    assert np.isfinite(np.asarray(observation)).all()


@pytest.mark.parametrize(("argument", "value"), [("length", 0), ("kind", "wanted")])
def test_bad_histories_are_refused(argument: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{argument}: found {value!r}, expected"):
        ActionHistory(FlyTrack(), **{argument: value})
