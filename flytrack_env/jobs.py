"""Many independent jobs in processes of their own, here or as tasks of a Ray cluster.

A job that crashes or exceeds its time costs itself only: its process is replaced. Ray runs the job
of a lost node again on another.
"""

import contextlib
import os
import queue
import signal
import socket
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import version
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from flytrack_env.extras import check_installed
from flytrack_env.messages import error_text
from flytrack_env.sources import PACKAGES, digest_of_sources

Function = Callable[..., Any]
KILL_AFTER_S, CONNECT_S = 5.0, 10.0
STDERR = 2
LIBRARIES = ("jax", "jaxlib", "numpy", "scipy")  # whose versions change results
# A worker's process finds modules where the caller does.
SERVE = (
    "import sys; sys.path[:] = sys.argv[2:];"
    "from flytrack_env.jobs import serve; serve(int(sys.argv[1]))"
)
_workers: list["Worker"] = []  # idle ones of a Ray process, which runs a task at a time


class Outcome(NamedTuple):
    """What a job returned; or why it did not, in which case ``value`` is None."""

    value: Any
    error: str = ""


class ClusterError(OSError):
    """A Ray cluster that cannot be used; the message says which, and why."""


def serve(descriptor: int) -> None:
    """Answer calls until the other end of a connection is closed: a worker's process does so."""
    os.set_inheritable(descriptor, False)  # what a job starts may outlive it
    connection = Connection(descriptor)
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):  # the caller is gone
        while True:
            function, arguments = connection.recv()
            try:
                outcome = Outcome(function(*arguments))
            except Exception as error:  # whatever a job raises is told, and the next one runs
                text = error_text(error)
                is_worded = isinstance(error, (ValueError, OSError)) and text
                outcome = Outcome(None, text if is_worded else f"{type(error).__name__}: {text}")
            connection.send(outcome)


class Worker:
    """A process that runs one job at a time, begun anew after one that crashed or hung.

    What jobs print goes to stderr, as stdout belongs to the caller's own results.

    Args:
        cores: on which it runs; none: those of the caller.
    """

    def __init__(self, cores: Sequence[int] = ()) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self._cores = cores

    def call(self, function: Function, arguments: tuple[Any, ...], limit_s: float) -> Outcome:
        """Return what a function returns, or that it crashed, raised, or ran longer than allowed.

        Args:
            function: of a module, which the process imports.
            arguments: of it.
            limit_s: longest time (s), with the start of the process.
        """
        process = self.process or self._begin()
        try:
            self._connection.send((function, arguments))
            if not self._connection.poll(limit_s):
                self.end()
                return Outcome(None, f"found no result after {limit_s:g} s, the limit of a job")
            outcome: Outcome = self._connection.recv()
            return outcome
        except (EOFError, OSError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(KILL_AFTER_S)
            self.end()
            return Outcome(None, f"its process crashed, with exit status {process.returncode}")

    def _begin(self) -> "subprocess.Popen[bytes]":
        own, other = socket.socketpair()
        with other:
            self.process = subprocess.Popen(
                [sys.executable, "-c", SERVE, str(other.fileno()), *sys.path],
                stdin=subprocess.DEVNULL,
                stdout=STDERR,
                pass_fds=[other.fileno()],
                start_new_session=True,
            )
        if self._cores:  # before JAX starts a thread for each core
            os.sched_setaffinity(self.process.pid, self._cores)
        self._connection = Connection(own.detach())
        return self.process

    def end(self) -> None:
        """End the process and what it has started, if there is one."""
        if self.process is not None:
            with contextlib.suppress(ProcessLookupError):  # it has ended, and left nothing behind
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self._connection.close()
            self.process = None


def run_jobs(
    function: Function,
    jobs: Mapping[str, tuple[Any, ...]],
    limit_s: float,
    address: str | None = None,
    workers: int = 1,
) -> Iterator[tuple[str, Outcome]]:
    """Yield the name and the outcome of each job once, in the order in which they end.

    Args:
        function: of a module; called with the arguments of each job.
        jobs: arguments by name; Ray's dashboard shows the names.
        limit_s: longest time of a job (s).
        address: of a Ray cluster, HOST:PORT, "auto" for the one that runs here, or "local" for one
            that is begun; None: processes of this machine, without Ray.
        workers: number of processes without Ray, which share this machine's cores; a cluster runs a
            job per core.

    Raises:
        ClusterError: no such cluster.
        ImportError: Ray is not installed.
    """
    if address is not None:
        yield from _run_on_cluster(function, jobs, limit_s, address)
        return
    free: queue.SimpleQueue[Worker] = queue.SimpleQueue()
    pool = [Worker(cores) for cores in share_cores(min(workers, len(jobs)))]
    for worker in pool:
        free.put(worker)

    def run(arguments: tuple[Any, ...]) -> Outcome:
        worker = free.get()
        try:
            return worker.call(function, arguments, limit_s)
        finally:
            free.put(worker)

    threads = ThreadPoolExecutor(max(len(pool), 1))
    try:
        futures = {threads.submit(run, arguments): name for name, arguments in jobs.items()}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        for worker in pool:
            worker.end()


def describe_code(function: Function) -> str:
    """Return what a job may run, in words: FlyTrack and the job's own package, and libraries."""
    package = function.__module__.partition(".")[0]
    digest = digest_of_sources(*PACKAGES, "baselines", package)
    libraries = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return f"FlyTrack of code {digest} with {libraries}"


def share_cores(count: int) -> list[Sequence[int]]:
    """Return the cores of each of some processes, so that their threads do not compete."""
    if not hasattr(os, "sched_getaffinity"):
        return [()] * count
    cores = sorted(os.sched_getaffinity(0))
    return [cores[index::count] or [cores[index % len(cores)]] for index in range(count)]


def run_as_task(
    function: Function, arguments: tuple[Any, ...], limit_s: float, expected: str
) -> Outcome:
    """Return the outcome of a job in a process below a Ray worker's, which a crash spares."""
    if expected != (found := describe_code(function)):
        return Outcome(None, f"node {socket.gethostname()}: found {found}, expected {expected}")
    if not _workers:
        _workers.append(Worker())
    return _workers[0].call(function, arguments, limit_s)


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """Yield Ray, connected to a cluster, as ``run_jobs`` takes its address.

    Raises:
        ClusterError: no such cluster, or one of other versions.
        ImportError: Ray is not installed.
    """
    check_installed("cluster", "jobs on a cluster", "ray")
    import logging

    import ray

    if ray.is_initialized():  # by the caller, who ends it
        yield ray
        return
    try:
        if ":" in address:  # Ray itself tries for minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
        with warnings.catch_warnings():
            # Ray forks before it executes its programs, of which JAX warns.
            warnings.filterwarnings("ignore", message=".*fork", category=RuntimeWarning)
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray raises many types, and Exception itself
        text = f"--address {address}: no Ray cluster that can be used: {error_text(error)}"
        raise ClusterError(text) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _run_on_cluster(
    function: Function, jobs: Mapping[str, tuple[Any, ...]], limit_s: float, address: str
) -> Iterator[tuple[str, Outcome]]:
    with connected(address) as ray:
        # A lost node costs a retry; a crash of the job itself does not reach Ray.
        task = ray.remote(num_cpus=1, max_retries=-1)(run_as_task)
        code = describe_code(function)
        names = {
            task.options(name=name).remote(function, arguments, limit_s, code): name
            for name, arguments in jobs.items()
        }
        waiting = list(names)
        while waiting:
            (done,), waiting = ray.wait(waiting)
            try:
                yield names[done], ray.get(done)
            except ray.exceptions.RayError as error:
                yield names[done], Outcome(None, error_text(error))
