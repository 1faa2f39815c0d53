"""The wake of a drone: whoever flies below it is pushed down, by no more than its thrust, and nobody else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

import flytrack_env
from flytrack_env.multi_drone import MultiDroneRace
from flytrack_env.multi_drone.downwash import DISC_RADIUS_M, SPREAD, downwash_acc_w, wake_of
from flytrack_env.multi_drone.rules import check_rules
from flytrack_env.plants import Plant
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
@given(metres, metres, metres, metres, metres)
def test_no_one_is_pushed_by_more_than_the_thrust_nor_from_below(x, y, z, speed, turn):
    quat = Quaternion(jnp.cos(turn / 2), jnp.sin(turn / 2), 0.0, 0.0)
    drone = hovering((speed, 0, 0), quat, thrust=20.0)
    acc_w = push((x, y, z), drone)
    assert np.linalg.norm(acc_w) <= 20.0 * (1 + 1e-5)
    up = np.array([float(part) for part in quat.axes()[2]])
    assert acc_w @ up <= 0.0
    still = hovering((0, 0, 0), quat, thrust=20.0)
    if np.array([x, y, z]) @ up > 1e-3:
        assert not push((x, y, z), still).any()


def test_a_disc_takes_the_momentum_that_a_jet_carries_through_it():
    """The share in the middle is the integral of the jet's momentum over a disc as large as a drone."""
    for below in (0.3, 1.0, 3.0):
        radius = DISC_RADIUS_M + SPREAD * below

        def momentum(r, radius=radius):
            return 2.0 * r / radius**2 * np.exp(-((r / radius) ** 2))

        assert quad(momentum, 0.0, np.inf)[0] == pytest.approx(1.0)
        met = quad(momentum, 0.0, DISC_RADIUS_M)[0]
        np.testing.assert_allclose(push((0, 0, -below)), (0, 0, -G * met), rtol=1e-4, atol=1e-6)
    # As docs/multi_drone.md says.
    np.testing.assert_allclose([push((0, 0, -0.5))[2], push((0, 0, -1))[2]], [-4.5, -3.4], atol=0.06)


def test_a_wake_weakens_with_distance_and_to_the_side():
    below = [abs(push((0, 0, -z))[2]) for z in (0.2, 0.5, 1.0, 2.0, 5.0)]
    aside = [abs(push((x, 0, -1.0))[2]) for x in (0.0, 0.1, 0.2, 0.4, 1.0)]
    assert below == sorted(below, reverse=True) and aside == sorted(aside, reverse=True)
    assert aside[-1] < 1e-3 * aside[0]


def test_a_fast_drone_leaves_its_wake_behind():
    fast = hovering((15, 0, 0))
    behind, under = push((-1, 0, -1), fast), push((0, 0, -1), fast)
    assert behind[2] < -1.0 and abs(under[2]) < 0.01


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
    assert together[1] == alone[1] and flown(0.0, 1.0)[0] == alone[0]


def test_a_share_below_zero_is_refused():
    with pytest.raises(ValueError, match=r"rules\.downwash: found -1\.0, expected a share from 0 on"):
        check_rules(RACE.default_params.rules._replace(downwash=-1.0), 2)


def test_a_plant_that_cannot_be_pushed_is_named():
    assert Coasting.with_drone is Plant.with_drone
    env = flytrack_env.make("FlyTrack-v0", plant=Coasting())
    race = MultiDroneRace(env, 2)
    params = race.default_params
    params = params._replace(rules=params.rules._replace(downwash=1.0))
    _, states = race.reset(jax.random.key(0), params)
    with pytest.raises(NotImplementedError, match="plant: found Coasting, expected one with with_drone"):
        race.step_env(states, jnp.zeros((2, 4)), params)
