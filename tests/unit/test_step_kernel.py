"""Fused code stays the same: ``compute_once``, ``one_kernel``, a batch's auto-reset, the step."""

from functools import partial

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import flytrack_env
from flytrack_env import nominal_parameters
from flytrack_env.auto_reset import Ended, reset_if_ended
from flytrack_env.effects import EFFECTS, stick_fields
from flytrack_env.fusion import ATTRIBUTES, SWITCH, compute_once, one_kernel
from flytrack_env.motion import Motion
from flytrack_env.registration import ENVIRONMENTS, RACES
from tests.contract.test_effects import inside_ranges
from tests.support.compiling import QUICKLY
from tests.support.stepping import flight, inputs


def with_all_effects(commands):
    """Return an environment whose model has all effects of its commands, a third into their ranges.

    Args:
        commands: what the effects act on, "sticks" or "motors".
    """
    on_motors = commands == "motors"
    effects = [
        inside_ranges(effect, 0.3)
        for effect in EFFECTS
        if not (stick_fields(effect) if on_motors else effect.takes_motors)
    ]
    model = nominal_parameters()._replace(motion=Motion.CONTINUOUS).with_effects(*effects)
    return flytrack_env.make("FlyTrack-v0", model=model)


VARIANTS = {
    "all wrappers": lambda: flytrack_env.make("FlyTrackRobust-v0", missed_gate="fly_on"),
    "all effects of sticks, continuous": partial(with_all_effects, "sticks"),
    "all effects of motors, continuous": partial(with_all_effects, "motors"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_the_kernel_is_the_same_step_unless_switched_off(monkeypatch, name):
    """With the inputs as constants of the program, and without the kernel as its arguments."""
    env = VARIANTS[name]()
    with_kernel = jax.jit(lambda: flight(env)(*inputs(env))).lower()
    monkeypatch.setenv(SWITCH, "0")
    env = VARIANTS[name]()  # of the first one, JAX keeps what it has traced
    without = jax.jit(flight(env)).lower(*inputs(env))
    mark = next(iter(ATTRIBUTES))
    assert mark in with_kernel.as_text() and mark not in without.as_text()
    leaves = jax.tree_util.tree_leaves_with_path(without.compile(QUICKLY)(*inputs(env)))
    sizes = {
        jax.tree_util.keystr(path): max(float(np.abs(leaf).max()), 1.0) for path, leaf in leaves
    }
    outcome = jax.tree.leaves(with_kernel.compile(QUICKLY)())
    for leaf, (path, expected) in zip(outcome, leaves, strict=True):
        # A bend is a second difference of forces, and rounds as they do.
        size = sizes[jax.tree_util.keystr(path).replace("force_bends_b", "forces_b")]
        assert_allclose(leaf, expected, rtol=1e-5, atol=1e-5 * size)


IDS = [*ENVIRONMENTS, *RACES]
ALL_WRAPPERS = ("FlyTrackRobust-v0", "FlyTrackDuel-v0")  # which hold the others


@pytest.mark.parametrize(
    "env_id",
    [
        pytest.param(env_id, marks=[] if env_id in ALL_WRAPPERS else pytest.mark.slow)
        for env_id in IDS
    ],
)
def test_a_step_on_a_gpu_has_no_loop_and_no_scatter(monkeypatch, env_id):
    """Each would be a launch of its own, and a loop's condition a wait of the host."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    env, params = gymnax.make(env_id)
    keys = jax.random.split(jax.random.key(0), 8)
    _, states = jax.eval_shape(jax.vmap(env.reset, (0, None)), keys, params)
    actions = jnp.zeros((8, *env.action_space(params).shape))
    step = jax.jit(jax.vmap(env.step, (0, 0, 0, None))).trace(keys, states, actions, params)
    text = step.lower(lowering_platforms=("cuda",)).as_text()
    # A ghost reads its recording at the time of the race, which is a gather.
    kernels = ("scatter", "while", "sort", *([] if env_id in RACES else ["gather"]))
    counts = {name: text.count(f"stablehlo.{name}") for name in kernels}
    assert not any(counts.values()), counts
    assert text.count("stablehlo.select") > 10


LEAVES = {
    "float": np.array([1.5, -0.0, np.inf, -np.inf, np.nan], np.float32),
    "scalar": np.float32(2.5),
    "half": np.array([0.5, 2.0], np.float16),
    "int": np.array([-3, 0, 2**31 - 1, -(2**31)], np.int32),
    "unsigned": np.array([0, 1, 2**32 - 1], np.uint32),
    "bool": np.array([True, False]),
}


@pytest.mark.parametrize("leaf", LEAVES)
def test_identity(leaf):
    value = jnp.asarray(LEAVES[leaf])
    along_the_last_axis = jax.vmap(compute_once, -1, -1)(jnp.stack([value, value], -1))[..., 1]
    for result in (jax.jit(compute_once)(value), along_the_last_axis):
        assert (result.dtype, result.shape) == (value.dtype, value.shape)
        assert_array_equal(result, value)
        if np.issubdtype(value.dtype, np.floating):
            assert_array_equal(np.signbit(result), np.signbit(value))


def swing(x, steps, unread):
    """Return what a loop of simple operations makes of numbers; the last one is not read."""
    swung = jax.lax.fori_loop(0, 3, lambda _, y: jnp.where(y > 0.3, jnp.sin(y), y * steps), x)
    return swung, x + 1.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_kernel_is_the_same_function_and_prunes_what_it_does_not_read(dtype):
    with jax.enable_x64(dtype is np.float64):
        given = (np.linspace(-2.0, 2.0, 12, dtype=dtype), dtype(1.5), np.zeros(3, dtype))
        tangents = (np.ones(12, dtype), dtype(0.5), np.ones(3, dtype))
        for transform in (
            lambda f: f,
            lambda f: jax.vmap(f, in_axes=(0, None, None)),
            lambda f: lambda *args: jax.jvp(f, args, tangents),
            lambda f: jax.grad(lambda *args: f(*args)[0].sum(), argnums=(0, 1)),
        ):
            result, expected = (jax.jit(transform(f))(*given) for f in (one_kernel(swing), swing))
            jax.tree.map(partial(assert_allclose, rtol=1e-6), result, expected)
            assert jax.tree.leaves(result)[0].dtype == dtype


def test_what_is_no_simple_operation_stays_outside_of_one_kernel():
    def product(x):
        return x @ x

    matrix = jnp.eye(3)
    text = jax.jit(one_kernel(product)).lower(matrix).as_text()
    assert "xla_cpu_small_call" not in text
    assert "xla_cpu_small_call" in jax.jit(one_kernel(jnp.sin)).lower(matrix).as_text()
    assert_array_equal(jax.jit(one_kernel(product))(matrix), matrix)


def test_what_only_xla_finds_unread_and_constants_abort_no_process():
    def sway(x, unread, *parameters):
        chosen = jnp.where(jnp.zeros((), bool), unread, parameters[0])
        return jax.lax.fori_loop(0, 3, lambda _, y: jnp.sin(y) * parameters[1] + chosen, x)

    x, one, two = np.linspace(0.0, 1.0, 1000, dtype=np.float32), np.float32(1.0), np.float32(2.0)
    for given in ((x, x, one, two, two), (x[:3], one, one, two, two)):
        expected, kernel = jax.jit(sway)(*given), one_kernel(sway)
        assert_allclose(jax.jit(kernel)(*given), expected, rtol=1e-5)
        assert_allclose(jax.jit(partial(kernel, *given))(), expected, rtol=1e-5)


def begin(seed, offset):
    """Return rows and state of a start."""
    value = seed.astype(jnp.float32) + offset
    return [value, 2.0 * value], {"scalar": value, "vector": jnp.tile(value, 3)}


def make_batch(size, share):
    """Return a batch of which about that share of the episodes end."""
    index = jnp.arange(size)
    done = jax.random.uniform(jax.random.key(1), (size,)) < share
    state = {"scalar": index * 1.0, "vector": jnp.ones((size, 3))}
    return Ended(done, ([index * 1.0, index * 3.0], state), (7 * index).astype(jnp.uint32))


def reset_or_keep(step, offset):
    """Return what the reset of one environment is by definition."""
    return jax.tree.map(partial(jnp.where, step.done), begin(step.seed, offset), step.shown)


reset = partial(reset_if_ended, begin)


@pytest.mark.parametrize("switch", ["1", "0"])
@pytest.mark.parametrize("size", [7, 300])
def test_only_ended_environments_change(monkeypatch, switch, size):
    monkeypatch.setenv(SWITCH, switch)
    result_of, expected_of = (
        jax.jit(jax.vmap(function, in_axes=(0, None)))
        for function in (one_kernel(reset), reset_or_keep)
    )
    for share in (0.0, 0.02, 0.4, 1.0):
        batch = make_batch(size, share)
        jax.tree.map(assert_array_equal, result_of(batch, 1000.0), expected_of(batch, 1000.0))


def test_a_batch_of_batches_and_parameters_of_each():
    batch = make_batch(24, 0.3)
    nested = jax.tree.map(lambda leaf: leaf.reshape(4, 6, *leaf.shape[1:]), batch)
    result, expected = (
        (
            jax.jit(jax.vmap(jax.vmap(function, (0, None)), (0, None)))(nested, 5.0),
            jax.jit(jax.vmap(function))(batch, 1.0 * jnp.arange(24)),
        )
        for function in (reset, reset_or_keep)
    )
    jax.tree.map(assert_array_equal, result, expected)


def test_gradient_flows_through_what_did_not_end():
    def total(rows):
        batch = Ended(jnp.array([True, False, True]), ([rows], rows), jnp.zeros(3, jnp.uint32))
        reset = partial(reset_if_ended, lambda seed, _: ([seed * 1.0], seed * 1.0))
        (shown,), _ = jax.vmap(one_kernel(reset), in_axes=(0, None))(batch, None)
        return (shown**2).sum()

    assert_allclose(jax.grad(total)(jnp.array([3.0, 4.0, 5.0])), [0.0, 8.0, 0.0])
