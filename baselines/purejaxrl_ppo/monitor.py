"""Evaluation flights of a policy while it trains, their files, and the progress line."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from baselines.purejaxrl_ppo.density import draw_position_density
from baselines.purejaxrl_ppo.flights import Outcomes, fly_many, outcomes_of, save_flight, score
from baselines.purejaxrl_ppo.networks import ActorCritic
from baselines.purejaxrl_ppo.recording import can_record, record_flights
from flytrack_env.progress import progress_bar

NUM_LAPS = 3
NUM_STEPS = 2500  # 25 s at 100 Hz: three laps of the slowest shipped track, flown by a beginner
EVALUATION_SEED = 20_000  # of the noisy starts: the same at every evaluation, unlike usual training seeds

logger = logging.getLogger(__name__)


def evaluation_metrics(outcomes: Outcomes) -> dict[str, float]:
    """Return the metrics of evaluation flights; times are left out where there are none.

    success: share that completed the laps. flying_lap_s: mean; best_lap_s: shortest flying lap. ended_*:
    share that each cause ended; ended_time_limit: share still in the air with laps to go.
    """
    values = {
        **score(outcomes)._asdict(),
        "laps": outcomes.laps.mean(),
        "best_lap_s": outcomes.flying_laps_s().min(initial=np.inf),
        "steps": outcomes.steps.mean(),
        **{f"ended_{name}": happened.mean() for name, happened in outcomes.ends().items()},
    }
    return {f"evaluation_{name}": float(value) for name, value in values.items() if np.isfinite(value)}


@contextmanager
def attempt(what: str, steps: int) -> Iterator[None]:
    """Turn an error into a warning: a failed evaluation must not end the training."""
    try:
        yield
    except Exception as error:  # whatever libraries that draw and record raise
        text = (str(error).splitlines() or [""])[0]
        message = "evaluation after %d steps: %s failed: %s: %s; training goes on"
        logger.warning(message, steps, what, type(error).__name__, text)


def evaluate_policy(
    env: Any,
    network: ActorCritic,
    params: Any,
    num_episodes: int,
    out: Path,
    steps: int,
    is_recorded: bool = False,
) -> tuple[dict[str, float], list[Path]]:
    """Fly noisy starts; write the first flight and the position density of all; return metrics and files.

    out: folder of the run. steps: environment steps of training so far, part of the files' names.
    is_recorded: also write the first flight as a Rerun recording, if Rerun is installed. What fails is a
    warning; the rest is returned.
    """
    metrics: dict[str, float] = {}
    with attempt("flying", steps):
        flights = fly_many(env, network, params, EVALUATION_SEED, num_episodes, NUM_STEPS, NUM_LAPS)
        metrics = evaluation_metrics(outcomes_of(flights, NUM_LAPS, len(env.track.gates)))
    if not metrics:
        return {}, []
    folder = out / "evaluation"
    rollout, chart = folder / f"rollout_{steps}.npy", folder / f"position_density_{steps}.png"
    first, recording = jax.tree.map(lambda leaf: leaf[0], flights), rollout.with_suffix(".rrd")
    density = (chart, flights.positions(), env.track, num_episodes, f"{steps:,} training steps")
    writers: dict[Path, Callable[[], None]] = {
        rollout: lambda: save_flight(rollout, first),
        chart: lambda: draw_position_density(*density),
    }
    if is_recorded and can_record():
        writers[recording] = lambda: record_flights(recording, {"policy": first}, env.track, NUM_LAPS)
    files = []
    for path, write in writers.items():
        with attempt(f"writing {path.name}", steps):
            write()
            files.append(path)
    return metrics, files


class ProgressLine:
    """One line: steps, rate, time left, mean return of the last episodes, success, best lap so far."""

    def __init__(self, total: int, done: int):
        self._bar = progress_bar("steps", total=total, initial=done, unit_scale=True, desc="compile")

    def begin(self) -> None:
        """Start the clock, now that everything is compiled."""
        self._bar.set_description("train")
        self._bar.unpause()

    def update(self, steps: int, last_return: float, success: float | None, best_lap_s: float | None) -> None:
        """Move on to a number of environment steps and show how the policy does."""
        success_text = "-" if success is None else f"{success:.0%}"
        best_lap = "-" if best_lap_s is None else f"{best_lap_s:.2f} s"
        text = f"return {last_return:.1f}, success {success_text}, best lap {best_lap}"
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(steps - self._bar.n)

    def close(self) -> None:
        """Leave the line as it is."""
        self._bar.close()
