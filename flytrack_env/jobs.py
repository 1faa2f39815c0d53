"""Many independent jobs in processes of their own, here or as tasks of a Ray cluster.

A job that crashes or exceeds its time costs itself only: its process is replaced. Ray runs the job
of a lost node again on another.
"""

import contextlib
import multiprocessing
import queue
import socket
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from flytrack_env.extras import check_installed
from flytrack_env.messages import error_text
from flytrack_env.sources import digest_of_sources

Function = Callable[..., Any]
KILL_AFTER_S, CONNECT_S = 5.0, 10.0
_workers: list["Worker"] = []  # idle ones of a Ray process, which runs a task at a time


class Outcome(NamedTuple):
    """What a job returned; or why it did not, in which case ``value`` is None."""

    value: Any
    error: str = ""


class ClusterError(OSError):
    """A Ray cluster that cannot be used; the message says which, and why."""


def serve(connection: Connection) -> None:
    """Answer calls until the other end is closed; the body of a worker's process."""
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
    """A process that runs one job at a time, begun anew after one that crashed or hung."""

    def __init__(self) -> None:
        self.process: Any = None

    def call(self, function: Function, arguments: tuple[Any, ...], limit_s: float) -> Outcome:
        """Return what a function returns, or that it crashed, raised, or ran longer than allowed.

        Args:
            function: of a module, which the process imports.
            arguments: of it.
            limit_s: longest time (s), with the start of the process.
        """
        if self.process is None:
            self._begin()
        try:
            self.connection.send((function, arguments))
            if not self.connection.poll(limit_s):
                self.end()
                return Outcome(None, f"found no result after {limit_s:g} s, the limit of a job")
            outcome: Outcome = self.connection.recv()
            return outcome
        except (EOFError, OSError):
            process = self.process
            process.join(KILL_AFTER_S)
            self.end()
            return Outcome(None, f"its process crashed, with exit status {process.exitcode}")

    def _begin(self) -> None:
        # Not forked: JAX has threads.
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=serve, args=(other,), daemon=True)
        self.process.start()
        other.close()

    def end(self) -> None:
        """End the process, if there is one."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.connection.close()
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
        workers: number of processes without Ray; a cluster runs a job per core.

    Raises:
        ClusterError: no such cluster.
        ImportError: Ray is not installed.
    """
    if address is not None:
        yield from _run_on_cluster(function, jobs, limit_s, address)
        return
    free: queue.SimpleQueue[Worker] = queue.SimpleQueue()
    own = [Worker() for _ in range(min(workers, len(jobs)))]
    for worker in own:
        free.put(worker)

    def run(arguments: tuple[Any, ...]) -> Outcome:
        worker = free.get()
        try:
            return worker.call(function, arguments, limit_s)
        finally:
            free.put(worker)

    threads = ThreadPoolExecutor(max(len(own), 1))
    try:
        futures = {threads.submit(run, arguments): name for name, arguments in jobs.items()}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        for worker in own:
            worker.end()


def run_as_task(
    function: Function, arguments: tuple[Any, ...], limit_s: float, expected: str
) -> Outcome:
    """Return the outcome of a job in a process below a Ray worker's, which a crash spares."""
    if expected != (found := digest_of_sources()):
        node = socket.gethostname()
        return Outcome(None, f"node {node}: found FlyTrack of code {found}, expected {expected}")
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
        ray.init(
            address=address,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except (OSError, RuntimeError, ValueError, OverflowError) as error:
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
        names = {
            task.options(name=name).remote(function, arguments, limit_s, digest_of_sources()): name
            for name, arguments in jobs.items()
        }
        waiting = list(names)
        while waiting:
            (done,), waiting = ray.wait(waiting)
            try:
                yield names[done], ray.get(done)
            except ray.exceptions.RayError as error:
                yield names[done], Outcome(None, error_text(error))
