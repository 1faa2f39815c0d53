"""Which wrappers may go around which others, and whose parameters they take."""

import copy
import re
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import pytest
from gymnax.wrappers import LogWrapper

from flytrack_env import FlyTrack, wrappers
from flytrack_env.observations import OBSERVATION_SIZE
from flytrack_env.plants import Simulator
from tests.support.wrapped_flights import ALL, wrapped

# Every public wrapper, both kinds of history among them, and one of gymnax's.
MAKERS = {
    "noise": wrappers.ObservationNoise,
    "commanded": partial(wrappers.ActionHistory, length=2),
    "applied": partial(wrappers.ActionHistory, length=1, kind="applied"),
    "delay": wrappers.ActionDelay,
    "randomization": wrappers.DomainRandomization,
    "corners": wrappers.GateCorners,
    "detector": wrappers.DetectorRandomization,
    "mask": partial(wrappers.GateMask, size=(8, 8)),
    "state": wrappers.StateObservation,
    "statistics": wrappers.EpisodeStatistics,
    "legacy": wrappers.LegacyStep,
    "log": LogWrapper,
}
DETECTOR = wrappers.DetectorRandomization
OTHER_STEP = ("legacy", "log")
ROWS = {"commanded": 8, "applied": 4, "state": OBSERVATION_SIZE}
CAMERAS = {"corners": (31,), "mask": (8, 8, 1)}


def test_every_public_wrapper_is_tried():
    exported = [getattr(wrappers, name) for name in wrappers.__all__]
    public = {
        export
        for export in exported
        if isinstance(export, type) and issubclass(export, wrappers.Wrapper)
    }
    assert public - {wrappers.Wrapper} < {
        type(make(wrappers.GateCorners(FlyTrack()) if make is DETECTOR else FlyTrack()))
        for make in MAKERS.values()
    }


def reasons_against(name, inside):
    """Return the possible messages why a wrapper may not go around others, innermost first."""
    if name == "legacy":
        return ["the step inside has five values already"] * (inside[-1:] == ("legacy",))
    if name == "log":
        return []
    if any(inner in OTHER_STEP for inner in inside):
        return [
            "found (LegacyStep|LogWrapper) inside, expected FlyTrack or a wrapper that acts before"
        ]
    reasons = {
        "both have the name": name in inside,
        "the history would hold the delayed commands": name == "delay" and "commanded" in inside,
        "found no GateCorners inside": name == "detector" and "corners" not in inside,
        "it replaces FlyTrack's observation": name in CAMERAS
        and any(inner in CAMERAS or inner in ROWS for inner in inside),
        "an image has no rows": name in (*ROWS, "noise") and "mask" in inside,
    }
    return [reason for reason, holds in reasons.items() if holds]


def test_any_three_compose_or_are_refused_with_the_reason():
    base = FlyTrack()
    for order in product(MAKERS, repeat=3):
        env = base
        for index, name in enumerate(order):
            reasons = reasons_against(name, order[:index])
            if reasons:
                with pytest.raises(wrappers.WrapperError) as caught:
                    MAKERS[name](env)
                assert any(re.search(reason, str(caught.value)) for reason in reasons), order
                break
            env = MAKERS[name](env)
        else:
            if not set(order) & set(OTHER_STEP):
                keys = [entry.key for entry in env.observation_table]
                assert len(set(keys)) == len(keys)
                size, *rest = next((CAMERAS[n] for n in order if n in CAMERAS), (OBSERVATION_SIZE,))
                size += sum(ROWS.get(n, 0) for n in order)
                assert env.observation_space().shape == (size, *rest)
                env.check_params(env.default_params)


def test_randomising_what_is_baked_in_is_refused():
    class Baked(Simulator):
        dt = 0.01

    with pytest.raises(wrappers.WrapperError, match="baked in, none can be drawn"):
        wrappers.DomainRandomization(FlyTrack(plant=Baked()))


@pytest.mark.parametrize(
    "wrapper", [wrappers.DomainRandomization, wrappers.ActionDelay, wrappers.ObservationNoise]
)
def test_parameters_of_another_environment_are_refused(wrapper):
    env, others = wrapped(wrapper), FlyTrack().default_params
    message = rf"params\.wrappers: found \[\], expected \['{env.key}'\]"
    with pytest.raises(ValueError, match=message):
        env.reset(jax.random.key(0), others)
    unknown = others.replace(wrappers={env.key: env.own_defaults(), "nois": wrappers.NoiseParams()})
    with pytest.raises(ValueError, match=r"params\.wrappers: found \[.*'nois'.*\], expected"):
        env.reset(jax.random.key(0), unknown)


def test_resets_and_steps_can_be_traced_and_gymnaxs_wrappers_go_around():
    env, key = wrapped(*ALL), jax.random.key(0)
    params = jax.tree.map(jnp.asarray, env.default_params)
    shape = env.observation_space().shape
    for outer, num_values in ((LogWrapper(env), 6), (wrappers.LegacyStep(env), 5)):
        _, state = jax.eval_shape(outer.reset, key, params)
        outputs = jax.eval_shape(outer.step, key, state, jnp.zeros(4), params)
        assert len(outputs) == num_values and outputs[0].shape == shape


class SixValues:
    """An environment of gymnax's protocol that does nothing."""

    name = "six"

    def step(self, key, state, action, params):
        return action, state, state, action > 0.0, action > 1.0, {"truncated": action > 1.0}


def test_legacy_step_joins_the_flags_and_survives_copies():
    original = wrappers.LegacyStep(SixValues())
    for env in (original, copy.copy(original), copy.deepcopy(original)):
        _, _, reward, done, info = env.step(None, 3.0, jnp.array([-1.0, 0.5, 2.0]))
        assert float(reward) == 3.0 and env.name == "six"
        assert done.tolist() == [False, True, True]
        assert info["truncated"].tolist() == [False, False, True]
    with pytest.raises(AttributeError):
        getattr(original, "no_such_" + "attribute")
