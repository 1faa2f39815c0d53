"""Training: killed at random moments and resumed; it must lose nothing and end with the same bits."""

import itertools
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.resume import checkpoints_in
from benchmarks.report import ROOT, table

BATCH, UPDATES, EVERY = 16 * 24, 12_000, 20  # steps of an update; updates; updates between checkpoints
KILLS = 10
LONGEST_LIFE_S = 0.5  # of a process after its first new checkpoint
TIMEOUT_S = 600.0
FLAGS = (
    "--env-id FlyTrackRobust-v0 --num-envs 16 --num-steps 24 --num-minibatches 4 --hidden-sizes 8 --seed 3 "
    f"--evaluate-every 0 --total-timesteps {UPDATES * BATCH} --checkpoint-every {EVERY * BATCH}"
)


def start(folder: Path, out: Path, is_new: bool = True) -> subprocess.Popen[str]:
    """Start a training, or resume it; what it compiles is kept for the next in ``folder``."""
    flags = FLAGS.split() if is_new else ["--resume", str(out)]
    return subprocess.Popen(
        [sys.executable, "-m", "baselines.purejaxrl_ppo.train_ppo", "--out", str(out), *flags],
        cwd=ROOT,
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"), "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> None:
    """Wait for a training; raises RuntimeError, with what it printed, if it failed."""
    errors = process.communicate(timeout=TIMEOUT_S)[1]
    if process.returncode:
        raise RuntimeError(errors[-1000:])


def kill(process: subprocess.Popen[str], out: Path, rng: random.Random) -> bool:
    """Kill a training at a random moment after its next checkpoint; return False if it ended before."""
    before = set(checkpoints_in(out))
    while process.poll() is None and set(checkpoints_in(out)) == before:
        time.sleep(0.001)
    time.sleep(rng.uniform(0.0, LONGEST_LIFE_S))
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=TIMEOUT_S)
    return process.returncode == -signal.SIGKILL


def num_broken(paths: set[Path]) -> int:
    """Return how many checkpoints are gone or cannot be loaded."""
    broken = 0
    for path in paths:
        try:
            load_checkpoint(path)
        except CheckpointError:
            broken += 1
    return broken


def arrays_of(out: Path) -> list[bytes]:
    """Return the bytes of all arrays of a training's last checkpoint: parameters, optimiser, environments."""
    (path,) = out.glob("final.*")
    checkpoint = load_checkpoint(path)
    leaves = jax.tree.leaves((checkpoint.params, dict(sorted((checkpoint.training or {}).items()))))
    return [np.asarray(leaf).tobytes() for leaf in leaves]


def measure(share: float) -> dict[str, Any]:
    """Return what came of a training that is killed a share of ``KILLS`` times, or until it ends."""
    with tempfile.TemporaryDirectory() as folder:
        return kill_and_resume(max(round(share * KILLS), 1), Path(folder))


def kill_and_resume(kills: int, folder: Path) -> dict[str, Any]:
    """Return how many checkpoints were lost, and whether the training ended as one left alone."""
    rng, whole, out = random.Random(0), folder / "whole", folder / "killed"
    finish(start(folder, whole))
    found = {"kills": 0, "checkpoints_lost": 0}
    process = start(folder, out)
    for _ in tqdm(range(kills), unit="kill"):
        known = set(checkpoints_in(out))
        if not kill(process, out, rng):
            break
        found["kills"] += 1
        newest = sorted(checkpoints_in(out), key=lambda path: path.stat().st_mtime)[-2:]
        found["checkpoints_lost"] += num_broken({*newest, *itertools.filterfalse(Path.exists, known)})
        process = start(folder, out, is_new=False)
    finish(process)
    is_same = arrays_of(out) == arrays_of(whole)
    return {**found, "same_bits": is_same, "is_held": is_same and not found["checkpoints_lost"]}


def as_markdown(result: dict[str, Any]) -> str:
    """Return the result as a table."""
    row = (result["kills"], result["checkpoints_lost"], "yes" if result["same_bits"] else "no")
    header = "kills | checkpoints lost or damaged | same final bits as without kills"
    text = f"A training of {UPDATES:,} updates, killed by SIGKILL at random moments and resumed each time."
    return f"{text}\n\n{table(header, [row])}"
