"""Fly a checkpoint on a black box: ``python eval_agent.py --checkpoint PATH --steps N``.

The black box moves the drone; the environment's own gate logic says what was passed, when, and why
the flight ended. The rollout is written as a plain numeric array (T, 25) = [x 21 | u 4].
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.evaluate import fly_episode, start_pose_params
from baselines.purejaxrl_ppo.flights import Flight
from flytrack_env import FlyTrack, blackbox
from flytrack_env.rollout import save_rollout

SHIPPED_BLACK_BOX = Path(__file__).parent / "blackbox" / "acro_step.bin"

MAX_SEED = 2**31


def black_box_env(checkpoint: Checkpoint, black_box: Path) -> FlyTrack:
    """Return the checkpoint's environment with the black box in place of the simulator.

    Raises:
        BlackBoxError, CheckpointError, TrackError: a file that cannot be used.
    """
    env = flytrack_env.make(
        checkpoint.env_id,
        track=checkpoint.track,
        plant=blackbox.load(black_box),
        missed_gate=checkpoint.meta["missed_gate"],
    )
    checkpoint.check_fits(env)
    env.check_params(env.default_params)
    return env


def fly_on_black_box(checkpoint: Checkpoint, black_box: Path, num_steps: int, seed: int) -> Flight:
    """Return one flight of the policy on a black box, from a noisy start pose, any number of laps."""
    env = black_box_env(checkpoint, black_box)
    params = start_pose_params(env.default_params, num_steps)
    key = jax.random.key(seed)
    network, policy_params = checkpoint.network, checkpoint.params
    return fly_episode(env, network, policy_params, key, params, num_steps, num_steps)


def lap_times(flight: Flight) -> np.ndarray:
    """Return the lap times of one flight, s, in order; the first is from the standing start."""
    return np.asarray(flight.lap_time_s)[np.asarray(flight.lap_completed)]


def reason_ended(flight: Flight) -> str:
    """Return the causes of termination, or that the steps ran out."""
    causes = [name for name, happened in flight.causes._asdict().items() if np.any(happened)]
    return ", ".join(causes) or "all steps flown"


def describe(flight: Flight, dt: float) -> str:
    """Return what a pilot wants to know of a flight."""
    num_flown = int(np.sum(flight.is_flying))
    times = lap_times(flight)
    laps = ", ".join(f"{seconds:.3f} s" for seconds in times) or "none"
    return (
        f"flown: {num_flown} steps, {num_flown * dt:.2f} s\n"
        f"gates: {int(np.max(flight.gates_passed))}, laps: {len(times)}\n"
        f"lap times: {laps}\n"
        f"ended: {reason_ended(flight)}"
    )


def save_flown(path: Path, flight: Flight) -> None:
    """Write the steps that were flown as a rollout file."""
    is_flying = np.asarray(flight.is_flying)
    save_rollout(path, np.asarray(flight.states)[is_flying], np.asarray(flight.actions)[is_flying])


def main() -> None:
    """Parse the command line, fly, print the result, write the rollout."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--steps", type=int, required=True, help="at 100 Hz; 2000 are 20 s")
    parser.add_argument("--black-box", type=Path, default=SHIPPED_BLACK_BOX)
    parser.add_argument("--seed", type=int, default=0, help="of the noisy start pose")
    parser.add_argument("--out", type=Path, default=Path("rollout.npy"))
    arguments = parser.parse_args()
    if arguments.steps < 1:
        parser.error(f"--steps: found {arguments.steps}, expected at least 1")
    if not 0 <= arguments.seed < MAX_SEED:
        parser.error(f"--seed: found {arguments.seed}, expected 0 to {MAX_SEED - 1}")
    if arguments.out.is_dir():
        parser.error(f"--out: {arguments.out} is a folder, expected the path of a file")
    try:
        checkpoint = load_checkpoint(arguments.checkpoint)
        flight = fly_on_black_box(checkpoint, arguments.black_box, arguments.steps, arguments.seed)
        print(describe(flight, dt=blackbox.DT))
        save_flown(arguments.out, flight)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(f"rollout: {arguments.out}")


if __name__ == "__main__":
    main()
