"""Where the processes of one training meet: ``train_ppo --distributed`` begins anew here.

JAX's runtime has to be joined before JAX computes anything, and gymnax computes as it is imported. So this
module imports neither, nor anything that does, before all processes are there.
"""

import argparse
import os
import sys
from typing import NamedTuple, NoReturn

FLAGS = ("--coordinator", "--num-processes", "--process-index")
LOST_AFTER_S = 30  # without a sign of life, a process counts as lost


class Job(NamedTuple):
    """Where the processes of a training meet; None: as SLURM or Open MPI say.

    coordinator: HOST:PORT of the first process. num_processes: how many there are. process: which this is.
    """

    coordinator: str | None = None
    num_processes: int | None = None
    process: int | None = None

    def check(self) -> None:
        """Raise ValueError, naming the flag, for what is not a job."""
        if self.coordinator is None or self.num_processes is None or self.process is None:
            given = [name for name, value in zip(FLAGS, self, strict=True) if value is not None]
            if given:
                raise ValueError(
                    f"--distributed: found {', '.join(given)}, expected all of {', '.join(FLAGS)}"
                )
            return
        host, _, port = self.coordinator.rpartition(":")
        if not host or not port.isdecimal():
            raise ValueError(f"--coordinator: found {self.coordinator!r}, expected HOST:PORT")
        if self.num_processes < 1:
            raise ValueError(f"--num-processes: found {self.num_processes}, expected at least 1")
        if not 0 <= self.process < self.num_processes:
            last = self.num_processes - 1
            raise ValueError(f"--process-index: found {self.process}, expected 0 to {last}")


def add_job_flags(parser: argparse.ArgumentParser) -> None:
    """Give a parser ``--distributed`` and where the processes meet."""
    group = parser.add_argument_group(
        "several devices",
        "The environments are spread over all devices, of this process or of all processes of a job of SLURM "
        "or Open MPI; elsewhere every process is told where they meet. All see the same folder.",
    )
    group.add_argument("--distributed", action="store_true", help="train on all devices of all processes")
    group.add_argument("--coordinator", metavar="HOST:PORT", help="where the first process can be reached")
    group.add_argument("--num-processes", type=int, metavar="N", help="how many processes there are")
    group.add_argument("--process-index", type=int, metavar="I", help="which of them this is, from 0")


def job_of(arguments: argparse.Namespace) -> Job:
    """Return what the flags say.

    Raises:
        ValueError: what is not a job.
    """
    job = Job(arguments.coordinator, arguments.num_processes, arguments.process_index)
    if job != Job() and not arguments.distributed:
        raise ValueError(f"found one of {', '.join(FLAGS)}, expected --distributed with it")
    job.check()
    return job


def begin_anew() -> NoReturn:
    """Replace this process by one with the same command line that meets the others first."""
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", "baselines.joining", *sys.argv[1:]])


def join(job: Job) -> None:
    """Meet the other processes; without a job, stay alone with several devices.

    Raises:
        ValueError: neither a job nor several devices, or others that do not come.
    """
    import jax

    try:
        jax.distributed.initialize(
            *job, heartbeat_timeout_seconds=LOST_AFTER_S, shutdown_timeout_seconds=LOST_AFTER_S
        )
    except ValueError as error:
        if job != Job() or jax.device_count() == 1:
            raise ValueError(
                f"--distributed: found no job of SLURM or Open MPI, and one device ({error}); expected "
                f"a job, several devices, or {', '.join(FLAGS)}"
            ) from error
    except RuntimeError as error:
        raise ValueError(f"--distributed: {job.coordinator}: {error}") from error


def main() -> None:
    """Meet the others, then train as the command line says."""
    parser = argparse.ArgumentParser(prog="train_ppo", add_help=False)
    add_job_flags(parser)
    arguments, _ = parser.parse_known_args()
    try:
        join(job_of(arguments))
    except ValueError as error:
        parser.exit(1, f"{parser.prog}: error: {error}\n")
    from baselines.purejaxrl_ppo.train_ppo import main as train

    train(has_joined=True)


if __name__ == "__main__":
    main()
