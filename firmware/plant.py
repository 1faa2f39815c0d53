"""``Betaflight``: the firmware on a body, as a plant for collecting, evaluation and environments.

A flight is a process. A plant's state holds the drone as it was reported, the number of its flight
(0: not begun) and its steps so far; a step passes through a callback to the processes, all rows of
a ``vmap`` at once, each in a process of its own. A flight goes on from its newest state; the last
step of it can be asked for again, as padded rollouts do, and is the same; an older state is an
error.
"""

import hashlib
import itertools
import shutil
import struct
import threading
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from msgspec.structs import replace

from firmware.body import Body, FirmwareError
from firmware.building import find_executable
from firmware.process import AT_REST, BODY, FLY, START, START_STATE, Firmware, Reply
from firmware.settings import settings_of
from flytrack_env import state as layout
from flytrack_env.battery import Battery
from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.files import fresh_folder
from flytrack_env.messages import error_text
from flytrack_env.motion import Motion
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Scalar
from flytrack_env.state import (
    BATTERY_EMPTY_V,
    BATTERY_FULL_V,
    STATE_SIZE,
    Action,
    Drone,
    pack,
    unpack,
)
from flytrack_sysid.importing.betaflight_settings import full_stick_rate, rate_loop, stick_curve

DT_S = 0.01
STEP_US = 10_000
ARM_US, SETTLE_US, LANDING_US = 100_000, 500_000, 1_500_000
CENTER_US, STICK_US, SWITCH_US = 1500.0, 500.0, 1900.0
LOWEST_PULSE_US, PULSE_RANGE_US = 1000.0, 1000.0
MIN_LOG_STEPS = 50  # of a flight whose blackbox log is kept
BOX_NAMES = "LOG*.BF*"  # as the firmware names its logs
NUM_SPARE = 16  # flights that are kept open beside those of the newest call


class FirmwareState(NamedTuple):
    """The drone as reported, the number of its flight (0: not begun) and its steps so far."""

    drone: Drone
    flight: jax.Array
    step: jax.Array


def _sticks(command: np.ndarray, throttle_us: float | None = None) -> tuple[float, ...]:
    """Return the receiver's channels, us, armed, of a command in [-1, 1].

    The command's yaw is positive to the left.
    """
    roll, pitch, yaw, thrust = (float(value) for value in np.clip(command, -1.0, 1.0))
    throttle = CENTER_US + STICK_US * thrust if throttle_us is None else throttle_us
    sticks = (
        CENTER_US + STICK_US * roll,
        CENTER_US + STICK_US * pitch,
        throttle,
        CENTER_US - STICK_US * yaw,
    )
    return (*sticks, SWITCH_US, *AT_REST[5:])


class _Flight:
    """A flight in its process, from a start (21,); its last step is kept."""

    def __init__(self, plant: "Betaflight", number: int, start: np.ndarray):
        self.number, self.steps, self.body = number, 0, plant.body
        self.folder = plant.firmware.folder / f"flight_{number}"
        self.folder.mkdir()
        self.link = plant.firmware.copy(self.folder, "the process of a flight")
        self.last_command, self.last_row = np.full(4, np.nan), start
        try:
            self._take_off(start.astype(float), plant)
        except BaseException:
            self.link.kill()
            raise

    def _take_off(self, start: np.ndarray, plant: "Betaflight") -> None:
        """Arm, let motors and filters settle where the start is, and let go."""
        digest = hashlib.sha256(struct.pack("=q", plant.seed) + start.tobytes()).digest()
        noise = int.from_bytes(digest[:8], "little")
        place, turn = (*start[layout.POSITION], *start[layout.VELOCITY]), start[layout.QUATERNION]
        at = [*place, *turn / np.linalg.norm(turn)]
        reply = self.link.call(
            FLY, duration_us=ARM_US, rc=_sticks(np.zeros(4), AT_REST[2]), is_held=True
        )
        if not reply.is_armed:
            raise FirmwareError(
                f"firmware: it does not arm: {reply.text.strip() or 'no reason given'}"
            )
        self.link.call(BODY, payload=self.body.pack(plant.firmware.is_reversed))
        self.link.call(
            START, payload=START_STATE.pack(*at, 0.0, 0.0, 0.0, start[layout.BATTERY], noise)
        )
        held = np.array([0.0, 0.0, 0.0, start[layout.APPLIED_ACTION][3]])
        self.link.call(FLY, duration_us=SETTLE_US, rc=_sticks(held), is_held=True)
        self.link.call(
            START, payload=START_STATE.pack(*at, *start[layout.RATES], start[layout.BATTERY], noise)
        )

    def land(self, box: Path | None) -> None:
        """End the flight.

        Args:
            box: folder for its blackbox log, which the firmware ends after disarming.
        """
        try:
            if box is not None and self.steps >= MIN_LOG_STEPS:
                self.link.call(FLY, duration_us=LANDING_US, is_held=True)
                for log in self.folder.glob(BOX_NAMES):
                    shutil.move(log, box / f"flight_{self.number:05d}.bbl")
        finally:
            self.link.kill()
            shutil.rmtree(self.folder, ignore_errors=True)


class Betaflight(Plant):
    """Betaflight 4.6 with settings, on a body; a context manager that leaves nothing running.

    Every flight begins armed and settled, hovering at the start's thrust, in whatever attitude; the
    same start, commands and seed give the same states, bit for bit, alone or among others. The
    applied action that is reported is angular velocity over full stick, and the thrust action at
    which motors as fast as these would be steady.
    """

    dt = DT_S

    def __init__(
        self,
        settings: str | Mapping[str, object] = {},
        body: Body = Body(),  # noqa: B008, frozen
        skip: Iterable[str] = (),
        seed: int = 0,
        blackbox: str | Path | None = None,
    ):
        """Start the firmware with settings, read them back, and have it ready to fly.

        Args:
            settings: the text of a ``dump`` or ``diff all``, or a dict above
                ``firmware.settings.DEFAULTS``.
            skip: patterns of settings to leave out.
            seed: of the body's sensor noise.
            blackbox: new folder for the firmware's own log of each flight of half a second or more,
                written when the flight ends: when later ones replace it, or in ``close``.

        Raises:
            FirmwareError: not built, settings that are refused or not kept, or it does not start.
        """
        self.body, self.seed = body, seed
        empty_v = body.full_v * BATTERY_EMPTY_V / BATTERY_FULL_V
        self.battery = Battery(body.full_v, empty_v, empty_v, body.full_v)
        self.box = None if blackbox is None else fresh_folder(Path(blackbox))
        at_rest = replace(
            body, gyro_noise=0.0, acc_noise=0.0
        )  # gyros are calibrated with the motors off
        made = settings_of(settings, skip, has_blackbox=self.box is not None)
        self.firmware = Firmware(find_executable(), made, at_rest)
        self._flights: dict[int, _Flight] = {}  # the least recently flown first
        self._numbers, self._lock = itertools.count(1), threading.Lock()
        self._failure: FirmwareError | None = None
        self._finalizer = weakref.finalize(self, self.firmware.close)
        rates, axes = (
            self.value("rates_type"),
            _rates(self.firmware, "rc_rate", "srate", "rate_limit"),
        )
        self.full_stick_deg_s = tuple(full_stick_rate(rates, *axis) for axis in axes)

    def __enter__(self) -> "Betaflight":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End all flights, write their blackbox logs, and end every process.

        A closed plant cannot be flown.
        """
        with self._lock:
            try:
                for flight in list(self._flights.values()):
                    self._land(flight)
            finally:
                self._stop()

    def value(self, name: str) -> str:
        """Return the value of a setting as the firmware has it, '' for an unknown name."""
        return self.firmware.value(name)

    def nominal_model(self) -> ModelParameters:
        """Return the nominal model with the craft's settings and continuous motion, to fit from."""
        full = np.array(self.full_stick_deg_s, np.float32)
        curve = stick_curve(
            self.value("rates_type"), _rates(self.firmware, "rc_rate", "srate", "expo")
        )
        model = nominal_parameters()._replace(max_rate=full, motion=Motion.CONTINUOUS)
        loop = rate_loop(self.value, 1.0 / DT_S)
        return model.with_effects(*(one for one in (curve, loop) if one is not None))

    def reset(self, drone: Drone, model: ModelParameters) -> FirmwareState:
        """Return the state of a flight that has not begun; ``model`` is not used."""
        floats = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone)
        return FirmwareState(floats, jnp.int32(0), jnp.int32(0))

    def step(
        self, state: FirmwareState, command: Action, dt: Scalar, model: ModelParameters
    ) -> FirmwareState:
        """Return the state 0.01 s later; ``dt`` and ``model`` are not used."""
        u = jnp.stack([jnp.asarray(value, jnp.float32) for value in command])
        rows = pack(state.drone), state.flight, state.step
        row, flight, step = jax.pure_callback(
            self._step_rows, rows, *rows, u, vmap_method="broadcast_all"
        )
        return FirmwareState(unpack(row), flight, step)

    def drone(self, state: FirmwareState) -> Drone:
        """Return the drone as reported."""
        return state.drone

    def fly(self, starts: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """Return the states (N, T, 21) after each command of flights side by side.

        Args:
            starts: (N, 21).
            commands: (N, T, 4) in [-1, 1], each held for 0.01 s.

        Raises:
            FirmwareError: a flight that fails.
        """
        rows, states = np.asarray(starts, np.float32), []
        numbers = counts = np.zeros(len(rows), np.int32)
        for column in np.moveaxis(np.asarray(commands, np.float32), 1, 0):
            rows, numbers, counts = self._step_rows(rows, numbers, counts, column)
            states.append(rows)
        self.check_alive()
        return np.stack(states, axis=1)

    def check_alive(self) -> None:
        """Raise FirmwareError if a step failed or the plant was closed.

        All states are NaN since a failed step.
        """
        if self._failure is not None:
            raise self._failure
        if not self._finalizer.alive:
            raise FirmwareError("firmware: the plant was closed")

    def _step_rows(
        self, drones: Any, flights: Any, steps: Any, commands: Any
    ) -> tuple[np.ndarray, ...]:
        """Fly a step of each row: (..., 21), (...), (...), (..., 4).

        Rows that are not finite are not flown and become NaN.

        Nothing is raised here, inside a compiled program: ``check_alive`` does.
        """
        shape, flight_shape = np.shape(drones), np.shape(flights)
        rows = np.asarray(drones, np.float32).reshape(-1, STATE_SIZE)
        sticks = np.asarray(commands, np.float32).reshape(-1, 4)
        numbers, counts = np.array(flights, np.int32).ravel(), np.array(steps, np.int32).ravel()
        after = np.full_like(rows, np.nan)
        is_usable = np.isfinite(rows).all(axis=1) & np.isfinite(sticks).all(axis=1)
        with self._lock:
            if self._finalizer.alive and is_usable.any():
                try:
                    every = [array[is_usable] for array in (rows, numbers, counts, sticks)]
                    flown = self._fly(*every)
                    after[is_usable] = [flight.last_row for flight in flown]
                    numbers[is_usable] = [flight.number for flight in flown]
                    counts[is_usable] = [flight.steps for flight in flown]
                except (FirmwareError, OSError) as error:
                    known = error if isinstance(error, FirmwareError) else None
                    self._failure = known or FirmwareError(f"firmware: {error_text(error)}")
                    after[:] = np.nan
                    self._stop()
        return after.reshape(shape), numbers.reshape(flight_shape), counts.reshape(flight_shape)

    def _fly(
        self, starts: np.ndarray, numbers: np.ndarray, steps: np.ndarray, commands: np.ndarray
    ) -> list[_Flight]:
        """Return the flights of the rows, a step later: all processes work at once."""
        flown = [
            self._find(*row)
            for row in zip(numbers.tolist(), steps.tolist(), commands, starts, strict=True)
        ]
        due: dict[int, _Flight] = {}
        for flight, step, command in zip(flown, steps, commands, strict=True):
            if flight.steps == step and flight.number not in due:
                flight.link.ask(FLY, duration_us=STEP_US, rc=_sticks(command))
                flight.last_command, due[flight.number] = command.copy(), flight
        for flight in due.values():
            reply = flight.link.answer()
            if not reply.is_armed:
                after_s = f"{DT_S * flight.steps:.2f} s"
                raise FirmwareError(
                    f"firmware: it disarmed in flight, after {after_s}: {reply.text.strip()}"
                )
            flight.last_row, flight.steps = self._row(reply), flight.steps + 1
        for flight in flown:  # to the end of the line
            self._flights[flight.number] = self._flights.pop(flight.number)
        while len(self._flights) > len(flown) + NUM_SPARE:
            self._land(next(iter(self._flights.values())))
        return flown

    def _find(self, number: int, step: int, command: np.ndarray, start: np.ndarray) -> _Flight:
        """Return the flight of a row, and begin it if need be.

        Raises:
            FirmwareError: it cannot go on from this state.
        """
        if number == 0:
            flight = _Flight(self, next(self._numbers), start)
            self._flights[flight.number] = flight
            return flight
        if number not in self._flights:
            raise FirmwareError(
                f"firmware: flight {number} has ended, since later ones took its place"
            )
        flight = self._flights[number]
        is_again = flight.steps == step + 1 and np.array_equal(flight.last_command, command)
        if flight.steps != step and not is_again:
            at = f"is at step {flight.steps}, and cannot go on from step {step}"
            raise FirmwareError(f"firmware: flight {number} {at}")
        return flight

    def _stop(self) -> None:
        """End every process."""
        for flight in self._flights.values():
            flight.link.end.close()
        self._flights.clear()
        self._finalizer()

    def _land(self, flight: _Flight) -> None:
        del self._flights[flight.number]
        flight.land(self.box)

    def _row(self, reply: Reply) -> np.ndarray:
        """Return the handout's state, (21,) float32, of a reply with motor speeds as action."""
        row = reply.numbers.copy()
        command = self.body.command_of(row[layout.APPLIED_ACTION], row[layout.BATTERY])
        low, high = (reply.motor_range - LOWEST_PULSE_US) / PULSE_RANGE_US
        thrust = 2.0 * (command - low) / (high - low) - 1.0
        sticks = row[layout.RATES] / np.deg2rad(self.full_stick_deg_s)
        row[layout.APPLIED_ACTION] = np.clip([*sticks, thrust], -1.0, 1.0)
        return row.astype(np.float32)


def _rates(firmware: Firmware, *names: str) -> list[tuple[float, ...]]:
    """Return rate settings of roll, pitch and yaw."""
    axes = ("roll", "pitch", "yaw")
    return [tuple(float(firmware.value(f"{axis}_{name}")) for name in names) for axis in axes]
