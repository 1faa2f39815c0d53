"""Simulation: actions that no pilot would give, extreme parameters; each step is checked."""

import time
from collections import Counter
from functools import partial
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import flytrack_env
from benchmarks.report import ROOT, table
from flytrack_env import blackbox
from flytrack_env.effects import EFFECTS, USUAL_STEPS, Range, effect_of
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.params import RANGES, EnvParams
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.state import ACTION_SIZE
from flytrack_env.terminations import Causes
from flytrack_env.tracks import available_tracks, build_course, load_track, random_track
from flytrack_env.wrappers import ActionDelay, ActionHistory, EpisodeStatistics, ObservationNoise

NUM_ENVS, NUM_STEPS = 1024, 1000  # of a flight
TOTAL_STEPS = 1e8
HELD_STEPS = 40  # for which some actions stay the same
UNIT_TOLERANCE = 1e-5  # of a quaternion's norm
VIOLATIONS = (
    "state not finite",
    "reward not finite",
    "info not finite",
    "attitude not a unit quaternion",
    "observation not finite",
    "observation outside its space",
    "episode beyond its time limit",
    "NaN action without an end",
)
# Values that sticks take, by kind of actions; the kinds share the environments evenly.
BEYOND = float(np.nextafter(np.float32(1.0), np.float32(2.0)))
ODD_VALUES = {
    "full stick": (1.0, -1.0),
    "centred": (0.0, -0.0, 1e-40, -1e-40),
    "at the edge": (1.0, -1.0, BEYOND, -BEYOND),
    "huge or infinite": (1e38, -3.4e38, np.inf, -np.inf),
    "sometimes NaN": (*([1.0, -1.0, 0.5, 0.0] * 16), np.nan),
}
KINDS = ("uniform", "uniform, held", "full stick, held", *ODD_VALUES)


def draw_actions(key: jax.Array, step: jax.Array) -> jax.Array:
    """Return a step's actions, (NUM_ENVS, 4): of ``KINDS``, in blocks."""
    size = (NUM_ENVS // len(KINDS), ACTION_SIZE)
    now, held = jax.random.fold_in(key, step), jax.random.fold_in(key, -1 - step // HELD_STEPS)
    uniform, uniform_held = (jax.random.uniform(one, size, minval=-1.0, maxval=1.0) for one in (now, held))
    odd = [jax.random.choice(now, jnp.array(values), size) for values in ODD_VALUES.values()]
    return jnp.concatenate([uniform, uniform_held, jnp.sign(uniform_held), *odd])


def is_finite(tree: Any) -> jax.Array:
    """Return for each environment of a batch whether all its numbers are finite, (NUM_ENVS,) bool."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    numbers = [leaf.reshape(NUM_ENVS, -1) for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(one).all(axis=1) for one in numbers]).all(axis=0)


def violations_of(env: EpisodicEnvironment, actions: Any, outputs: Any, is_late: Any) -> jax.Array:
    """Return which of ``VIOLATIONS`` a step shows, (len(VIOLATIONS), NUM_ENVS) bool."""
    observations, states, rewards, terminated, _, info = outputs
    both, limit = jnp.stack([observations, info["final_observation"]]), env.observation_space().high
    norm_squared = sum(component**2 for component in jax.vmap(env.drone)(states).quat)
    return jnp.stack(
        [
            ~is_finite(states),
            ~is_finite(rewards),
            ~is_finite(info),
            jnp.abs(norm_squared - 1.0) > 2.0 * UNIT_TOLERANCE,
            ~jnp.isfinite(both).all(axis=(0, 2)),
            (jnp.abs(both) > limit).any(axis=(0, 2)),
            is_late,
            jnp.isnan(actions).any(axis=1) & ~terminated,
        ]
    )


@partial(jax.jit, static_argnames=("env", "is_batched"))
def fly(env: EpisodicEnvironment, key: jax.Array, params: EnvParams, is_batched: bool) -> dict[str, Any]:
    """Return counts of ends and violations in NUM_STEPS steps of NUM_ENVS environments from a reset on.

    params: the same for all environments, or a batch, flown by ``vmap(step)``.
    """
    axis = 0 if is_batched else None
    keys = jax.random.split(key, NUM_ENVS)
    _, states = jax.vmap(env.reset, in_axes=(0, axis))(keys, params)

    def advance(carry: Any, step: jax.Array) -> Any:
        states, ages = carry
        actions = draw_actions(key, step)
        key_step = jax.random.fold_in(key, step)
        if is_batched:
            outputs = jax.vmap(env.step)(jax.random.split(key_step, NUM_ENVS), states, actions, params)
        else:
            outputs = env.step_batch(key_step, states, actions, params)
        _, states, _, terminated, truncated, info = outputs
        done = terminated | truncated
        is_late = ages >= params.max_steps_in_episode
        counts = {"episodes": done.sum(), "truncated": truncated.sum()}
        counts |= {name: (info[name] & done).sum() for name in Causes._fields}
        violations = violations_of(env, actions, outputs, is_late).sum(axis=1)
        counts |= dict(zip(VIOLATIONS, violations, strict=True))
        return (states, jnp.where(done, 0, ages + 1)), counts

    carry = (states, jnp.zeros(NUM_ENVS, jnp.int32))
    _, counts = jax.lax.scan(advance, carry, jnp.arange(NUM_STEPS))
    return jax.tree.map(jnp.sum, counts)


def draw_extremes(generator: np.random.Generator, params: EnvParams) -> EnvParams:
    """Return a batch of parameters: each at its default, at an end of its range, or anywhere between."""
    share = generator.choice([0.03, 0.3, 1.0], NUM_ENVS)  # of its parameters that are not at their defaults

    def within(bounds: Range, default: Any) -> np.ndarray:
        shape = (NUM_ENVS, *np.shape(default))
        between = generator.uniform(bounds.low, bounds.high, shape)
        drawn = np.choose(generator.integers(3, size=shape), [bounds.low, bounds.high, between])
        is_drawn = generator.random(shape) < share.reshape(-1, *[1] * np.ndim(default))
        return np.where(is_drawn, drawn, default).astype(np.float32)

    batch = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], NUM_ENVS, axis=0), params)
    for name, bounds in RANGES.items():
        if name == "dt" and params.wrappers:  # delays and randomisation of wrappers depend on it
            continue
        part, _, field = name.rpartition(".")
        value = within(bounds, attrgetter(name)(params))
        changed = {part: getattr(batch, part)._replace(**{field: value})} if part else {field: value}
        batch = batch.replace(**changed)
    effects = []
    for parameters in params.model.effects:
        effect, neutral = effect_of(parameters), parameters._asdict()
        values = {field: within(bounds, neutral[field]) for field, bounds in effect.ranges.items()}
        left_s = np.float32(USUAL_STEPS) * batch.dt  # all delays of an effect share what is remembered
        for field in effect.most_steps:
            values[field] = np.minimum(values[field], left_s)
            left_s = left_s - np.maximum(values[field], 0.0)
        effects.append(effect.parameters(**values))
    radius = np.minimum(batch.drone_radius, 0.9 * batch.course.gates.half_opening.min(axis=1))
    return batch.replace(
        model=batch.model._replace(effects=tuple(effects)),
        drone_radius=radius.astype(np.float32),
        max_steps_in_episode=generator.choice([1, 2, 30, NUM_STEPS], NUM_ENVS).astype(np.int32),
    )


def extreme_environments() -> dict[str, EpisodicEnvironment]:
    """Return an environment with all effects, and one with all wrappers."""
    effects = [effect.parameters() for effect in EFFECTS]
    model = flytrack_env.nominal_parameters().with_effects(*effects)
    wrapped: Any = ObservationNoise(ActionDelay(flytrack_env.make("FlyTrack-v0")))
    wrapped = EpisodeStatistics(ActionHistory(wrapped, kind="applied"))
    plain = flytrack_env.make("FlyTrack-v0", model=model, missed_gate="fly_on")
    return {"extreme, all effects": plain, "extreme, all wrappers": wrapped}


def measure(share: float) -> dict[str, Any]:
    """Return what a share of ``TOTAL_STEPS`` comes to, by environment."""
    envs = {env_id: flytrack_env.make(env_id) for env_id in ENVIRONMENTS}
    box = blackbox.load(ROOT / "blackbox" / "acro_step.bin")
    envs["FlyTrack-v0, black box"] = flytrack_env.make("FlyTrack-v0", plant=box)
    tracks = [load_track(name) for name in available_tracks()] + [random_track(seed) for seed in range(2)]
    flights = max(round(share * TOTAL_STEPS / (NUM_ENVS * NUM_STEPS) / (len(envs) + 2)), 1)
    counts: dict[str, Counter[str]] = {}
    started_s = time.process_time()
    for name, env in tqdm((envs | extreme_environments()).items(), unit="environment"):
        counts[name] = Counter()
        for flight in range(flights):
            params, is_extreme = env.default_params, name.startswith("extreme")
            if is_extreme:
                params = draw_extremes(np.random.default_rng(flight), params)
                env.check_params(params)
            else:
                params = params.replace(course=build_course(tracks[flight % len(tracks)]))
            found = fly(env, jax.random.key(flight), params, is_extreme)
            counts[name].update({key: int(value) for key, value in found.items()}, steps=NUM_ENVS * NUM_STEPS)
    broken = sum(count[name] for count in counts.values() for name in VIOLATIONS)
    minutes = round((time.process_time() - started_s) / 60.0, 1)
    return {"environments": counts, "cpu_minutes": minutes, "is_held": broken == 0}


def as_markdown(result: dict[str, Any]) -> str:
    """Return a table of all environments."""
    ends = (*Causes._fields, "truncated")
    rows = [
        (
            name,
            f"{count['steps'] / 1e6:.1f}",
            f"{count['episodes'] / 1e6:.2f}",
            *(f"{count[end] / max(count['episodes'], 1):.1%}" for end in ends),
            "; ".join(f"{one}: {count[one]}" for one in VIOLATIONS if count.get(one)) or "none",
        )
        for name, count in result["environments"].items()
    ]
    header = ("environment", "million steps", "million episodes", *ends, "violations")
    checked = f"Actions: {'; '.join(KINDS)}. Checked in every step: {'; '.join(VIOLATIONS)}."
    return f"{checked}\n\n{table(header, rows)}"
