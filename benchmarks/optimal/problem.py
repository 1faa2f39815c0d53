"""The time-optimal flight as a nonlinear program: multiple shooting over the simulator's own step.

A flight is cut into segments, one per gate, that end with the step in which the gate is passed. Every
segment has a whole number of steps of one length, and the point of passing lies on the straight line from
the last node but one to the last, as ``flytrack_env.race`` has it: at a fraction of that step. With fractions
held at 1 and free lengths, segments have free times; with lengths held at 0.01 s and free fractions, the
flight is one of the simulator at 100 Hz, exactly.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import casadi
import numpy as np

from flytrack_env.state import ACTION_SIZE, BATTERY, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from flytrack_env.tracks import Course

CLEARANCE_M = 2e-3  # kept from frames and bounds: float32 replays stray less
SMOOTHING_S = 1e-6  # s per squared change of a command: prevents chatter, costs less than a millisecond
ACROSS_M_S = 0.1  # m/s, least speed through a gate in its direction of flight
SHORTEST_SHARE, LONGEST_SHARE = 0.2, 5.0  # of a free step's length, of its first guess
LOOSE_UNIT = 1.1  # bound of a component of a unit quaternion, which the step itself normalises
FRACTION_EDGE = 0.02  # of a step: rounding could put a node on a gate's plane on either side of it


class Guess(NamedTuple):
    """A first guess or a solution; SI units.

    states: (N + 1, 21). commands: (N, 4). steps_s: (num_gates,), length of a step of each segment.
    fractions: (num_gates,), where in the last step of each segment its gate is passed.
    """

    states: np.ndarray
    commands: np.ndarray
    steps_s: np.ndarray
    fractions: np.ndarray

    def times(self, counts: np.ndarray) -> np.ndarray:
        """Return the time at which each gate is passed, s, given the steps of each segment."""
        return np.cumsum(counts * self.steps_s) - (1.0 - self.fractions) * self.steps_s

    def closure(self) -> float:
        """Return 1 if the last attitude's quaternion has the sign of the first, else -1.

        Both signs are the same attitude; the sign depends on whole turns, which a search does not change.
        """
        return 1.0 if self.states[0, QUATERNION] @ self.states[-1, QUATERNION] > 0.0 else -1.0


class Solution(NamedTuple):
    """A result of the solver: flight, IPOPT's status, whether it is solved, iterations."""

    flight: Guess
    status: str
    is_solved: bool
    iterations: int


@dataclasses.dataclass(frozen=True)
class Task:
    """The task: kind "flying" or "standing", gates and bounds, drone radius, m, and the first state.

    start: (21,): where a standing start begins; of a flying lap only the battery voltage is taken.
    """

    kind: str
    course: Course
    radius_m: float
    start: np.ndarray

    @property
    def is_lap(self) -> bool:
        """Whether the flight is periodic."""
        return self.kind == "flying"


Limit = tuple[Any, float, float]  # an expression and its bounds, elementwise


def _gate_limits(task: Task, index: int, point: Any, velocity: Any) -> list[Limit]:
    """Return that a point is on a gate's plane, within its opening less the drone, flown in its direction."""
    gates = task.course.gates
    forward, left, up = (
        np.array([np.float64(axis[index]) for axis in axes])
        for axes in (gates.forward, gates.left(), gates.up)
    )
    offset = point - np.array([np.float64(axis[index]) for axis in gates.centre])
    free = float(gates.half_opening[index]) - task.radius_m - CLEARANCE_M
    return [
        (casadi.dot(forward, offset), 0.0, 0.0),
        (casadi.dot(left, offset), -free, free),
        (casadi.dot(up, offset), -free, free),
        (casadi.dot(forward, velocity), ACROSS_M_S, np.inf),
    ]


class Problem:
    """The program of a task and a model for given numbers of steps; solved again from other guesses.

    step: the model's step. needed: the places of the state vector that it depends on. counts: (num_gates,),
    steps of each segment. closure: as ``Guess.closure`` says, of a flying lap.
    """

    def __init__(
        self, task: Task, step: casadi.Function, needed: list[int], counts: np.ndarray, closure: float
    ):
        self.task, self.step, self.needed, self.counts, self.closure = task, step, needed, counts, closure
        self.num_steps, size = int(np.sum(counts)), len(needed)
        self.states = casadi.MX.sym("x", size, self.num_steps + 1)
        self.commands = casadi.MX.sym("u", ACTION_SIZE, self.num_steps)
        self.steps_s = casadi.MX.sym("d", 1, len(counts))
        self.fractions = casadi.MX.sym("f", 1, len(counts))
        self.short_step = self._short_step()
        self.limits = [*self._flight_limits(), *self._gates_limits()]
        self.variables = casadi.vertcat(
            *map(casadi.vec, (self.states, self.commands, self.steps_s, self.fractions))
        )

    def _short_step(self) -> casadi.Function:
        """Return the step on the needed places of the state alone."""
        short = casadi.SX.sym("x", len(self.needed))
        whole = casadi.SX.zeros(STATE_SIZE)
        whole[self.needed] = short
        command, dt = casadi.SX.sym("u", ACTION_SIZE), casadi.SX.sym("dt")
        after = self.step(whole, command, dt)[self.needed]
        return casadi.Function("short_step", [short, command, dt], [after])

    def rows(self, part: slice) -> list[int]:
        """Return where a part of the state vector stands among the needed places."""
        return [self.needed.index(place) for place in range(STATE_SIZE)[part]]

    def _flight_limits(self) -> Iterator[Limit]:
        """Yield that every node follows from the one before, and that a lap ends as it began."""
        lengths = [casadi.repmat(self.steps_s[i], 1, int(n)) for i, n in enumerate(self.counts)]
        stepped = self.short_step.map(self.num_steps)(
            self.states[:, :-1], self.commands, casadi.horzcat(*lengths)
        )
        yield self.states[:, 1:] - stepped, 0.0, 0.0
        if self.task.is_lap:
            last_step_s = self.fractions[-1] * self.steps_s[-1]
            end = self.short_step(self.states[:, -2], self.commands[:, -1], last_step_s)
            signs = np.ones(len(self.needed))
            signs[self.rows(QUATERNION)] = self.closure
            periodic = [row for row, place in enumerate(self.needed) if place != BATTERY]
            yield (self.states[:, 0] - signs * end)[periodic], 0.0, 0.0

    def _gates_limits(self) -> Iterator[Limit]:
        """Yield where and in which direction every gate is passed."""
        position, velocity = self.rows(POSITION), self.rows(VELOCITY)
        for index, node in enumerate(np.cumsum(self.counts)):
            before, after = self.states[:, int(node) - 1], self.states[:, int(node)]
            between = before + self.fractions[index] * (after - before)
            is_end_of_lap = self.task.is_lap and node == self.num_steps
            if is_end_of_lap:  # it ends where it begins, and that is on the plane
                between = after = self.states[:, 0]
            yield from _gate_limits(self.task, index, between[position], after[velocity])

    def total_time(self) -> Any:
        """Return the time to the last gate, s, as an expression."""
        whole = casadi.dot(self.steps_s, casadi.DM(self.counts).T)
        return whole - (1.0 - self.fractions[-1]) * self.steps_s[-1]

    def _cost(self) -> Any:
        changes = casadi.diff(self.commands, 1, 1)
        return self.total_time() + SMOOTHING_S * casadi.sumsqr(changes)

    def _bounds(self, guess: Guess, is_on_grid: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest values of the variables."""
        task, shape = self.task, (len(self.needed), self.num_steps + 1)
        low, high = np.full(shape, -np.inf), np.full(shape, np.inf)
        low[self.rows(POSITION)] = np.array(task.course.bounds_low, float)[:, None] + CLEARANCE_M
        high[self.rows(POSITION)] = np.array(task.course.bounds_high, float)[:, None] - CLEARANCE_M
        low[self.rows(QUATERNION)], high[self.rows(QUATERNION)] = -LOOSE_UNIT, LOOSE_UNIT
        is_given = [place == BATTERY or not task.is_lap for place in self.needed]
        low[is_given, 0] = high[is_given, 0] = task.start[np.array(self.needed)[is_given]]
        if is_on_grid:
            steps, fractions = (guess.steps_s,) * 2, (FRACTION_EDGE, 1.0 - FRACTION_EDGE)
        else:
            steps, fractions = (SHORTEST_SHARE * guess.steps_s, LONGEST_SHARE * guess.steps_s), (1.0, 1.0)

        def stacked(states: np.ndarray, stick: float, step: np.ndarray, fraction: float) -> np.ndarray:
            sticks, ends = np.full(ACTION_SIZE * self.num_steps, stick), np.full(len(self.counts), fraction)
            return np.concatenate([states.ravel("F"), sticks, step, ends])

        return stacked(low, -1.0, steps[0], fractions[0]), stacked(high, 1.0, steps[1], fractions[1])

    def solve(self, guess: Guess, is_on_grid: bool, options: dict[str, Any]) -> Solution:
        """Return what IPOPT finds from a guess: lengths of steps as in the guess, or free ones.

        is_on_grid: hold the lengths of the guess, and let gates be passed between nodes.
        """
        columns = [casadi.vec(expression) for expression, _, _ in self.limits]
        sizes = [column.numel() for column in columns]
        program = {"x": self.variables, "f": self._cost(), "g": casadi.vertcat(*columns)}
        solver = casadi.nlpsol("solver", "ipopt", program, options)
        low, high = self._bounds(guess, is_on_grid)
        start = np.concatenate(
            [guess.states[:, self.needed].ravel(), guess.commands.ravel(), guess.steps_s, guess.fractions]
        )
        arguments = {"x0": np.clip(start, low, high), "lbx": low, "ubx": high}
        arguments |= {"lbg": np.repeat([least for _, least, _ in self.limits], sizes)}
        arguments |= {"ubg": np.repeat([most for _, _, most in self.limits], sizes)}
        found = solver(**arguments)
        stats = solver.stats()
        return Solution(
            flight=self._unstack(found["x"].full()[:, 0]),
            status=stats["return_status"],
            is_solved=bool(stats["success"]),
            iterations=int(stats["iter_count"]),
        )

    def _unstack(self, values: np.ndarray) -> Guess:
        """Return the flight of the solver's variables, with the places of the state that it does not need."""
        sizes = [len(self.needed) * (self.num_steps + 1), ACTION_SIZE * self.num_steps, len(self.counts)]
        short, commands, steps_s, fractions = np.split(values, np.cumsum(sizes))
        states = np.zeros((self.num_steps + 1, STATE_SIZE))
        states[:, self.needed] = short.reshape(-1, len(self.needed))
        commands = commands.reshape(-1, ACTION_SIZE)
        lengths = np.repeat(steps_s, self.counts)
        others = [place for place in range(STATE_SIZE) if place not in self.needed]
        for index, (command, length) in enumerate(zip(commands, lengths, strict=True)):
            after = self.step(states[index], command, length).full()[:, 0]
            states[index + 1, others] = after[others]
        if self.task.is_lap:
            end = self.step(states[-2], commands[-1], fractions[-1] * steps_s[-1]).full()[:, 0]
            states[0, others] = end[others]
        else:
            states[0, others] = self.task.start[others]
        return Guess(states, commands, steps_s, fractions)
