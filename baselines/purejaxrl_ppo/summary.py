"""The numbers of an evaluation as JSON values: success, lap times, ends, time above the optimum.

Where there is no number there is None, never NaN.
"""

from typing import Any

import numpy as np
from scipy.stats import binomtest

from baselines.purejaxrl_ppo.flights import Outcomes
from flytrack_env.references import References

CONFIDENCE = 0.95
QUANTILES = {"q05": 0.05, "q50": 0.5, "q95": 0.95}
LAPS = {"first_lap_s": "standing", "flying_lap_s": "flying"}  # the reference of each kind of lap


def share(is_success: np.ndarray) -> dict[str, Any]:
    """Return number of successes, number of trials, share, and its 95 % interval, ``low`` to ``high``.

    Wilson's interval, which is valid near 0 and 1 too. Trials are assumed to be independent.
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
    """Return number, mean, shortest, and 5, 50 and 95 % quantiles of times; None where there are none."""
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
    """Return a summary of flights, as JSON values.

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


def compare_with_optimum(summary: dict[str, Any], references: References) -> dict[str, Any]:
    """Return by how much lap times exceed the optimum, as JSON values.

    summary: as ``summarise`` returns it. For each kind of lap: ``time_s`` of the optimum,
    ``mean_percent_above`` and ``min_percent_above`` of the laps flown, None where there were none.
    """
    comparison: dict[str, Any] = {"model": references["flying"].model_name}
    for lap, kind in LAPS.items():
        percent = {
            f"{name}_percent_above": None
            if summary[lap][name] is None
            else references[kind].percent_above(summary[lap][name])
            for name in ("mean", "min")
        }
        comparison[lap] = {"time_s": references[kind].time_s, **percent}
    return comparison


def time_lost(outcomes: Outcomes, references: References, gate_ids: list[int]) -> list[dict[str, Any]]:
    """Return the mean time lost on the way to each gate, s, as JSON values: one row per gate, with its id.

    Only complete laps count, so that the rows add up to mean lap time minus optimum; None without any.
    """
    num_gates = len(references["flying"].gate_times_s)
    num_laps = outcomes.lap_times_s.shape[-1]
    times_s = outcomes.gate_times_s.astype(float).reshape(-1, num_laps, num_gates)
    starts_s = np.concatenate([np.zeros((len(times_s), 1)), times_s[:, :-1, -1]], axis=1)
    within_s = times_s - starts_s[..., None]
    laps = {"first_lap_s": within_s[:, 0], "flying_lap_s": within_s[:, 1:].reshape(-1, num_gates)}
    lost: dict[str, Any] = {}
    for name, gates_s in laps.items():
        complete = gates_s[np.isfinite(gates_s).all(axis=1)]
        own = np.diff(complete, axis=1, prepend=0.0)
        optimal = np.diff(references[LAPS[name]].gate_times_s, prepend=0.0)
        lost[name] = (own.mean(axis=0) - optimal).tolist() if len(own) else [None] * num_gates
    columns = zip(*lost.values(), strict=True)
    rows = zip(gate_ids, columns, strict=True)
    return [{"gate": gate, **dict(zip(LAPS, values, strict=True))} for gate, values in rows]
