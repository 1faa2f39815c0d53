"""The time-optimal flight as a nonlinear program: multiple shooting over the simulator's own step.

A flight is cut into segments, one per gate, that end with the step in which the gate is passed.
Every segment has a whole number of steps of one length, and the point of passing lies on the
straight line from the last node but one to the last, as ``flytrack_env.race`` has it: at a fraction
of that step. With fractions held at 1 and free lengths, segments have free times; with lengths held
at 0.01 s and free fractions, the flight is one of the simulator at 100 Hz, exactly.

There is no second copy of the physics: ``flytrack_env.dynamics.advance`` is traced by JAX for one
drone of scalars and one model, and every operation of the trace is carried out on CasADi symbols,
including those of all effects.

From a task to its optimum: coarse from several starts, then fine, then on the simulator's own grid.
"""

import dataclasses
import operator
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import casadi
import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env import state as layout
from flytrack_env.dynamics import ModelParameters, advance
from flytrack_env.effects import effect_of
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.tracks import Course, hermite_curve, sample_way

SENSOR = ("sensor",)  # stage of effects that do not change the flight
CLEARANCE_M = 2e-3  # kept from frames and bounds: float32 replays stray less
# s per squared change of a command: prevents chatter, costs less than a millisecond
SMOOTHING_S = 1e-6
ACROSS_M_S = 0.1  # m/s, least speed through a gate in its direction of flight
SHORTEST_SHARE, LONGEST_SHARE = 0.2, 5.0  # of a free step's length, of its first guess
LOOSE_UNIT = 1.1  # bound of a component of a unit quaternion, which the step itself normalises
FRACTION_EDGE = 0.02  # of a step: rounding could put a node on a gate's plane on either side of it
PATH_POINTS = 400  # per segment
GRAVITY = np.array([0.0, 0.0, 9.80665])  # m/s^2, of first guesses, whatever the model's
FOLLOW = None  # heading along the path
UPSIDE_DOWN = 1e-6  # norm of a quaternion below which there is no shortest turn
COARSE_STEP_M = 0.6  # of the path, per step
FEWEST_STEPS = 4  # of a coarse segment
QUARTER_TURN = 0.5 * np.pi
SPEEDS_M_S = (10.0, 16.0)  # of first guesses: gentle, and fast enough to turn upside down
HEADINGS_RAD = (
    FOLLOW,
    0.0,
    QUARTER_TURN / 2,
)  # of first guesses; quarter turns are nearly equivalent
MOST_SHIFTS = 8  # rounds in which gates move to an adjacent step
NEAR_EDGE = 1e-3  # of a step: a gate this near to the end of its step's range is moved
COARSE = {"ipopt.max_iter": 400, "ipopt.tol": 1e-5, "ipopt.acceptable_tol": 1e-4}
FINE = {"ipopt.max_iter": 400, "ipopt.tol": 1e-7, "ipopt.acceptable_tol": 1e-6}
WARM = {"ipopt.mu_init": 1e-3}  # for a guess that is a solution on another grid
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}


# Those that operator and CasADi call the same, and those that do nothing to scalars.
OWN_NAMES = {
    operator: ("add", "sub", "mul", "neg", "pow", "lt", "le", "gt", "ge", "eq"),
    casadi: ("exp", "log", "sqrt", "sin", "cos", "tanh", "sign", "floor"),
}
NEUTRAL = (
    "convert_element_type",
    "broadcast_in_dim",
    "reshape",
    "squeeze",
    "copy",
    "stop_gradient",
)
OPERATIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(module, name) for module, names in OWN_NAMES.items() for name in names},
    **dict.fromkeys(NEUTRAL, lambda value: value),
    "add_any": operator.add,
    "div": operator.truediv,
    "square": lambda value: value * value,
    "abs": casadi.fabs,
    "max": casadi.fmax,
    "min": casadi.fmin,
    "and": casadi.logic_and,
    "or": casadi.logic_or,
    "not": casadi.logic_not,
    "select_n": lambda which, off, on: casadi.if_else(which, on, off),
}


def _apply(equation: Any, values: list[Any]) -> list[Any]:
    """Return the outputs of one operation of a trace; numbers stay numbers."""
    inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
    if inner is not None:
        return _evaluate(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), values)
    name = equation.primitive.name
    if name == "flytrack_compute_once":
        return values
    if not any(isinstance(value, casadi.SX) for value in values):
        found = equation.primitive.bind(*values, **equation.params)
        return list(found) if equation.primitive.multiple_results else [found]
    if any(not isinstance(value, casadi.SX) and np.size(value) != 1 for value in values):
        raise ValueError(f"model: operation {name} on an array, expected scalars")
    values = [value if isinstance(value, casadi.SX) else float(value) for value in values]
    if name == "integer_pow":
        return [values[0] ** equation.params["y"]]
    if name not in OPERATIONS:
        raise ValueError(f"model: operation {name}: expected one of {', '.join(OPERATIONS)}")
    return [OPERATIONS[name](*values)]


def _evaluate(jaxpr: Any, constants: Any, arguments: list[Any]) -> list[Any]:
    """Return the outputs of a trace for CasADi symbols or numbers."""
    known = dict(zip(jaxpr.constvars, constants, strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))

    def value_of(atom: Any) -> Any:
        return atom.val if hasattr(atom, "val") else known[atom]

    for equation in jaxpr.eqns:
        outputs = _apply(equation, [value_of(atom) for atom in equation.invars])
        known.update(zip(equation.outvars, outputs, strict=True))
    return [value_of(atom) for atom in jaxpr.outvars]


def step_function(model: ModelParameters) -> casadi.Function:
    """Return the model's step in float64, (21,), (4,), s -> (21,).

    States are packed as ``flytrack_env.state`` says.

    Raises:
        ValueError: an effect with a memory, or an operation that has no counterpart in CasADi.
    """
    effects = tuple(effect for effect in model.effects if effect_of(effect).acts_on != SENSOR)
    for effect in map(effect_of, effects):
        if effect.memory is not None:  # it has no place in the state vector
            raise ValueError(f"model: effect {effect.name}: found one with a memory, expected none")
    with jax.enable_x64(True):
        model = jax.tree.map(lambda leaf: np.asarray(leaf, float), model._replace(effects=effects))
        structure = jax.tree.structure(layout.unpack(jnp.zeros(layout.STATE_SIZE)))

        def leaves_after(*leaves: Any) -> list[Any]:
            drone: layout.Drone = jax.tree.unflatten(structure, leaves[: layout.STATE_SIZE])
            command = layout.Action(*leaves[layout.STATE_SIZE : -1])
            memories = (None,) * len(effects)
            return jax.tree.leaves(advance(drone, memories, command, leaves[-1], model)[0])

        scalar = jax.ShapeDtypeStruct((), np.float64)
        trace = jax.make_jaxpr(leaves_after)(
            *[scalar] * (layout.STATE_SIZE + layout.ACTION_SIZE + 1)
        )
        state, command = (
            casadi.SX.sym("x", layout.STATE_SIZE),
            casadi.SX.sym("u", layout.ACTION_SIZE),
        )
        dt = casadi.SX.sym("dt")
        arguments = [*casadi.vertsplit(state), *casadi.vertsplit(command), dt]
        after = casadi.vertcat(*_evaluate(trace.jaxpr, trace.consts, arguments))
    return casadi.Function("step", [state, command, dt], [after])


def needed_states(step: casadi.Function) -> list[int]:
    """Return the indices of the state vector on which a path depends, directly or indirectly."""
    depends = np.array(casadi.DM(step.jac_sparsity(0, 0), 1).full(), bool) | np.eye(
        layout.STATE_SIZE, dtype=bool
    )
    reached = np.linalg.matrix_power(depends, layout.STATE_SIZE)
    return [int(place) for place in np.flatnonzero(reached[layout.POSITION].any(axis=0))]


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

        Both signs are the same attitude; the sign depends on whole turns, which a search does not
        change.
        """
        return (
            1.0
            if self.states[0, layout.QUATERNION] @ self.states[-1, layout.QUATERNION] > 0.0
            else -1.0
        )


class Solution(NamedTuple):
    """A result of the solver: flight, IPOPT's status, whether it is solved, iterations."""

    flight: Guess
    status: str
    is_solved: bool
    iterations: int


@dataclasses.dataclass(frozen=True)
class Task:
    """The task: kind "flying" or "standing", gates and bounds, drone radius, and first state.

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
    """Return the limits of a gate: on its plane, within its opening, flown in its direction.

    The drone's radius and a clearance are taken off the opening.
    """
    gates = task.course.gates
    vectors = (gates.centre, gates.forward, gates.left(), gates.up)
    centre, forward, left, up = (np.array(axes, float)[:, index] for axes in vectors)
    offset = point - centre
    free = float(np.asarray(gates.half_opening)[index]) - task.radius_m - CLEARANCE_M
    return [
        (casadi.dot(forward, offset), 0.0, 0.0),
        (casadi.dot(left, offset), -free, free),
        (casadi.dot(up, offset), -free, free),
        (casadi.dot(forward, velocity), ACROSS_M_S, np.inf),
    ]


class Problem:
    """The program of a task and model for given numbers of steps; solved again from new guesses.

    step: the model's step. needed: the places of the state vector that it depends on. counts:
    (num_gates,), steps of each segment. closure: as ``Guess.closure`` says, of a flying lap.
    """

    def __init__(
        self,
        task: Task,
        step: casadi.Function,
        needed: list[int],
        counts: np.ndarray,
        closure: float,
    ):
        self.task, self.step, self.needed, self.counts, self.closure = (
            task,
            step,
            needed,
            counts,
            closure,
        )
        self.num_steps, size = int(np.sum(counts)), len(needed)
        self.states = casadi.MX.sym("x", size, self.num_steps + 1)
        self.commands = casadi.MX.sym("u", layout.ACTION_SIZE, self.num_steps)
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
        whole = casadi.SX.zeros(layout.STATE_SIZE)
        whole[self.needed] = short
        command, dt = casadi.SX.sym("u", layout.ACTION_SIZE), casadi.SX.sym("dt")
        after = self.step(whole, command, dt)[self.needed]
        return casadi.Function("short_step", [short, command, dt], [after])

    def rows(self, part: slice) -> list[int]:
        """Return where a part of the state vector stands among the needed places."""
        return [self.needed.index(place) for place in range(layout.STATE_SIZE)[part]]

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
            signs[self.rows(layout.QUATERNION)] = self.closure
            periodic = [row for row, place in enumerate(self.needed) if place != layout.BATTERY]
            yield (self.states[:, 0] - signs * end)[periodic], 0.0, 0.0

    def _gates_limits(self) -> Iterator[Limit]:
        """Yield where and in which direction every gate is passed."""
        position, velocity = self.rows(layout.POSITION), self.rows(layout.VELOCITY)
        for index, node in enumerate(np.cumsum(self.counts)):
            before, after = self.states[:, int(node) - 1], self.states[:, int(node)]
            between = before + self.fractions[index] * (after - before)
            is_end_of_lap = self.task.is_lap and node == self.num_steps
            if is_end_of_lap:  # it ends where it begins, and that is on the plane
                between = after = self.states[:, 0]
            yield from _gate_limits(self.task, index, between[position], after[velocity])

    def _cost(self) -> Any:
        """Return the cost: time to the last gate, s, and a penalty on changes of the commands."""
        whole_s = casadi.dot(self.steps_s, casadi.DM(self.counts).T)
        total_s = whole_s - (1.0 - self.fractions[-1]) * self.steps_s[-1]
        return total_s + SMOOTHING_S * casadi.sumsqr(casadi.diff(self.commands, 1, 1))

    def _bounds(self, guess: Guess, is_on_grid: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest values of the variables."""
        task, shape = self.task, (len(self.needed), self.num_steps + 1)
        low, high = np.full(shape, -np.inf), np.full(shape, np.inf)
        low[self.rows(layout.POSITION)] = (
            np.array(task.course.bounds_low, float)[:, None] + CLEARANCE_M
        )
        high[self.rows(layout.POSITION)] = (
            np.array(task.course.bounds_high, float)[:, None] - CLEARANCE_M
        )
        low[self.rows(layout.QUATERNION)], high[self.rows(layout.QUATERNION)] = (
            -LOOSE_UNIT,
            LOOSE_UNIT,
        )
        is_given = [place == layout.BATTERY or not task.is_lap for place in self.needed]
        low[is_given, 0] = high[is_given, 0] = task.start[np.array(self.needed)[is_given]]
        if is_on_grid:
            steps, fractions = (guess.steps_s,) * 2, (FRACTION_EDGE, 1.0 - FRACTION_EDGE)
        else:
            steps, fractions = (
                (SHORTEST_SHARE * guess.steps_s, LONGEST_SHARE * guess.steps_s),
                (1.0, 1.0),
            )

        def stacked(
            states: np.ndarray, stick: float, step: np.ndarray, fraction: float
        ) -> np.ndarray:
            sticks = np.full(layout.ACTION_SIZE * self.num_steps, stick)
            return np.concatenate(
                [states.ravel("F"), sticks, step, np.full(len(self.counts), fraction)]
            )

        return stacked(low, -1.0, steps[0], fractions[0]), stacked(
            high, 1.0, steps[1], fractions[1]
        )

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
            [
                guess.states[:, self.needed].ravel(),
                guess.commands.ravel(),
                guess.steps_s,
                guess.fractions,
            ]
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
        """Return the flight of the solver's variables, with all entries of the state."""
        variables = (self.states, self.commands, self.steps_s)
        ends = np.cumsum([variable.numel() for variable in variables])
        short, commands, steps_s, fractions = np.split(values, ends)
        states = np.zeros((self.num_steps + 1, layout.STATE_SIZE))
        states[:, self.needed] = short.reshape(-1, len(self.needed))
        commands = commands.reshape(-1, layout.ACTION_SIZE)
        lengths = np.repeat(steps_s, self.counts)
        others = [place for place in range(layout.STATE_SIZE) if place not in self.needed]
        for index, (command, length) in enumerate(zip(commands, lengths, strict=True)):
            after = self.step(states[index], command, length).full()[:, 0]
            states[index + 1, others] = after[others]
        if self.task.is_lap:
            end = self.step(states[-2], commands[-1], fractions[-1] * steps_s[-1]).full()[:, 0]
            states[0, others] = end[others]
        else:
            states[0, others] = self.task.start[others]
        return Guess(states, commands, steps_s, fractions)


class Optimum(NamedTuple):
    """The optimum: flight, gate times, s, and how it was found."""

    flight: Guess
    gate_times_s: np.ndarray
    found: dict[str, Any]


def _paths(task: Task) -> np.ndarray:
    """Return points of the path to every gate, (num_gates, PATH_POINTS, 3), m."""
    ways = np.roll(sample_way(task.course, PATH_POINTS), 1, axis=0)
    if not task.is_lap:
        gates, position = task.course.gates, task.start[layout.POSITION]
        centre, forward = (np.array(axes, float)[:, 0] for axes in (gates.centre, gates.forward))
        chord = centre - position
        length = np.linalg.norm(chord)
        s = np.linspace(0.0, 1.0, PATH_POINTS)
        ends = (position, chord, centre, forward * length)
        start, leave, end, meet = (Vec3(*vector) for vector in ends)
        ways[0] = np.stack(hermite_curve(start, leave, end, meet, s)[0], axis=-1)
    return ways


def segment_lengths(task: Task) -> np.ndarray:
    """Return the path's length to every gate from the one before or the start, (num_gates,), m."""
    return np.linalg.norm(np.diff(_paths(task), axis=1), axis=-1).sum(axis=1)


def _along(points: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return points at shares of the length of a polyline."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.stack([np.interp(shares * lengths[-1], lengths, axis) for axis in points.T], axis=1)


def _attitudes(thrust_w: np.ndarray, velocity: np.ndarray, heading_rad: float | None) -> np.ndarray:
    """Return attitudes (N, 4) with body z along thrust_w and a heading, without jumps in sign."""
    quats: list[np.ndarray] = []
    for force, speed in zip(thrust_w, velocity, strict=True):
        axis = force / np.linalg.norm(force)
        # The shortest turn from the world's z to the axis, after a turn about z by the heading.
        tilt = np.array([1.0 + axis[2], -axis[1], axis[0], 0.0])
        tilt = tilt / max(np.linalg.norm(tilt), UPSIDE_DOWN)
        half = 0.5 * (np.arctan2(speed[1], speed[0]) if heading_rad is None else heading_rad)
        turn = Quaternion(np.cos(half), 0.0, 0.0, np.sin(half))
        quat = np.array(Quaternion(*tilt).multiply(turn))
        quats.append(-quat if quats and quat @ quats[-1] < 0.0 else quat)
    return np.array(quats)


def first_guess(
    task: Task, counts: np.ndarray, speed_m_s: float, heading_rad: float | None
) -> Guess:
    """Return a flight along the path at one speed, m/s, with a heading, rad, or along the path.

    counts: (num_gates,), steps of each segment. The flight satisfies no equation of motion.
    """
    ways = _paths(task)
    steps_s = segment_lengths(task) / speed_m_s / counts
    pieces = [_along(way, np.arange(n) / n) for way, n in zip(ways, counts, strict=True)]
    positions = np.concatenate([*pieces, ways[-1][-1:]])
    times = np.concatenate([[0.0], np.cumsum(np.repeat(steps_s, counts))])
    velocity = np.gradient(positions, times, axis=0)
    acceleration = np.gradient(velocity, times, axis=0)
    if task.is_lap:
        velocity[0] = velocity[-1] = 0.5 * (velocity[0] + velocity[-1])
    states = np.zeros((len(times), layout.STATE_SIZE))
    states[:, layout.POSITION], states[:, layout.VELOCITY] = positions, velocity
    states[:, layout.ACCELERATION] = acceleration
    states[:, layout.QUATERNION] = _attitudes(acceleration + GRAVITY, velocity, heading_rad)
    states[:, layout.BATTERY] = task.start[layout.BATTERY]
    if not task.is_lap:
        states[0] = task.start
        if states[0, layout.QUATERNION] @ states[1, layout.QUATERNION] < 0.0:
            states[1:, layout.QUATERNION] *= -1.0
    states[1:, layout.APPLIED_ACTION] = 0.0
    commands = np.zeros((len(times) - 1, layout.ACTION_SIZE))
    return Guess(states, commands, steps_s, np.ones(len(counts)))


def resample(
    flight: Guess, counts: np.ndarray, new_counts: np.ndarray, steps_s: np.ndarray
) -> Guess:
    """Return a flight resampled to other numbers and lengths of steps of each segment."""
    old = np.concatenate([[0.0], np.cumsum(np.repeat(flight.steps_s, counts))])
    new = np.concatenate([[0.0], np.cumsum(np.repeat(steps_s, new_counts))])
    states = np.stack([np.interp(new, old, column) for column in flight.states.T], axis=1)
    states[:, layout.QUATERNION] /= np.linalg.norm(
        states[:, layout.QUATERNION], axis=1, keepdims=True
    )
    middles = 0.5 * (new[:-1] + new[1:])
    held = np.clip(np.searchsorted(old, middles, side="right") - 1, 0, len(flight.commands) - 1)
    return Guess(states, flight.commands[held], steps_s, flight.fractions)


class _Search:
    """The stages of one search; counts iterations."""

    def __init__(self, task: Task, model: ModelParameters, dt_s: float):
        self.task, self.dt_s = task, dt_s
        self.step = step_function(model)
        self.needed = needed_states(self.step)
        self.iterations = 0

    def solve(
        self, guess: Guess, counts: np.ndarray, is_on_grid: bool, options: dict[str, Any]
    ) -> Solution:
        """Return the solution from a guess for numbers of steps by segment; count iterations."""
        problem = Problem(self.task, self.step, self.needed, counts, guess.closure())
        found = problem.solve(guess, is_on_grid, QUIET | options)
        self.iterations += found.iterations
        return found

    def coarse(self) -> tuple[Guess, np.ndarray, list[float]]:
        """Return the best of all starts, its numbers of steps, and all times, s (NaN if failed)."""
        counts = np.round(segment_lengths(self.task) / COARSE_STEP_M).astype(int)
        counts = np.maximum(counts, FEWEST_STEPS)
        best, times = None, []
        for speed in SPEEDS_M_S:
            for heading in HEADINGS_RAD:
                guess = first_guess(self.task, counts, speed, heading)
                found = self.solve(guess, counts, False, COARSE)
                times.append(float(found.flight.times(counts)[-1]) if found.is_solved else np.nan)
                if found.is_solved and times[-1] <= np.nanmin(times):
                    best = found.flight
        if best is None:
            raise RuntimeError(f"{self.task.kind}: no start of {len(times)} converged")
        return best, counts, times

    def fine(self, flight: Guess, counts: np.ndarray) -> tuple[Solution, np.ndarray]:
        """Return the optimum with free segment times, steps of about ``dt_s``."""
        new_counts = np.round(counts * flight.steps_s / self.dt_s).astype(int)
        guess = resample(flight, counts, new_counts, flight.steps_s * counts / new_counts)
        found = self.solve(guess, new_counts, False, FINE)
        if not found.is_solved:
            raise RuntimeError(f"{self.task.kind}: free segment times: {found.status}")
        return found, new_counts

    def on_grid(self, flight: Guess, counts: np.ndarray) -> tuple[Solution, np.ndarray]:
        """Return the optimum in steps of ``dt_s``, each gate within the step where it is best.

        Gates at an end of their step move to the next one, as long as that is new and can be
        solved.
        """
        nodes = np.ceil(flight.times(counts) / self.dt_s).astype(int)
        guess = resample(flight, counts, np.diff(nodes, prepend=0), np.full(len(nodes), self.dt_s))
        guess = guess._replace(fractions=flight.times(counts) / self.dt_s - (nodes - 1))
        seen: dict[tuple[int, ...], tuple[float, Solution, np.ndarray]] = {}
        while tuple(nodes) not in seen and len(seen) < MOST_SHIFTS:
            steps = np.diff(nodes, prepend=0)
            found = self.solve(guess, steps, True, FINE | WARM)
            if not found.is_solved:
                break
            seen[tuple(nodes)] = (float(found.flight.times(steps)[-1]), found, steps)
            early = found.flight.fractions < FRACTION_EDGE + NEAR_EDGE
            late = found.flight.fractions > 1.0 - FRACTION_EDGE - NEAR_EDGE
            shifts = late.astype(int) - early.astype(int)
            nodes = nodes + shifts
            guess = _lengthened(found.flight, nodes[-1], shifts)
        if not seen:
            raise RuntimeError(f"{self.task.kind}: steps of {self.dt_s} s: {found.status}")
        _, best, steps = min(seen.values(), key=lambda entry: entry[0])
        return best, steps


def _lengthened(flight: Guess, num_steps: int, shifts: np.ndarray) -> Guess:
    """Return a flight of ``num_steps``, with moved gates at the other end of a step.

    Its last step is repeated or dropped.
    """
    ends = [FRACTION_EDGE, 1.0 - FRACTION_EDGE]
    fractions = np.select([shifts > 0, shifts < 0], ends, flight.fractions)
    rows = np.minimum(np.arange(num_steps + 1), len(flight.states) - 1)
    commands = flight.commands[np.minimum(rows[:-1], len(flight.commands) - 1)]
    return Guess(flight.states[rows], commands, flight.steps_s, fractions)


def find_optimum(task: Task, model: ModelParameters, dt_s: float) -> Optimum:
    """Return the best time-optimal flight that is found, in steps of ``dt_s``.

    It is a local optimum, the best of several starts.

    Raises:
        ValueError: a model that cannot be expressed. RuntimeError: no optimum was found.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    search = _Search(task, model, dt_s)
    flight, counts, starts = search.coarse()
    free, counts = search.fine(flight, counts)
    held, counts_held = search.on_grid(free.flight, counts)
    found = {
        "solver": "IPOPT",
        "status": held.status,
        "iterations": search.iterations,
        "cpu_s": round(time.process_time() - cpu, 1),
        "wall_s": round(time.perf_counter() - wall, 1),
        "coarse_times_s": [None if np.isnan(seconds) else round(seconds, 4) for seconds in starts],
        "free_time_s": float(free.flight.times(counts)[-1]),
        "gate_fractions": held.flight.fractions.tolist(),
    }
    return Optimum(held.flight, held.flight.times(counts_held), found)
