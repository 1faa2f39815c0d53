"""A sweep of two trials, tracked, with ``[sweep]`` alone. Run by ``release.check_wheel``."""

import subprocess
import sys
from pathlib import Path

from baselines.purejaxrl_ppo import load_checkpoint

SIZES = "--num-envs 16 --num-steps 32 --num-minibatches 4 --total-timesteps 1024 --hidden-sizes 8"
SPACE, FOLDER = Path("space.toml"), Path("runs/sweep")


def sweep() -> None:
    """Sweep for a moment and look for what must have been written."""
    SPACE.write_text("[learning_rate]\ngrid_search = [1e-3, 2e-3]\n")
    options = [str(SPACE), *SIZES.split(), "--trials", "1", "--out", str(FOLDER)]
    command = [sys.executable, "-I", "-m", "baselines.purejaxrl_ppo.sweeps", *options]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    rates = [load_checkpoint(path).config.learning_rate for path in FOLDER.glob("trial*/final.msgpack")]
    assert sorted(rates) == [1e-3, 2e-3], ran.stdout


if __name__ == "__main__":
    sweep()
