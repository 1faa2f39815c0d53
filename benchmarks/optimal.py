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

import contextlib
import operator
import time
from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import casadi
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env import state as layout
from flytrack_env.dynamics import ModelParameters, advance
from flytrack_env.effects import effect_of
from flytrack_env.tracks import Course, sample_way

SENSOR = ("sensor",)  # stage of effects that do not change the flight
CLEARANCE_M = 2e-3  # kept from frames and bounds: float32 replays stray less
# s per squared change of a command: prevents chatter, costs less than a millisecond
SMOOTHING_S = 1e-6
ACROSS_M_S = 0.1  # m/s, least speed through a gate in its direction of flight
MIN_SHARE, MAX_SHARE = 0.2, 5.0  # of a free step's length, of its first guess
LOOSE_UNIT = 1.1  # bound of a component of a unit quaternion, which the step itself normalises
FRACTION_EDGE = 0.02  # of a step: rounding could put a node on a gate's plane on either side of it
PATH_POINTS = 400  # per segment
GRAVITY = np.array([0.0, 0.0, 9.80665])  # m/s^2, of first guesses, whatever the model's
UPSIDE_DOWN = 1e-6  # norm of a quaternion below which there is no shortest turn
COARSE_STEP_M = 0.6  # of the path, per step
MIN_STEPS = 4  # of a coarse segment
SPEEDS_M_S = (10.0, 16.0)  # of first guesses: gentle, and fast enough to turn upside down
# Of first guesses, None along the path; quarter turns are nearly equivalent.
HEADINGS_RAD = (None, 0.0, 0.25 * np.pi)
MAX_SHIFTS = 8  # rounds in which gates move to an adjacent step
NEAR_EDGE = 1e-3  # of a step: a gate this near to the end of its step's range is moved
COARSE = {"ipopt.max_iter": 400, "ipopt.tol": 1e-5, "ipopt.acceptable_tol": 1e-4}
FINE = {"ipopt.max_iter": 400, "ipopt.tol": 1e-7, "ipopt.acceptable_tol": 1e-6}
WARM = {"ipopt.mu_init": 1e-3}  # for a guess that is a solution on another grid
QUIET = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    "detect_simple_bounds": True,
}


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
        result = equation.primitive.bind(*values, **equation.params)
        return list(result) if equation.primitive.multiple_results else [result]
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

        scalars = np.zeros(layout.STATE_SIZE + layout.ACTION_SIZE + 1)
        trace = jax.make_jaxpr(leaves_after)(*scalars)
        sizes = {"state": layout.STATE_SIZE, "command": layout.ACTION_SIZE, "dt": 1}
        inputs = [casadi.SX.sym(name, size) for name, size in sizes.items()]
        arguments = casadi.vertsplit(casadi.vertcat(*inputs))
        after = casadi.vertcat(*_evaluate(trace.jaxpr, trace.consts, arguments))
    return casadi.Function("step", inputs, [after])


class Flight(NamedTuple):
    """A first guess or a solution; SI units.

    Attributes:
        states: (N + 1, 21).
        commands: (N, 4).
        steps_s: (num_gates,), length of a step of each segment.
        counts: (num_gates,), steps of each segment.
        fractions: (num_gates,), where in the last step of each segment its gate is passed.
    """

    states: np.ndarray
    commands: np.ndarray
    steps_s: np.ndarray
    counts: np.ndarray
    fractions: np.ndarray

    @property
    def gate_times_s(self) -> np.ndarray:
        """The time at which each gate is passed, (num_gates,)."""
        return np.cumsum(self.counts * self.steps_s) - (1.0 - self.fractions) * self.steps_s

    @property
    def node_times_s(self) -> np.ndarray:
        """The time of each state, (N + 1,)."""
        return np.concatenate([[0.0], np.cumsum(np.repeat(self.steps_s, self.counts))])

    def closure(self) -> float:
        """Return 1 if the last attitude's quaternion has the sign of the first, else -1.

        Both signs are the same attitude; the sign depends on whole turns, which a search does not
        change.
        """
        quats = self.states[:, layout.QUATERNION]
        return float(np.copysign(1.0, quats[0] @ quats[-1]))


class Solution(NamedTuple):
    """A result of the solver: flight, IPOPT's status, whether it is solved, iterations."""

    flight: Flight
    status: str
    is_solved: bool
    iterations: int


class Task(NamedTuple):
    """The task: kind "flying" or "standing", gates and bounds, drone radius, and first state.

    Attributes:
        start: (21,): where a standing start begins; of a flying lap only the battery voltage is
            taken.
    """

    kind: str
    course: Course
    radius_m: float
    start: np.ndarray

    @property
    def is_lap(self) -> bool:
        """Whether the flight is periodic."""
        return self.kind == "flying"


def solve(
    task: Task,
    step: casadi.Function,
    guess: Flight,
    is_on_grid: bool,
    options: dict[str, Any],
) -> Solution:
    """Solve the nonlinear program of a task by IPOPT, with a guess's numbers of steps.

    Args:
        task: gates, bounds and start.
        step: the model's step, of ``step_function``.
        guess: where the search starts.
        is_on_grid: hold the lengths of the guess's steps and let gates be passed between nodes;
            else lengths are free and gates are passed at nodes.
        options: of CasADi's interface to IPOPT.
    """
    opti, counts = casadi.Opti(), guess.counts
    num_steps = int(np.sum(counts))
    states = opti.variable(layout.STATE_SIZE, num_steps + 1)
    commands = opti.variable(layout.ACTION_SIZE, num_steps)
    if is_on_grid:
        steps_s, fractions = casadi.DM(guess.steps_s), opti.variable(len(counts))
        opti.subject_to(opti.bounded(FRACTION_EDGE, fractions, 1.0 - FRACTION_EDGE))
        opti.set_initial(fractions, np.clip(guess.fractions, FRACTION_EDGE, 1.0 - FRACTION_EDGE))
    else:
        steps_s, fractions = opti.variable(len(counts)), casadi.DM.ones(len(counts))
        shortest_s, longest_s = MIN_SHARE * guess.steps_s, MAX_SHARE * guess.steps_s
        opti.subject_to(opti.bounded(shortest_s, steps_s, longest_s))
        opti.set_initial(steps_s, guess.steps_s)
    opti.set_initial(states, guess.states.T)
    opti.set_initial(commands, guess.commands.T)

    # Every node follows from the one before, within the bounds, and a lap ends as it began.
    lengths = [casadi.repmat(steps_s[i], 1, int(count)) for i, count in enumerate(counts)]
    after = step.map(num_steps)(states[:, :-1], commands, casadi.horzcat(*lengths))
    opti.subject_to(states[:, 1:] == after)
    low, high = (
        np.array(corner, float) for corner in (task.course.bounds_low, task.course.bounds_high)
    )
    for axis, position in enumerate(casadi.vertsplit(states[layout.POSITION, :])):
        opti.subject_to(opti.bounded(low[axis] + CLEARANCE_M, position, high[axis] - CLEARANCE_M))
    opti.subject_to(opti.bounded(-LOOSE_UNIT, states[layout.QUATERNION, :], LOOSE_UNIT))
    opti.subject_to(opti.bounded(-1.0, commands, 1.0))
    if task.is_lap:
        signs = np.ones(layout.STATE_SIZE)
        signs[layout.QUATERNION] = guess.closure()
        end = signs * step(states[:, -2], commands[:, -1], fractions[-1] * steps_s[-1])
        periodic = [index for index in range(layout.STATE_SIZE) if index != layout.BATTERY]
        opti.subject_to(states[periodic, 0] == end[periodic])
        opti.subject_to(states[layout.BATTERY, 0] == task.start[layout.BATTERY])
    else:
        opti.subject_to(states[:, 0] == task.start)

    # Every gate is passed on its plane, within its opening, and in its direction of flight.
    gates = task.course.gates
    vectors = (gates.centre, gates.forward, gates.left(), gates.up)
    axes = zip(*(np.array(vector, float).T for vector in vectors), strict=True)
    half_openings = np.asarray(gates.half_opening) - task.radius_m - CLEARANCE_M
    for index, (node, (centre, forward, left, up)) in enumerate(
        zip(np.cumsum(counts).tolist(), axes, strict=True)
    ):
        before, after = states[:, node - 1], states[:, node]
        passing = before + fractions[index] * (after - before)
        if task.is_lap and node == num_steps:  # it ends where it begins, and that is on the plane
            passing = after = states[:, 0]
        offset, free = passing[layout.POSITION] - centre, float(half_openings[index])
        opti.subject_to(casadi.dot(forward, offset) == 0.0)
        opti.subject_to(opti.bounded(-free, casadi.dot(left, offset), free))
        opti.subject_to(opti.bounded(-free, casadi.dot(up, offset), free))
        opti.subject_to(casadi.dot(forward, after[layout.VELOCITY]) >= ACROSS_M_S)

    total_s = casadi.dot(steps_s, counts) - (1.0 - fractions[-1]) * steps_s[-1]
    opti.minimize(total_s + SMOOTHING_S * casadi.sumsqr(casadi.diff(commands, 1, 1)))
    opti.solver("ipopt", QUIET | options)
    with contextlib.suppress(RuntimeError):  # not solved: the statistics say so
        opti.solve()
    statistics, value = opti.stats(), opti.debug.value
    return Solution(
        Flight(
            states=value(states).T,
            commands=value(commands).T,
            steps_s=np.ravel(value(steps_s)),
            counts=counts,
            fractions=np.ravel(value(fractions)),
        ),
        status=statistics["return_status"],
        is_solved=bool(statistics["success"]),
        iterations=int(statistics["iter_count"]),
    )


def _paths(task: Task) -> np.ndarray:
    """Return points of the path to every gate, (num_gates, PATH_POINTS, 3), m."""
    ways = np.roll(sample_way(task.course, PATH_POINTS), 1, axis=0)
    if not task.is_lap:
        first_gate = np.array(task.course.gates.centre, float)[:, 0]
        ways[0] = np.linspace(task.start[layout.POSITION], first_gate, PATH_POINTS)
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
    x, y, z = (thrust_w / np.linalg.norm(thrust_w, axis=1, keepdims=True)).T
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    if heading_rad is not None:
        heading = np.full(len(x), heading_rad)
    # The shortest turn from the world's z to the axis, after a turn about z by the heading.
    tilt = np.stack([np.maximum(1.0 + z, UPSIDE_DOWN), -y, x, np.zeros(len(x))], axis=1)
    turn = Rotation.from_quat(tilt, scalar_first=True) * Rotation.from_euler("z", heading[:, None])
    quats = turn.as_quat(scalar_first=True)
    is_flipped = np.sum(quats[1:] * quats[:-1], axis=1) < 0.0
    quats[1:] *= np.cumprod(np.where(is_flipped, -1.0, 1.0))[:, None]
    return quats


def first_guess(
    task: Task, counts: np.ndarray, speed_m_s: float, heading_rad: float | None
) -> Flight:
    """Return a flight along the path at one speed, m/s, with a heading, rad, or along the path.

    The flight satisfies no equation of motion.

    Args:
        counts: (num_gates,), steps of each segment.
    """
    ways = _paths(task)
    steps_s = segment_lengths(task) / speed_m_s / counts
    pieces = [_along(way, np.arange(n) / n) for way, n in zip(ways, counts, strict=True)]
    positions = np.concatenate([*pieces, ways[-1][-1:]])
    states = np.zeros((len(positions), layout.STATE_SIZE))
    commands = np.zeros((len(positions) - 1, layout.ACTION_SIZE))
    guess = Flight(states, commands, steps_s, counts, np.ones(len(counts)))
    times = guess.node_times_s
    velocity = np.gradient(positions, times, axis=0)
    acceleration = np.gradient(velocity, times, axis=0)
    if task.is_lap:
        velocity[0] = velocity[-1] = 0.5 * (velocity[0] + velocity[-1])
    states[:, layout.POSITION], states[:, layout.VELOCITY] = positions, velocity
    states[:, layout.ACCELERATION] = acceleration
    states[:, layout.QUATERNION] = _attitudes(acceleration + GRAVITY, velocity, heading_rad)
    states[:, layout.BATTERY] = task.start[layout.BATTERY]
    if not task.is_lap:
        states[0] = task.start
        if states[0, layout.QUATERNION] @ states[1, layout.QUATERNION] < 0.0:
            states[1:, layout.QUATERNION] *= -1.0
    return guess


def resample(flight: Flight, counts: np.ndarray, steps_s: np.ndarray) -> Flight:
    """Return a flight resampled to other numbers and lengths of steps of each segment."""
    new = flight._replace(counts=counts, steps_s=steps_s)
    old_s, new_s = flight.node_times_s, new.node_times_s
    states = np.stack([np.interp(new_s, old_s, column) for column in flight.states.T], axis=1)
    quats = states[:, layout.QUATERNION]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    middles_s = 0.5 * (new_s[:-1] + new_s[1:])
    held = np.searchsorted(old_s, middles_s, side="right") - 1
    return new._replace(states=states, commands=flight.commands.take(held, axis=0, mode="clip"))


Solve = Callable[[Flight, bool, dict[str, Any]], Solution]  # guess, whether on grid, options


def _solve_coarsely(task: Task, solve_from: Solve) -> tuple[Flight, list[float]]:
    """Return the best of all starts, and all times, s (NaN if failed)."""
    counts = np.round(segment_lengths(task) / COARSE_STEP_M).astype(int)
    counts = np.maximum(counts, MIN_STEPS)
    guesses = [
        first_guess(task, counts, speed, heading)
        for speed, heading in product(SPEEDS_M_S, HEADINGS_RAD)
    ]
    solutions = [solve_from(guess, False, COARSE) for guess in guesses]
    times_s = [one.flight.gate_times_s[-1] if one.is_solved else np.nan for one in solutions]
    if np.isnan(times_s).all():
        raise RuntimeError(f"{task.kind}: no start of {len(times_s)} converged")
    return solutions[int(np.nanargmin(times_s))].flight, times_s


def _solve_finely(flight: Flight, dt_s: float, solve_from: Solve) -> Flight:
    """Return the optimum with free segment times, steps of about ``dt_s``."""
    durations_s = flight.counts * flight.steps_s
    counts = np.round(durations_s / dt_s).astype(int)
    solution = solve_from(resample(flight, counts, durations_s / counts), False, FINE)
    if not solution.is_solved:
        raise RuntimeError(f"free segment times: {solution.status}")
    return solution.flight


def _solve_on_grid(flight: Flight, dt_s: float, solve_from: Solve) -> Solution:
    """Return the optimum in steps of ``dt_s``, each gate within the step where it is best.

    Gates at an end of their step move to the next one, as long as that is new and can be solved.
    """
    steps = flight.gate_times_s / dt_s
    nodes = np.ceil(steps).astype(int)
    guess = resample(flight, np.diff(nodes, prepend=0), np.full(len(nodes), dt_s))
    guess = guess._replace(fractions=steps - (nodes - 1))
    solutions: dict[tuple[int, ...], Solution] = {}
    while tuple(nodes) not in solutions and len(solutions) < MAX_SHIFTS:
        solution = solve_from(guess, True, FINE | WARM)
        if not solution.is_solved:
            break
        solutions[tuple(nodes)] = solution
        fractions = solution.flight.fractions
        is_early = fractions < FRACTION_EDGE + NEAR_EDGE
        is_late = fractions > 1.0 - FRACTION_EDGE - NEAR_EDGE
        nodes = nodes + is_late - is_early
        guess = _moved(solution.flight, nodes)
    if not solutions:
        raise RuntimeError(f"steps of {dt_s} s: {solution.status}")
    return min(solutions.values(), key=lambda one: one.flight.gate_times_s[-1])


def _moved(flight: Flight, nodes: np.ndarray) -> Flight:
    """Return a flight with gates passed before other nodes, (num_gates,).

    Moved gates are at the other end of their step. The last step is repeated or dropped.
    """
    shifts = nodes - np.cumsum(flight.counts)
    ends = [FRACTION_EDGE, 1.0 - FRACTION_EDGE]
    rows = np.arange(nodes[-1] + 1)
    return flight._replace(
        states=flight.states.take(rows, axis=0, mode="clip"),
        commands=flight.commands.take(rows[:-1], axis=0, mode="clip"),
        counts=np.diff(nodes, prepend=0),
        fractions=np.select([shifts > 0, shifts < 0], ends, flight.fractions),
    )


def find_optimum(task: Task, model: ModelParameters, dt_s: float) -> tuple[Flight, dict[str, Any]]:
    """Return the best time-optimal flight in steps of ``dt_s``, and how it was found.

    It is a local optimum, the best of several starts.

    Raises:
        ValueError: a model that cannot be expressed.
        RuntimeError: no optimum was found.
    """
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    step, iterations = step_function(model), []

    def solve_from(guess: Flight, is_on_grid: bool, options: dict[str, Any]) -> Solution:
        solution = solve(task, step, guess, is_on_grid, options)
        iterations.append(solution.iterations)
        return solution

    flight, coarse_times_s = _solve_coarsely(task, solve_from)
    free = _solve_finely(flight, dt_s, solve_from)
    optimum = _solve_on_grid(free, dt_s, solve_from)
    return optimum.flight, {
        "solver": "IPOPT",
        "status": optimum.status,
        "iterations": sum(iterations),
        "cpu_s": round(time.process_time() - cpu_s, 1),
        "wall_s": round(time.perf_counter() - wall_s, 1),
        "coarse_times_s": [
            None if np.isnan(time_s) else round(time_s, 4) for time_s in coarse_times_s
        ],
        "free_time_s": float(free.gate_times_s[-1]),
        "gate_fractions": optimum.flight.fractions.tolist(),
    }
