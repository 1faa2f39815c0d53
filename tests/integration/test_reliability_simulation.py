"""The part of the reliability page on simulation: what it flies, and that it sees what it should."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.reliability.actions import KINDS, draw_actions, kinds_of
from benchmarks.reliability.checked import VIOLATIONS, Checked
from benchmarks.reliability.extremes import draw_courses, draw_extremes
from benchmarks.reliability.flying import load_pilot
from benchmarks.reliability.simulation import (
    PILOTED,
    SECTION,
    Case,
    as_markdown,
    fly_once,
    is_held,
    kinds_flown,
    make_cases,
    measure_cases,
    with_all_effects,
    with_all_wrappers,
)
from flytrack_env import FlyTrack
from flytrack_env.effects import BY_NAME
from flytrack_env.params import RANGES
from flytrack_env.wrappers import Wrapper

NUM_ENVS, NUM_STEPS = 64, 60
FAULTS = ("none", *VIOLATIONS)
NAN_DIES = "NaN action without a crash"


class FaultyState(NamedTuple):
    """The inner state, and the steps of this episode."""

    inner: Any
    steps: jax.Array


class Fault(NamedTuple):
    """Which of FAULTS the environment has."""

    place: Any = 0


class Faulty(Wrapper):
    """An environment that does, from an episode's fifth step on, what it never should: one of FAULTS."""

    key = "faulty"

    def own_defaults(self) -> Fault:
        """Return that there is none."""
        return Fault()

    def has(self, name: str, params: Any) -> jax.Array:
        """Return whether a fault is the one that is planted."""
        return self.own_params(params).place == FAULTS.index(name)

    def begin(self, drone: Any, gate_index: Any, params: Any, seed: Any = 0) -> FaultyState:
        """Return the state of an episode that begins."""
        return FaultyState(self.env.begin(drone, gate_index, params, seed), jnp.int32(0))

    def advance(self, state: FaultyState, command: Any, params: Any) -> Any:
        """Return the outcome of the inner environment, with the fault in it."""
        is_old = state.steps >= 4

        def when(name: str, wrong: Any, right: Any) -> jax.Array:
            return jnp.where(self.has(name, params) & is_old, wrong, right)

        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        drone = inner.plant.drone
        broken = drone._replace(
            acc_w=drone.acc_w._replace(x=when("state not finite", jnp.inf, drone.acc_w.x)),
            quat=jax.tree.map(lambda q: when("attitude not a unit quaternion", 1.00002 * q, q), drone.quat),
            battery_v=when("battery rises", drone.battery_v + 2e-4, drone.battery_v),
        )
        inner = inner._replace(plant=inner.plant._replace(drone=broken))
        info["gate_distance_m"] = when("info not finite", jnp.nan, info["gate_distance_m"])
        is_fearless = self.has(NAN_DIES, params) & info["crash"]
        reward = when("reward not finite", -jnp.inf, reward)
        return FaultyState(inner, state.steps + 1), reward, terminated & ~is_fearless, info

    def observe_drone(self, drone: Any, state: FaultyState, params: Any) -> list[jax.Array]:
        """Return the inner observation, with the fault in it."""
        first, *others = self.env.observe_drone(drone, state.inner, params)
        is_old = state.steps >= 4
        first = jnp.where(self.has("observation not finite", params) & is_old, jnp.nan, first)
        first = jnp.where(self.has("observation outside its space", params) & is_old, 30.001, first)
        return [first, *others]

    def is_truncated(self, state: FaultyState, params: Any) -> jax.Array:
        """Return whether the time limit is reached, or the step after it."""
        is_blind = self.has("episode goes on beyond its time limit", params)
        return self.env.is_truncated(state.inner, params) & ~is_blind


ENV = Checked(Faulty(FlyTrack()))


def faulty(name: str) -> Case:
    """Return a case with a fault, in episodes of 20 steps."""

    def draw(params: Any, generator: Any, num_envs: int) -> Any:
        wrappers = {"faulty": Fault(np.int32(FAULTS.index(name)))}
        return params.replace(max_steps_in_episode=20, wrappers=wrappers)

    return Case("faulty", "faulty", ENV, draw, False, 1.0)


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_is_seen_and_where_it_begins(name: str) -> None:
    result = measure_cases([faulty(name)], 3, NUM_ENVS * NUM_STEPS, NUM_ENVS)
    assert sum(row["steps"] for row in result["rows"]) == NUM_ENVS * NUM_STEPS
    assert is_held(result) == (name == "none")
    seen = {fault for fault in VIOLATIONS for row in result["rows"] if row[fault]}
    # What is not a number is in no space either; what is infinite shows in the space's limit at most.
    also = {"observation not finite": {"observation outside its space"}}.get(name, set())
    assert seen == ({name} | also if name != "none" else set())
    if name == "none":
        assert result["firsts"] == [] and "flights with violations" not in as_markdown(result)
        return
    assert name in as_markdown(result)
    [first] = result["firsts"]
    again = fly_once(faulty(name), load_pilot(), 3, first["flight"], first["step"] + 1, NUM_ENVS)
    assert again.first[first["environment"]] == first["step"] and name in first["violations"]
    before = fly_once(faulty(name), load_pilot(), 3, first["flight"], first["step"], NUM_ENVS)
    assert not before.violations.any()


def test_a_fault_of_the_start_is_seen(make_drone: Any) -> None:
    params = ENV.default_params
    crooked = make_drone((15.0, 10.0, 2.0), quat=(1.00002, 0.0, 0.0, 0.0))
    for drone, is_seen in ((crooked, True), (make_drone((15.0, 10.0, 2.0)), False)):
        info = ENV.step_env(None, ENV.begin(drone, 0, params), jnp.zeros(4), params)[4]
        assert bool(info["violations"]) == is_seen


def test_every_kind_of_actions_is_what_it_says() -> None:
    size = 4096
    steps = [np.asarray(draw_actions(np.uint32(1), np.int32(step), size)) for step in range(4)]
    by_kind = {
        name: np.stack([actions[kinds_of(size) == place] for actions in steps])
        for place, name in enumerate(KINDS)
    }
    assert all(len(values[0]) > 0 for values in by_kind.values())
    for name in ("full stick, held", "full stick, alternating", "full stick, at random"):
        assert (np.abs(by_kind[name]) == 1.0).all() and 0.4 < (by_kind[name] > 0.0).mean() < 0.6
    alternating, held = by_kind["full stick, alternating"], by_kind["full stick, held"]
    assert (alternating[1:] == -alternating[:-1]).all() and (held[1:] == held[:-1]).all()
    assert (by_kind["uniform"].std(axis=(0, 1)) > 0.5).all() and np.abs(by_kind["uniform"]).max() <= 1.0
    beyond = np.abs(by_kind["on the edge and just beyond"])
    assert set(np.unique(beyond)) == {np.float32(1.0), np.nextafter(np.float32(1.0), np.float32(2.0))}
    centred = by_kind["centred, -0 and denormal"]
    assert np.signbit(centred[centred == 0.0]).any() and (np.abs(centred) < 1e-39).all() and centred.any()
    assert np.isinf(by_kind["infinite"]).all() and (np.abs(by_kind["1e38 and more"]) >= 1e38).all()
    is_nan = {name: np.isnan(values).any(axis=2).mean() for name, values in by_kind.items()}
    assert is_nan.pop("always NaN") == 1.0 and is_nan.pop("every other one NaN") == 0.5
    assert 0.0 < is_nan.pop("rarely NaN") < 0.05 and not any(is_nan.values())
    assert kinds_flown(size)[-1] == PILOTED and set(kinds_flown(size)) == {*KINDS, PILOTED}


def test_extremes_fill_their_ranges_and_are_accepted() -> None:
    generator = np.random.default_rng(0)
    for env in (with_all_effects(), with_all_wrappers()):
        params = draw_extremes(generator, env.default_params, 256)
        env.check_params(params)
        for name in ("dt", "model.m", "model.tau", "reset.course_yaw_deg", "reward.progress"):
            part, _, field = name.rpartition(".")
            values = getattr(getattr(params, part) if part else params, field)
            assert values.shape[0] == 256 and len(np.unique(values)) > 20
            assert values.min() == np.float32(RANGES[name].low), name
            assert values.max() == np.float32(RANGES[name].high), name
    wind = with_all_effects().default_params.model.effects[list(BY_NAME).index("wind")]
    assert isinstance(wind, BY_NAME["wind"].parameters)
    courses = draw_courses(generator, 64)
    assert np.abs(courses.gates.centre.x).max() > 1e5 and len(np.unique(courses.gates.centre.x)) > 100
    assert (courses.gates.half_frame > courses.gates.half_opening).all()


def test_the_cases_are_all_ids_on_all_tracks() -> None:
    cases = make_cases()
    assert len({case.name for case in cases}) == len(cases) == 5 * 7 + 4
    assert sum(case.share for case in cases) == pytest.approx(1.0)
    assert SECTION.name == "simulation" and SECTION.as_markdown is as_markdown


def test_a_small_share_of_what_is_extreme_holds() -> None:
    extreme = [case for case in make_cases() if case.is_batched]
    result = measure_cases(extreme, 1, 40_000, 256)
    assert is_held(result), as_markdown(result)
    assert len({row["group"] for row in result["rows"]}) == 2
    assert not is_held({**result, "broken_flights": 1})
