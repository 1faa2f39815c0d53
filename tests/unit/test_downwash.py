"""The wake of a drone: whoever flies below it is pushed down, by no more than its thrust, and nobody else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

import flytrack_env
from flytrack_env import blackbox
from flytrack_env.multi_drone import MultiDroneRace, RaceParams, RaceRules
from flytrack_env.multi_drone.downwash import downwash_acc_w, wake_of
from flytrack_env.multi_drone.ghosts import time_optimal_ghost
from flytrack_env.multi_drone.rules import check_rules
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import unpack
from tests.support.coasting import Coasting

G = 9.81
metres = st.floats(-5.0, 5.0, width=32)
LEVEL = Quaternion(*map(jnp.float32, (1, 0, 0, 0)))


def hovering(vel_w=(0, 0, 0), quat=LEVEL, thrust=G):
    drone = unpack(jnp.zeros(21))
    up = quat.axes()[2]
    acc_w = up.scale(thrust) - Vec3(0.0, 0.0, G)
    return drone._replace(vel_w=Vec3(*map(jnp.float32, vel_w)), acc_w=acc_w, quat=quat)


def push(apart, drone=None):
    wake = wake_of(hovering() if drone is None else drone, G, True)
    return np.array([float(part) for part in downwash_acc_w(Vec3(*map(jnp.float32, apart)), wake)])


@settings(deadline=None, max_examples=50)
@given(metres, metres, metres, metres)
def test_nobody_above_is_pushed(x, y, z, turn):
    quat = Quaternion(jnp.cos(turn / 2), jnp.sin(turn / 2), 0.0, 0.0)
    up = np.array([float(part) for part in quat.axes()[2]])
    height = np.array([x, y, z]) @ up
    acc_w = push((x, y, z), hovering((0, 0, 0), quat, thrust=20.0))
    if height > 1e-3:
        assert not acc_w.any()
    np.testing.assert_allclose(np.cross(acc_w, up), 0.0, atol=1e-4)


def test_a_disc_takes_the_momentum_that_a_jet_carries_through_it():
    """Of a Gaussian jet of the thrust's momentum, what goes through a disc as large as a drone."""
    for below in (0.5, 1.0, 3.0):
        radius = 0.15 + 0.094 / np.sqrt(2.0 * np.log(2.0)) * below
        met = quad(lambda r, radius=radius: 2.0 * r / radius**2 * np.exp(-((r / radius) ** 2)), 0.0, 0.15)[0]
        np.testing.assert_allclose(push((0, 0, -below)), (0, 0, -G * met), rtol=1e-2, atol=1e-6)
    assert push((0, 0, -1))[2] == pytest.approx(-3.4, abs=0.06)  # as docs/multi_drone.md says


def test_a_wake_weakens_with_distance_and_to_the_side():
    below = [abs(push((0, 0, -z))[2]) for z in (0.2, 0.5, 1.0, 2.0, 5.0)]
    aside = [abs(push((x, 0, -1.0))[2]) for x in (0.0, 0.1, 0.2, 0.4, 1.0)]
    assert below == sorted(below, reverse=True) and aside == sorted(aside, reverse=True)
    assert aside[-1] < 1e-3 * aside[0]


def test_a_fast_drone_leaves_its_wake_behind():
    """Where it is by momentum theory, solved numerically, of a disc that moves edgewise."""
    speed, loading = 15.0, G / (2.0 * 1.2 * np.pi * 0.15**2)  # of 1 kg, over twice the density of air
    induced = brentq(lambda v: v * np.hypot(v, speed) - loading, 0.0, 50.0)
    behind = speed / (2.0 * induced)
    fast = hovering((speed, 0, 0))
    along = [push((-x, 0, -1), fast)[2] for x in (behind - 0.3, behind, behind + 0.3)]
    assert along[1] < -1.0 and min(along) == along[1]
    assert abs(push((0, 0, -1), fast)[2]) < 0.01
    np.testing.assert_allclose(push((-behind, 0.2, -1), fast)[:2], 0.0, atol=1e-6)


RACE = MultiDroneRace(flytrack_env.make("FlyTrackNoisy-v0"), 2)


def flown(downwash, apart_m, num_steps=20):
    """Return the heights' gain of two drones that begin above each other and hold a stick, (2,)."""
    params = RACE.default_params
    params = params._replace(rules=params.rules._replace(downwash=downwash))
    head, gate = RACE.env.sample_start(jnp.uint32(3), params.flight)
    pair = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), head)
    lifted = pair.pos_w._replace(z=pair.pos_w.z + jnp.array([0.0, apart_m]))
    _, states = RACE.begin(pair._replace(pos_w=lifted), jnp.stack([gate, gate]), params)
    first = RACE.drone(states).pos_w.z
    for _ in range(num_steps):
        states = RACE.step_env(states, jnp.zeros((2, 4)), params)[1]
    return np.asarray(RACE.drone(states).pos_w.z - first)


def test_in_a_race_the_one_below_sinks_and_the_one_above_flies_as_alone():
    alone, together = flown(None, 1.0), flown(1.0, 1.0)
    assert together[0] < flown(0.5, 1.0)[0] < alone[0] - 0.02
    assert together[1] == pytest.approx(alone[1], abs=1e-5)
    assert flown(0.0, 1.0)[0] == pytest.approx(alone[0], abs=1e-5)


def test_wakes_add_up_and_none_comes_from_or_reaches_who_is_out():
    race = MultiDroneRace(flytrack_env.make("FlyTrack-v0"), 3)
    params = race.default_params
    params = params._replace(rules=params.rules._replace(downwash=jnp.array([0.0, 1.0])))
    head, gate = race.env.sample_start(jnp.uint32(3), params.flight)
    column = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), head)
    column = column._replace(pos_w=column.pos_w._replace(z=column.pos_w.z + jnp.array([0.0, 1.0, 2.0])))
    first = params._replace(rules=race.default_params.rules)
    _, states = race.begin(column, jnp.stack([gate] * 3), first)
    over_rules = RaceParams(None, RaceRules(*[None] * 6, downwash=0))

    @jax.jit
    def fall(is_out):
        """Return the speeds upwards of all drones after a step, without downwash and with it, and views."""
        step = jax.vmap(race.step_env, (None, None, over_rules))
        observations, after, *_ = step(states._replace(is_out=is_out), jnp.zeros((3, 4)), params)
        seen = jax.vmap(race.observe, (0, None))(after, first)
        return jax.vmap(race.drone)(after).vel_w.z, observations, seen

    nobody = jnp.zeros(3, bool)
    without, both = fall(nobody)[0]
    only_middle = fall(nobody.at[2].set(True))[0][1]
    only_top = fall(nobody.at[1].set(True))[0][1]
    middle, top = without[0] - only_middle[0], without[0] - only_top[0]
    assert middle > top > 0.001
    assert float(without[0] - both[0]) == pytest.approx(float(middle + top), rel=1e-3)
    assert only_middle[2] == 0.0 and only_top[1] == 0.0  # they hang where they are
    np.testing.assert_allclose(*fall(nobody)[1:], atol=1e-5)  # others are seen at the speed that they have


def test_a_ghost_has_no_wake_and_a_black_box_feels_one():
    track = flytrack_env.make("FlyTrack-v0").track
    env = flytrack_env.make("FlyTrack-v0", plant=blackbox.load(blackbox.SHIPPED))
    race = MultiDroneRace(env, 2, ghosts={1: time_optimal_ghost(track)})
    plain = MultiDroneRace(env, 2)

    def sink(race, above_m):
        params = race.default_params
        params = params._replace(rules=params.rules._replace(downwash=1.0))
        head, gate = race.env.sample_start(jnp.uint32(3), params.flight)
        pair = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), head)
        pair = pair._replace(pos_w=pair.pos_w._replace(z=pair.pos_w.z + jnp.array([0.0, above_m])))
        _, states = race.begin(pair, jnp.stack([gate, gate]), params)
        return float(race.drone(race.step_env(states, jnp.zeros((2, 4)), params)[1]).vel_w.z[0])

    assert sink(race, 1.0) == pytest.approx(sink(race, 9.0), abs=1e-6)
    assert sink(plain, 1.0) < sink(plain, 9.0) - 0.001


def test_a_share_below_zero_is_refused():
    with pytest.raises(ValueError, match=r"rules\.downwash: found -1\.0, expected a number of at least 0"):
        check_rules(RACE.default_params.rules._replace(downwash=-1.0), 2)


def test_a_plant_that_cannot_be_pushed_is_named():
    env = flytrack_env.make("FlyTrack-v0", plant=Coasting())
    race = MultiDroneRace(env, 2)
    params = race.default_params
    params = params._replace(rules=params.rules._replace(downwash=1.0))
    _, states = race.reset(jax.random.key(0), params)
    with pytest.raises(NotImplementedError, match="plant: found Coasting, expected one with with_drone"):
        race.step_env(states, jnp.zeros((2, 4)), params)
