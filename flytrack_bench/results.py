"""Run a suite: fly every task, adapt the policy if asked, and collect the result file."""

import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
from scipy import stats

from baselines.purejaxrl_ppo.checkpoint_env import with_model_as_given
from baselines.purejaxrl_ppo.flights import Outcomes, fly_many, race_many, score, start_keys
from baselines.purejaxrl_ppo.networks import Policy as NetworkPolicy
from flytrack_bench.policies import Policy
from flytrack_bench.suite import Suite, Task
from flytrack_loop.stages import BATCH, log_of_flights, rounded
from flytrack_sysid import FlightLog

SCHEMA = 1
DRAWS, COVERED = 2000, 0.95  # of the bootstrap
QUARTER = 0.25
# By which a result may differ on another machine: share of starts, share of a lap time.
SAME_SUCCESS, SAME_LAP = 0.02, 0.005
NOISE = 1.0  # of common sensors
MAX_S = 25.0  # of one flight
MAX_LAPS = 25  # of one flight: a lap takes more than a second
Report = Callable[[int, int], None]


class DataError(ValueError):
    """More data than a regime allows."""


class Data:
    """Flights on a task's plant, as common sensors log them.

    Attributes:
        task: what will be flown. Its plant is hidden: an honest entry looks at the logs alone.
        seconds_left: of flight that may still be logged; it counts down.
    """

    def __init__(self, task: Task, suite: Suite, seconds: float):
        """Begin with the seconds of flight that may be logged in all."""
        self.task, self.seconds_left, self._seed = task, seconds, suite.seed

    def fly(self, policy: Policy, seconds: float) -> FlightLog:
        """Return the log of a policy's flights on the plant, from perturbed starts.

        Raises:
            DataError: more seconds than are left.
            ValueError: a policy that crashes at once.
        """
        if seconds > self.seconds_left + 1e-9:
            raise DataError(
                f"seconds: found {seconds:g}, expected at most the {self.seconds_left:g} s left"
            )
        self.seconds_left -= seconds
        self._seed += 1
        env = policy.env(self.task.plant, self.task.track)
        step_s = float(env.default_params.dt)
        steps = round(min(seconds, MAX_S) / step_s)
        flights = fly_many(
            env, NetworkPolicy(policy.network, policy.params), self._seed, BATCH, steps, MAX_LAPS
        )
        log = log_of_flights(flights, step_s, self._seed, seconds, NOISE)
        return log.select(np.arange(len(log)) < round(seconds / step_s))


Adapt = Callable[[Data, Policy], Policy]


def fly_task(task: Task, suite: Suite, policy: Policy) -> dict[str, Any]:
    """Return the results of a policy on a task.

    They are success, mean lap times, s, score, the mean of gates passed, and the share of all
    flights by what ended them, but for those that finished. The score is the share of starts that
    finish times the time-optimal lap over the mean flying lap.
    """
    env = policy.env(task.plant, task.track)
    params = with_model_as_given(env.default_params)
    keys = start_keys(suite.seed, suite.starts)
    network = NetworkPolicy(policy.network, policy.params)
    outcomes = race_many(env, network, keys, suite.steps, suite.laps, params)
    found = score(outcomes)
    ratio = found.flying_lap_s / task.optimal_lap_s
    return {
        "success": round(found.success, 6),
        "first_lap_s": rounded(found.first_lap_s),
        "flying_lap_s": rounded(found.flying_lap_s),
        "over_optimal": rounded(ratio),
        "score": rounded(found.success / ratio if found.success else 0.0),
        "gates": rounded(found.gates),
        "ended": end_shares(outcomes),
    }


def end_shares(outcomes: Outcomes) -> dict[str, float]:
    """Return the share of flights that each cause ended before they finished, the largest first."""
    shares = {name: float(np.mean(is_ended)) for name, is_ended in outcomes.ends().items()}
    return {
        name: round(share, 6)
        for name, share in sorted(shares.items(), key=lambda one: -one[1])
        if share
    }


def run(
    suite: Suite,
    policies: Sequence[Policy],
    tasks: Sequence[Task],
    seconds: float = 0.0,
    adapt: Adapt | None = None,
    report: Report = lambda done, total: None,
) -> dict[str, Any]:
    """Return the result of policies, one a training seed, on tasks, as JSON values.

    Args:
        seconds, adapt: with so much data of each task, each policy is replaced by what is made of
            it.
        report: called with flights done and to do.
    """
    started_s, total = time.process_time(), len(tasks) * len(policies)
    flown: dict[str, list[dict[str, Any]]] = {}
    for place, task in enumerate(tasks):
        flown[task.id] = []
        for number, policy in enumerate(policies):
            own = policy if adapt is None else adapt(Data(task, suite, seconds), policy)
            flown[task.id].append(fly_task(task, suite, own))
            report(place * len(policies) + number + 1, total)
    regime = "zero-shot" if adapt is None else f"{seconds:g} s of data"
    return summarize(suite, policies, flown, regime, time.process_time() - started_s)


def summarize(
    suite: Suite,
    policies: Sequence[Policy],
    flown: dict[str, list[dict[str, Any]]],
    regime: str,
    cpu_s: float,
) -> dict[str, Any]:
    """Return the result of flown tasks as JSON values; cpu_s: that they took."""
    return {
        "schema": SCHEMA,
        "suite": suite.name,
        "digest": suite.digest,
        "regime": regime,
        "policies": [
            {"name": one.name, "sha256": one.sha256, "training": one.training()} for one in policies
        ],
        "tasks": flown,
        "summary": {name: summary(flown, name) for name in ("success", "score")},
        "versions": {name: version(name) for name in ("flytrack", "jax", "jaxlib")},
        "cpu_s": round(cpu_s, 1),
    }


def summary(flown: dict[str, list[dict[str, Any]]], name: str) -> dict[str, Any]:
    """Return the interquartile mean of a figure over tasks and seeds, and its 95 % interval.

    The interval is of a bootstrap that draws seeds again within each task (R. Agarwal et al., "Deep
    reinforcement learning at the edge of the statistical precipice", 2021); null of fewer than two
    seeds.
    """
    values = np.array([[one[name] for one in ones] for ones in flown.values()])
    interval = None
    if values.shape[1] > 1:
        drawn = np.random.default_rng(0).integers(values.shape[1], size=(DRAWS, *values.shape))
        means = [
            stats.trim_mean(np.take_along_axis(values, one, axis=1), QUARTER, axis=None)
            for one in drawn
        ]
        tail = 0.5 * (1.0 - COVERED)
        interval = [round(float(one), 6) for one in np.quantile(means, (tail, 1.0 - tail))]
    return {
        "interquartile_mean": round(float(stats.trim_mean(values, QUARTER, axis=None)), 6),
        "ci95": interval,
    }


def differences(found: dict[str, Any], again: dict[str, Any]) -> list[str]:
    """Return in what tasks of another run a result is not confirmed, a line each."""
    lines = []
    for task, ones in again["tasks"].items():
        for number, (one, other) in enumerate(zip(found["tasks"][task], ones, strict=True)):
            laps = one["flying_lap_s"], other["flying_lap_s"]
            is_same_lap = laps[0] == laps[1] or (
                None not in laps and abs(laps[1] / laps[0] - 1.0) <= SAME_LAP
            )
            if abs(one["success"] - other["success"]) > SAME_SUCCESS or not is_same_lap:
                lines.append(f"{task}, policy {number}: found {other}, the file says {one}")
    return lines
