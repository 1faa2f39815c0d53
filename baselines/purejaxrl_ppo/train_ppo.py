"""Train PPO on a FlyTrack environment: ``python -m baselines.purejaxrl_ppo.train_ppo``."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.ppo import make_train
from flytrack_env.model_file import model_as_json

MAX_SEED = 2**31


def progress_report(bar: tqdm, config: Config) -> Callable[[dict[str, Any]], None]:
    """Return a callback that moves the bar on by one update and shows how the policy flies.

    unharmed: share of the episodes that the time limit ended, not a crash or a miss.
    """

    def report(metrics: dict[str, Any]) -> None:
        bar.update(config.batch_size)
        bar.set_postfix_str(
            f"return {float(metrics['episode_return']):6.1f}, "
            f"gates {float(metrics['episode_gates_passed']):4.1f}, "
            f"unharmed {float(metrics['episode_truncated']):4.0%}"
        )

    return report


def track_reference(track: str | Path) -> str:
    """Return what finds a track from any folder: its name, or the absolute path of its file.

    Raises:
        ValueError: a ``Track``, which no checkpoint could name; save it to a file first.
    """
    if not isinstance(track, (str, Path)):
        raise ValueError(f"track: found a {type(track).__name__}, expected a name or the path of a file")
    return str(Path(track).resolve()) if str(track).endswith(".toml") else str(track)


def train_policy(
    out: Path, config: Config, seed: int, env_id: str = "FlyTrack-v0", **env_arguments: Any
) -> tuple[Checkpoint, dict[str, np.ndarray]]:
    """Train from scratch and write ``out``/final.msgpack; return the checkpoint and the metrics.

    env_arguments: of ``flytrack_env.make``. metrics: one value per update.

    Raises:
        ValueError: settings, id, track or model that cannot be used, before any training.
    """
    track = track_reference(env_arguments.get("track", "flytrack"))
    env = flytrack_env.make(env_id, **env_arguments)
    config.check()
    env.check_params(env.default_params)
    out.mkdir(parents=True, exist_ok=True)
    num_steps = config.num_updates * config.batch_size
    with tqdm(total=num_steps, unit="step", unit_scale=True, desc="train") as bar:
        params = env.default_params.replace(max_steps_in_episode=config.episode_steps)
        train = jax.jit(make_train(env, params, config, report=progress_report(bar, config)))
        started = time.perf_counter()
        runner, metrics = jax.block_until_ready(train(jax.random.key(seed)))
        seconds = time.perf_counter() - started
        jax.effects_barrier()
    metrics = jax.tree.map(np.asarray, metrics)
    path = out / "final.msgpack"
    description = {
        "env_id": env_id,
        "track": track,
        "missed_gate": env.missed_gate,
        "observation_size": int(env.observation_space().shape[0]),
        "seed": seed,
        "steps": num_steps,
        "seconds": round(seconds, 1),
        "model": model_as_json(env.default_params.model),
    }
    save_checkpoint(path, runner.train_state.params, config, description)
    return load_checkpoint(path), metrics


def main() -> None:
    """Parse the command line, train, say where the checkpoint is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env-id", default="FlyTrack-v0")
    parser.add_argument("--track", default="flytrack", help="name of a track, or path of its file")
    parser.add_argument("--model", help="path of a model file; the nominal model if not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-timesteps", type=float, default=Config.total_timesteps)
    parser.add_argument("--out", type=Path, default=Path("runs/train"))
    arguments = parser.parse_args()
    if not 0 <= arguments.seed < MAX_SEED:
        parser.error(f"--seed: found {arguments.seed}, expected 0 to {MAX_SEED - 1}")
    try:
        config = Config(total_timesteps=int(arguments.total_timesteps))
        checkpoint, _ = train_policy(
            arguments.out,
            config,
            arguments.seed,
            arguments.env_id,
            track=arguments.track,
            model=arguments.model,
        )
    except (ValueError, OverflowError, OSError) as error:
        parser.error(str(error))
    print(f"{checkpoint.meta['steps']} steps in {checkpoint.meta['seconds']} s")
    print(f"checkpoint: {arguments.out / 'final.msgpack'}")


if __name__ == "__main__":
    main()
