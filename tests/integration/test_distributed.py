"""Training on several devices and in several processes: one update, one set of files, a process lost."""

import os
import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import as_named_arrays
from baselines.purejaxrl_ppo.collectives import AXIS
from baselines.purejaxrl_ppo.distributed import check_divides
from baselines.purejaxrl_ppo.resume import checkpoints_in, newest_intact
from tests.support.pages import ROOT
from tests.support.ppo_runs import BATCH, CONFIG

TRAIN = "-m baselines.purejaxrl_ppo.train_ppo"
SMALL = "--num-envs 16 --num-steps 24 --num-minibatches 4 --hidden-sizes 8 --evaluate-every 0 --no-tracking"


def test_environments_and_minibatches_divide_into_shards():
    mesh = jax.sharding.Mesh(np.array(jax.devices() * 3), (AXIS,))
    with pytest.raises(ValueError, match="num_envs: found 16, expected a multiple of 3 devices"):
        check_divides(CONFIG, mesh)
    with pytest.raises(ValueError, match="num_minibatches: found 64, expected a divisor of the 96 steps"):
        check_divides(Config(num_envs=12, num_steps=24, num_minibatches=64), mesh)


# Whole processes.


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


STARTED = []


@pytest.fixture(autouse=True)
def no_process_is_left():
    yield
    while STARTED:
        process = STARTED.pop()
        process.kill()
        process.communicate()


def start(out, *flags, devices=1, number=1, index=0, port=None):
    job = ["--distributed"] if devices > 1 or number > 1 else []
    if number > 1:
        job += [
            *("--coordinator", f"127.0.0.1:{port}"),
            *("--num-processes", number, "--process-index", index),
        ]
    command = [sys.executable, *TRAIN.split(), "--out", out, *SMALL.split(), *job, *flags]
    xla = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    process = subprocess.Popen(
        [*map(str, command)],
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": xla, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    STARTED.append(process)
    return process


def end_of(process):
    output, errors = process.communicate(timeout=240)
    return process.returncode, output, errors


def parameters(folder, name="final.safetensors"):
    return as_named_arrays(load_checkpoint(folder / name).params)


@pytest.mark.slow
def test_two_processes_train_as_two_devices(tmp_path):
    flags = ["--total-timesteps", 7 * BATCH, "--checkpoint-every", 2 * BATCH]
    devices = start(tmp_path / "devices", *flags, devices=2)
    port = free_port()
    pair = [start(tmp_path / "pair", *flags, number=2, index=i, port=port) for i in (0, 1)]
    status, output, errors = end_of(devices)
    assert status == 0, errors
    (first, first_output, errors_first), (second, said_second, errors_second) = map(end_of, pair)
    assert (first, second) == (0, 0), errors_first + errors_second
    # Files are written once, by the first process, and each says as much as one alone.
    assert "final.safetensors" in first_output and "final.safetensors" in output
    assert "safetensors" not in said_second
    names = sorted(path.name for path in (tmp_path / "devices").iterdir())
    assert sorted(path.name for path in (tmp_path / "pair").iterdir()) == names
    assert sum(name.startswith("step_") for name in names) == 4
    of_pair, of_devices = parameters(tmp_path / "pair"), parameters(tmp_path / "devices")
    for name, array in of_devices.items():
        np.testing.assert_allclose(of_pair[name], array, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_a_lost_process_ends_the_job_and_another_number_goes_on(tmp_path):
    port, long = free_port(), ["--total-timesteps", 200_000 * BATCH, "--checkpoint-every", 50 * BATCH]
    out = tmp_path / "lost"
    pair = [start(out, *long, number=2, index=i, port=port) for i in (0, 1)]
    while not (out / f"step_{50 * BATCH}.safetensors").exists():
        assert [one.poll() for one in pair] == [None, None], [end_of(one) for one in pair]
        time.sleep(0.1)
    pair[1].send_signal(signal.SIGKILL)
    status, _, errors = end_of(pair[0])
    end_of(pair[1])
    assert status == 1
    assert "process 0 of 2 has lost another" in errors and f"continue with --resume {out}" in errors
    assert "Traceback" not in errors
    stored = newest_intact(out)[0]
    # Another number of processes goes on, and says that the bits may be others.
    status, _, errors = end_of(start(out, "--resume", out, "--learning-rate", 1e-4))
    assert status == 2 and "config.learning_rate" in errors and "machine.devices: found 2" in errors
    alone = start(out, "--resume", out)
    while checkpoints_in(out)[0] == stored:
        assert alone.poll() is None, end_of(alone)
        time.sleep(0.1)
    alone.send_signal(signal.SIGINT)
    status, _, errors = end_of(alone)
    assert status == 130 and "found 2, expected 1; continuing, perhaps not bit for bit" in errors


@pytest.mark.slow
def test_one_device_alone_is_no_job(tmp_path):
    status, _, errors = end_of(start(tmp_path / "x", "--distributed"))
    assert status == 2 and not (tmp_path / "x").exists()
    assert "expected a job of SLURM or Open MPI, several devices, or all of --coordinator" in errors
