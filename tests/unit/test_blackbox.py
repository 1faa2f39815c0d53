"""Black boxes: loading any, refusing the rest, flying them in bulk and in the environment."""

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import flytrack_env
from flytrack_env.blackbox import BlackBoxError, load
from flytrack_env.state import BATTERY
from tests.support.black_boxes import random_inputs, write_artifact

# Loading


REFUSALS = [
    (r"signature: found .*float32\[20\], float32\[4\].*expected", lambda x, u: x, {"shapes": ((20,), (4,))}),
    (r"signature: found .*-> \(float32\[21\], float32\[4\]\).*expected", lambda x, u: (x, u), {}),
    (r"signature: found .*\(float32\[21\]\) ->.*expected", lambda x: x, {"shapes": ((21,),)}),
    (r"signature: found .*float16\[21\].*expected", lambda x, u: x, {"dtype": jnp.float16}),
    (r".* does not run on the CPU .*platforms", lambda x, u: x, {"platforms": ["cuda"]}),
    (r"components \[8\] .*expected finite numbers", lambda x, u: x.at[8].set(x[8] / x[0]), {}),
]


@pytest.mark.parametrize(("reason", "function", "options"), REFUSALS)
def test_what_cannot_be_flown_is_refused(tmp_path, reason, function, options):
    path = write_artifact(tmp_path / "other.bin", function, **options)
    with pytest.raises(BlackBoxError, match=rf"other\.bin: {reason}"):
        load(path)


# Flying


def test_vmap_nested_vmap_and_scan_agree_with_a_loop(black_box, fly_black_box):
    states, actions = random_inputs(12)
    one_by_one = np.stack([fly_black_box(x, u) for x, u in zip(states, actions, strict=True)])
    close = {"rtol": 1e-5, "atol": 1e-5}
    batched = jax.jit(jax.vmap(black_box.step_vector))(states, actions)
    np.testing.assert_allclose(batched, one_by_one, **close)
    grid = (states.reshape(3, 4, 21), actions.reshape(3, 4, 4))
    nested = jax.jit(jax.vmap(jax.vmap(black_box.step_vector)))(*grid)
    np.testing.assert_allclose(nested.reshape(12, 21), one_by_one, **close)
    one_state = jax.vmap(black_box.step_vector, in_axes=(None, 0))(states[0], actions)
    expected = np.stack([fly_black_box(states[0], u) for u in actions])
    np.testing.assert_allclose(one_state, expected, **close)

    def body(x, u):
        x = jax.vmap(black_box.step_vector, in_axes=(0, None))(x, u)
        return x, x

    _, path = jax.jit(lambda x: jax.lax.scan(body, x, actions))(states[:2])
    x = states[1]
    for u, row in zip(actions, path[:, 1], strict=True):
        x = fly_black_box(x, u)
        np.testing.assert_allclose(row, x, rtol=1e-4, atol=1e-4)


def test_many_drones_fly_in_one_loop(black_box):
    batch = jnp.zeros((16, 16, 21)), jnp.zeros((16, 16, 4))
    text = jax.jit(jax.vmap(jax.vmap(black_box.step_vector))).lower(*batch)
    assert text.as_text().count("stablehlo.while") == 1


def test_another_backend_is_a_clear_error(black_box):
    traced = jax.jit(black_box.step_vector).trace(jnp.zeros(21), jnp.zeros(4))
    with pytest.raises(ValueError, match="exported for platforms"):
        traced.lower(lowering_platforms=("cuda",))


def test_artifact_of_18_components(tmp_path):
    def reduced_step(x: jax.Array, u: jax.Array) -> jax.Array:
        # Position, velocity, acceleration and quaternion stay; the rest is made recognisable.
        rates = jnp.deg2rad(jnp.array([618.0, 618.0, 120.0])) * u[:3]
        return jnp.concatenate([x[:13], rates, u[3:] * x[16], x[17:] - 1.0])

    path = write_artifact(tmp_path / "reduced.bin", reduced_step, ((18,), (4,)))
    box = load(path)
    assert box.state_size == 18
    states, actions = random_inputs(5)
    after = np.asarray(jax.jit(jax.vmap(box.step_vector))(states, actions))
    np.testing.assert_array_equal(after[:, :13], states[:, :13])
    np.testing.assert_allclose(after[:, 16:19], actions[:, :3], rtol=1e-5)
    np.testing.assert_allclose(after[:, 19], actions[:, 3] * states[:, 19], rtol=1e-6)
    np.testing.assert_allclose(after[:, BATTERY], states[:, BATTERY] - 1.0, rtol=1e-6)
    slower = load(path, max_rate=(309.0, 618.0, 120.0)).step_vector(states[0], actions[0])
    np.testing.assert_allclose(slower[16], 2.0 * actions[0, 0], rtol=1e-5)


def test_environment_flies_the_black_box(black_box, fly_black_box):
    env, params = gymnax.make("FlyTrack-v0", plant=black_box)
    assert isinstance(env, flytrack_env.FlyTrack)
    keys = jax.random.split(jax.random.key(0), 3)
    actions = jnp.array([[0.1, 0.2, -0.3, 0.4], [0.0, 0.1, 0.0, 0.2], [0.3, 0.0, 0.1, -0.5]])

    _, states = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    step = jax.jit(env.step_batch)
    for _ in range(3):
        before = np.stack(jax.tree.leaves(jax.vmap(env.drone)(states)), axis=-1)
        _, states, reward, *_ = step(keys[0], states, actions, params)
        after = np.stack(jax.tree.leaves(jax.vmap(env.drone)(states)), axis=-1)
        expected = [fly_black_box(x, u) for x, u in zip(before, actions, strict=True)]
        np.testing.assert_allclose(after, expected, rtol=1e-5, atol=1e-4)
        assert np.isfinite(reward).all()
    with pytest.raises(ValueError, match=r"dt: found 0\.02 s, expected 0\.01 s"):
        black_box.step(None, None, 0.02, None)
