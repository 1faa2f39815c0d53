"""Training on several devices and in several processes: the result of one, and a process lost."""

import os
import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from baselines.purejaxrl_ppo import Config, devices, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import as_named_arrays

BATCH = 16 * 24
SMALL = "--num-envs 16 --num-steps 24 --num-minibatches 4 --hidden-sizes 8 --evaluate-every 0"
FINAL = "final.safetensors"


def test_a_batch_that_devices_do_not_divide_is_refused():
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1] * 3), (devices.AXIS,))
    with pytest.raises(ValueError, match="num_envs: found 16, expected a multiple of 3 devices"):
        devices.check_divides(Config(num_envs=16), mesh)
    few = Config(num_envs=12, num_steps=24, num_minibatches=36)
    with pytest.raises(ValueError, match="rows of a minibatch: found 8, expected a multiple of 3"):
        devices.check_divides(few, mesh)
    with pytest.raises(ValueError, match="--devices: found 99, expected 1 to"):
        devices.make_mesh(99)


def test_a_coordinator_that_is_none_is_refused(monkeypatch):
    monkeypatch.setattr(devices, "JOIN_TIMEOUT_S", 0.01)
    with pytest.raises(ValueError, match=r"--coordinator 127\.0\.0\.1:9: nobody listens there"):
        devices.join("127.0.0.1:9", 2, 1)
    with pytest.raises(ValueError, match="--coordinator: found 'here', expected HOST:PORT or auto"):
        devices.join("here", 2, 1)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (jax.errors.JaxRuntimeError("INTERNAL: NCCL operation failed"), devices.LostProcessError),
        (ValueError("Gloo all-reduce: Connection closed by peer"), devices.LostProcessError),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory"), RuntimeError),
        (ValueError("gate_margin: found 9"), ValueError),
    ],
)
def test_only_what_tells_of_another_process_is_a_loss(error, expected, monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(expected) as found, devices.noticing_loss("--resume runs"):
        raise error
    assert (found.value is error) == (expected is not devices.LostProcessError)


# Whole processes.


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@pytest.fixture
def start():
    """Start trainings; end those that are left."""
    started = []

    def start_one(out, *flags):
        command = [sys.executable, "-m", "flytrack", "train", *SMALL.split(), "--no-tracking"]
        started.append(
            subprocess.Popen(
                [*command, "--out", str(out), *map(str, flags)],
                env={**os.environ, "JAX_PLATFORMS": "cpu"},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        return started[-1]

    yield start_one
    for process in started:
        process.kill()
        process.communicate()


def end_of(process):
    output, errors = process.communicate(timeout=300)
    return process.returncode, output, errors


def pair_flags():
    address = ("--coordinator", f"127.0.0.1:{free_port()}", "--num-processes", 2)
    return [(*address, "--process", index) for index in (0, 1)]


def arrays_of(path):
    checkpoint = load_checkpoint(path)
    return {**as_named_arrays(checkpoint.params), **checkpoint.training}


def largest_difference(path, reference):
    found, expected = (as_named_arrays(load_checkpoint(one).params) for one in (path, reference))
    return max(np.abs(found[name] - array).max() for name, array in expected.items())


@pytest.mark.slow
def test_two_processes_and_two_devices_train_as_one(tmp_path, start):
    flags = ("--total-timesteps", 20 * BATCH, "--checkpoint-every", 8 * BATCH)
    alone = end_of(start(tmp_path / "alone", *flags))
    shared = end_of(start(tmp_path / "shared", *flags, "--devices", 2))
    pair = [start(tmp_path / "pair", *flags, *job) for job in pair_flags()]
    ends = [end_of(process) for process in pair]
    assert [end[0] for end in (alone, shared, *ends)] == [0] * 4, (alone, shared, ends)
    assert "final.safetensors" in ends[0][1]
    assert "safetensors" not in ends[1][1]
    names = sorted(path.name for path in (tmp_path / "alone").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "pair").iterdir())
    for name in ("shared", "pair"):
        assert largest_difference(tmp_path / name / FINAL, tmp_path / "alone" / FINAL) < 1e-5
    # What one device stored continues on two; the other way round is tested below.
    out, step = tmp_path / "longer", tmp_path / "alone" / f"step_{8 * BATCH}.safetensors"
    status, _, errors = end_of(start(out, "--resume", step, "--devices", 2))
    assert status == 0, errors
    assert largest_difference(out / FINAL, tmp_path / "alone" / FINAL) < 1e-5
    # Other settings in one of two processes are named there.
    jobs = pair_flags()
    pair = [start(tmp_path / "x", *flags, "--seed", seed, *jobs[seed]) for seed in (0, 1)]
    ends = [end_of(process) for process in pair]
    assert "process 1: does not fit: seed: found 1, expected 0" in ends[1][2]
    assert ends[0][0] == 1
    assert "has lost another" in ends[0][2]


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_process_ends_the_other_and_nothing_stored_is_lost(tmp_path, start, victim):
    out, step = tmp_path / "lost", f"step_{50 * BATCH}.safetensors"
    flags = ("--total-timesteps", 100_000 * BATCH, "--checkpoint-every", 50 * BATCH)
    pair = [start(out, *flags, *job) for job in pair_flags()]
    while not (out / step).exists():
        assert [process.poll() for process in pair] == [None, None], list(map(end_of, pair))
        time.sleep(0.1)
    pair[victim].send_signal(signal.SIGKILL)
    begun_s = time.monotonic()
    status, _, errors = end_of(pair[1 - victim])
    assert time.monotonic() - begun_s < 30
    assert status == 1, errors
    assert f"process {1 - victim} of 2 has lost another; continue with --resume {out}" in errors
    assert "Traceback" not in errors
    assert not list(out.glob(".*.safetensors*")), "no part of a file is left"
    if victim == 0:
        return
    # One device restores the state that both stored, to the bit, and goes on.
    copied, longer = tmp_path / "alone", tmp_path / "longer"
    for folder, updates in ((copied, 50), (longer, 51)):
        length = ("--total-timesteps", updates * BATCH)
        assert end_of(start(folder, "--resume", out / step, *length))[0] == 0
        assert load_checkpoint(folder / FINAL).steps == updates * BATCH
    stored, restored = arrays_of(out / step), arrays_of(copied / FINAL)
    assert stored.keys() == restored.keys()
    assert all(stored[name].tobytes() == restored[name].tobytes() for name in stored)
