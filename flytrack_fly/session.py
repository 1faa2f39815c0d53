"""A pilot's session: flights from the start to a crash, their laps, and the gap to the ghost."""

import math
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from flytrack_env import ModelParameters, Track, make
from flytrack_env.multi_drone import Path, RaceRules, is_put_out, place_on_grid
from flytrack_env.quaternion import Vec3
from flytrack_env.rendering import FlightLog, scene_row
from flytrack_env.rendering.flight_log import GATE_INDEX, LAP_START, LAP_TIME, LAPS
from flytrack_env.rollout import MAX_STEPS
from flytrack_env.state import BATTERY, POSITION, STATE_SIZE
from flytrack_env.terminations import Causes
from flytrack_env.thrust import hover_action
from flytrack_env.tracks import cross_gate
from flytrack_fly.ghost import Ghost, still_start
from flytrack_fly.sticks import NAMES, command_of

MAX_LAG_S = 0.1  # later than that, the flight is slowed down: it must not fall behind ever more
START_HINT = "W, or throttle up: start.  H: keys"
ROUNDING = 1e-6  # of a number of steps
GRID = RaceRules()


def steps_due(behind_s: float, frame_s: float, step_s: float) -> tuple[int, float]:
    """Return how many steps are due after a picture that took ``frame_s`` s, and the rest, s.

    No more than ``MAX_LAG_S`` are caught up on.

    Args:
        behind_s: left over before.
    """
    due_s = min(behind_s + frame_s, MAX_LAG_S)
    steps = math.floor(due_s / step_s + ROUNDING)
    return steps, due_s - steps * step_s


@dataclass(eq=False)
class Flight:
    """A flight from the start: log, commands (4,), lap times, gates passed, why it ended.

    Attributes:
        gap: index of the last gate that was passed, and how much later within the lap than the
            ghost, s.
    """

    log: FlightLog
    commands: list[np.ndarray] = field(default_factory=list)
    lap_times_s: list[float] = field(default_factory=list)
    num_gates: int = 0
    gap: tuple[int, float] | None = None
    ended: str = "quit"

    def rollout(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the states (T, 21) in which the commands (T, 4) were given, and these."""
        return self.log.rows[: len(self.commands), :STATE_SIZE], np.stack(self.commands)


class Session:
    """Flights of FlyTrack-v0, each from rest at the start pose; the step is compiled at once.

    A flight begins when the throttle goes up from its middle or below. A gate that is missed stays
    the next. is_race: the ghost starts once with the pilot, who has a place beside and behind it,
    and can be hit.

    Raises:
        ValueError: a track or model that cannot be flown, or a race without a ghost.
    """

    def __init__(
        self, track: Track, model: ModelParameters, ghost: Ghost | None, is_race: bool = False
    ):
        if is_race and ghost is None:
            raise ValueError(
                "--race: found --ghost none, expected an opponent: reference or champion"
            )
        self.ghost, self.is_race = ghost, is_race
        self.gate_ids = [gate.id for gate in track.gates]
        self.env = make("FlyTrack-v0", track=track, model=model, missed_gate="fly_on")
        self.params = still_start(self.env.default_params, MAX_STEPS)  # the battery ends a flight
        self.step_s = float(self.params.dt)
        self._start = self.env.reset(jax.random.key(0), self.params)[1]
        if is_race:
            beside = place_on_grid(self.env.drone(self._start), 1, GRID)
            self._start = self.env.begin(beside, jax.numpy.int32(0), self.params)
        self._step = jax.jit(self._advance_state)
        nobody = np.full((2, 3), np.nan, np.float32)
        jax.block_until_ready(self._step(self._start, np.zeros(len(NAMES), np.float32), nobody))
        self.flights: list[Flight] = []
        self.restart()

    def _advance_state(
        self, state: Any, command: jax.Array, opponent_w: jax.Array
    ) -> tuple[Any, ...]:
        """Return the next state, its row, the crossing time, and the causes of an end.

        The crossing is that of the next gate's plane. opponent_w: where an opponent is before and
        after the step, (2, 3); NaN: nowhere.
        """
        env, params = self.env, self.params
        _, after, _, _, info = env.step_env(None, state, command, params)
        ends_w, race = (env.drone(state).pos_w, env.drone(after).pos_w), env.race(state)
        fraction = cross_gate(race.gate, *ends_w, params.drone_radius).fraction
        row = scene_row(env.drone(after), env.race(after))
        causes = {name: info[name] for name in Causes._fields}
        opponent = Path(*(Vec3(*position_w) for position_w in opponent_w))
        causes["collision"] = is_put_out(Path(*ends_w), opponent, GRID)
        return after, row, (state.time + fraction) * params.dt, causes

    def restart(self) -> None:
        """Put the drone at the start; the flight so far is kept if it has begun."""
        self.flights = [one for one in self.flights if one.commands]
        self.flights.append(Flight(FlightLog(self.step_s)))
        self.state, self._is_armed = self._start, False
        self.now.log.append(
            np.asarray(scene_row(self.env.drone(self.state), self.env.race(self.state)))
        )

    @property
    def now(self) -> Flight:
        """The flight that is being flown, or waits for the throttle."""
        return self.flights[-1]

    def advance(self, sticks: np.ndarray) -> None:
        """Fly a step with sticks (4,), once the throttle has gone up."""
        self._is_armed |= bool(sticks[3] <= 0.0)
        if self.now.commands or (self._is_armed and sticks[3] > 0.0):
            model, battery_v = self.params.model, float(self.now.log.rows[-1, BATTERY])
            hover = hover_action(model.thrust_coeffs, float(model.m) * float(model.g), battery_v)
            self.fly(command_of(sticks, hover))

    def fly(self, command: np.ndarray) -> None:
        """Fly a step with a command (4,); back to the start if it ends the flight."""
        flight, before = self.now, self.now.log.rows[-1]
        self.state, row, gate_s, causes = self._step(self.state, command, self._opponent_w())
        flight.commands.append(command)
        self._count(before, np.asarray(row), float(gate_s))
        flight.log.append(np.asarray(row))
        if ended := [name.replace("_", " ") for name, happened in causes.items() if happened]:
            flight.ended = ", ".join(ended)
            self.restart()

    def _count(self, before: np.ndarray, after: np.ndarray, gate_s: float) -> None:
        """Count a gate passed between two rows, and a lap completed by it."""
        if after[GATE_INDEX] == before[GATE_INDEX]:
            return
        flight, gate = self.now, int(before[GATE_INDEX])
        flight.num_gates += 1
        if self.ghost is not None:
            laps = int(before[LAPS])
            begin_s = self.ghost.lap_begin_s(laps) if self.is_race else before[LAP_START]
            flight.gap = gate, float(gate_s - begin_s - self.ghost.lap(laps).gate_times_s[gate])
        if after[LAPS] > before[LAPS]:
            flight.lap_times_s.append(float(after[LAP_TIME]))

    def ghost_state(self) -> np.ndarray | None:
        """Return the ghost's state (21,) now, if any.

        It begins every lap with the pilot, except in a race.
        """
        log = self.now.log
        if self.ghost and self.is_race:
            return self.ghost.state_at(0, log.time_s)
        laps, lap_start_s = int(log.rows[-1, LAPS]), float(log.rows[-1, LAP_START])
        return self.ghost and self.ghost.state_at(laps, log.time_s - lap_start_s)

    def _opponent_w(self) -> np.ndarray:
        """Return the opponent's positions before and after the next step, (2, 3); NaN without."""
        if self.ghost is None or not self.is_race:
            return np.full((2, 3), np.nan, np.float32)
        times_s = (self.now.log.time_s, self.now.log.time_s + self.step_s)
        return np.stack([self.ghost.state_at(0, time_s)[POSITION] for time_s in times_s]).astype(
            np.float32
        )

    def notes(self) -> str:
        """Return the picture's text besides its bar: best lap, gap to the ghost, how to start."""
        lap_times_s = [time_s for flight in self.flights for time_s in flight.lap_times_s]
        lines = [f"best {min(lap_times_s):.2f} s"] if lap_times_s else []
        if self.ghost and self.now.gap is not None:
            gate, gap_s = self.now.gap
            whom = f"the {self.ghost.name} {'opponent' if self.is_race else 'ghost'}"
            lines.append(f"gate {self.gate_ids[gate]}: {gap_s:+.2f} s to {whom}")
        if not self.now.commands:
            lines += [f"ended: {self.flights[-2].ended}"] if len(self.flights) > 1 else []
            lines.append(START_HINT)
        return "\n".join(lines)
