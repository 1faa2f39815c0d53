"""Simulated flights, logged with the noise of real sensors, in FlyTrack's conventions.

``make_flight`` draws a craft, a kind of flight, a rate of the log and noise from a seed:

- ``race``: 8 gates on a ring, 3-12 m/s, nose towards the next gate;
- ``excitation``: doublets of one command at a time, between recoveries;
- ``gentle``: waypoints at 0.5-1.5 m/s, with turns;
- ``hover``: around a point.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.seams.craft import (
    GRAVITY,
    STEP_S,
    UP,
    Craft,
    State,
    advance,
    at_rest,
    draw_craft,
    hold,
)
from flytrack_sysid.log import FlightLog

KINDS = {"race": 0.4, "excitation": 0.3, "gentle": 0.2, "hover": 0.1}  # shares
LOG_RATES_HZ = {100: 0.7, 50: 0.1, 250: 0.1, 500: 0.1}
MAX_WIND_M_S = 1.0
VOLTAGE_NOISE_V, POSITION_NOISE_M = 0.02, 0.005


class Flight(NamedTuple):
    """A flight.

    Attributes:
        log: what the sensors measured: u, p, v, q, w, f, v_bat.
        motors: outputs of the mixer to motors 1 to 4, 0..1, (num_rows, 4).
        craft: that flew.
        kind: of ``KINDS``.
        truth: the log without noise and bias.
    """

    log: FlightLog
    motors: np.ndarray
    craft: Craft
    kind: str
    truth: FlightLog


class Plan(NamedTuple):
    """Where a pilot flies.

    Attributes:
        waypoints: world, m, (num_waypoints, 3); flown in turn, again and again.
        headings: at each waypoint, rad; None for the nose towards the waypoint.
        speed: m/s; the pilot slows down before a waypoint where headings are given.
        reach_m: distance at which a waypoint is passed.
        stay_s: longest time for a waypoint.
        doublets: added to commands, (num_rows, 4).
    """

    waypoints: np.ndarray
    headings: np.ndarray | None
    speed: float
    reach_m: float
    stay_s: float
    doublets: np.ndarray


def make_flight(seed: int, seconds: float = 60.0, kind: str | None = None) -> Flight:
    """Fly a random craft and log it; kind: of ``KINDS``, None to draw it."""
    rng = np.random.default_rng([seed, 5])
    drawn = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    kind = drawn if kind is None else kind
    rate_hz = int(rng.choice(list(LOG_RATES_HZ), p=list(LOG_RATES_HZ.values())))
    craft, dt = draw_craft(rng), 1.0 / rate_hz
    plan = _draw_plan(rng, kind, craft, round(seconds * rate_hz), dt)
    states, commands = _fly(rng, craft, plan, dt)
    truth = FlightLog(
        time=np.arange(len(commands)) * dt,
        channels={
            "u": commands,
            **{name: getattr(states, name) for name in ("p", "v", "q", "w", "f")},
            "v_bat": states.v_bat[:, None],
        },
        segment=np.zeros(len(commands), int),
        source=f"simulated flight {seed}",
        origin="measured",
    )
    return Flight(_with_noise(rng, truth), states.outputs, craft, kind, truth)


def _draw_plan(rng: np.random.Generator, kind: str, craft: Craft, rows: int, dt: float) -> Plan:
    """Draw where a flight of a kind leads."""
    center = np.append(rng.uniform(-10.0, 10.0, 2), 5.0)
    still = Plan(
        waypoints=center + rng.normal(0.0, 0.1, (20, 3)),
        headings=np.full(20, rng.uniform(-np.pi, np.pi)),
        speed=0.3,
        reach_m=0.0,
        stay_s=3.0,
        doublets=np.zeros((rows, 4)),
    )
    if kind == "race":
        turn = rng.choice([-1.0, 1.0])
        angles = turn * (2.0 * np.pi * np.arange(8) / 8 + rng.uniform(-0.3, 0.3, 8))
        speed = rng.uniform(3.0, 12.0)
        ring = 2.0 + speed * rng.uniform(0.8, 1.4) * rng.uniform(0.6, 1.4, 8)
        gates = np.stack([ring * np.cos(angles), ring * np.sin(angles), rng.uniform(-2, 2, 8)], 1)
        return still._replace(
            waypoints=center + gates, headings=None, speed=speed, reach_m=1.5, stay_s=6.0
        )
    if kind == "gentle":
        return still._replace(
            waypoints=center + rng.uniform(-3.0, 3.0, (20, 3)),
            headings=rng.uniform(-np.pi, np.pi, 20),
            speed=rng.uniform(0.5, 1.5),
            stay_s=rng.uniform(2.0, 5.0),
        )
    if kind == "excitation":
        return still._replace(speed=3.0, doublets=_draw_doublets(rng, craft, rows, dt))
    return still


def _draw_doublets(rng: np.random.Generator, craft: Craft, rows: int, dt: float) -> np.ndarray:
    """Draw doublets of one command at a time, (rows, 4); a rate's turns by 50 degrees at most."""
    doublets, start = np.zeros((rows, 4)), round(1.0 / dt)
    while start < rows:
        axis, half_s, size = rng.integers(4), rng.uniform(0.08, 0.2), rng.uniform(0.2, 0.7)
        if axis < 3:
            size = min(size, 50.0 / (half_s * craft.max_rate[axis]))
        half, middle = round(half_s / dt), start + round(half_s / dt)
        doublets[start:middle, axis] = size * rng.choice([-1.0, 1.0])
        doublets[middle : middle + half, axis] = -doublets[start, axis]
        start = middle + half + round(rng.uniform(0.6, 1.5) / dt)
    return doublets


def _fly(rng: np.random.Generator, craft: Craft, plan: Plan, dt: float) -> tuple[State, np.ndarray]:
    """Fly a plan; returns the state at each row and the command from it on, (num_rows, ...)."""
    wind = np.append(rng.normal(size=2), 0.0)
    wind *= rng.uniform(0.0, MAX_WIND_M_S) / np.linalg.norm(wind)
    heading = 0.0 if plan.headings is None else plan.headings[0]
    start = at_rest(craft, plan.waypoints[-1], heading, rng.uniform(0.0, 30.0))
    hover = np.array([0.0, 0.0, 0.0, craft.hover])
    start = hold(craft, start, hover, wind, 1)  # so that f is a flight's
    with jax.enable_x64(True):
        flown = _fly_from(craft, start, plan, wind, dt, round(dt / STEP_S))
        return jax.tree.map(np.array, flown)


@jax.jit
def _fly_from(craft: Craft, start: State, plan: Plan, wind: Any, dt: Any, steps: Any) -> Any:
    """Return states and commands of a flight in rows of ``dt``, s, that take some steps each."""

    def fly_row(carry: Any, doublets: Any) -> Any:
        state, target, since_s = carry
        u = jnp.clip(_steer(craft, state, plan, target, dt) + doublets, -1.0, 1.0)
        after, since_s = advance(craft, state, u, wind, steps), since_s + dt
        is_near = jnp.linalg.norm(plan.waypoints[target] - after.p) < plan.reach_m
        is_passed = is_near | (since_s > plan.stay_s)
        target = (target + is_passed) % len(plan.waypoints)
        return (after, target, jnp.where(is_passed, 0.0, since_s)), (state, u)

    plan = jax.tree.map(jnp.asarray, plan)
    begun: Any = (start, 0, 0.0)
    return jax.lax.scan(fly_row, begun, plan.doublets)[1]


def _steer(craft: Craft, x: State, plan: Plan, target: Any, dt: Any) -> jax.Array:
    """Return the command, (4,), that flies towards a waypoint.

    Each loop is slower than the one inside it: attitude, velocity, position.
    """
    attitude_gain = 0.3 / (craft.lags.max() + dt)
    velocity_gain, position_gain = attitude_gain / 2.0, attitude_gain / 6.0
    way = plan.waypoints[target] - x.p
    distance = jnp.linalg.norm(way) + 1e-9
    heading: Any = jnp.arctan2(way[1], way[0])
    speed: Any = plan.speed
    if plan.headings is not None:
        heading = plan.headings[target]
        speed = jnp.minimum(plan.speed, position_gain * distance)
    wanted = velocity_gain * (way * (speed / distance) - x.v)
    most = 0.5 * (craft.thrust_to_weight - 1.0) * GRAVITY
    wanted = wanted * jnp.minimum(1.0, most / (jnp.linalg.norm(wanted) + 1e-9)) + GRAVITY * UP
    wanted = wanted.at[2].set(jnp.maximum(wanted[2], 2.0))  # upright
    lift = x.attitude.inv().apply(wanted)  # body
    across = jnp.hypot(lift[0], lift[1])
    along = jnp.arctan2(across, lift[2]) / (across + 1e-9)
    nose = x.attitude.apply(jnp.array([1.0, 0.0, 0.0]))
    turn = heading - jnp.arctan2(nose[1], nose[0])
    turn = (turn + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
    yaw_rate = jnp.clip(0.4 * turn * attitude_gain, -2.0, 2.0)
    rates = jnp.stack([-lift[1] * along * attitude_gain, lift[0] * along * attitude_gain, yaw_rate])
    strength = (x.v_bat / craft.voltage[1]) ** 2 * craft.thrust_to_weight * GRAVITY
    throttle = craft.output_for(jnp.maximum(lift[2], 0.0) / strength)
    return jnp.append(rates / jnp.deg2rad(craft.max_rate), 2.0 * throttle - 1.0)


def _with_noise(rng: np.random.Generator, truth: FlightLog) -> FlightLog:
    """Return a log as sensors measure it: white noise on all but commands, bias on gyro and f."""

    def white(sigma: float, columns: int = 3) -> np.ndarray:
        return rng.normal(0.0, sigma, (len(truth), columns))

    q, angle = truth["q"], white(np.deg2rad(rng.uniform(0.2, 0.5)))
    q = multiply(q, np.column_stack([np.ones(len(q)), 0.5 * angle]))
    if rng.random() < 0.5:  # half the loggers keep q_w positive
        q *= np.where(q[:, :1] < 0.0, -1.0, 1.0)
    channels = {
        "u": truth["u"],
        "p": truth["p"] + white(POSITION_NOISE_M),
        "v": truth["v"] + white(rng.uniform(0.02, 0.05)),
        "q": q,
        "w": truth["w"] + white(rng.uniform(0.01, 0.05)) + rng.normal(0.0, 0.01, 3),
        "f": truth["f"] + white(rng.uniform(0.2, 0.8)) + rng.normal(0.0, 0.1, 3),
        "v_bat": truth["v_bat"] + white(VOLTAGE_NOISE_V, 1),
    }
    return FlightLog(truth.time, channels, truth.segment, truth.source, truth.origin)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return products of unit quaternions (w, x, y, z), (num_rows, 4); arguments broadcast."""
    first, second = (Rotation.from_quat(quat, scalar_first=True) for quat in (a, b))
    return np.asarray((first * second).as_quat(scalar_first=True))
