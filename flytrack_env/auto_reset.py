"""Auto-reset of a batch of which, as a rule, few episodes end in the same step.

Sampling, observing and selecting a start for every environment cost almost as much as the step. So
on the CPU, under ``vmap``, only as many starts are sampled as a step is likely to need, and they
are put in the place of the environments that ended. On a GPU a start is sampled for every
environment: that adds no kernel to the step, and a round would add 84. Each
environment starts as it would alone.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from flytrack_env.fusion import compute_once, has_kernels, is_in_kernel, one_kernel, vary_like

Shown = tuple[list[jax.Array], Any]  # observation, row by row, and state
Begin = Callable[[jax.Array, Any], Shown]

# Each round of resets samples one start per 32 environments, plus eight. With random actions, one
# environment in 70 ends an episode at each step, so one round usually suffices.
ENVS_PER_START = 32
SPARE_STARTS = 8
WORD_BITS = 32  # bits


class Ended(NamedTuple):
    """A step before auto-reset; scalars, or of a batch (num_envs,).

    Attributes:
        done: whether the episode ended.
        shown: observation, row by row, and state after the step.
        seed: random word, uint32, of the episode that may begin.
    """

    done: jax.Array
    shown: Shown
    seed: jax.Array


def reset_if_ended(begin: Begin, step: Ended, params: Any) -> Shown:
    """Return the start ``begin(seed, params)`` if an episode ended, else what there is.

    Of one environment. Under ``vmap`` on the CPU starts are sampled only for those that ended, as
    long as all share the parameters.
    """
    batch = reset_ended(begin, jax.tree.map(lambda leaf: leaf[None], step), params)
    return jax.tree.map(lambda leaf: leaf[0], batch)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def reset_ended(begin: Begin, steps: Ended, params: Any) -> Shown:
    """Return the same for a batch that shares its parameters; leaves (num_envs, ...)."""

    @custom_vmap
    def reset(steps: Ended, params: Any) -> Shown:
        is_in_rounds = len(steps.done) > 1 and has_kernels()
        return (_reset_in_rounds if is_in_rounds else _reset_all)(begin, steps, params)

    @reset.def_vmap
    def reset_batch(size: int, is_batched: Any, steps: Ended, params: Any) -> Any:
        axes = jax.tree.map(lambda is_mapped: 0 if is_mapped else None, is_batched)
        if any(jax.tree.leaves(is_batched[1])):
            shown = jax.vmap(partial(_reset_all, begin), tuple(axes), axis_size=size)(steps, params)
        else:  # a batch of batches, as one
            batches = jax.vmap(lambda step: step, (axes[0],), axis_size=size)(steps)
            flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batches)
            shown = reset_ended(begin, flat, params)
            shown = jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), shown)
        return shown, jax.tree.map(lambda _: True, shown)

    return reset(steps, params)


@reset_ended.defjvp
def _reset_ended_jvp(begin, primals, tangents):  # type: ignore[no-untyped-def]
    """Differentiate the same function without its loop, which has no reverse mode."""
    return jax.jvp(partial(_reset_all, begin), primals, tangents)


def _reset_all(begin: Begin, steps: Ended, params: Any) -> Shown:
    """Return what ``reset_ended`` does, with a start sampled for every environment."""

    def choose(old: jax.Array, start: jax.Array) -> jax.Array:
        return jnp.where(steps.done.reshape(-1, *[1] * (old.ndim - 1)), start, old)

    return jax.tree.map(choose, steps.shown, _starts(begin, steps.seed, params, steps.shown))


def _starts(begin: Begin, seeds: jax.Array, params: Any, shown: Shown) -> Shown:
    """Return a start for each seed, in the types of what is shown."""
    starts = jax.vmap(begin, in_axes=(0, None))(seeds, params)
    return jax.tree.map(lambda start, old: start.astype(old.dtype), starts, shown)


def _reset_in_rounds(begin: Begin, steps: Ended, params: Any) -> Shown:
    """Return what ``reset_ended`` does, sampling as many starts at once as a step may need."""
    num_envs = len(steps.done)
    count = min(num_envs, num_envs // ENVS_PER_START + SPARE_STARTS)
    find: Callable[..., jax.Array] = partial(_scan, count=count)
    take, put = _take, _put
    if not is_in_kernel():
        find, take, put = one_kernel(find), one_kernel(take), one_kernel(put)

    def reset_some(carry: Any) -> Any:
        indices, pending, shown = carry
        starts = _starts(begin, take(steps.seed, indices), params, shown)
        news = compute_once((jnp.zeros(count, bool), starts))
        pending, shown = put((pending, shown), news, indices)
        return find(pending), pending, shown

    # A conditional would copy every leaf in each of its branches, which cost more than the reset.
    start = vary_like((find(steps.done), steps.done, steps.shown), steps)
    return jax.lax.while_loop(lambda carry: carry[0][0] < num_envs, reset_some, start)[2]


def _scan(ended: jax.Array, count: int) -> jax.Array:
    """Return the indices of the first ``count`` true elements of a vector, then its length.

    It scans 32-bit words for their set bits.
    """
    size = ended.shape[0]
    bits = jnp.pad(ended, (0, -size % WORD_BITS)).reshape(-1, WORD_BITS).astype(jnp.uint32)
    words, half = bits << jnp.arange(WORD_BITS, dtype=jnp.uint32), WORD_BITS // 2
    while half:  # a reduction would be no simple operation
        words, half = compute_once(words[:, :half] | words[:, half:]), half // 2
    words = words[:, 0]
    last = words.shape[0] - 1

    def next_bit(carry: Any) -> Any:
        word_index, word, count_found, indices = carry
        is_one, lowest = word != 0, word & (~word + 1)
        bit = jax.lax.population_count(lowest - 1).astype(jnp.int32)
        # Without a bit, what is written is written over.
        index = jnp.where(is_one, word_index * WORD_BITS + bit, size)
        indices = jax.lax.dynamic_update_index_in_dim(indices, index, count_found, 0)
        word = jnp.where(is_one, word ^ lowest, _at(words, jnp.minimum(word_index + 1, last)))
        return (
            jnp.where(is_one, word_index, word_index + 1),
            word,
            count_found + is_one.astype(jnp.int32),
            indices,
        )

    start = (jnp.int32(0), words[0], jnp.int32(0), jnp.full(count, size, jnp.int32))
    return jax.lax.while_loop(
        lambda carry: (carry[0] <= last) & (carry[2] < count), next_bit, start
    )[3]


def _at(values: jax.Array, index: Any) -> jax.Array:
    return jax.lax.dynamic_index_in_dim(values, index, keepdims=False)


def _take(values: jax.Array, indices: jax.Array) -> jax.Array:
    """Return the values at indices; those beyond the end take the last value."""

    def take(number: Any, taken: jax.Array) -> jax.Array:
        value = _at(values, jnp.minimum(_at(indices, number), values.shape[0] - 1))
        return jax.lax.dynamic_update_index_in_dim(taken, value, number, 0)

    return jax.lax.fori_loop(0, indices.shape[0], take, jnp.zeros(indices.shape, values.dtype))


def _put(olds: Any, news: Any, indices: jax.Array) -> Any:
    """Return ``olds`` with the starts at their indices; those beyond the end come last, unused."""
    size, last = len(olds[0]), len(indices) - 1

    def put(carry: Any) -> Any:
        number, olds = carry
        index = _at(indices, number)

        def put_one(old: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_index_in_dim(old, _at(new, number), index, 0)

        return number + 1, jax.tree.map(put_one, olds, news)

    def is_left(carry: Any) -> jax.Array:
        return (carry[0] <= last) & (_at(indices, jnp.minimum(carry[0], last)) < size)

    return jax.lax.while_loop(is_left, put, (jnp.int32(0), olds))[1]
