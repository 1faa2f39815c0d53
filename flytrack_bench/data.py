"""Data that a policy may be adapted with: flights on a plant, and no more seconds of them than allowed."""

import numpy as np

from baselines.purejaxrl_ppo.flights import fly_many
from flytrack_bench.policies import Policy
from flytrack_bench.suite import Suite, Task
from flytrack_loop.flight_log import BATCH, log_of_flights
from flytrack_sysid import FlightLog

NOISE = 1.0  # of common sensors
LONGEST_S = 25.0  # of one flight


class DataError(ValueError):
    """More data than a regime allows."""


class Data:
    """Flights on a task's plant, as common sensors log them; seconds_left counts down.

    task: what will be flown. Its plant is hidden: an honest entry looks at the logs alone.
    """

    def __init__(self, task: Task, suite: Suite, seconds: float):
        """seconds: of flight that may be logged in all."""
        self.task, self.seconds_left, self._seed = task, seconds, suite.seed

    def fly(self, policy: Policy, seconds: float) -> FlightLog:
        """Return the log of a policy's flights on the plant, from perturbed starts.

        Raises:
            DataError: more seconds than are left. ValueError: a policy that crashes at once.
        """
        if seconds > self.seconds_left + 1e-9:
            raise DataError(f"seconds: found {seconds:g}, expected at most the {self.seconds_left:g} s left")
        self.seconds_left -= seconds
        self._seed += 1
        env = policy.env(self.task.plant, self.task.track)
        step_s = float(env.default_params.dt)
        steps = round(min(seconds, LONGEST_S) / step_s)
        flights = fly_many(env, policy.network, policy.params, self._seed, BATCH, steps, num_laps=steps)
        log = log_of_flights(flights, step_s, self._seed, seconds, NOISE)
        return log.select(np.arange(len(log)) < round(seconds / step_s))
