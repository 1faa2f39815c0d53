"""An evaluation in numbers, as JSON values, and as text for a terminal (docs/baseline.md).

Where there is no number there is None, never NaN.
"""

from typing import Any

import numpy as np
from scipy.stats import binomtest

from baselines.purejaxrl_ppo.checkpoint_env import RANGES
from baselines.purejaxrl_ppo.flights import Outcomes
from flytrack_env.references import References

CONFIDENCE = 0.95
QUANTILES = {"q05": 0.05, "q50": 0.5, "q95": 0.95}
KINDS = {"first_lap_s": "standing", "flying_lap_s": "flying"}  # the reference of each kind of lap
LAPS = {"first_lap_s": "first lap", "flying_lap_s": "flying laps"}


def share(is_success: np.ndarray) -> dict[str, Any]:
    """Return the numbers of successes and trials, the share, and its 95 % interval.

    The interval is ``low`` to ``high``.

    Wilson's interval, which is valid near 0 and 1 too. Trials are assumed to be independent.
    """
    successes, number = int(np.sum(is_success)), int(np.size(is_success))
    low, high = binomtest(successes, number).proportion_ci(CONFIDENCE, method="wilson")
    counts = {"number": successes, "of": number, "share": successes / number}
    return {**counts, "low": float(low), "high": float(high)}


def distribution(times_s: np.ndarray) -> dict[str, Any]:
    """Return number, mean, minimum, and 5, 50 and 95 % quantiles of times; None without any."""
    if not times_s.size:
        return {"number": 0, **dict.fromkeys(("mean", "min", *QUANTILES))}
    values = {"mean": times_s.mean(dtype=float), "min": times_s.min()}
    values |= {name: np.quantile(times_s, quantile) for name, quantile in QUANTILES.items()}
    return {"number": times_s.size, **{name: float(value) for name, value in values.items()}}


def summarize(outcomes: Outcomes, is_limited: bool) -> dict[str, Any]:
    """Return a summary of flights, as JSON values.

    Args:
        outcomes: of the flights; several causes can end one.
        is_limited: whether there is a number of laps to complete. Without, ``success`` is None, and
            a flight whose steps ran out counts as ended by the time limit.
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


def summarize_plants(drawn: dict[str, np.ndarray], is_complete: np.ndarray) -> dict[str, Any]:
    """Return on how many plants every flight completes its laps, as JSON values.

    Args:
        drawn: values by the names of ``RANGES``, (num_plants,) each.
        is_complete: of flights, (num_plants, num_episodes).

    Returns: ``by_thirds`` shows how success depends on each quantity: a row for each third of the
        plants, with the smallest and the largest value in it.
    """
    is_passed, rows = np.asarray(is_complete.all(axis=1)), []
    for name, values in drawn.items():
        thirds = np.array_split(np.argsort(values, kind="stable"), 3)
        for third, plants in enumerate(thirds, start=1):
            if plants.size:
                bounds = {"from": float(values[plants].min()), "to": float(values[plants].max())}
                shares = {
                    "plants": share(is_passed[plants]),
                    "flights_share": float(is_complete[plants].mean()),
                }
                rows.append({"quantity": name, "third": third, **bounds, **shares})
    ranges = {name: list(bounds) for name, bounds in RANGES.items()}
    return {"success": share(is_passed), "ranges": ranges, "by_thirds": rows}


def compare_with_optimum(summary: dict[str, Any], references: References) -> dict[str, Any]:
    """Return by how much lap times exceed the optimum, as JSON values.

    Args:
        summary: as ``summarize`` returns it.
        references: time-optimal flights.

    Returns: For each kind of lap ``time_s`` of the optimum, and ``mean_percent_above`` and
        ``min_percent_above`` of the laps flown, None where there were none.
    """
    comparison: dict[str, Any] = {"model": references["flying"].model_name}
    for lap, kind in KINDS.items():
        comparison[lap] = {"time_s": references[kind].time_s}
        for name in ("mean", "min"):
            time_s = summary[lap][name]
            above = None if time_s is None else references[kind].percent_above(time_s)
            comparison[lap][f"{name}_percent_above"] = above
    return comparison


def compute_time_lost(
    outcomes: Outcomes, references: References, gate_ids: list[int]
) -> list[dict[str, Any]]:
    """Return the mean time lost on the way to each gate, s, as JSON values.

    There is one row per gate, with its id.

    Only complete laps count, so that the rows add up to mean lap time minus optimum; None without
    any.
    """
    shape = (-1, outcomes.lap_times_s.shape[-1], len(gate_ids))  # flights, laps, gates
    legs_s = np.diff(outcomes.gate_times_s.astype(float), axis=-1, prepend=0.0).reshape(shape)
    laps = {"first_lap_s": legs_s[:, :1], "flying_lap_s": legs_s[:, 1:]}
    rows: list[dict[str, Any]] = [{"gate": gate, **dict.fromkeys(KINDS)} for gate in gate_ids]
    for name, kind in KINDS.items():
        complete = laps[name][np.isfinite(laps[name]).all(axis=-1)]
        if len(complete):
            lost = complete.mean(axis=0) - np.diff(references[kind].gate_times_s, prepend=0.0)
            for row, time_s in zip(rows, lost.tolist(), strict=True):
                row[name] = time_s
    return rows


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
    if share["low"] is not None:
        text += f" ({CONFIDENCE:.0%} interval {share['low']:.1%} to {share['high']:.1%})"
    return text


def describe_times(times: dict[str, Any], optimal: dict[str, Any] | None) -> str:
    """Return the number and times of one kind of lap, and their excess over the time optimum."""
    if times["number"] == 0:
        return "none"
    text = (
        "{number}, mean {mean:.3f} s, shortest {min:.3f} s, "
        "5/50/95 %: {q05:.3f}/{q50:.3f}/{q95:.3f} s"
    )
    if optimal is not None:
        text += "\n  mean {mean_percent_above:.1f} %, shortest {min_percent_above:.1f} % above"
        text += " the time-optimal {time_s:.3f} s"
    return text.format(**times, **(optimal or {}))


def describe_report(report: dict[str, Any]) -> str:
    """Return the text about an evaluation."""
    plants, optimal, limit = report["plants"], report["optimal"], report["laps"]
    where = f"the black box {report['black_box']}"
    if plants is not None:
        number = plants["success"]["of"]
        where = (
            f"{number} plants drawn around the checkpoint's model, in the simulator, "
            "not on a black box"
        )
    lines = [f"{report['flights']} flights, track {report['track']}: on {where}"]
    if report["success"] is not None:
        ended = (
            f"{name.replace('_', ' ')} {number}"
            for name, number in report["ended"].items()
            if number
        )
        lines += [
            f"flights that complete {limit} laps: {describe_share(report['success'])}",
            f"gates: {report['gates_mean']:.2f} of {limit * report['gates_per_lap']}",
            f"ended: {', '.join(ended)}",
        ]
    if optimal is not None:
        lines.append(f"time-optimal laps: of model {optimal['model']}")
    for lap, label in LAPS.items():
        lines.append(f"{label}: {describe_times(report[lap], optimal and optimal[lap])}")
    if plants is not None:
        lines.append(
            f"plants on which every flight completes its laps: {describe_share(plants['success'])}"
        )
        lines.append("by thirds of the drawn values:")
        for row in plants["by_thirds"]:
            bounds = f"{row['from']:.4g} to {row['to']:.4g}"
            lines.append(f"  {row['quantity']:20} {bounds:18} {describe_share(row['plants'])}")
    if report["time_lost_s"] is not None:
        lines.append("lost on the way to each gate, mean of complete laps (s):")
        lines.append("  gate" + "".join(f"{label:>12}" for label in LAPS.values()))
        for row in report["time_lost_s"]:
            cells = ("-" if row[lap] is None else f"{row[lap]:+.3f}" for lap in LAPS)
            lines.append(f"  {row['gate']:4}" + "".join(f"{cell:>12}" for cell in cells))
    return "\n".join(lines) + "\n"
