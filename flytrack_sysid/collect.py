"""Collection of flight logs: an excitation or a script flown on a plant.

A plant is a ``flytrack_env.plants.Plant`` or a function ``step(x, u)`` of the handout's vectors.
Only its outputs are used.

Envelope: a flight ends where the drone would exceed 20 m/s, leave heights between 10 and 110 m, or
leave the voltages of the plant's battery (22 to 24 V if it does not state them). A script may go
down to 0.1 m.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.plants import Plant
from flytrack_env.state import ACCELERATION, STATE_SIZE, pack, unpack, unpack_action
from flytrack_sysid import excitation
from flytrack_sysid.excitation import DT_S, MIN_STEPS, VOLTAGES
from flytrack_sysid.log import FlightLog, log_of_states
from flytrack_sysid.log_voltage import voltages_of
from flytrack_sysid.script_file import Script, build_script, check_script
from flytrack_sysid.sensors import LOST_ROWS, measure

StepFunction = Callable[[np.ndarray, np.ndarray], Any]
Fly = Callable[[np.ndarray, np.ndarray], np.ndarray]
Report = Callable[[int, int], None]

SECONDS_PER_FLIGHT = excitation.FLIGHT_STEPS * DT_S
MIN_MINUTES = excitation.FLIGHTS_PER_KIND * len(excitation.KINDS) * SECONDS_PER_FLIGHT / 60.0


class CollectError(ValueError):
    """A plant that cannot be flown, or a request that cannot be met."""


def states_flown(
    plant: Plant, model: ModelParameters, start: jax.Array, command: jax.Array
) -> jax.Array:
    """Return the states, (T + 1, 21), of a plant under commands, from the start on.

    Args:
        plant: what flies.
        model: its parameters; a black box ignores them.
        start: first state, (21,).
        command: (T, 4).
    """

    def step(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        return plant.step(state, unpack_action(action), DT_S, model), pack(plant.drone(state))

    last, states = jax.lax.scan(step, plant.reset(unpack(start), model), command)
    return jnp.concatenate([states, pack(plant.drone(last))[None]])


def _fly_plant(plant: Plant) -> Fly:
    """Return a function that flies a plant from all starts at once."""
    # The model is part of the contract; a black box ignores it.
    fly_all = jax.jit(jax.vmap(partial(states_flown, plant, nominal_parameters())))

    def fly(starts: np.ndarray, commands: np.ndarray) -> np.ndarray:
        try:
            states = np.asarray(fly_all(starts, commands))
            plant.check_alive()
            return states
        except Exception as error:  # a user's plant may raise anything
            raise CollectError(f"plant: {type(error).__name__}: {error}") from error

    return fly


def _fly_function(step: StepFunction, report: Report) -> Fly:
    """Return a function that calls ``step(x, u)`` for every step of every flight."""

    def checked(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        try:
            # Pass copies, because a function that changes its arguments must not change the log.
            after = np.asarray(step(x.copy(), u.copy()), np.float32)
        except Exception as error:  # a user's function may raise anything
            raise CollectError(f"step: {type(error).__name__}: {error}") from error
        if after.shape != (STATE_SIZE,):
            raise CollectError(
                f"step: found a state of shape {after.shape}, expected ({STATE_SIZE},)"
            )
        return after

    def fly(starts: np.ndarray, commands: np.ndarray) -> np.ndarray:
        states = np.empty((*commands.shape[:2], STATE_SIZE), np.float32)
        states = np.concatenate([starts[:, None].astype(np.float32), states], axis=1)
        for flight, command in enumerate(commands):
            for number, u in enumerate(command):
                states[flight, number + 1] = checked(states[flight, number], u)
            report(flight + 1, len(commands))
        return states

    return fly


def _fly_any(plant: Plant | StepFunction, report: Report) -> Fly:
    """Return a function that flies a plant or a step function."""
    return _fly_plant(plant) if isinstance(plant, Plant) else _fly_function(plant, report)


def find_hover(fly: Fly, middle_v: float) -> float:
    """Return the thrust action at which a plant, level and at rest, holds its weight.

    Raises:
        CollectError: the plant does not sink at thrust -1 and climb at 1.
    """
    actions = np.linspace(-1.0, 1.0, 41)
    rng = np.random.default_rng(0)
    starts = np.stack(
        [excitation.start_state(rng, middle_v, action, 0.0, 0.0) for action in actions]
    )
    commands = np.zeros((len(actions), 1, 4), np.float32)
    commands[:, 0, 3] = actions
    climb = fly(starts.astype(np.float32), commands)[:, -1, ACCELERATION][:, 2]
    if not (climb[0] < 0.0 < climb[-1]):
        accelerations = f"{climb[0]:.3g} and {climb[-1]:.3g} m/s^2"
        raise CollectError(
            f"plant: found vertical accelerations of {accelerations} at thrust -1 and 1, level at "
            f"{middle_v:g} V; expected it to sink and to climb"
        )
    first_climbing = int(np.argmax(climb > 0.0))
    around = slice(first_climbing - 1, first_climbing + 1)
    return float(np.interp(0.0, climb[around], actions[around]))


def collect(
    plant: Plant | StepFunction,
    minutes: float = 2.0,
    seed: int = 0,
    noise: float = 0.0,
    report: Report = lambda done, total: None,
    script: Script | None = None,
) -> FlightLog:
    """Fly the excitation, or a script instead, on a plant and return the log, a segment per flight.

    Args:
        plant: a plant, or a function ``(x (21,), u (4,)) -> x (21,)`` of a step of 0.01 s, started
            from chosen states.
        minutes: of flight before the envelope cuts any, at least 1.
        seed: of the excitation and the noise.
        noise: 0 logs the state itself, 1 what common sensors measure
            (``flytrack_sysid.sensors``).
        report: called with the number of flights done and in all.
        script: flights to fly instead of the excitation.

    Raises:
        CollectError: an argument is out of range, or the plant cannot be flown.
        ScriptError: the script cannot be flown.
    """
    if not MIN_MINUTES <= minutes < np.inf:
        raise CollectError(f"minutes: found {minutes}, expected at least {MIN_MINUTES:g}")
    if not 0.0 <= noise < 1.0 / LOST_ROWS:
        raise CollectError(f"noise: found {noise}, expected 0 or more, below {1.0 / LOST_ROWS:g}")
    if seed < 0:
        raise CollectError(f"seed: found {seed}, expected 0 or more")
    rng = np.random.default_rng(seed)
    fly = _fly_any(plant, report)
    battery = plant.battery if isinstance(plant, Plant) else None
    voltages = VOLTAGES if battery is None else voltages_of(battery)
    if script is None:
        hover = find_hover(_fly_any(plant, lambda done, total: None), 0.5 * sum(voltages))
        num_flights = round(minutes * 60.0 / SECONDS_PER_FLIGHT)
        flights, heights = (
            build_script(excitation.script(num_flights, hover, rng, voltages)),
            excitation.HEIGHTS,
        )
    else:
        check_script(script)
        flights, heights = script, excitation.SCRIPT_HEIGHTS
    log = log_of_states(_cut(*_states(fly, flights), heights, voltages), DT_S, "collected")
    if noise > 0.0:
        log = measure(log, noise, float(nominal_parameters().g), rng)
    return log


def _states(fly: Fly, flights: Script) -> tuple[np.ndarray, np.ndarray]:
    """Return states, (N, T, 21), and commands, (N, T, 4), of a script's flights, float32."""
    starts, commands = flights.starts.astype(np.float32), flights.commands.astype(np.float32)
    # Start one step before the log, so that the first row's acceleration is the plant's, not the
    # start's.
    states = fly(starts, np.concatenate([commands[:, :1], commands], axis=1))
    if not np.isfinite(states).all():
        flight, row, column = np.argwhere(~np.isfinite(states))[0]
        raise CollectError(
            f"plant: found {states[flight, row, column]} in component {column}, flight {flight} "
            f"({flights.kinds[flight]}), step {row}; expected finite numbers"
        )
    return states[:, 1:-1], commands


def _cut(
    states: np.ndarray,
    commands: np.ndarray,
    heights: tuple[float, float],
    voltages: tuple[float, float],
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return each flight until it leaves the envelope, without flights of less than two rows."""
    is_inside = excitation.is_inside(states, heights, voltages)
    lengths = np.where(is_inside.all(axis=1), states.shape[1], np.argmin(is_inside, axis=1))
    kept = [
        (x[:n], u[:n]) for x, u, n in zip(states, commands, lengths, strict=True) if n >= MIN_STEPS
    ]
    if not kept:
        raise CollectError("plant: no flight stayed within the envelope for more than a step")
    return kept
