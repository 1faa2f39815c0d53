"""Polishing a trained policy: gradient descent on its race time, through the simulator itself.

PPO finds out how to race; near the optimum its noise costs more than a gate's edge gains. The
simulator is differentiable, and a policy that already races is stable, so that the gradient of the
time of its last gate along the whole flight (backpropagation through time) says how to fly faster.
A gate's opening is wider here, so that a pass beyond its edge still counts and has a gradient; the
real edge is a penalty. Only the actor changes. The policy is that of the mean action.

A policy that does not race has no such gradient. Where its simulator is to become another one, the
models move from the one to the other as fast as the policy follows: a step further after an update
in which half of the flights finish, a step back after any other.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from optax.projections import projection_l2_ball

from baselines.purejaxrl_ppo.flights import start_pose_params
from baselines.purejaxrl_ppo.networks import Policy
from flytrack_env.dynamics import ModelParameters
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.params import EnvParams
from flytrack_env.state import Action
from flytrack_env.tracks import cross_gate

# offset beyond the limit up to which the penalty is quadratic, linear from there
QUADRATIC_OFFSET = 0.1
# Share of an update's flights that finish, after which models move on. No other was tried.
FOLLOWED = 0.5


class LostError(ValueError):
    """A policy that does not race; the message says in which flights, and what was expected."""


class Settings(NamedTuple):
    """How a policy is polished.

    Attributes:
        updates: of the policy on the models that it is meant for.
        curriculum_steps: in which models move to these before; 0 if they do not move.
        curriculum_updates: most updates for these steps.
        learning_rate: on the way; after it, it falls to 0 as a cosine.
        flights: of one update, from noisy start poses.
        laps: of a flight.
        slowest_lap_s: mean lap time from which a flight is cut off (s).
        offset_limit: of a pass, over the free half opening, from which it is penalised.
        penalty_s: seconds for the square of an offset beyond the limit.
        widened_m: by which half openings are widened.
        largest_gradient: norm at which the gradient of a flight is clipped.
        gradient_decay: share of a state's gradient that is passed on to the step before; below 1 it
            looks ahead for 1 / (1 - share) steps and cannot overflow.
    """

    updates: int = 1500
    curriculum_steps: int = 0
    curriculum_updates: int = 400
    learning_rate: float = 1e-3
    flights: int = 32
    laps: int = 3
    slowest_lap_s: float = 4.2
    offset_limit: float = 0.95
    penalty_s: float = 20.0
    widened_m: float = 0.3
    largest_gradient: float = 1.0
    gradient_decay: float = 0.998


class Flown(NamedTuple):
    """The result of a flight.

    Attributes:
        time_s: mean time of its gates (s).
        gates: passed.
        penalty: sum over its passes.
    """

    time_s: jax.Array
    gates: jax.Array
    penalty: jax.Array


def fly(
    env: EpisodicEnvironment, policy: Policy, key: jax.Array, params: EnvParams, settings: Settings
) -> Flown:
    """Fly the mean action, differentiable in the policy; the state is frozen after the end."""
    gates = params.course.gates
    free = gates.half_opening - params.drone_radius
    # Of a pass in units of the real opening; all gates of a track may differ.
    relative = jnp.mean((free + settings.widened_m) / free)
    widened = gates._replace(half_opening=gates.half_opening + settings.widened_m)
    params = params.replace(course=params.course._replace(gates=widened))
    last_gate = settings.laps * params.course.num_gates

    def step(carry: tuple[Any, ...], index: jax.Array) -> tuple[Any, None]:
        memory, observation, state, is_flying, flown = carry
        remembered, action = policy.network.act(policy.params, memory, observation)
        state = decay_gradient(state, settings.gradient_decay)
        race, before = env.race(state), env.drone(state)
        next_state, _, is_over, _ = env.advance(state, Action(*action), params)
        after = env.drone(next_state)
        crossing = cross_gate(race.gate, before.pos_w, after.pos_w, params.drone_radius)
        counts = crossing.is_pass & is_flying & (flown.gates < last_gate)
        offset = jnp.where(counts, crossing.offset * relative, 0.0)
        beyond = jnp.maximum(offset - settings.offset_limit, 0.0)
        # Linear far out: one lost flight must not outweigh all that race.
        linear = QUADRATIC_OFFSET * (2.0 * beyond - QUADRATIC_OFFSET)
        flown = Flown(
            time_s=flown.time_s
            + jnp.where(counts, (index + crossing.fraction) * params.dt, 0.0) / last_gate,
            gates=flown.gates + counts,
            penalty=flown.penalty + jnp.where(beyond < QUADRATIC_OFFSET, beyond * beyond, linear),
        )
        # What ended would fly on to where numbers overflow, and its gradient with it.
        is_flying = is_flying & ~is_over
        keep = partial(jax.tree.map, partial(jnp.where, is_flying))
        next_observation = jnp.stack(env.observe_drone(after, next_state, params))
        kept = keep((remembered, next_observation, next_state), (memory, observation, state))
        return (*kept, is_flying, flown), None

    zero = jnp.float32(0.0)
    start = (
        policy.network.first_memory(),
        *env.reset_env(key, params),
        jnp.asarray(True),
        Flown(zero, jnp.int32(0), zero),
    )
    num_steps = round(settings.laps * settings.slowest_lap_s / float(env.default_params.dt))
    return jax.lax.scan(jax.checkpoint(step), start, jnp.arange(num_steps))[0][-1]


def decay_gradient(tree: Any, share: float) -> Any:
    """Return a tree unchanged, and pass on only a share of the gradient through it."""

    def decay_leaf(value: Any) -> Any:
        if share == 1.0 or not jnp.issubdtype(jnp.asarray(value).dtype, jnp.floating):
            return value
        constant = jax.lax.stop_gradient(value)
        return constant + share * (value - constant)

    return jax.tree.map(decay_leaf, tree)


def average_clipped(gradients: Any, largest: float) -> Any:
    """Return the mean of the gradients of flights, each clipped at a norm.

    Clipping the mean is no substitute: single flights of Betaflight with curved sticks had a norm
    of 300,000, others of 2.

    Args:
        gradients: leaves (flights, ...).
        largest: norm of a flight's gradient.
    """
    clipped = jax.vmap(partial(projection_l2_ball, scale=largest))(gradients)
    return jax.tree.map(partial(jnp.mean, axis=0), clipped)


def polish(
    env: EpisodicEnvironment,
    policy: Policy,
    seed: int,
    settings: Settings = Settings(),  # noqa: B008, a tuple of constants
    draw_model: Callable[[jax.Array, jax.Array], ModelParameters] | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Any:
    """Return the parameters of a policy that races faster.

    Args:
        env: simulator with the model that is raced on.
        policy: that races already.
        seed: of the flights.
        settings: see ``Settings``.
        draw_model: from a key and the share of the way, the model of one flight; that of the
            environment if None.
        report: called with the number of updates done, and of all if the policy follows from now.

    Raises:
        LostError: no flight of an update passes all gates, or models have not arrived.
    """
    params = start_pose_params(env.default_params, 10**6)
    last_gate = settings.laps * params.course.num_gates
    optimizer = optax.scale_by_adam()
    learning_rate = optax.cosine_decay_schedule(settings.learning_rate, settings.updates)

    def compute_cost(
        policy_params: Any, key: jax.Array, way: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        key_model, key_start = jax.random.split(key)
        flown_params = params
        if draw_model is not None:
            flown_params = params.replace(model=draw_model(key_model, way))
        flown = fly(env, Policy(policy.network, policy_params), key_start, flown_params, settings)
        is_complete = flown.gates >= last_gate
        return jnp.where(
            is_complete, flown.time_s, 0.0
        ) + settings.penalty_s * flown.penalty, is_complete

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(
        policy_params: Any, optimizer_state: Any, key: jax.Array, way: jax.Array, done: jax.Array
    ) -> tuple[Any, Any, jax.Array]:
        keys = jax.random.split(key, settings.flights)
        gradients, is_complete = jax.vmap(jax.grad(compute_cost, has_aux=True), (None, 0, None))(
            policy_params, keys, way
        )
        gradient = average_clipped(gradients, settings.largest_gradient)
        change, optimizer_state = optimizer.update(gradient, optimizer_state)
        change = jax.tree.map(lambda leaf: -learning_rate(done) * leaf, change)
        return optax.apply_updates(policy_params, change), optimizer_state, is_complete.sum()

    policy_params = jax.tree.map(
        jnp.array, policy.params
    )  # the caller's stay, though updates donate
    optimizer_state = optimizer.init(policy_params)
    most_updates = settings.updates + (
        settings.curriculum_updates if settings.curriculum_steps else 0
    )
    keys = iter(jax.random.split(jax.random.key(seed), most_updates))
    step = on_way = done = 0
    while done < settings.updates:
        is_there = step == settings.curriculum_steps
        if not is_there and on_way == settings.curriculum_updates:
            raise LostError(
                f"policy: followed {step / settings.curriculum_steps:.0%} of the way to other "
                f"models in {on_way} updates, expected all of it"
            )
        way = step / settings.curriculum_steps if settings.curriculum_steps else 1.0
        policy_params, optimizer_state, num_complete = update(
            policy_params, optimizer_state, next(keys), jnp.float32(way), jnp.int32(done)
        )
        if is_there:
            done += 1
        else:
            on_way += 1
            follows = int(num_complete) >= FOLLOWED * settings.flights
            step = step + 1 if follows else max(step - 1, 0)
        if is_there and int(num_complete) == 0:
            raise LostError(
                f"policy: found none of {settings.flights} flights that passed {last_gate} gates "
                f"within {settings.laps * settings.slowest_lap_s:g} s, expected one that already "
                "races"
            )
        report(on_way + done, settings.updates + on_way + settings.curriculum_steps - step)
    return policy_params
