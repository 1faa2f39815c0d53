"""A policy's flights beside the time-optimal one: percent above it, and where time is lost."""

from typing import Any

import numpy as np

from baselines.purejaxrl_ppo.flights import Outcomes
from flytrack_env.references import References

LAPS = {"first_lap_s": "standing", "flying_lap_s": "flying"}  # what each reference is the optimum of


def compare(summary: dict[str, Any], references: References) -> dict[str, Any]:
    """Return how far lap times are above the optimum, as JSON values.

    summary: as ``summary.summarise`` returns it. For each kind of lap: ``time_s`` of the optimum,
    ``mean_percent_above`` and ``min_percent_above`` of the laps flown, None where there were none.
    """
    compared: dict[str, Any] = {"model": references["flying"].model_name}
    for lap, kind in LAPS.items():
        percent = {
            f"{name}_percent_above": None
            if summary[lap][name] is None
            else references[kind].percent_above(summary[lap][name])
            for name in ("mean", "min")
        }
        compared[lap] = {"time_s": references[kind].time_s, **percent}
    return compared


def time_lost(outcomes: Outcomes, references: References) -> list[dict[str, Any]]:
    """Return the mean time lost on the way to each gate, s, as JSON values: one row per gate.

    Of complete laps, so that the rows add up to the mean lap less the optimum; None where there was none.
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
    return [{"gate": gate + 1, **dict(zip(LAPS, values, strict=True))} for gate, values in enumerate(columns)]
