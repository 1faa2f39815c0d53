"""A training run, tracked, and the champion, with ``[train]`` alone. Run by ``release.check_wheel``."""

import subprocess
import sys
from importlib import resources
from pathlib import Path

from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.evaluate import race_many, start_keys
from baselines.purejaxrl_ppo.flights import score
from flytrack_env import make
from flytrack_env.model_file import model_from_json

SIZES = "--num-envs 16 --num-steps 32 --num-minibatches 4 --total-timesteps 1024 --hidden-sizes 8"
FOLDER, STORE = Path("runs/small"), Path("mlflow.db")
NUM_FLIGHTS, NUM_STEPS, NUM_LAPS = 8, 1500, 2


def train() -> None:
    """Train for a moment and look for what must have been written."""
    options = [*SIZES.split(), "--out", str(FOLDER), "--tracking-uri", f"sqlite:///{STORE}"]
    command = [sys.executable, "-I", "-m", "baselines.purejaxrl_ppo.train_ppo", *options]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert STORE.is_file()
    assert load_checkpoint(FOLDER / "final.msgpack").training is not None


def race() -> None:
    """Fly the champion that the wheel has, in the simulator of the model that it was trained for."""
    shipped = resources.files("baselines.purejaxrl_ppo") / "champion" / "flytrack.msgpack"
    with resources.as_file(shipped) as path:
        champion = load_checkpoint(path)
    env = make("FlyTrack-v0", model=model_from_json(champion.meta["model"], "champion"))
    keys = start_keys(0, NUM_FLIGHTS)
    result = score(race_many(env, champion.network, champion.params, keys, NUM_STEPS, NUM_LAPS))
    assert result.success == 1.0, result


if __name__ == "__main__":
    train()
    race()
