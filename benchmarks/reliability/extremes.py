"""Parameters at the ends of their ranges, and courses that nobody would build."""

from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import jax
import numpy as np

from flytrack_env.effects import BY_NAME, EFFECTS, CommandDelay, Range, effect_of
from flytrack_env.params import RANGES, EnvParams
from flytrack_env.tracks import Course, Gate, Track, build_course
from flytrack_env.tracks.track import LARGEST
from flytrack_env.wrappers import NoiseParams, RandomizationParams
from flytrack_env.wrappers.observation_noise import RANGES as NOISE_RANGES

NUM_GATES = 8
NUM_COURSES = 32  # of a batch
SIZES_M = (3.0, 30.0, 1e3, 0.6 * LARGEST)  # half edges of the box that gates stand in
OPENINGS_M = (0.1, 1.5, 20.0)
SHARES = (0.03, 0.3, 1.0)  # of its parameters that an environment has not at their defaults
WIDE = 1e3  # ranges that are wider, end over end, are drawn from evenly in the logarithm
LONGEST_STEPS = 1000  # within what is flown, so that an episode that does not end is seen


class Draw:
    """Draws parameters for a batch of environments; each has its own share of extreme ones."""

    def __init__(self, generator: np.random.Generator, num_envs: int):
        self.generator, self.num_envs = generator, num_envs
        self.shares = generator.choice(SHARES, num_envs)

    def within(self, bounds: Range, default: Any) -> np.ndarray:
        """Return numbers, (num_envs, *default's shape), float32: the default, an end or anything between."""
        shape = (self.num_envs, *np.shape(default))
        between = self.generator.uniform(bounds.low, bounds.high, shape)
        if bounds.low > 0.0 and bounds.high / bounds.low > WIDE:
            between = np.exp(self.generator.uniform(np.log(bounds.low), np.log(bounds.high), shape))
        kinds = self.generator.choice(3, shape)
        extreme = np.choose(kinds, [np.full(shape, bounds.low), np.full(shape, bounds.high), between])
        is_drawn = self.generator.random(shape) < self.shares.reshape(-1, *[1] * np.ndim(default))
        return np.where(is_drawn, extreme, default).astype(np.float32)

    def effect(self, name: str, dt: np.ndarray) -> Any:
        """Return the parameters of an effect, its times within what the steps dt (num_envs,) allow."""
        effect = BY_NAME[name]
        neutral = effect.parameters()
        values = {
            field: self.within(bounds, getattr(neutral, field)) for field, bounds in effect.ranges.items()
        }
        for field, most in effect.most_steps.items():
            values[field] = np.minimum(values[field], np.float32(most) * dt)
        return effect.parameters(**values)


def draw_course(generator: np.random.Generator) -> Course:
    """Return a course of gates that stand, lie and face anyhow, near each other or far apart."""
    size = generator.choice(SIZES_M)
    centres = generator.uniform(-size, size, (NUM_GATES, 3))
    if generator.random() < 0.2:
        centres[:] = centres[0]
    turns = generator.normal(size=(NUM_GATES + 1, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    openings = generator.choice(OPENINGS_M, NUM_GATES)
    frames = openings * generator.choice([1.0 + 1e-6, 1.8, 100.0], NUM_GATES)
    gates = tuple(
        Gate(i, tuple(centres[i]), tuple(turns[i]), generator.choice([-1.0, 1.0]), openings[i], frames[i])
        for i in range(NUM_GATES)
    )
    start = tuple(generator.uniform(-size, size, 3))
    bounds = (-1.5 * size,) * 3, (1.5 * size,) * 3
    return build_course(Track("extreme", gates, start, tuple(turns[-1]), *bounds))


def draw_courses(generator: np.random.Generator, num_envs: int) -> Course:
    """Return courses, leaves (num_envs, ...): NUM_COURSES of them, in turn."""
    courses = [draw_course(generator) for _ in range(NUM_COURSES)]
    return jax.tree.map(
        lambda *leaves: np.stack([leaves[i % NUM_COURSES] for i in range(num_envs)]), *courses
    )


def draw_extremes(generator: np.random.Generator, params: EnvParams, num_envs: int) -> EnvParams:
    """Return parameters of a batch, every leaf (num_envs, ...), that ``check_params`` accepts."""
    draw = Draw(generator, num_envs)
    found = {name: draw.within(bounds, attrgetter(name)(params)) for name, bounds in RANGES.items()}
    courses = draw_courses(generator, num_envs)
    if generator.random() < 0.5:
        repeat = lambda leaf: np.repeat(np.asarray(leaf)[None], num_envs, axis=0)  # noqa: E731
        courses = jax.tree.map(repeat, params.course)
    radius = courses.gates.half_opening.min(axis=1) * generator.choice([0.03, 0.2, 0.999], num_envs)
    radius = np.maximum(radius, RANGES["drone_radius"].low)
    dt = found["dt"]
    effects = [draw.effect(effect_of(parameters).name, dt) for parameters in params.model.effects]
    return params.replace(
        model=params.model._replace(**_of("model", found), effects=tuple(effects)),
        course=courses,
        reset=params.reset._replace(**_of("reset", found)),
        reward=params.reward._replace(**_of("reward", found)),
        dt=dt,
        drone_radius=radius.astype(np.float32),
        max_steps_in_episode=generator.choice([1, 2, 30, LONGEST_STEPS], num_envs).astype(np.int32),
        wrappers={name: _draw_wrapper(draw, own, found) for name, own in params.wrappers.items()},
    )


def _of(part: str, found: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return what was found for the fields of a part."""
    return {name.partition(".")[2]: value for name, value in found.items() if name.startswith(f"{part}.")}


def _draw_wrapper(draw: Draw, own: Any, found: Mapping[str, np.ndarray]) -> Any:
    """Return the parameters of a wrapper, whose own ones these are."""
    dt = found["dt"]
    if isinstance(own, NoiseParams):
        noise = own._asdict().items()
        return NoiseParams(**{name: draw.within(NOISE_RANGES[name], value) for name, value in noise})
    if isinstance(own, CommandDelay):
        return draw.effect("command_delay", dt)
    if isinstance(own, RandomizationParams):
        return _draw_ranges(draw, found)
    raise TypeError(
        f"wrapper: found parameters {type(own).__name__}, expected those of a wrapper of FlyTrack"
    )


def _draw_ranges(draw: Draw, found: Mapping[str, np.ndarray]) -> RandomizationParams:
    """Return ranges of domain randomisation: of every effect, as wide as its own or none at all."""
    factors: dict[str, np.ndarray] = {}
    for name, path in (("mass", "model.m"), ("lag", "model.tau")):
        bounds, value = RANGES[path], found[path].reshape(draw.num_envs, -1)
        lowest, highest = bounds.low / value.min(axis=1), bounds.high / value.max(axis=1)
        factors[f"{name}_factor_low"] = np.maximum(draw.within(Range(0.01, 1.0, "1"), 0.8), lowest)
        factors[f"{name}_factor_high"] = np.minimum(draw.within(Range(1.0, 100.0, "1"), 1.2), highest)
    factors["effect_factor_low"] = draw.within(Range(0.01, 1.0, "1"), 0.8)
    factors["effect_factor_high"] = draw.within(Range(1.0, 100.0, "1"), 1.2)
    ends = [[draw.effect(effect.name, found["dt"]) for effect in EFFECTS] for _ in range(2)]
    low, high = (jax.tree.map(choose, *ends) for choose in (np.minimum, np.maximum))
    factors = {name: value.astype(np.float32) for name, value in factors.items()}
    return RandomizationParams(**factors, low=tuple(low), high=tuple(high))
