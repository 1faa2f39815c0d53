"""One flight, or the numbers of an evaluation (docs/baseline.md), as text for a terminal."""

from typing import Any

import numpy as np

from baselines.purejaxrl_ppo.flights import Rollout
from baselines.purejaxrl_ppo.summary import CONFIDENCE

UNITS = {
    "quadratic_drag_per_m": ("drag, mean of axes", "1/m"),
    "thrust_scale": ("thrust scale", ""),
    "wind_m_s": ("wind", "m/s"),
    "command_delay_s": ("command delay", "s"),
}
LAPS = {"first_lap_s": "first lap", "flying_lap_s": "flying laps"}


def describe_flight(rollout: Rollout, dt: float, num_laps: int | None = None) -> str:
    """Return duration, gates, lap times and end of a flight; num_laps: laps to complete, if limited."""
    num_flown = int(np.sum(rollout.is_flying))
    times = rollout.lap_times()
    laps = ", ".join(f"{seconds:.3f} s" for seconds in times) or "none"
    return (
        f"flown: {num_flown} steps, {num_flown * dt:.2f} s\n"
        f"gates: {int(np.max(rollout.gates_passed))}, laps: {len(times)}\n"
        f"lap times: {laps}\n"
        f"ended: {rollout.end_reason(num_laps)}\n"
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
