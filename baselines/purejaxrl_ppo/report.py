"""One flight, or an evaluation's report, as text for a terminal; what a report is: docs/baseline.md."""

from typing import Any

import numpy as np

from baselines.purejaxrl_ppo.flights import Flight
from baselines.purejaxrl_ppo.summary import CONFIDENCE

UNITS = {
    "quadratic_drag_per_m": ("drag, mean of axes", "1/m"),
    "thrust_scale": ("thrust scale", ""),
    "wind_m_s": ("wind", "m/s"),
    "command_delay_s": ("command delay", "s"),
}
LAPS = {"first_lap_s": "first lap", "flying_lap_s": "flying laps"}


def lap_times(flight: Flight) -> np.ndarray:
    """Return the lap times of one flight, s, in order; the first is from the standing start."""
    return np.asarray(flight.lap_time_s)[np.asarray(flight.lap_completed)]


def reason_ended(flight: Flight, num_laps: int | None = None) -> str:
    """Return the causes of termination, that the laps were completed, or that the steps ran out."""
    causes = [name for name, happened in flight.causes._asdict().items() if np.any(happened)]
    if num_laps is not None and len(lap_times(flight)) >= num_laps:
        return "laps complete"
    return ", ".join(causes) or "all steps flown"


def describe(flight: Flight, dt: float, num_laps: int | None = None) -> str:
    """Return what a pilot wants to know of a flight; num_laps: that it was asked for, if any."""
    num_flown = int(np.sum(flight.is_flying))
    times = lap_times(flight)
    laps = ", ".join(f"{seconds:.3f} s" for seconds in times) or "none"
    return (
        f"flown: {num_flown} steps, {num_flown * dt:.2f} s\n"
        f"gates: {int(np.max(flight.gates_passed))}, laps: {len(times)}\n"
        f"lap times: {laps}\n"
        f"ended: {reason_ended(flight, num_laps)}"
    )


def describe_share(share: dict[str, Any]) -> str:
    """Return a share with its interval, where it has one."""
    text = f"{share['number']} of {share['of']}, {share['share']:.1%}"
    if share["low"] is None:
        return text
    return f"{text} ({CONFIDENCE:.0%} interval {share['low']:.1%} to {share['high']:.1%})"


def describe_times(name: str, times: dict[str, Any], optimal: dict[str, Any] | None, model: str) -> str:
    """Return one kind of lap: how many, how long, how far above the time-optimal one."""
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
    """Return the lines on all flights together."""
    ended = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in report["ended"].items() if n)
    gates = "" if report["laps"] is None else f" of {report['laps'] * report['gates_per_lap']}"
    return [
        f"flights that complete {report['laps']} laps: {describe_share(report['success'])}",
        f"gates: {report['gates_mean']:.2f}{gates}",
        f"ended: {ended}",
    ]


def describe_laps(report: dict[str, Any]) -> list[str]:
    """Return the lines on lap times."""
    optimal = report["optimal"] or {"model": ""}
    return [
        describe_times(label, report[lap], optimal.get(lap), optimal["model"]) for lap, label in LAPS.items()
    ]


def describe_plants(plants: dict[str, Any]) -> list[str]:
    """Return the lines on drawn plants: how many are raced, and how that depends on what was drawn."""
    lines = [
        f"plants on which every flight completes its laps: {describe_share(plants['success'])}",
        "by thirds of what was drawn:",
    ]
    for row in plants["by_thirds"]:
        label, unit = UNITS[row["quantity"]]
        bounds = f"{row['from']:.4g} to {row['to']:.4g} {unit}".rstrip()
        lines.append(f"  {label:19} {bounds:26} {describe_share(row['plants'])}")
    return lines


def describe_time_lost(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of the mean time lost against the time-optimal flight on the way to each gate."""

    def column(lap: str, row: dict[str, Any]) -> str:
        return f"{'-' if row[lap] is None else format(row[lap], '+.3f'):>12}"

    lines = [
        "lost on the way to each gate, mean of complete laps (s):",
        "  gate" + "".join(f"{label:>12}" for label in LAPS.values()),
    ]
    return lines + [f"  {row['gate']:4}" + "".join(column(lap, row) for lap in LAPS) for row in rows]


def describe_report(report: dict[str, Any]) -> str:
    """Return all lines on an evaluation."""
    where = f"the black box {report['black_box']}"
    if report["plants"] is not None:
        number = report["plants"]["success"]["of"]
        where = f"{number} plants drawn around the checkpoint's model, in the simulator, not on a black box"
    lines = [f"{report['flights']} flights, track {report['track']}: on {where}"]
    if report["success"] is not None:
        lines += describe_flights(report)
    lines += describe_laps(report)
    if report["plants"] is not None:
        lines += describe_plants(report["plants"])
    if report["time_lost_s"] is not None:
        lines += describe_time_lost(report["time_lost_s"])
    return "\n".join(lines) + "\n"
