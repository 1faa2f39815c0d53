"""Can every track be flown? Train on each and race: ``python -m benchmarks.tracks``.

For every shipped track and two random ones: train PPO with the shipped recipe on the nominal model, then fly
256 noisy starts over 3 laps in the same simulator. Writes a table.
"""

import argparse
import math
from pathlib import Path

import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.flights import fly_many, outcomes_of, score
from baselines.purejaxrl_ppo.training import train_policy
from benchmarks import report
from flytrack_env.files import fresh_folder
from flytrack_env.state import VELOCITY
from flytrack_env.tracks import available_tracks, build_course, random_track, save_track, way_length

RANDOM_SEEDS = (0, 1)
NUM_EPISODES, NUM_LAPS = 256, 3
SLOWEST_MEAN_SPEED = 8.0  # m/s along the way: slower laps run into the time limit of the evaluation
HEADER = (
    "track | gates | length (m) | success | gates passed | first lap (s) | flying lap (s) | "
    "highest speed (m/s) | ended early by"
)


def measure_track(name: str, track: str | Path, seed: int, out: Path, config: Config) -> tuple[str, ...]:
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
        name,
        str(num_gates),
        f"{length:.1f}",
        f"{result.success:.1%}",
        f"{result.gates:.2f} of {NUM_LAPS * num_gates}",
        f"{result.first_lap_s:.3f}",
        f"{result.flying_lap_s:.3f}",
        f"{np.linalg.norm(velocities, axis=1).max():.1f}",
        ", ".join(f"{name} {end.sum()}" for name, end in outcomes.ends().items() if end.any()) or "-",
    )


def main() -> None:
    """Measure every track, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="of training and evaluation")
    parser.add_argument("--total-timesteps", type=float, default=Config.total_timesteps, help="per training")
    parser.add_argument("--table", type=Path, default=report.RESULTS / "tracks.md", help="page to write")
    arguments = parser.parse_args()
    config = Config(total_timesteps=int(arguments.total_timesteps))
    config.check()
    out = fresh_folder(Path("runs/tracks"))
    tracks: dict[str, str | Path] = {name: name for name in available_tracks()}
    for seed in RANDOM_SEEDS:
        path = out / f"random_{seed}.toml"
        save_track(path, random_track(seed))
        tracks[f"random_track({seed})"] = path
    rows = []
    for name, track in tracks.items():
        rows.append(measure_track(name, track, arguments.seed, out, config))
        print(*rows[-1], sep=", ", flush=True)
    counts = {"steps": config.total_timesteps, "episodes": NUM_EPISODES, "laps": NUM_LAPS}
    report.fill_page(arguments.table, "tracks", table=report.table(HEADER, rows), **counts)


if __name__ == "__main__":
    main()
