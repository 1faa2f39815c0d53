"""Numbers of an evaluation as JSON values: shares with their interval, lap times, ends. None, never NaN."""

from typing import Any

import numpy as np
from scipy.stats import binomtest

from baselines.purejaxrl_ppo.flights import Outcomes

CONFIDENCE = 0.95
QUANTILES = {"q05": 0.05, "q50": 0.5, "q95": 0.95}


def share(is_success: np.ndarray) -> dict[str, Any]:
    """Return how many succeeded, of how many, the share, and its 95 % interval, ``low`` to ``high``.

    Wilson's interval: it holds near 0 and 1 too, where races are decided. Trials are taken as independent.
    """
    successes, number = int(np.sum(is_success)), int(np.size(is_success))
    interval = binomtest(successes, number).proportion_ci(CONFIDENCE, method="wilson")
    return {
        "number": successes,
        "of": number,
        "share": successes / number,
        "low": float(interval.low),
        "high": float(interval.high),
    }


def distribution(times_s: np.ndarray) -> dict[str, Any]:
    """Return number, mean, shortest, and the quantiles 5, 50 and 95 % of times; None where there are none."""
    if not times_s.size:
        return {"number": 0, "mean": None, "min": None, **dict.fromkeys(QUANTILES)}
    quantiles = np.quantile(times_s, list(QUANTILES.values()))
    return {
        "number": int(times_s.size),
        "mean": float(times_s.mean(dtype=float)),
        "min": float(times_s.min()),
        **dict(zip(QUANTILES, map(float, quantiles), strict=True)),
    }


def summarise(outcomes: Outcomes, is_limited: bool) -> dict[str, Any]:
    """Return what came of flights, as JSON values.

    is_limited: whether there was a number of laps to complete; without, ``success`` is None and a flight
    whose steps ran out counts as ended by the time limit. Several causes can end one flight.
    """
    is_complete = outcomes.is_complete()
    ended = {"laps_complete": is_complete, **outcomes.ends()}
    return {
        "flights": len(is_complete),
        "success": share(is_complete) if is_limited else None,
        "gates_mean": float(np.mean(outcomes.gates_passed)),
        "laps_mean": float(np.mean(outcomes.laps)),
        "steps": int(np.sum(outcomes.steps)),
        "ended": {name: int(np.sum(happened)) for name, happened in ended.items()},
        "first_lap_s": distribution(outcomes.first_laps_s()),
        "flying_lap_s": distribution(outcomes.flying_laps_s()),
    }
