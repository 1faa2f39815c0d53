"""From a log of a policy's flight to a policy for the plant that flew: diagnose, improve, judge.

The plant is known up to what the log leaves possible: models are drawn from the joint uncertainty
of the diagnosis. The policy descends the gradient of its race's time through some of them and is
judged on others, as is the one that it was made from. A policy that cannot fly the plant has no
such gradient there. So the models move from the one that the policy flies to the plant's, as fast
as the policy follows. Only a craft's rate loop is there from the start: half a loop is none.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo import Checkpoint, CheckpointError
from baselines.purejaxrl_ppo.checkpoint import rewards_of
from baselines.purejaxrl_ppo.flights import Outcomes, race_many, start_keys
from baselines.purejaxrl_ppo.networks import Policy
from baselines.purejaxrl_ppo.polish import LostError, polish
from baselines.purejaxrl_ppo.polish import Settings as Polishing
from baselines.purejaxrl_ppo.report import describe_share, share
from flytrack_env import ModelParameters
from flytrack_env.effects import LearnedLaw, effect_of, takes_motors
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.model_file import model_as_json, model_from_json
from flytrack_sysid import Diagnosis, FlightLog, LogError, diagnose
from flytrack_sysid.check import check_log
from flytrack_sysid.diagnosis import text_of
from flytrack_sysid.diagnosis.plausible import PlausibleModels, find_plausible_models
from flytrack_sysid.inference.parameters import from_vector, to_vector, without_neutral_effects
from flytrack_sysid.log import usual_step
from flytrack_sysid.plausibility import check_plausible

ENV_ID = "FlyTrack-v0"  # whose observation the policy has, and in which it learns
LEAD_IN_S = 0.5  # of each flight, from which a diagnosis learns nothing
MIN_FLIGHT_S = 3.0  # of all flights, without that
MIN_STICK = 0.1  # of roll and pitch, exceeded in a twentieth of a race and not in a hover
STICK_QUANTILE = 0.95
# Constants of the model that the log contradicts: one may be what is to be adapted to, as a yaw
# rate of 106 instead of 120 deg/s of a hidden plant (suite v1, plant_6); two are another craft's.
OTHER_CRAFT = 2
NUM_STEPS, NUM_LAPS = 2500, 3  # of a flight that is judged
NUMBERS = ("tau", "thrust_coeffs", "max_rate", "m", "g", "battery_drain_v_per_min")  # of a model
STREAMS = ("judge", "polish")
Report = Callable[[int, int], None]


class Settings(NamedTuple):
    """How a policy is adapted and judged.

    Attributes:
        flights: drawn plants that a policy is judged on, one flight each.
        polishing: descent along the gradient of the race's time.
    """

    flights: int = 256
    polishing: Polishing = Polishing(
        updates=100,
        curriculum_steps=100,
        flights=16,
        laps=2,
        slowest_lap_s=5.5,
        offset_limit=0.85,
        widened_m=0.5,
        gradient_decay=0.995,
    )


class FlightResults(NamedTuple):
    """Flights of one policy, each on another plant.

    Attributes:
        is_complete: whether it finished, (num_flights,).
        lap_s: mean of its flying laps, (num_flights,); NaN where it did not finish.
    """

    is_complete: np.ndarray
    lap_s: np.ndarray

    @classmethod
    def of(cls, outcomes: Outcomes) -> "FlightResults":
        """Return the flights of outcomes."""
        is_complete = outcomes.is_complete()
        laps_s = np.where(is_complete[:, None], outcomes.lap_times_s[:, 1:], np.nan)
        return cls(is_complete, laps_s.mean(axis=1))

    def part(self, first: int, last: int) -> "FlightResults":
        """Return some of the flights."""
        return FlightResults(self.is_complete[first:last], self.lap_s[first:last])

    @property
    def speed(self) -> float:
        """Mean laps per second over all flights, those that do not finish counted as 0."""
        return float(np.nan_to_num(1.0 / self.lap_s).mean())


class Adapted(NamedTuple):
    """A policy and what it was made of.

    Attributes:
        diagnosis: of the log.
        checkpoint: the new policy, or the old one where nothing is to be adapted to, or where the
            new one is worse.
        is_new: whether it is the new one.
        known: the old policy on the model that it was made for; None if nothing was flown.
        old: the old policy on drawn plants.
        new: the new policy on the same plants, from the same starts; None if it lost its way.
    """

    diagnosis: Diagnosis
    checkpoint: Checkpoint
    is_new: bool
    known: FlightResults | None = None
    old: FlightResults | None = None
    new: FlightResults | None = None


def adapt(
    log: FlightLog,
    checkpoint: Checkpoint,
    seed: int = 0,
    settings: Settings = Settings(),  # noqa: B008, a tuple of constants
    accept: bool = False,
    report: Callable[[str], Report] = lambda unit: lambda done, total: None,
    craft: ModelParameters | None = None,
) -> Adapted:
    """Return a policy adapted to the plant that flew a log.

    Args:
        log: of flights on the plant, best of the policy itself.
        checkpoint: the policy.
        seed: of drawn plants and starts.
        settings: see ``Settings``.
        accept: adapt although the log contradicts itself or the policy's model.
        report: from a unit, what is called with the number done and of all.
        craft: a model with mass, battery, full-stick rates and settings of the craft; None if these
            are the policy's own.

    Raises:
        CheckpointError: a policy of another observation, or without its model.
        LogError: a log of no race, or of another craft.
        ValueError: a craft whose motors are commanded.
    """
    model = read_policy_model(checkpoint)
    nominal = model if craft is None else as_craft(model, craft)
    check_inputs(log, nominal, accept)
    diagnosis = diagnose(log, nominal, report=report("stages"))
    if nominal is model and not is_different(diagnosis, model):
        return Adapted(diagnosis, checkpoint, False)
    models = find_plausible_models(diagnosis)
    return improve(checkpoint, model, models, diagnosis, seed, settings, report)


def is_different(diagnosis: Diagnosis, model: ModelParameters) -> bool:
    """Return whether a diagnosis of a model found anything to adapt to: also another motion."""
    return bool(
        diagnosis.extended.motion is not model.motion
        or diagnosis.causes
        or diagnosis.beyond
        or diagnosis.learned is not None
        or diagnosis.unexplained.flagged
    )


def as_craft(model: ModelParameters, craft: ModelParameters) -> ModelParameters:
    """Return a model with a craft's mass, battery, full-stick rates and settings.

    Settings are its rate curve and its rate loop. The model itself is returned if it has all that:
    what was fitted of a loop, such as the motors' lag, stays.

    Raises:
        ValueError: a craft whose motors are commanded.
    """
    if takes_motors(craft.effects):
        raise ValueError("craft: found a model commanded by motors, expected one by sticks")
    constants, craft_constants = list_craft_constants(model), list_craft_constants(craft)
    if constants.keys() == craft_constants.keys() and all(
        np.isclose(value, craft_constants[name]) for name, value in constants.items()
    ):
        return model
    laws = tuple(one for one in model.effects if not effect_of(one).search.is_setting)
    settings = [one for one in craft.effects if effect_of(one).search.is_setting]
    sized = model.resized(float(craft.m), craft.battery)
    return sized._replace(max_rate=craft.max_rate, effects=laws).with_effects(*settings)


def list_craft_constants(model: ModelParameters) -> dict[str, float]:
    """Return what of a model is known of a craft without flying it, by name."""
    constants = {"m": float(model.m), "full_v": float(model.battery.full_v)}
    constants |= {"empty_v": float(model.battery.empty_v)}
    constants |= {f"max_rate_{axis}": float(rate) for axis, rate in enumerate(model.max_rate)}
    for parameters in model.effects:
        effect = effect_of(parameters)
        if effect.search.is_setting:
            constants |= {
                f"{effect.name}.{name}": float(value)
                for name, value in parameters._asdict().items()
                if name not in effect.search.fitted
            }
    return constants


def with_rate_loop(model: ModelParameters, craft: ModelParameters) -> ModelParameters:
    """Return a model with those settings of a craft that have a memory: its rate loop."""
    settings = [(effect_of(one), one) for one in craft.effects]
    return model.with_effects(
        *(one for effect, one in settings if effect.search.is_setting and effect.memory)
    )


def read_policy_model(checkpoint: Checkpoint) -> ModelParameters:
    """Return the model that a policy was made for; raise CheckpointError as ``adapt`` does.

    What an earlier adaptation learnt, beyond the list, is of the log of that time, and left out.
    """
    if "model" not in checkpoint.meta:
        raise CheckpointError(
            f"{checkpoint.path}: model: found none, expected the one it was trained on"
        )
    model = model_from_json(checkpoint.meta["model"], f"{checkpoint.path}: model")
    try:
        checkpoint.check_fits(make_env(checkpoint, model))
    except CheckpointError as error:
        raise CheckpointError(
            f"{checkpoint.path}: found a policy of {checkpoint.env_id}, expected one that observes "
            f"what {ENV_ID} shows: {error}"
        ) from error
    listed = tuple(one for one in model.effects if not isinstance(one, LearnedLaw))
    return model._replace(effects=listed)


def check_inputs(log: FlightLog, model: ModelParameters, accept: bool) -> None:
    """Raise LogError for a log of no race, or of another craft than a model's."""
    check_race(log)
    check_plausible(log, accept, model)
    remarks = () if accept else check_log(log, model).remarks
    if len(remarks) >= OTHER_CRAFT:
        raise LogError(
            f"{log.source}: found another craft than the policy's: {'; '.join(remarks)}; "
            "--accept goes on"
        )


def check_race(log: FlightLog) -> None:
    """Raise LogError for a log of crashes or of a hover."""
    steps_s, starts = usual_step(log), np.flatnonzero(log.is_start())
    lengths_s = np.add.reduceat(steps_s, starts)
    flight_s = float(np.maximum(lengths_s - LEAD_IN_S, 0.0).sum())
    if flight_s < MIN_FLIGHT_S:
        raise LogError(
            f"{log.source}: found {len(lengths_s)} flights of {lengths_s.max():.2g} s at most, "
            f"{flight_s:.2g} s in all without the first {LEAD_IN_S:g} s of each, expected "
            f"{MIN_FLIGHT_S:g} s or more: crashes tell too little"
        )
    stick = float(np.quantile(np.abs(log["u"][:, :2]).max(axis=1), STICK_QUANTILE))
    if stick < MIN_STICK:
        raise LogError(
            f"{log.source}: u_roll, u_pitch: found at most {stick:.2g} in {STICK_QUANTILE:.0%} of "
            f"the rows, expected {MIN_STICK:g} or more, as in a race: this looks like a hover"
        )


def make_env(checkpoint: Checkpoint, model: ModelParameters) -> EpisodicEnvironment:
    """Return the environment in which a policy learns and is judged, with a model."""
    return flytrack_env.make(
        ENV_ID,
        track=checkpoint.track,
        missed_gate=checkpoint.meta["missed_gate"],
        reward=rewards_of(checkpoint),
        model=model,
    )


def improve(
    checkpoint: Checkpoint,
    model: ModelParameters,
    models: PlausibleModels,
    diagnosis: Diagnosis,
    seed: int,
    settings: Settings,
    report: Callable[[str], Report],
) -> Adapted:
    """Return a policy improved on plausible models, or the old one if that is no better."""
    env, policy = make_env(checkpoint, models.model), checkpoint.policy
    keys = dict(zip(STREAMS, jax.random.split(jax.random.key(seed), len(STREAMS)), strict=True))
    flown = (draw_plants(model, models, keys["judge"], settings.flights), seed)
    known, old = judge(env, policy, *flown)
    moving = partial(
        draw_moving,
        models=models,
        start=to_vector(embed(with_rate_loop(model, diagnosis.nominal), models.like)),
    )
    seed_of_flights = int(jax.random.bits(keys["polish"], dtype=jnp.uint32) >> 1)
    try:
        params = polish(env, policy, seed_of_flights, settings.polishing, moving, report("updates"))
    except LostError:
        return Adapted(diagnosis, checkpoint, False, known, old)
    _, new = judge(env, Policy(policy.network, params), *flown)
    if new.speed <= old.speed:
        return Adapted(diagnosis, checkpoint, False, known, old, new)
    meta = {**checkpoint.meta, "model": model_as_json(without_neutral_effects(models.model))}
    adapted = checkpoint._replace(params=params, meta=meta, training=None)
    return Adapted(diagnosis, adapted, True, known, old, new)


def judge(
    env: EpisodicEnvironment, policy: Policy, plants: ModelParameters, seed: int
) -> tuple[FlightResults, FlightResults]:
    """Return a policy's flights on the first and on the second half of some plants.

    Both begin at the same starts, which follow from the seed.
    """
    half = len(jax.tree.leaves(plants)[0]) // 2
    starts = jnp.tile(start_keys(seed, half), 2)
    flown = FlightResults.of(race_many(env, policy, starts, NUM_STEPS, NUM_LAPS, models=plants))
    return flown.part(0, half), flown.part(half, 2 * half)


def draw_moving(
    key: jax.Array, way: jax.Array, models: PlausibleModels, start: np.ndarray
) -> ModelParameters:
    """Draw a model on the way from a start to a plausible one; at 1, the way is done."""
    drawn = models.draw_vector(key)
    return from_vector(start + way * (drawn - start), models.like)


def embed(model: ModelParameters, like: ModelParameters) -> ModelParameters:
    """Return a model with effects, motion and size of another; what it lacks is neutral."""
    model = model.resized(float(like.m), like.battery)

    def own(parameters: Any) -> Any:
        effect = effect_of(parameters)
        known = model.effect(effect.name)
        if not effect.static or effect_of(known) in map(effect_of, model.effects):
            return known
        return known._replace(**{effect.static: getattr(parameters, effect.static)})

    return like._replace(
        **{name: getattr(model, name) for name in NUMBERS}, effects=tuple(map(own, like.effects))
    )


def draw_plants(
    model: ModelParameters, models: PlausibleModels, key: jax.Array, number: int
) -> ModelParameters:
    """Return a model ``number`` times, and as many plausible ones; leaves (2 * number, ...)."""
    drawn = jax.vmap(models.draw)(jax.random.split(key, number))
    return jax.tree.map(
        lambda leaf, many: np.concatenate([np.broadcast_to(leaf, many.shape), many]),
        embed(model, models.like),
        drawn,
    )


def describe_adapted(found: Adapted) -> str:
    """Return what was wrong, what it cost, and what is expected of the new policy, as text."""
    lines = [text_of(found.diagnosis), ""]
    if found.known is None or found.old is None:
        nothing = "Nothing to adapt to: the log agrees with the model that the policy was made for."
        return "\n".join([*lines, f"{nothing} The policy is unchanged."])
    flights = {"old policy, its own craft": found.known, "old policy, this plant": found.old}
    if found.new is not None:
        flights["new policy, this plant"] = found.new
    lines.append(
        f"{len(found.old.lap_s)} flights, each on another plant that the log leaves possible, none "
        "of them trained on:"
    )
    lines += [f"  {name:27}{_describe_flights(judged)}" for name, judged in flights.items()]
    lines += [_describe_cost(found.known, found.old), _describe_choice(found)]
    if found.diagnosis.unexplained.flagged:
        lines.append(
            "Less sure than these figures say: something of this log remains unexplained, and no "
            "drawn plant has it."
        )
    return "\n".join(lines)


def _describe_flights(judged: FlightResults) -> str:
    """Return who finishes and how long flying laps take."""
    text = f"finish: {describe_share(share(judged.is_complete))}; flying lap: "
    laps_s = judged.lap_s[judged.is_complete]
    if not laps_s.size:
        return f"{text}none"
    low, middle, high = np.quantile(laps_s, [0.05, 0.5, 0.95])
    return f"{text}{laps_s.mean():.3f} s, 5/50/95 %: {low:.3f}/{middle:.3f}/{high:.3f} s"


def _describe_cost(known: FlightResults, old: FlightResults) -> str:
    """Return what the plant's differences cost the old policy."""
    lost = known.is_complete.mean() - old.is_complete.mean()
    text = f"What differs costs the old policy {lost:.0%} of the flights"
    if old.is_complete.any() and known.is_complete.any():
        text += f" and {np.nanmean(old.lap_s) - np.nanmean(known.lap_s):+.3f} s a lap"
    return f"{text}."


def _describe_choice(found: Adapted) -> str:
    """Return which policy was chosen, and what is expected of it."""
    if found.new is None:
        return (
            "No policy was found that races on this plant: the old one is kept. Fly a slower one."
        )
    if not found.is_new:
        return "The new policy is worse on the plants that it was judged on: the old one is kept."
    expected = share(found.new.is_complete)
    laps_s = found.new.lap_s[found.new.is_complete]
    low, high = np.quantile(laps_s, [0.025, 0.975])
    return (
        f"Expected of the new policy on this plant, 95 %: {expected['low']:.1%} to "
        f"{expected['high']:.1%} of flights finish, a flying lap of {low:.3f} to {high:.3f} s."
    )
