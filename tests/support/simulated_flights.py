"""Simulated flights with every effect in the model: one compiled program for all tests."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters, move, nominal_parameters, read_sensors, sensed
from flytrack_env.effects import EFFECTS, MAX_DELAY_STEPS
from flytrack_env.plants import Simulator, SimulatorState
from flytrack_env.state import BATTERY, QUATERNION, Action, pack, unpack, unpack_action

DT, NUM_STEPS = 0.01, 200
NOMINAL = nominal_parameters()
# In float64, and no number as another.
UNEVEN = ModelParameters(
    tau=np.array([0.03, 0.05, 0.08, 0.04]),
    thrust_coeffs=np.array([-9.0, -6.0, 3.1, 0.4, 0.9, 1.1]),
    max_rate=np.array([600.0, 500.0, 130.0]),
    m=1.2,
    g=9.81,
    battery_drain_v_per_min=1.3,
)
# Neutral effects change no bit (tests/contract/test_effects.py), so that a test may replace any of
# them.
ALL_NEUTRAL = NOMINAL.with_effects(*(effect.parameters() for effect in EFFECTS))
_SIMULATOR = Simulator(MAX_DELAY_STEPS)


@jax.jit
def fly(drone, commands, model, dt=DT):
    """Return state, gyro, accelerometer and pose after each command, packed, (num_steps, 37)."""

    def one(state, action):
        moved = move(*state, unpack_action(action), dt, model)
        reading = read_sensors(moved, model)
        after = SimulatorState(moved.after, moved.memories)
        seen = sensed(after.drone, after.memories, dt, model)
        pose = [*seen.pos_w, *seen.vel_w, *seen.quat]
        readings = jnp.stack([*reading.rates_b, *reading.force_b, *pose])
        return after, jnp.concatenate([pack(after.drone), readings])

    return jax.lax.scan(one, _SIMULATOR.reset(drone, model), commands)[1]


def flown(
    parameters=(),
    commands=None,
    drone=None,
    model=NOMINAL,
):
    """Return a flight, (num_steps, 37), float64, with one effect or a tuple of them."""
    effects = parameters if type(parameters) is tuple else (parameters,)
    full = model._replace(effects=ALL_NEUTRAL.effects).with_effects(*effects)
    commands = held(1) if commands is None else np.asarray(commands, np.float32)
    flight = fly(drone_with() if drone is None else drone, padded(commands), full)
    return np.asarray(flight, float)[: len(commands)]


def padded(commands, num_steps=NUM_STEPS):
    """Pad commands with the last one to a common length, so that all flights share a program."""
    return np.pad(commands, ((0, num_steps - len(commands)), (0, 0)), mode="edge")


def flown_by(plant, model, start, commands):
    """Return a plant's packed states after each command, (num_steps, 21)."""

    def one(state, action):
        after = plant.step(state, unpack_action(action), DT, model)
        return after, pack(plant.drone(after))

    return jax.lax.scan(one, plant.reset(unpack(start), model), commands)[1]


def held(num_steps=1, **sticks):
    """Return commands (num_steps, 4) that hold sticks; those not named are 0."""
    return np.tile(
        np.array(Action(**{**dict.fromkeys(Action._fields, 0.0), **sticks})), (num_steps, 1)
    )


def drone_with(**fields):
    """Return a drone, level and at rest 1 km up, some of whose fields are replaced, float32."""
    x = np.zeros(21, np.float32)
    x[2], x[QUATERNION.start], x[BATTERY] = 1e3, 1.0, 24.0
    drone = unpack(jnp.asarray(x))
    fields = {name: type(getattr(drone, name))(*value) for name, value in fields.items()}
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone._replace(**fields))


def random_drone(seed):
    """Return a drone near the ground in a random attitude, fast, with sticks off centre."""
    rng = np.random.default_rng(seed)
    return drone_with(
        pos_w=rng.normal(size=3) + np.array([0.0, 0.0, 5.0]),
        vel_w=rng.normal(size=3) * 8.0,
        quat=Rotation.random(rng=rng).as_quat(scalar_first=True),
        rates_b=rng.normal(size=3),
        applied=rng.uniform(-0.8, 0.8, 4),
    )


def random_commands(seed, num_steps):
    """Return commands all over the sticks' range, (num_steps, 4)."""
    return np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, (num_steps, 4)).astype(np.float32)
