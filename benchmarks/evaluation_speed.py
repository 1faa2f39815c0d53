"""How long many evaluation flights take on one core: ``python -m benchmarks.evaluation_speed CHECKPOINT``.

Flies a checkpoint from noisy starts on a black box and in the simulator, as ``eval_agent.py`` does, and
counts process CPU time. Compilation stands apart: a first call with a time limit of one step does it.
"""

import argparse
import time
from pathlib import Path
from typing import NamedTuple

from baselines.purejaxrl_ppo.checkpoint import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.evaluate import MAX_FLIGHTS, SHIPPED_BLACK_BOX
from baselines.purejaxrl_ppo.flights import race_many, start_keys
from baselines.purejaxrl_ppo.monitor import NUM_LAPS, NUM_STEPS
from baselines.purejaxrl_ppo.race_env import plant_env, simulated_env, with_model_as_given
from benchmarks import report
from flytrack_env import blackbox
from flytrack_env.episodes import EpisodicEnvironment

AIM_FLIGHTS, AIM_S = 10_000, 30.0
HEADER = "flown by | CPU s | first call, CPU s | steps flown | steps per CPU s | flights complete"


class Measured(NamedTuple):
    """CPU seconds of the flights, and of the first call, which compiles; steps flown; success, 0 to 1."""

    seconds: float
    first_call_s: float
    steps: int
    success: float

    def row(self, name: str) -> list[str]:
        """Return the row of the table."""
        steps = (f"{self.steps:,}", f"{self.steps / self.seconds:,.0f}")
        return [name, f"{self.seconds:.1f}", f"{self.first_call_s:.1f}", *steps, f"{self.success:.1%}"]


def measure(env: EpisodicEnvironment, checkpoint: Checkpoint, num_flights: int, seed: int) -> Measured:
    """Return what flights of a checkpoint cost."""
    keys, params = start_keys(seed, num_flights), with_model_as_given(env.default_params)
    seconds = []
    for num_steps in (1, NUM_STEPS):
        started_s = time.process_time()
        outcomes = race_many(env, checkpoint.network, checkpoint.params, keys, num_steps, NUM_LAPS, params)
        seconds.append(time.process_time() - started_s)
    first_call_s, flights_s = seconds
    return Measured(flights_s, first_call_s, int(outcomes.steps.sum()), float(outcomes.is_complete().mean()))


def main() -> None:
    """Measure both, print and write the table; exit 1 if the aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--episodes", type=int, default=AIM_FLIGHTS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--black-box", type=Path, default=SHIPPED_BLACK_BOX)
    parser.add_argument("--out", type=Path, default=report.RESULTS / "evaluation_speed.md")
    arguments = parser.parse_args()
    if not 1 <= arguments.episodes <= MAX_FLIGHTS:
        expected = f"expected 1 to {MAX_FLIGHTS}"
        parser.error(f"--episodes: found {arguments.episodes}, {expected}")
    pinned = report.pin_to_one_core()
    try:
        checkpoint = load_checkpoint(arguments.checkpoint)
        scenes = {
            "black box": plant_env(checkpoint, blackbox.load(arguments.black_box)),
            "simulator": simulated_env(checkpoint),
        }
    except (ValueError, OSError) as error:
        parser.error(str(error))
    measured = {
        name: measure(env, checkpoint, arguments.episodes, arguments.seed) for name, env in scenes.items()
    }
    text = report.page(
        "Evaluation speed",
        f"{report.command_line()}: {arguments.episodes:,} flights of {NUM_LAPS} laps from noisy starts, "
        "at most "
        f"{NUM_STEPS} steps each, of a {checkpoint.env_id} policy on {checkpoint.track}. "
        f"Aim: {AIM_FLIGHTS:,} flights in {AIM_S:g} s.",
        report.table(HEADER, [found.row(name) for name, found in measured.items()]),
        f"{pinned.capitalize()}. {report.provenance_line(report.provenance())}",
    )
    report.write_page(arguments.out, text)
    if max(found.seconds / arguments.episodes for found in measured.values()) > AIM_S / AIM_FLIGHTS:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
