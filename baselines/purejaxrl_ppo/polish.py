"""Polishing a trained policy: gradient descent on its race time, through the simulator itself.

PPO finds out how to race; near the optimum its noise costs more than a gate's edge gains. The simulator is
differentiable, and a policy that already races is stable, so that the gradient of the time of its last gate
along the whole flight (backpropagation through time) says how to fly faster. A gate's opening is wider
here, so that a pass beyond its edge still counts and has a gradient; the real edge is a penalty. Only the
actor changes. The policy is that of the mean action.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

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

FAR = 0.1  # of an offset beyond the limit


class Settings(NamedTuple):
    """How a policy is polished.

    updates: of the policy. learning_rate: the highest, reached after warm_up updates and falling to 0 as a
    cosine. flights: of one update, from noisy start poses, of so many laps. slowest_lap_s: mean lap time from
    which a flight is cut off. offset_limit: of a pass, over the free half opening, from which it is
    penalised, by penalty_s seconds times the square of what is beyond. widened_m: by which half openings are
    widened. largest_gradient: norm at which gradients are clipped. clips: the gradient of an "update", or
    that of each "flight" before they are averaged, so that one that is nearly lost does not outweigh the
    others. gradient_decay: share of a state's gradient that is passed on to the step before; below 1 it looks
    ahead for 1 / (1 - share) steps and cannot overflow. nearness_s: cost of a step of nearness 1 to an
    opponent. Its gradient has a decay of its own, since keeping clear takes no foresight of seconds, and is
    clipped apart from the other, then multiplied by nearness_weight.
    """

    updates: int = 1500
    learning_rate: float = 1e-3
    warm_up: int = 0
    flights: int = 32
    laps: int = 3
    slowest_lap_s: float = 4.2
    offset_limit: float = 0.95
    penalty_s: float = 20.0
    widened_m: float = 0.3
    largest_gradient: float = 1.0
    clips: Literal["update", "flight"] = "update"
    gradient_decay: float = 0.998
    nearness_s: float = 0.02
    nearness_decay: float = 0.98
    nearness_weight: float = 0.5


class Flown(NamedTuple):
    """What a flight came to: mean time of its gates, s, gates passed, the penalty, the sum of nearness."""

    time_s: jax.Array
    gates: jax.Array
    penalty: jax.Array
    nearness: jax.Array


Nearness = Callable[[Any], jax.Array]


def alone(state: Any) -> jax.Array:
    """Return the nearness to an opponent where there is none, 0."""
    return jnp.float32(0.0)


def fly(
    env: EpisodicEnvironment,
    policy: Policy,
    key: jax.Array,
    params: EnvParams,
    settings: Settings,
    nearness: Nearness = alone,
) -> Flown:
    """Return a flight of the mean action, differentiable in the policy; it stands still once it is over."""
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
        state = decayed(state, settings.gradient_decay)
        race, before = env.race(state), env.drone(state)
        next_state, _, is_over, _ = env.advance(state, Action(*action), params)
        after = env.drone(next_state)
        crossing = cross_gate(race.gate, before.pos_w, after.pos_w, params.drone_radius)
        is_racing = is_flying & (flown.gates < last_gate)
        counts = crossing.is_pass & is_racing
        offset = jnp.where(counts, crossing.offset * relative, 0.0)
        beyond = jnp.maximum(offset - settings.offset_limit, 0.0)
        flown = Flown(
            time_s=flown.time_s + jnp.where(counts, (index + crossing.fraction) * params.dt, 0.0) / last_gate,
            gates=flown.gates + counts,
            # Linear far out: one lost flight must not outweigh all that race.
            penalty=flown.penalty + jnp.where(beyond < FAR, beyond * beyond, FAR * (2.0 * beyond - FAR)),
            nearness=flown.nearness + jnp.where(is_racing, nearness(next_state), 0.0),
        )
        # What ended would fly on to where numbers overflow, and its gradient with it.
        is_flying = is_flying & ~is_over
        keep = partial(jax.tree.map, partial(jnp.where, is_flying))
        seen = jnp.stack(env.observe_drone(after, next_state, params))
        kept = keep((remembered, seen, next_state), (memory, observation, state))
        return (*kept, is_flying, flown), None

    zero = jnp.float32(0.0)
    nothing = Flown(zero, jnp.int32(0), zero, zero)
    start = (policy.network.first_memory(), *env.reset_env(key, params), jnp.asarray(True), nothing)
    num_steps = round(settings.laps * settings.slowest_lap_s / float(env.default_params.dt))
    return jax.lax.scan(jax.checkpoint(step), start, jnp.arange(num_steps))[0][-1]


def decayed(tree: Any, share: float) -> Any:
    """Return a tree as it is, that passes only a share of its gradient on to what comes before it."""

    def leaf(value: Any) -> Any:
        if share == 1.0 or not jnp.issubdtype(jnp.asarray(value).dtype, jnp.floating):
            return value
        still = jax.lax.stop_gradient(value)
        return still + share * (value - still)

    return jax.tree.map(leaf, tree)


DrawModel = Callable[[jax.Array], ModelParameters]


def polish(
    env: EpisodicEnvironment,
    policy: Policy,
    seed: int,
    settings: Settings = Settings(),  # noqa: B008, a tuple of constants
    draw_model: DrawModel | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
    nearness: Nearness = alone,
) -> Any:
    """Return the parameters of a policy that races faster.

    env: a simulator with the model that is raced on. draw_model: the model of each flight, from a key; that
    of the environment if None. report: called with updates done and in all. nearness: to an opponent, from a
    state of the environment.

    Raises:
        ValueError: a policy of which no flight of an update passes all gates.
    """
    params = start_pose_params(env.default_params, 10**6)
    last_gate = settings.laps * params.course.num_gates
    schedule = optax.warmup_cosine_decay_schedule(
        settings.learning_rate if settings.warm_up == 0 else 0.0,
        settings.learning_rate,
        settings.warm_up,
        settings.updates,
    )
    optimiser = optax.adam(schedule)
    foresight = settings._replace(gradient_decay=settings.nearness_decay)

    def flown(policy_params: Any, key: jax.Array, settings: Settings) -> Flown:
        of_model, of_start = jax.random.split(key)
        own = params if draw_model is None else params.replace(model=draw_model(of_model))
        return fly(env, Policy(policy.network, policy_params), of_start, own, settings, nearness)

    def race_time(policy_params: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        flight = flown(policy_params, key, settings)
        is_complete = flight.gates >= last_gate
        return jnp.where(is_complete, flight.time_s, 0.0) + settings.penalty_s * flight.penalty, is_complete

    def crowding(policy_params: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return settings.nearness_s * flown(policy_params, key, foresight).nearness, jnp.asarray(True)

    clip = partial(projection_l2_ball, scale=settings.largest_gradient)

    def gradient_of(cost: Callable[..., Any], policy_params: Any, keys: jax.Array) -> tuple[Any, jax.Array]:
        """Return the clipped gradient of a flight's mean cost, and the number of flights that count."""

        def of_flight(key: jax.Array) -> tuple[Any, jax.Array]:
            gradient, counts = jax.grad(cost, has_aux=True)(policy_params, key)
            return clip(gradient) if settings.clips == "flight" else gradient, counts

        gradients, counts = jax.vmap(of_flight)(keys)
        number = counts.sum()
        gradient = jax.tree.map(lambda leaf: leaf.sum(axis=0) / jnp.maximum(number, 1), gradients)
        return gradient if settings.clips == "flight" else clip(gradient), number

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(policy_params: Any, optimiser_state: Any, key: jax.Array) -> tuple[Any, Any, jax.Array]:
        keys = jax.random.split(key, settings.flights)
        gradient, number = gradient_of(race_time, policy_params, keys)
        if nearness is not alone:
            away, _ = gradient_of(crowding, policy_params, keys)
            gradient = jax.tree.map(lambda own, other: own + settings.nearness_weight * other, gradient, away)
        change, optimiser_state = optimiser.update(gradient, optimiser_state)
        return optax.apply_updates(policy_params, change), optimiser_state, number

    policy_params = jax.tree.map(jnp.array, policy.params)  # the caller's stay, though updates donate
    optimiser_state = optimiser.init(policy_params)
    keys = jax.random.split(jax.random.key(seed), settings.updates)
    for done, key in enumerate(keys, start=1):
        policy_params, optimiser_state, number = update(policy_params, optimiser_state, key)
        if int(number) == 0:
            raise ValueError(
                f"policy: found none of {settings.flights} flights that passed {last_gate} gates within "
                f"{settings.laps * settings.slowest_lap_s:g} s, expected one that already races"
            )
        report(done, settings.updates)
    return policy_params
