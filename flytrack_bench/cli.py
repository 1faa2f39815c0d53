"""Take a policy, or a method that names errors, through a frozen suite, and write the result."""

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from baselines.purejaxrl_ppo.config import OPTIONAL, OptionalPath
from flytrack_bench.misspec import SHARES, is_log_suite, load_log_suite, run_method
from flytrack_bench.misspec.door import LIMIT_S
from flytrack_bench.policies import Policy, PolicyError, load_policy
from flytrack_bench.results import differences, run, summarize
from flytrack_bench.suite import Suite, SuiteError, load_suite
from flytrack_env.extras import import_object
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.jobs import ClusterError, run_jobs
from flytrack_env.messages import error_text
from flytrack_env.progress import ProgressBar

MAX_BYTES = 2**24
MAX_JOB_S = 86_400.0  # of a task, with retraining
VERIFIED = 3  # tasks of a result that are flown again


@dataclass(frozen=True)
class Flags:
    """What is flown."""

    policy: Annotated[tuple[str, ...], arg(metavar="CHECKPOINT|MODULE:NAME [...]")] = ()
    """The policy, one for each training seed: checkpoints, or functions of the observation that
    return four sticks."""
    method: Annotated[str | None, arg(metavar="MODULE:FUNCTION", help_behavior_hint=OPTIONAL)] = (
        None
    )
    """What names the errors of a model, for a suite of logs (misspec-v1): a function of log and
    model that returns a `flytrack_bench.misspec.Answer`."""
    out: OptionalPath = None
    """The result, .json; default: it is printed only. With --method, a result that has begun goes
    on."""
    suite: str = "v1"
    """Name of a shipped suite, or a suite's file: v1 for policies, misspec-v1 for methods."""
    tasks: tuple[str, ...] = ()
    """Ids of the tasks or logs; default: all, or with --adapt all hidden plants."""
    adapt: Annotated[str | None, arg(metavar="MODULE:NAME", help_behavior_hint=OPTIONAL)] = None
    """A function that makes a policy for each plant, given `flytrack_bench.Data` and --policy:
    `flytrack_bench:adapt_to_flight`, `flytrack_bench:diagnose_and_retrain`, or your own."""
    data_seconds: float = 30.0
    """Seconds of flight that --adapt may log of each plant."""
    address: Annotated[
        str | None, arg(metavar="HOST:PORT|auto|local", help_behavior_hint=OPTIONAL)
    ] = None
    """A Ray cluster, a task of the suite a job; its nodes must see policies and
    suite. Default: this process."""
    verify: OptionalPath = None
    """A result to verify: some of its tasks are flown again with this policy."""
    limit_s: float = LIMIT_S
    """Seconds (wall clock) after which --method has failed on a log."""


def run_bench(flags: Flags) -> int:
    """Fly as the flags say; return the exit status, 1 where a result is not confirmed."""
    if is_log_suite(flags.suite):
        name_errors(flags)
        return 0
    if flags.method is not None:
        raise ValueError(f"--suite: found {flags.suite}, expected one of logs for --method")
    if not flags.policy:
        raise ValueError(f"--policy: missing, expected a policy for the suite {flags.suite}")
    if flags.limit_s != LIMIT_S:
        raise ValueError(f"--limit-s: found with {flags.suite}, expected --method beside it")
    if flags.verify is not None:
        return 0 if verify(flags) else 1
    bench(flags)
    return 0


def name_errors(flags: Flags) -> None:
    """Show a method the logs, print and write the result."""
    if flags.method is None:
        raise ValueError(f"--method: missing, expected one for the suite of logs {flags.suite}")
    for name in ("policy", "adapt", "verify", "address"):
        if getattr(flags, name):
            raise ValueError(f"--{name}: found with {flags.suite}, expected --method alone")
    suite = load_log_suite(flags.suite)
    ids, report = suite.chosen(flags.tasks), ProgressBar("logs")
    found = run_method(suite, ids, flags.method, flags.out, flags.limit_s, report)
    print(summary_text(found))
    if flags.out is not None:
        print(f"written: {flags.out}")


def summary_text(found: dict[str, Any]) -> str:
    """Return the summary of a method's result as a table."""
    summary, lines = found["summary"], []
    for name, (meaning, _) in SHARES.items():
        one = summary[name]
        interval = "" if one["ci95"] is None else " ({:.2f} to {:.2f})".format(*one["ci95"])
        lines.append(f"{meaning:58} {one['k']:3} of {one['n']:3}{interval}")
    covered = summary["coverage"]
    lines.append(f"{'95 % intervals that cover the truth':58} {covered['k']:3} of {covered['n']:3}")
    for row, error in summary["error_m"].items():
        value = "-" if error is None or error["median"] is None else f"{error['median']:.4g} m"
        lines.append(f"{f'error after 0.5 s of unseen flight, {row}: median':58} {value:>10}")
    if summary["cpu_s"] is not None:
        lines.append(f"{'CPU seconds a log: median':58} {summary['cpu_s']['median']!s:>8} s")
    for log_id, line in found["logs"].items():
        if "reason" in line:
            lines.append(f"log {log_id}: no answer: {line['reason']}")
    others = [log_id for log_id, line in found["logs"].items() if not line["is_frozen"]]
    if others:
        lines.append(f"logs that differ from the frozen ones on this machine: {', '.join(others)}")
    return "\n".join(lines)


def fly(flags: Flags, suite: Suite, ids: tuple[str, ...]) -> dict[str, Any]:
    """Return the result of the policies on some tasks."""
    policies = [load_policy(one) for one in flags.policy]
    tasks, adapt = suite.chosen(ids), None
    if flags.adapt is not None:
        adapt = import_object(flags.adapt, "--adapt", PolicyError)
        tasks = tasks if ids else tuple(task for task in tasks if task.craft is not None)
    if flags.address is None:
        return run(suite, policies, tasks, flags.data_seconds, adapt, ProgressBar("flights"))
    return fly_on_cluster(flags, suite, policies, [task.id for task in tasks])


def fly_on_cluster(
    flags: Flags, suite: Suite, policies: list[Policy], ids: list[str]
) -> dict[str, Any]:
    """Return the result of the policies, each task of the suite flown as a job of a Ray cluster.

    Raises:
        ClusterError: no such cluster, or a task that failed on it.
    """
    of_job = replace(
        flags,
        address=None,
        verify=None,
        policy=tuple(map(absolute, flags.policy)),  # a job has a folder of its own
        suite=absolute(flags.suite) if flags.suite.endswith(".json") else flags.suite,
    )
    jobs = {name: (of_job, name) for name in ids}
    results: dict[str, dict[str, Any]] = {}
    bar = ProgressBar("tasks")
    for name, outcome in run_jobs(fly_job, jobs, MAX_JOB_S, flags.address):
        if outcome.error:
            raise ClusterError(f"task {name}: {outcome.error}")
        results[name] = outcome.value
        bar(len(results), len(ids))
    flown = {name: results[name]["tasks"][name] for name in ids}
    cpu_s = sum(result["cpu_s"] for result in results.values())
    return summarize(suite, policies, flown, results[ids[0]]["regime"], cpu_s)


def absolute(where: str) -> str:
    """Return the whole path of a file, and any other name as it is."""
    return str(Path(where).resolve()) if Path(where).is_file() else where


def fly_job(flags: Flags, task: str) -> dict[str, Any]:
    """Return the result of the policies on one task; called in processes of their own."""
    return fly(flags, load_suite(flags.suite), (task,))


def bench(flags: Flags) -> None:
    """Fly the tasks, print and write the result."""
    if flags.out is not None and flags.out.exists():
        raise ValueError(f"--out: {flags.out} exists already; remove it, or give another file")
    found = fly(flags, load_suite(flags.suite), flags.tasks)
    print(text_of(found))
    if flags.out is not None:
        write_atomically(flags.out, (json.dumps(found, indent=1) + "\n").encode())
        print(f"written: {flags.out}")


def verify(flags: Flags) -> bool:
    """Fly some tasks of a result again, and say whether they confirm it."""
    assert flags.verify is not None
    suite, content = load_suite(flags.suite), read_at_most(flags.verify, MAX_BYTES)
    try:
        found = json.loads(content)
        ids, digest = list(found["tasks"]), found["digest"]
        hashes = [one["sha256"] for one in found["policies"]]
    except (KeyError, TypeError, ValueError) as error:
        raise SuiteError(f"{flags.verify}: not a result: {error_text(error)}") from error
    if digest != suite.digest:
        raise SuiteError(
            f"{flags.verify}: digest: found {digest}, expected {suite.digest} of {suite.name}"
        )
    if hashes != [load_policy(one).sha256 for one in flags.policy]:
        raise PolicyError(f"{flags.verify}: policies: found others than --policy names")
    rng = np.random.default_rng(int(hashlib.sha256(content).hexdigest(), 16))
    chosen = tuple(str(one) for one in rng.permutation(ids)[:VERIFIED])
    lines = differences(found, fly(flags, suite, chosen))
    print("\n".join(lines) or f"confirmed on {', '.join(chosen)}")
    return not lines


def text_of(found: dict[str, Any]) -> str:
    """Return a result as a table, the means over policies, and its summary."""
    lines = [
        f"{'task':12} {'success':>8} {'lap':>8} {'over optimal':>13} {'gates':>6}  mostly ended by"
    ]
    for task, ones in found["tasks"].items():
        laps = [one["flying_lap_s"] for one in ones if one["flying_lap_s"] is not None]
        ratios = [one["over_optimal"] for one in ones if one["over_optimal"] is not None]
        lap = f"{np.mean(laps):.3f} s" if laps else "-"
        ratio = f"{np.mean(ratios):.3f}" if ratios else "-"
        success, gates = (np.mean([one[name] for one in ones]) for name in ("success", "gates"))
        ends = ", ".join(dict.fromkeys(cause for one in ones for cause in list(one["ended"])[:1]))
        lines.append(
            f"{task:12} {success:8.1%} {lap:>8} {ratio:>13} {gates:6.1f}  {ends.replace('_', ' ')}"
        )
    for name, one in found["summary"].items():
        interval = "" if one["ci95"] is None else " ({:.3f} to {:.3f})".format(*one["ci95"])
        lines.append(f"{name}: interquartile mean {one['interquartile_mean']:.3f}{interval}")
    return "\n".join(lines)
