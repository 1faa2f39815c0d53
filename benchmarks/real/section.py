"""A diagnosis of a measured flight: its record, and its section of a page.

The section has sentences for pilots, a picture and tables.
"""

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from benchmarks.report import Line as Record
from benchmarks.report import commit_of_checkout, table
from flytrack_env.dynamics import ModelParameters
from flytrack_env.pictures.drawing import new_figure, plain
from flytrack_env.scene import BLUE, GREEN, GREY, ORANGE
from flytrack_sysid import FlightLog, diagnose
from flytrack_sysid.diagnosis import Diagnosis
from flytrack_sysid.diagnosis.report import describe_verdict

STYLES: dict[str, dict[str, Any]] = {
    "nominal": {"color": ORANGE, "marker": "o"},
    "refitted_base": {"color": GREY, "marker": "o"},
    "extended": {"color": BLUE, "marker": "o", "linewidth": 2.4},
    "placebo": {"color": GREEN, "linestyle": "--"},
    "fir": {"color": "black", "linestyle": ":"},
    "arx": {"color": "black", "linestyle": "-."},
    "network": {"color": "black", "linestyle": "--"},
}
WIDTH_IN, HEIGHT_IN = 2.6, 3.2
SHOWN_HORIZON_S = "0.5"
SHOWN_MODELS = ("nominal", "refitted_base", "extended", "placebo")
# They trade off against each other, so that their mean over the log says more.
THRUST_COEFFICIENTS = ("c0", "c1", "c2", "c3", "c4", "c5")


def diagnose_log(
    log: FlightLog, model: ModelParameters, held_out: np.ndarray | None = None
) -> tuple[Diagnosis, Record]:
    """Return a log's diagnosis, and a record of it: JSON values, number of rows, CPU time."""
    started = time.process_time()
    log = replace(log, source=Path(log.source).name)  # warnings name it, and records are published
    diagnosis = diagnose(log, model, held_out)
    return diagnosis, {
        "num_rows": len(log),
        "cpu_s": time.process_time() - started,
        "jax": jax.__version__,
        "commit": commit_of_checkout(),
        "sentence": describe_verdict(diagnosis).text,
        "diagnosis": diagnosis.as_json(),
    }


def format_number(value: float | None, unit: str = "1") -> str:
    """Return three digits, and the unit if there is one."""
    text = "none" if value is None or not np.isfinite(value) else f"{value:.3g}"
    return text if unit == "1" else f"{text} {unit}"


def split_key(key: str) -> tuple[str, str]:
    """Return the quantity and the unit of a key: "attitude_rad", "rates_rad_per_s", ..."""
    quantity, unit = key.split("_", 1)
    return quantity, unit.replace("_per_", "/")


def describe_responses(by_model: Mapping[str, Mapping[str, Record]]) -> str:
    """Return how fast the craft answers its sticks, and how fast the nominal model did."""
    if not by_model:
        return ""

    def format_time(response: Record) -> str:
        time_s = response["time"]
        if response["ci95"] is None:
            return f"{1e3 * time_s:.0f}"
        highest = response["ci95"][1]
        half_s = math.inf if highest is None else highest - time_s
        return "not determined" if half_s > time_s else f"{1e3 * time_s:.0f} ± {1e3 * half_s:.0f}"

    def format_times(model: str) -> str:
        return ", ".join(
            f"{stick} {format_time(response)}"
            for stick, response in by_model[model].items()
            if response["time"] is not None
        )

    return (
        "From a small step of the stick to half of the answer it takes, in ms: "
        f"{format_times('extended')}; the model said {format_times('nominal')}."
    )


def draw_errors(measured: Record) -> Figure | None:
    """Draw held-out errors of free flight over its length, a panel a quantity; None without any."""
    errors = measured["diagnosis"]["prediction"]["errors"]
    if not errors:
        return None
    by_quantity = errors["extended"]
    figure = new_figure(max(WIDTH_IN * len(by_quantity), 2 * WIDTH_IN), HEIGHT_IN)
    panels = figure.subplots(1, len(by_quantity), squeeze=False)[0]
    for axes, (key, horizons) in zip(panels, by_quantity.items(), strict=True):
        quantity, unit = split_key(key)
        scale = np.rad2deg(1.0) if unit.startswith("rad") else 1.0
        for name, style in STYLES.items():
            by_horizon = errors.get(name, {}).get(key)
            if by_horizon:
                values = scale * np.array([*by_horizon.values()])
                label = name.replace("_", " ")
                plain(axes).loglog(
                    [*map(float, by_horizon)], values, markersize=3, label=label, **style
                )
        title = f"{quantity} ({unit.replace('rad', 'deg')})"
        axes.set_title(title, fontsize="small", loc="left")
        axes.set_xticks([*map(float, horizons)], [*horizons])
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.set_xlabel("seconds of free flight", fontsize="small")
        axes.tick_params(labelsize="small")
    entries = figure.axes[0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=4, frameon=False, fontsize="small")
    return figure


def causes_table(diagnosis: Record) -> str:
    """Return the causes with intervals and what they may be confused with."""
    rows = []
    for cause in (*diagnosis["causes"], *diagnosis["beyond_the_list"]):
        values = [
            f"{name} {format_number(one['value'], one['unit'])} ({_interval(one)})"
            for name, one in cause["parameters"].items()
            if name not in THRUST_COEFFICIENTS
        ]
        if cause["beyond"]:
            values.append(f"**not named; beyond the list: {cause['beyond']}**")
        equivalent = ", ".join(cause["equivalent"])
        rows.append([f"`{cause['effect']}`", "<br>".join(values), equivalent])
    return table("cause | values, 95 % intervals | or", rows)


def _interval(estimate: Record) -> str:
    return " to ".join(map(format_number, estimate["ci95"]))


def errors_table(diagnosis: Record) -> str:
    """Return the errors of free flight on held-out rows at one horizon; the record has all."""
    flights = diagnosis["prediction"]["errors"]
    rows = []
    for key in flights["nominal"]:
        quantity, unit = split_key(key)
        errors = [flights.get(name, {}).get(key, {}).get(SHOWN_HORIZON_S) for name in SHOWN_MODELS]
        rows.append([f"{quantity}, {unit}", *map(format_number, errors)])
    heads = [name.replace("_", " ") for name in SHOWN_MODELS]
    return table([f"rms error after {SHOWN_HORIZON_S} s", *heads], rows)


def formulas_of(learned: Record) -> list[str]:
    """Return the formulas of what was learnt beyond the list."""
    return [one["formula"] for one in learned["law"]]


def format_section(measured: Record, picture: str) -> str:
    """Return what was found in one diagnosis; the record has its warnings.

    Args:
        measured: record of a diagnosis.
        picture: file of ``draw_errors``.
    """
    diagnosis = measured["diagnosis"]
    unexplained = [
        f"{name} ({format_number(share)} times the sensor's noise)"
        for name, share in diagnosis["unexplained"]["times_sensor_noise"].items()
    ]
    small = ", ".join(f"`{cause['effect']}`" for cause in diagnosis["negligible"])
    learned = diagnosis.get("learned")
    cost = f"{measured['cpu_s']:.0f} CPU s, compilation included; commit {measured['commit']}"
    has_flights = diagnosis["prediction"]["errors"]
    # Else the sentence has the error of position.
    is_without_positions = bool(has_flights) and "position_m" not in has_flights["nominal"]
    parts = [
        measured["sentence"],
        describe_responses(diagnosis["half_response_s"]),
        f"![Errors of free flight over its length]({picture})" if has_flights else "",
        f"{measured['num_rows']} rows; verdict `{diagnosis['verdict']}`; "
        f"motion `{diagnosis['motion']}`; {cost}.",
        causes_table(diagnosis),
        f"Significant, and too small to matter: {small}." if small else "",
        errors_table(diagnosis) if is_without_positions else "",
        f"Unexplained: {', '.join(unexplained) or 'nothing'}.",
        f"Learnt beyond the list: {'; '.join(formulas_of(learned))}." if learned else "",
    ]
    return "\n\n".join(filter(None, parts))
