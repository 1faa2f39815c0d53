"""A diagnosis of a measured flight: its record, and its section of a page.

The section has a paragraph for pilots, a picture and tables.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from benchmarks.report import commit_of_checkout, table
from flytrack_env.dynamics import ModelParameters
from flytrack_env.pictures.drawing import new_figure, plain
from flytrack_env.scene import BLUE, GREEN, GREY, ORANGE
from flytrack_sysid import FlightLog, Imported, diagnose, import_log
from flytrack_sysid.diagnosis import Diagnosis
from flytrack_sysid.diagnosis.evidence import words_of
from flytrack_sysid.diagnosis.refinement import Tested
from flytrack_sysid.diagnosis.report import verdict_of
from flytrack_sysid.prediction_windows import QUANTITIES, Windows, chunks_of, prediction_errors

Record = dict[str, Any]
STYLES: dict[str, dict[str, Any]] = {
    "nominal": {"color": ORANGE, "marker": "o"},
    "refitted_base": {"color": GREY, "marker": "o"},
    "extended": {"color": BLUE, "marker": "o", "linewidth": 2.4},
    "placebo": {"color": GREEN, "linestyle": "--"},
    "fir": {"color": "black", "linestyle": ":"},
    "arx": {"color": "black", "linestyle": "-."},
    "network": {"color": "black", "linestyle": "--"},
}
MOST_VALUES = 3  # of a cause, in a sentence
SPOKEN = (("attitude_rad", "0.25"), ("rates_rad_per_s", "0.25"), ("position_m", "1"))
WIDTH_IN, HEIGHT_IN = 2.6, 3.2


def diagnosed(
    log: FlightLog, model: ModelParameters, held_out: np.ndarray | None = None
) -> tuple[Diagnosis, Record]:
    """Return a log's diagnosis, and a record of it: JSON values, number of rows, CPU time."""
    started = time.process_time()
    found = diagnose(log, model, held_out)
    return found, {
        "num_rows": len(log),
        "cpu_s": time.process_time() - started,
        "jax": jax.__version__,
        "commit": commit_of_checkout(),
        "sentence": verdict_of(found).text,
        "diagnosis": found.as_json(),
    }


def imported(files: Path | Sequence[Path], kind: str, mapping: str) -> Imported:
    """Return logs imported with a mapping that is given as text."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mapping.toml"
        path.write_text(mapping, encoding="utf-8")
        return import_log(files, kind, path)


_errors = jax.jit(prediction_errors)


def tested(model: ModelParameters, windows: Windows) -> Tested:
    """Return a model's errors on windows; inside ``jax.enable_x64(True)``."""
    model = jax.tree.map(lambda leaf: np.asarray(leaf, float), model)
    parts = [np.asarray(_errors(model, chunk)) for chunk in chunks_of(windows)]
    errors = np.concatenate(parts, axis=1)[:, : len(windows.start)]
    return Tested(errors.reshape(1, *errors.shape[:-1], len(QUANTITIES), 3), windows)


def number(value: float | None, unit: str = "1") -> str:
    """Return three digits, and the unit if there is one."""
    text = "none" if value is None or not np.isfinite(value) else f"{value:.3g}"
    return text if unit == "1" else f"{text} {unit}"


def in_degrees(key: str, value: float) -> tuple[float, str]:
    """Return an error and its unit, with angles in degrees.

    key: "attitude_rad", "rates_rad_per_s", ...
    """
    unit = key.split("_", 1)[1].replace("_per_", "/")
    return (
        (float(np.rad2deg(value)), unit.replace("rad", "deg"))
        if unit.startswith("rad")
        else (value, unit)
    )


def paragraph(measured: Record) -> str:
    """Return what is wrong with the model, in words."""
    found = measured["diagnosis"]
    parts = [measured["sentence"], _values(found), _responses(found["half_response_s"])]
    return " ".join(filter(None, [*parts, _flights(found["prediction"])]))


def _values(found: Record) -> str:
    texts = []
    for cause in found["causes"]:
        told = cause["parameters"]
        told = {name: one for name, one in told.items() if name == "mean_factor"} or told
        values = [
            f"{name.replace('_', ' ')} {number(one['value'], one['unit'])}"
            for name, one in told.items()
        ]
        if len(values) <= MOST_VALUES:
            texts.append(f"{words_of(cause['effect'])}: {', '.join(values)}")
    return f"In numbers: {'; '.join(texts)}." if texts else ""


def _responses(found: Mapping[str, Mapping[str, Record]]) -> str:
    if not found:
        return ""

    def time_of(one: Record) -> str:
        high = (one["ci95"] or (None, None))[1]
        half = None if high is None else high - one["time"]
        if half is not None and half > one["time"]:
            return "not determined"
        return f"{1e3 * one['time']:.0f}" + ("" if half is None else f" ± {1e3 * half:.0f}")

    def times(model: str) -> str:
        known = {stick: one for stick, one in found[model].items() if one["time"] is not None}
        return ", ".join(f"{stick} {time_of(one)}" for stick, one in known.items())

    return (
        "From a small step of the stick to half of the answer it takes, in ms: "
        f"{times('extended')}; the model said {times('nominal')}."
    )


def _flights(prediction: Record) -> str:
    errors, texts = prediction["errors"], []
    for key, horizon in SPOKEN:
        if horizon in errors.get("extended", {}).get(key, {}):
            pairs = [
                in_degrees(key, errors[name][key][horizon])
                for name in ("nominal", "refitted_base", "extended")
            ]
            nominal, base, own = (f"{value:.3g}" for value, _ in pairs)
            what = key.split("_")[0]
            texts.append(
                f"{what} {own} {pairs[0][1]} after {horizon} s (nominal {nominal}, refitted {base})"
            )
    said = f"Errors of free flight that was held out: {'; '.join(texts)}." if texts else ""
    silent = [what for what, horizons in prediction["evidence"].items() if not horizons]
    if silent:
        said += (
            f" Of {' and '.join(silent)}, a guess from the start alone, without commands, "
            "is as good."
        )
    return said


def draw(measured: Record) -> Figure | None:
    """Draw held-out errors of free flight over its length, a panel a quantity; None without any."""
    errors = measured["diagnosis"]["prediction"]["errors"]
    if not errors:
        return None
    keys = list(errors["extended"])
    figure = new_figure(max(WIDTH_IN * len(keys), 2 * WIDTH_IN), HEIGHT_IN)
    for axes, key in zip(figure.subplots(1, len(keys), squeeze=False)[0], keys, strict=True):
        unit = in_degrees(key, 0.0)[1]
        for name, style in STYLES.items():
            by_horizon = errors.get(name, {}).get(key)
            if by_horizon:
                values = [in_degrees(key, one)[0] for one in by_horizon.values()]
                label = name.replace("_", " ")
                plain(axes).loglog(
                    [*map(float, by_horizon)], values, markersize=3, label=label, **style
                )
        axes.set_title(f"{key.split('_')[0]} ({unit})", fontsize="small", loc="left")
        axes.set_xticks([*map(float, errors["extended"][key])], [*errors["extended"][key]])
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.set_xlabel("seconds of free flight", fontsize="small")
        axes.tick_params(labelsize="small")
    entries = figure.axes[0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=4, frameon=False, fontsize="small")
    return figure


def causes_table(found: Record) -> str:
    """Return the causes with intervals, gains and what they may be confused with."""
    rows = []
    for cause in (*found["causes"], *found["beyond_the_list"]):
        values = "<br>".join(
            f"{name} {number(one['value'], one['unit'])} ({' to '.join(map(number, one['ci95']))})"
            for name, one in cause["parameters"].items()
        )
        values += (
            f"<br>**not named; beyond the list: {cause['beyond']}**" if cause["beyond"] else ""
        )
        rival = cause["closest_rival"]
        against = f"no (closest: {rival})" if rival else "not tried"
        gains = (cause["chi2_gain"], cause["heldout_gain"], cause["lambda"], cause["lambda_sep"])
        alike = ", ".join(cause["equivalent"]) or against
        rows.append([f"`{cause['effect']}`", values, *map(number, gains), alike])
    header = (
        "cause | values, 95 % intervals | chi2_gain | heldout_gain | lambda | lambda_sep | alike?"
    )
    return table(header, rows)


def errors_table(found: Record) -> str:
    """Return the errors of the models on held-out rows, of one step and of free flight."""
    models, flights = found["error"], found["prediction"]["errors"]
    columns = [*models, *(name for name in flights if name not in models)]
    rows = [
        [f"{channel}, one step, NRMSE"]
        + [number(models.get(name, {}).get("one_step_nrmse", {}).get(channel)) for name in columns]
        for channel in models["nominal"]["one_step_nrmse"]
    ]
    for quantity, by_horizon in flights.get("nominal", {}).items():
        what, unit = quantity.split("_", 1)
        rows += [
            [f"{what} after {horizon} s, {unit.replace('_per_', '/')}"]
            + [number(flights.get(name, {}).get(quantity, {}).get(horizon)) for name in columns]
            for horizon in by_horizon
        ]
    return table(
        ["rms error on held-out rows", *(name.replace("_", " ") for name in columns)], rows
    )


def changed_table(found: Record) -> str:
    """Return every parameter of the extended model that is not nominal."""
    rows = [
        [
            f"`{one['name']}`",
            number(one["nominal"], one["unit"]),
            number(one["value"], one["unit"])
            + (" (end of what is searched)" if one["is_at_bound"] else ""),
            " to ".join(map(number, one["ci95"])),
        ]
        for one in found["changed"]
    ]
    return table("parameter | nominal | extended | 95 % interval", rows)


def formulas_of(learned: Record) -> list[str]:
    """Return the formulas of what was learnt beyond the list."""
    return [one["formula"] for one in learned["law"]]


def section(measured: Record, picture: str) -> str:
    """Return what was found in one diagnosis; picture: the file of ``draw``."""
    found = measured["diagnosis"]
    left, learned = found["unexplained"]["times_sensor_noise"], found.get("learned")
    shares = ", ".join(
        f"{name} ({number(share)} times the sensor's noise)" for name, share in left.items()
    )
    small = ", ".join(f"`{cause['effect']}`" for cause in found["negligible"])
    cost = f"{measured['cpu_s']:.0f} CPU s, compilation included; commit {measured['commit']}"
    parts = [
        paragraph(measured),
        f"![Errors of free flight over its length]({picture})"
        if found["prediction"]["errors"]
        else "",
        f"{measured['num_rows']} rows; verdict `{found['verdict']}`; "
        f"motion `{found['motion']}`; {cost}.",
        causes_table(found),
        f"Significant, and too small to matter: {small}." if small else "",
        errors_table(found),
        "Every parameter that changed:",
        changed_table(found),
        f"Unexplained: {shares or 'nothing'}.",
        f"Learnt beyond the list: {'; '.join(formulas_of(learned))}." if learned else "",
        *found["warnings"],
    ]
    return "\n\n".join(filter(None, parts))
