"""Another drone in every episode: mass, lags and effects drawn from ranges."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import (
    ROUNDING,
    CommandDelay,
    LinearDrag,
    Range,
    ThrustScale,
    Wind,
    check_beside_motors,
    check_parameters,
    effect_of,
    merge,
)
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.params import RANGES, EnvParams
from flytrack_env.quaternion import Scalar
from flytrack_env.randomness import Draws
from flytrack_env.state import Drone
from flytrack_env.wrappers.base import WrapperError
from flytrack_env.wrappers.episode_draws import DrawnState, EpisodeDraws

EFFECT_FACTORS = (1e-6, 1e6)
NOT_DRAWN: Any = None  # in the place of a parameter's bound: not drawn


class RandomizationParams(NamedTuple):
    """Ranges of uniform draws, once per episode.

    An effect that was identified is known: its departure from neutral is scaled, instead of drawn
    from low to high; but what was learnt, of which ``spread`` is drawn, in standard errors.

    Attributes:
        mass_factor_low, mass_factor_high: of the model's mass; forces per mass (drag, a wind's
            push) stay, so that it acts like 1 / thrust_scale.
        lag_factor_low, lag_factor_high: of each of its four time constants.
        low, high: parameters of effects (``flytrack_env.effects``), the same effects in both; None
            leaves a parameter alone.
        effect_factor_low, effect_factor_high: of what the model itself has of these effects.
    """

    mass_factor_low: Scalar = 0.8
    mass_factor_high: Scalar = 1.2
    lag_factor_low: Scalar = 0.7
    lag_factor_high: Scalar = 1.3
    effect_factor_low: Scalar = 0.8
    effect_factor_high: Scalar = 1.2
    low: tuple[Any, ...] = (
        CommandDelay(0.0, NOT_DRAWN, NOT_DRAWN),
        ThrustScale(0.85),
        Wind(-3.0, -3.0, NOT_DRAWN, a_x=NOT_DRAWN, a_y=NOT_DRAWN, a_z=NOT_DRAWN),
        LinearDrag(0.0, 0.0, 0.0),
    )
    high: tuple[Any, ...] = (
        CommandDelay(0.02, NOT_DRAWN, NOT_DRAWN),
        ThrustScale(1.15),
        Wind(3.0, 3.0, NOT_DRAWN, a_x=NOT_DRAWN, a_y=NOT_DRAWN, a_z=NOT_DRAWN),
        LinearDrag(0.5, 0.5, 0.3),
    )


def sample_model(
    word: jax.Array, model: ModelParameters, ranges: RandomizationParams
) -> ModelParameters:
    """Return the model of an episode, from a uint32 word; the same word gives the same model.

    Drawn again wherever it is needed: cheaper than to carry some twenty numbers through every step.
    """
    draws = Draws(word)
    mass_factor = draws.uniform("mass", ranges.mass_factor_low, ranges.mass_factor_high)
    lag_factors = [
        draws.uniform(f"lag_{axis}", ranges.lag_factor_low, ranges.lag_factor_high)
        for axis in ("roll", "pitch", "yaw", "thrust")
    ]
    # As scalars, which batch without a gather; who reads a drawn model stacks them.
    tau: Any = [model.tau[i] * factor for i, factor in enumerate(lag_factors)]
    drawn = [
        _draw(draws, model, low, high, (ranges.effect_factor_low, ranges.effect_factor_high))
        for low, high in zip(ranges.low, ranges.high, strict=True)
    ]
    return model._replace(m=model.m * mass_factor, tau=tau).with_effects(*drawn)


def _draw(
    draws: Draws, model: ModelParameters, low: Any, high: Any, factors: tuple[Scalar, Scalar]
) -> Any:
    """Return the parameters of one effect: around the model's, or from the range if it has none."""
    effect, present = effect_of(low), [type(parameters) for parameters in model.effects]
    known, neutral = model.effect(effect.name), effect.parameters()
    values = {}
    for field, lowest in low._asdict().items():
        if lowest is None or field == effect.static:
            continue
        name = f"{effect.name}.{field}"
        if type(low) in present and not effect.static:
            departure = getattr(known, field) - getattr(neutral, field)
            value = getattr(neutral, field) + departure * draws.uniform(name, *factors)
            bounds = effect.ranges[field]
            values[field] = jnp.clip(value, bounds.low, bounds.high)
        else:
            values[field] = draws.uniform(name, lowest, getattr(high, field))
    return known._replace(**values)


class DomainRandomization(EpisodeDraws):
    """Fly every episode with a model drawn around the given one.

    The ranges are ``params.wrappers["domain_randomization"]``, a ``RandomizationParams``. The
    policy does not see the draw; ``env.model(state, params)`` returns it.

    Raises:
        WrapperError: as ``Wrapper``, or a plant that has its parameters baked in.
    """

    key = "domain_randomization"

    def __init__(self, env: EpisodicEnvironment):
        super().__init__(env)
        if env.plant.dt is not None:
            raise WrapperError(
                f"DomainRandomization around {env.plant!r}: its parameters are baked in, "
                "none can be drawn"
            )

    def own_defaults(self) -> RandomizationParams:
        """Return the default ranges."""
        return RandomizationParams()

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError for ranges that hold no model, and what the inner check refuses.

        The effects of the ranges may be others than the default's, but the same in ``low`` and
        ``high``.
        """
        self.env.check_params(params)
        ranges = params.wrappers.get(self.key)
        if not isinstance(ranges, RandomizationParams):
            expected = "RandomizationParams, as in this environment's default_params"
            raise ValueError(
                f"params.wrappers[{self.key!r}]: found {ranges!r}, expected {expected}"
            )
        _check_ranges(ranges, params, self.env.plant.delay_steps)

    def model(self, state: DrawnState, params: EnvParams) -> ModelParameters:
        """Return the model that a state's episode is flown with."""
        model = self.env.model(state.inner, self.drawn(state.word, params))
        return model._replace(tau=jnp.stack(list(model.tau)))

    def drawn(self, word: jax.Array, params: EnvParams) -> EnvParams:
        """Return parameters with the model of an episode."""
        ranges = self.own_params(params)
        return params.replace(model=sample_model(word, params.model, ranges))

    def sample_start(self, seed: jax.Array, params: EnvParams) -> tuple[Drone, jax.Array]:
        """Return a start of the drone that the episode will be flown with."""
        return self.env.sample_start(seed, self.drawn(self.word(seed), params))


def _check_ranges(ranges: RandomizationParams, params: EnvParams, delay_steps: int) -> None:
    """Raise ValueError for ranges that are empty or cannot be flown, or effects that differ."""
    classes = [
        [effect_of(parameters).parameters for parameters in side]
        for side in (ranges.low, ranges.high)
    ]
    if classes[0] != classes[1]:
        names = [[parameters.__name__ for parameters in side] for side in classes]
        raise ValueError(f"high: found effects {names[1]}, expected those of low, {names[0]}")
    masses = _factors(RANGES["model.m"], np.asarray(params.model.m)[..., None])
    lags = _factors(RANGES["model.tau"], params.model.tau)
    rows: list[tuple[Any, ...]] = [
        ("mass_factor", ranges.mass_factor_low, ranges.mass_factor_high, *masses),
        ("lag_factor", ranges.lag_factor_low, ranges.lag_factor_high, *lags),
        ("effect_factor", ranges.effect_factor_low, ranges.effect_factor_high, *EFFECT_FACTORS),
    ]
    for low, high in zip(ranges.low, ranges.high, strict=True):
        effect = effect_of(low)
        for side in (low, high):
            known = {
                name: getattr(side, name)
                for name in effect.ranges
                if getattr(side, name) is not None
            }
            drawn = effect.parameters()._replace(**known)
            check_beside_motors(merge(params.model.effects, drawn))
        check_parameters(drawn, params.dt, delay_steps)  # of the upper side: delays are longest
        for name, bounds in effect.ranges.items():
            pair = getattr(low, name), getattr(high, name)
            if any(end is not None for end in pair):
                rows.append((f"{effect.name}.{name}", *pair, bounds.low, bounds.high))
    for name, low, high, lowest, highest in rows:
        # NaN, not 0, for None; not jnp, which would be traced under jit.
        lows, highs = (np.asarray(np.nan if edge is None else edge) for edge in (low, high))
        if not np.all((lowest <= lows) & (lows <= highs) & (highs <= highest)):
            expected = f"one within {np.max(lowest):g} to {np.min(highest):g}"
            raise ValueError(f"{name}: found a range from {low} to {high}, expected {expected}")


def _factors(bounds: Range, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and largest factor, (...), that keep values (..., N) within bounds."""
    values = np.asarray(values, float)
    lowest, highest = bounds.low / values.min(axis=-1), bounds.high / values.max(axis=-1)
    return lowest * (1.0 - ROUNDING), highest * (1.0 + ROUNDING)
