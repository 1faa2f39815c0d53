"""From a task to its optimum: coarse from several starts, then fine, then on the simulator's own grid."""

import time
from typing import Any, NamedTuple

import numpy as np

from benchmarks.optimal.guess import FOLLOW, first_guess, resample, segment_lengths
from benchmarks.optimal.problem import FRACTION_EDGE, Guess, Problem, Solution, Task
from benchmarks.optimal.symbolic import needed_states, step_function
from flytrack_env.dynamics import ModelParameters

COARSE_STEP_M = 0.6  # of the way, per step
FEWEST_STEPS = 4  # of a coarse segment
QUARTER_TURN = 0.5 * np.pi
SPEEDS_M_S = (10.0, 16.0)  # of first guesses: gently round the course, and fast enough to be upside down
HEADINGS_RAD = (FOLLOW, 0.0, QUARTER_TURN / 2)  # of first guesses; four arms make quarter turns equal, nearly
MOST_SHIFTS = 8  # rounds in which gates move to a step before or after
NEAR_EDGE = 1e-3  # of a step: a gate this near to the end of its step's range may want another step
COARSE = {"ipopt.max_iter": 400, "ipopt.tol": 1e-5, "ipopt.acceptable_tol": 1e-4}
FINE = {"ipopt.max_iter": 400, "ipopt.tol": 1e-7, "ipopt.acceptable_tol": 1e-6}
WARM = {"ipopt.mu_init": 1e-3}  # a guess that is a solution but for the grid
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}


class UnsolvedError(RuntimeError):
    """No start led to an optimum; the message has the solver's words."""


class Optimum(NamedTuple):
    """The optimum: flight, steps of each segment, gate times, s, and how it was found."""

    flight: Guess
    counts: np.ndarray
    gate_times_s: np.ndarray
    found: dict[str, Any]


class _Search:
    """The stages of one search, which count iterations and say how they went."""

    def __init__(self, task: Task, model: ModelParameters, dt_s: float):
        self.task, self.dt_s = task, dt_s
        self.step = step_function(model)
        self.needed = needed_states(self.step)
        self.iterations = 0

    def solve(self, guess: Guess, counts: np.ndarray, is_on_grid: bool, options: dict[str, Any]) -> Solution:
        """Return the solution from a guess, for numbers of steps of each segment; counts iterations."""
        problem = Problem(self.task, self.step, self.needed, counts, guess.closure())
        found = problem.solve(guess, is_on_grid, QUIET | options)
        self.iterations += found.iterations
        return found

    def coarse(self) -> tuple[Guess, np.ndarray, list[float]]:
        """Return the best of all starts, its numbers of steps, and all starts' times, s, NaN if it failed."""
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
            raise UnsolvedError(f"{self.task.kind}: no start of {len(times)} converged")
        return best, counts, times

    def fine(self, flight: Guess, counts: np.ndarray) -> tuple[Solution, np.ndarray]:
        """Return the optimum with free segment times, steps of about ``dt_s``."""
        new_counts = np.round(counts * flight.steps_s / self.dt_s).astype(int)
        found = self.solve(resample(flight, counts, new_counts), new_counts, False, FINE)
        if not found.is_solved:
            raise UnsolvedError(f"{self.task.kind}: free segment times: {found.status}")
        return found, new_counts

    def on_grid(self, flight: Guess, counts: np.ndarray) -> tuple[Solution, np.ndarray]:
        """Return the optimum in steps of ``dt_s``, every gate passed within the step where it is best.

        Gates at an end of their step move to the next one, as long as that is new and can be solved.
        """
        nodes = np.ceil(flight.times(counts) / self.dt_s).astype(int)
        guess = _held(flight, counts, nodes, self.dt_s)
        seen: dict[tuple[int, ...], tuple[float, Solution, np.ndarray]] = {}
        while tuple(nodes) not in seen and len(seen) < MOST_SHIFTS:
            steps = np.diff(nodes, prepend=0)
            found = self.solve(guess, steps, True, FINE | WARM)
            if not found.is_solved:
                break
            seen[tuple(nodes)] = (float(found.flight.times(steps)[-1]), found, steps)
            shifts = _shifts(found.flight.fractions)
            nodes = nodes + shifts
            guess = _lengthened(found.flight, nodes[-1], shifts)
        if not seen:
            raise UnsolvedError(f"{self.task.kind}: steps of {self.dt_s} s: {found.status}")
        _, best, steps = min(seen.values(), key=lambda entry: entry[0])
        return best, steps


def _held(flight: Guess, counts: np.ndarray, nodes: np.ndarray, dt_s: float) -> Guess:
    """Return a flight of free segment times in steps of one length, which end segments at these nodes."""
    old = np.concatenate([[0.0], np.cumsum(np.repeat(flight.steps_s, counts))])
    new = dt_s * np.arange(nodes[-1] + 1)
    states = np.stack([np.interp(new, old, column) for column in flight.states.T], axis=1)
    held = np.clip(np.searchsorted(old, new[:-1] + 0.5 * dt_s, side="right") - 1, 0, len(flight.commands) - 1)
    fractions = flight.times(counts) / dt_s - (nodes - 1)
    return Guess(states, flight.commands[held], np.full(len(counts), dt_s), fractions)


def _shifts(fractions: np.ndarray) -> np.ndarray:
    """Return by how many steps each gate's step should move: those at an end of its range."""
    early = fractions < FRACTION_EDGE + NEAR_EDGE
    late = fractions > 1.0 - FRACTION_EDGE - NEAR_EDGE
    return late.astype(int) - early.astype(int)


def _lengthened(flight: Guess, num_steps: int, shifts: np.ndarray) -> Guess:
    """Return a flight with its last step repeated or left out, and gates at the other end of a moved step."""
    fractions = np.where(
        shifts > 0, FRACTION_EDGE, np.where(shifts < 0, 1.0 - FRACTION_EDGE, flight.fractions)
    )
    rows = np.minimum(np.arange(num_steps + 1), len(flight.states) - 1)
    commands = flight.commands[np.minimum(rows[:-1], len(flight.commands) - 1)]
    return Guess(flight.states[rows], commands, flight.steps_s, fractions)


def find_optimum(task: Task, model: ModelParameters, dt_s: float) -> Optimum:
    """Return the best time-optimal flight that is found, in steps of ``dt_s``.

    A local optimum, the best of several starts: nothing proves it to be the global one.

    Raises:
        UnsupportedModelError: a model that cannot be expressed. UnsolvedError: no optimum was found.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    search = _Search(task, model, dt_s)
    flight, counts, starts = search.coarse()
    free, counts = search.fine(flight, counts)
    held, counts_held = search.on_grid(free.flight, counts)
    gate_times = held.flight.times(counts_held)
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
    return Optimum(held.flight, counts_held, gate_times, found)
