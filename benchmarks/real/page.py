"""The part of the page on measured flights that judges Crazyflie policies left out."""

import json
from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np

from benchmarks.real.crazyflie import FITS, LINES
from benchmarks.report import lines_in, table
from flytrack_sysid.prediction_windows import HORIZONS_S, QUANTITIES

FIGURES = (("attitude", 0.1, 0.70), ("attitude", 0.25, 0.83), ("position", 0.5, 0.80))
BLACK_BOXES = {
    "fir": "FIR, linear in the commands of 0.3 s",
    "arx": "ARX, linear in commands and its own rates",
    "network": "network on top of the refitted base",
}
OTHERS = {
    "refitted_to_flights": "the base alone, fitted to flights too",
    "placebo": "placebo: the state at the start, no commands",
}
AS_GOOD = 1.005  # rounds to 1.00
WITHIN_MS = 5.0  # times to half response
Line = dict[str, Any]


def lines_of() -> list[Line]:
    """Return the last line of each policy, by policy; none where nothing was measured."""
    last = {line["policy"]: line for line in lines_in(LINES)}
    return [last[policy] for policy in sorted(last)]


def ratios(line: Line, model: str) -> np.ndarray:
    """Return a model's rms errors over the refitted base's, (horizons, quantities)."""
    return np.array(line["rms"][model]) / np.array(line["rms"]["refitted_base"])


def _cell(quantity: str, horizon_s: float) -> tuple[int, int]:
    return HORIZONS_S.index(horizon_s), QUANTITIES.index(quantity)


def _median(lines: list[Line], value: Callable[[Line], np.ndarray]) -> np.ndarray:
    return np.median(np.stack([value(line) for line in lines]), axis=0)


def figures_table(lines: list[Line]) -> str:
    """Return the asked figures: medians over policies, and the same over the best black box."""
    rows = []
    for quantity, horizon, asked in FIGURES:
        cell = _cell(quantity, horizon)
        own = _median(lines, lambda line: ratios(line, "extended"))[cell]
        boxes = [_median(lines, lambda line: ratios(line, name))[cell] for name in BLACK_BOXES]  # noqa: B023
        cells = [f"{value:.2f}" for value in (*boxes, own / min(boxes))]
        rows.append([f"{quantity} after {horizon:g} s", f"{own:.2f}", f"<= {asked:.2f}", *cells])
    header = ["rms error over the refitted base's, median", "extended", "asked", *BLACK_BOXES]
    return table([*header, "extended over the best"], rows)


def horizons_table(lines: list[Line]) -> str:
    """Return the medians over policies at all horizons, of all models."""
    names = {"extended": "extended model", **OTHERS, **BLACK_BOXES}
    rows = []
    for quantity in QUANTITIES:
        for name, words in names.items():
            found = [line for line in lines if name in line["rms"]]
            if found:
                middle = _median(found, lambda line: ratios(line, name))[:, QUANTITIES.index(quantity)]  # noqa: B023
                rows.append([quantity, words, *(f"{value:.2f}" for value in middle)])
    return table(["error of", "model", *(f"{horizon:g} s" for horizon in HORIZONS_S)], rows)


def policies_table(lines: list[Line]) -> str:
    """Return what stayed in the model of each fold, and how the left-out policy is predicted."""
    rows = []
    for line in lines:
        found = ratios(line, "extended")
        flights = np.concatenate([np.ravel(one) for one in line["by_flight"].values()])
        flights = flights[flights > 0.0]
        cells = [f"{found[_cell(quantity, horizon)]:.2f}" for quantity, horizon, _ in FIGURES]
        worse = f"{np.sum(flights > AS_GOOD)} of {len(flights)}"
        kept = ", ".join(f"`{name}`" for name in line["kept"]) or "none: the refitted base"
        rows.append([line["policy"], kept, *cells, f"{np.nanmax(found):.2f}", worse, f"{line['cpu_s']:.0f}"])
    heads = [f"{quantity} {horizon:g} s" for quantity, horizon, _ in FIGURES]
    header = ["left-out policy", "effects that stay", *heads, "largest of all cells"]
    return table([*header, "cells worse, by flight", "CPU s"], rows)


def fits_part() -> str:
    """Return the values of one structure fitted to the flights of each policy, and whether they agree."""
    if not FITS.exists():
        return ""
    fits = json.loads(FITS.read_text(encoding="utf-8"))
    rows = []
    for name in fits[0]["values"]:
        if "." not in name and not name.startswith("tau"):
            continue
        pairs = [one["values"][name] for one in fits]
        agree = [abs(a - b) <= first + second for (a, first), (b, second) in combinations(pairs, 2)]
        values = [f"{value:.3g} ± {half:.2g}" for value, half in pairs]
        rows.append([f"`{name}`", *values, f"{sum(agree)} of {len(agree)}"])
    for stick in fits[0]["half_response_s"]:
        times_ms = np.array([1e3 * one["half_response_s"][stick] for one in fits])
        agree = [abs(a - b) <= WITHIN_MS for a, b in combinations(times_ms, 2)]
        cells = [f"{time:.1f} ms" for time in times_ms]
        rows.append([f"half response, {stick}", *cells, f"{sum(agree)} of {len(agree)}"])
    heads = [f"policy {one['policy']}" for one in fits]
    return table(["parameter", *heads, f"pairs that overlap (times: within {WITHIN_MS:g} ms)"], rows)


def crazyflie_part() -> str:
    """Return the part of the page; nothing where nothing was measured."""
    lines = lines_of()
    if not lines:
        return ""
    num_flights = sum(len(line["by_flight"]) for line in lines)
    parts = [
        "### Policies left out",
        f"{len(lines)} policies, {num_flights} flights; each is judged by models that were learnt from the "
        "others (`python -m benchmarks.real.crazyflie`). Free flights start from measured states every "
        "0.25 s. Numbers are errors over those of the refitted base, the model that a user gets without any "
        "effect: below 1 is better.",
        figures_table(lines),
        horizons_table(lines),
        policies_table(lines),
    ]
    fitted = fits_part()
    if fitted:
        parts += [
            "One structure fitted to the flights of each policy alone (`--fits`), 95 % intervals:",
            fitted,
        ]
    return "\n\n".join(parts)
