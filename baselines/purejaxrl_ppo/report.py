"""An evaluation in numbers, as JSON values, and as text for a terminal (docs/baseline.md).

Where there is no number there is None, never NaN.
"""

from typing import Any

import numpy as np
from scipy.stats import binomtest

from baselines.purejaxrl_ppo.flights import Outcomes
from flytrack_env.references import References

CONFIDENCE = 0.95
QUANTILES = {"q05": 0.05, "q50": 0.5, "q95": 0.95}
KINDS = {"first_lap_s": "standing", "flying_lap_s": "flying"}  # the reference of each kind of lap
LAPS = {"first_lap_s": "first lap", "flying_lap_s": "flying laps"}
UNITS = {
    "quadratic_drag_per_m": ("drag, mean of axes", "1/m"),
    "thrust_scale": ("thrust scale", ""),
    "wind_m_s": ("wind", "m/s"),
    "command_delay_s": ("command delay", "s"),
}


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
    for lap, kind in KINDS.items():
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
        optimal = np.diff(references[KINDS[name]].gate_times_s, prepend=0.0)
        lost[name] = (own.mean(axis=0) - optimal).tolist() if len(own) else [None] * num_gates
    columns = zip(*lost.values(), strict=True)
    rows = zip(gate_ids, columns, strict=True)
    return [{"gate": gate, **dict(zip(KINDS, values, strict=True))} for gate, values in rows]


def describe_flight(flight: dict[str, Any], dt: float) -> str:
    """Return duration, gates, lap times and end of a flight."""
    laps = ", ".join(f"{seconds:.3f} s" for seconds in flight["lap_times_s"]) or "none"
    return (
        f"flown: {flight['steps']} steps, {flight['steps'] * dt:.2f} s\n"
        f"gates: {flight['gates']}, laps: {len(flight['lap_times_s'])}\n"
        f"lap times: {laps}\n"
        f"ended: {flight['ended']}\n"
    )


def describe_share(share: dict[str, Any]) -> str:
    """Return a share and its interval, if it has one."""
    text = f"{share['number']} of {share['of']}, {share['share']:.1%}"
    if share["low"] is None:
        return text
    return f"{text} ({CONFIDENCE:.0%} interval {share['low']:.1%} to {share['high']:.1%})"


def describe_times(name: str, times: dict[str, Any], optimal: dict[str, Any] | None, model: str) -> str:
    """Return number and times of one kind of lap, and by how much they exceed the time-optimal one."""
    if times["number"] == 0:
        return f"{name}: none"
    text = (
        f"{name}: {times['number']}, mean {times['mean']:.3f} s, shortest {times['min']:.3f} s, "
        f"5/50/95 %: {times['q05']:.3f}/{times['q50']:.3f}/{times['q95']:.3f} s"
    )
    if optimal is None:
        return text
    mean, shortest = (f"{optimal[f'{which}_percent_above']:.1f} %" for which in ("mean", "min"))
    time_s = f"{optimal['time_s']:.3f} s"
    return f"{text}\n  mean {mean}, shortest {shortest} above the time-optimal {time_s} (model {model})"


def describe_flights(report: dict[str, Any]) -> list[str]:
    """Return the lines about all flights."""
    ended = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in report["ended"].items() if n)
    gates = "" if report["laps"] is None else f" of {report['laps'] * report['gates_per_lap']}"
    return [
        f"flights that complete {report['laps']} laps: {describe_share(report['success'])}",
        f"gates: {report['gates_mean']:.2f}{gates}",
        f"ended: {ended}",
    ]


def describe_plants(plants: dict[str, Any]) -> list[str]:
    """Return the lines about drawn plants: success, and how it depends on each quantity."""
    lines = [
        f"plants on which every flight completes its laps: {describe_share(plants['success'])}",
        "by thirds of the drawn values:",
    ]
    for row in plants["by_thirds"]:
        label, unit = UNITS[row["quantity"]]
        bounds = f"{row['from']:.4g} to {row['to']:.4g} {unit}".rstrip()
        lines.append(f"  {label:19} {bounds:26} {describe_share(row['plants'])}")
    return lines


def describe_time_lost(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of mean time lost to the time-optimal flight on the way to each gate."""
    lines = ["lost on the way to each gate, mean of complete laps (s):"]
    lines.append("  gate" + "".join(f"{label:>12}" for label in LAPS.values()))
    for row in rows:
        cells = ("-" if row[lap] is None else format(row[lap], "+.3f") for lap in LAPS)
        lines.append(f"  {row['gate']:4}" + "".join(f"{cell:>12}" for cell in cells))
    return lines


def describe_report(report: dict[str, Any]) -> str:
    """Return the text about an evaluation."""
    where = f"the black box {report['black_box']}"
    if report["plants"] is not None:
        number = report["plants"]["success"]["of"]
        where = f"{number} plants drawn around the checkpoint's model, in the simulator, not on a black box"
    lines = [f"{report['flights']} flights, track {report['track']}: on {where}"]
    if report["success"] is not None:
        lines += describe_flights(report)
    optimal = report["optimal"] or {"model": ""}
    for lap, label in LAPS.items():
        lines.append(describe_times(label, report[lap], optimal.get(lap), optimal["model"]))
    if report["plants"] is not None:
        lines += describe_plants(report["plants"])
    if report["time_lost_s"] is not None:
        lines += describe_time_lost(report["time_lost_s"])
    return "\n".join(lines) + "\n"
