"""Can every track be flown? Train on each and race: ``python -m benchmarks.tracks``.

For every shipped track and two random ones: trains PPO with the shipped recipe on the nominal model, then
flies 256 noisy starts over 3 laps in the same simulator. Writes a table.
"""

import argparse
import math
import platform
from pathlib import Path

import jax
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.evaluate import fly_many
from baselines.purejaxrl_ppo.flights import Outcomes, outcomes_of, score
from baselines.purejaxrl_ppo.train_ppo import train_policy
from flytrack_env.files import fresh_folder, write_atomically
from flytrack_env.state import VELOCITY
from flytrack_env.tracks import available_tracks, build_course, random_track, save_track, way_length

RANDOM_SEEDS = (0, 1)
NUM_EPISODES, NUM_LAPS = 256, 3
SLOWEST_MEAN_SPEED = 8.0  # m/s along the way: slower laps run into the time limit of the evaluation
HEADER = (
    "| track | gates | length (m) | success | gates passed | first lap (s) | flying lap (s) | "
    "highest speed (m/s) | ended early by |\n|---|---|---|---|---|---|---|---|---|\n"
)


def describe_ends(outcomes: Outcomes) -> str:
    """Return what ended episodes before the last lap, with how often."""
    return ", ".join(f"{name} {end.sum()}" for name, end in outcomes.ends().items() if end.any()) or "-"


def measure_track(name: str, track: str | Path, seed: int, out: Path, config: Config) -> str:
    """Train and race on a track, by name or path; return its row of the table."""
    checkpoint, _ = train_policy(out / name, config, seed, track=track)
    env = flytrack_env.make("FlyTrack-v0", track=track)
    length, num_gates = way_length(build_course(env.track)), len(env.track.gates)
    num_steps = math.ceil(NUM_LAPS * length / SLOWEST_MEAN_SPEED / env.default_params.dt)
    flight = fly_many(env, checkpoint.network, checkpoint.params, seed, NUM_EPISODES, num_steps, NUM_LAPS)
    outcomes = outcomes_of(flight, NUM_LAPS, num_gates)
    result = score(outcomes)
    velocities = np.asarray(flight.states)[np.asarray(flight.is_flying)][:, VELOCITY]
    return (
        f"| {name} | {num_gates} | {length:.1f} | {result.success:.1%} | {result.gates:.2f} of "
        f"{NUM_LAPS * num_gates} | {result.first_lap_s:.3f} | {result.flying_lap_s:.3f} | "
        f"{np.linalg.norm(velocities, axis=1).max():.1f} | {describe_ends(outcomes)} |\n"
    )


def main() -> None:
    """Measure every track, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="of training and evaluation")
    parser.add_argument("--out", type=Path, default=Path("runs/tracks"))
    parser.add_argument("--total-timesteps", type=float, default=Config.total_timesteps)
    parser.add_argument("--table", type=Path, default=Path("docs/results/tracks.md"))
    arguments = parser.parse_args()
    config = Config(total_timesteps=int(arguments.total_timesteps))
    config.check()
    out = fresh_folder(arguments.out)
    tracks: dict[str, str | Path] = {name: name for name in available_tracks()}
    for seed in RANDOM_SEEDS:
        path = out / f"random_{seed}.toml"
        save_track(path, random_track(seed))
        tracks[f"random_track({seed})"] = path
    rows = []
    for name, track in tracks.items():
        rows.append(measure_track(name, track, arguments.seed, out, config))
        print(rows[-1], end="", flush=True)
    text = (
        "# Racing on every track\n\n"
        f"`python -m benchmarks.tracks --seed {arguments.seed} "
        f"--total-timesteps {config.total_timesteps:g}` on "
        f"{platform.machine()}, {jax.device_count()} {jax.default_backend()} device, jax {jax.__version__}. "
        "Per track one policy, trained with the shipped recipe on the nominal model and flown in the same "
        f"simulator: {NUM_EPISODES} noisy starts, {NUM_LAPS} laps. Length: of the way on which episodes "
        "start. First lap: from standstill at the start to the last gate.\n\n" + HEADER + "".join(rows)
    )
    write_atomically(arguments.table, text.encode())


if __name__ == "__main__":
    main()
