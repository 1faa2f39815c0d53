"""What is seen of a policy while it trains: evaluation flights, their files, and the live line."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from baselines.purejaxrl_ppo.density import draw_position_density
from baselines.purejaxrl_ppo.distributed import is_first
from baselines.purejaxrl_ppo.evaluate import fly_many
from baselines.purejaxrl_ppo.flights import Outcomes, outcomes_of, save_flown, score
from baselines.purejaxrl_ppo.networks import ActorCritic
from baselines.purejaxrl_ppo.recording import can_record, record_flights

NUM_LAPS = 3
NUM_STEPS = 2500  # 25 s at 100 Hz: three laps of the slowest shipped track, flown by a beginner
EVALUATION_SEED = 20_000  # of the noisy starts: the same at every evaluation, none of a usual training seed

logger = logging.getLogger(__name__)


def evaluation_metrics(outcomes: Outcomes) -> dict[str, float]:
    """Return what evaluation flights show; times that there is none of are left out.

    success: share that completed the laps. flying_lap_s: mean; best_lap_s: shortest flying lap. ended_*:
    share that each cause ended; ended_time_limit: of those still in the air, their laps not complete.
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
    """Warn of an error and go on: no evaluation is worth the training that it watches."""
    try:
        yield
    except Exception as error:  # whatever libraries that draw and record raise
        text = (str(error).splitlines() or [""])[0]
        logger.warning(
            "evaluation after %d steps: %s failed: %s: %s; training goes on",
            steps,
            what,
            type(error).__name__,
            text,
        )


def evaluate_policy(
    env: Any,
    network: ActorCritic,
    params: Any,
    num_episodes: int,
    out: Path,
    steps: int,
    is_recorded: bool = False,
) -> tuple[dict[str, float], list[Path]]:
    """Fly noisy starts and write the first flight and the position density of all; return metrics and files.

    out: folder of the run. steps: environment steps of training so far, which name the files. is_recorded:
    write the first flight as a Rerun recording too, where that is installed. What fails is reported, and
    what came of the rest is returned.
    """
    metrics: dict[str, float] = {}
    files: list[Path] = []
    flights = None
    with attempt("flying", steps):
        flights = fly_many(env, network, params, EVALUATION_SEED, num_episodes, NUM_STEPS, NUM_LAPS)
        metrics = evaluation_metrics(outcomes_of(flights, NUM_LAPS, len(env.track.gates)))
    if flights is None:
        return metrics, files
    folder = out / "evaluation"
    rollout, chart = folder / f"rollout_{steps}.npy", folder / f"position_density_{steps}.png"
    first = jax.tree.map(lambda leaf: leaf[0], flights)
    with attempt("writing the rollout", steps):
        save_flown(rollout, first)
        files.append(rollout)
    with attempt("drawing the position density", steps):
        label = f"{steps:,} training steps"
        draw_position_density(chart, flights.positions(), env.track, num_episodes, label)
        files.append(chart)
    if is_recorded and can_record():
        with attempt("recording with Rerun", steps):
            record_flights(rollout.with_suffix(".rrd"), {"policy": first}, env.track, NUM_LAPS)
            files.append(rollout.with_suffix(".rrd"))
    return metrics, files


class Seen(NamedTuple):
    """What evaluations have shown so far: the last one's success, the shortest flying lap of all, s."""

    success: float | None = None
    best_lap_s: float | None = None

    def after(self, evaluation: dict[str, float]) -> "Seen":
        """Return what has been seen after another evaluation, which may have failed."""
        laps = (self.best_lap_s, evaluation.get("evaluation_best_lap_s"))
        return Seen(
            evaluation.get("evaluation_success", self.success),
            min((lap_s for lap_s in laps if lap_s is not None), default=None),
        )

    def metrics(self) -> dict[str, float]:
        """Return what no single evaluation tells."""
        return {} if self.best_lap_s is None else {"evaluation_best_lap_so_far_s": self.best_lap_s}


class LiveLine:
    """One line: steps, rate, time left, mean return of the last episodes, success, best lap so far."""

    def __init__(self, total: int, done: int):
        is_hidden = not is_first()
        self._bar = tqdm(
            total=total, initial=done, unit="step", unit_scale=True, desc="compile", disable=is_hidden
        )

    def begin(self) -> None:
        """Count time from now on: what came before was compilation."""
        self._bar.set_description("train")
        self._bar.unpause()

    def trained(self, steps: int) -> None:
        """Move on to a number of environment steps."""
        self._bar.update(steps - self._bar.n)

    def show(self, last_return: float, seen: Seen) -> None:
        """Show how the policy does."""
        success = "-" if seen.success is None else f"{seen.success:.0%}"
        best_lap = "-" if seen.best_lap_s is None else f"{seen.best_lap_s:.2f} s"
        text = f"return {last_return:.1f}, success {success}, best lap {best_lap}"
        self._bar.set_postfix_str(text, refresh=False)

    def close(self) -> None:
        """Leave the line as it is."""
        self._bar.close()
