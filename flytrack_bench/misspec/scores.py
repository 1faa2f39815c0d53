"""Scores of answers, a line a log, and their summary with intervals by plants.

Every share is one that a good method has at 1, and a log without an answer counts as 0 in each.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import binomtest

from flytrack_bench.hidden import Truth
from flytrack_bench.misspec.suite import Plant

Line = dict[str, Any]
NAMED_ROWS = ("one", "two", "onset")  # whose truth has names
# Hidden plants have other laws for these, whose parameters are not the package's.
OTHER_LAW = ("translational_lift", "rate_saturation", "ground_effect")
DRAWS, COVERED = 2000, 0.95
SHARES: dict[str, tuple[str, Callable[[Line], bool]]] = {
    # name: what is right, of which logs
    "silent": ("no name on a clean plant", lambda line: line["row"] == "clean"),
    "quiet": (
        "neither a name nor a flag on a clean plant without gusts",
        lambda line: line["row"] == "clean" and line["noise"] != "gusts",
    ),
    "no_false_name": ("every name is true", lambda line: True),
    "exact": ("exactly the true names", lambda line: line["row"] in NAMED_ROWS),
    "in_class": (
        "each true effect in the class of a name of its own",
        lambda line: line["row"] in NAMED_ROWS,
    ),
    "detected": ("a name or a flag on a plant with a fault", lambda line: line["row"] != "clean"),
    "left_open": ("outside the list: flagged, no name", lambda line: line["row"] == "outside"),
}


def score(plant: Plant, answer: Line) -> Line:
    """Return a log's line: what was said, the truth, and the scores of it."""
    truth, names = plant.truth, set(answer.get("names", ()))
    effects = set(truth.effects)
    has_answer = "reason" not in answer
    flagged = bool(answer.get("flagged"))
    classes = {name: {name, *answer.get("classes", {}).get(name, ())} for name in names}
    return {
        "row": plant.drawn.row,
        "noise": plant.drawn.noise,
        "motion": plant.drawn.motion,
        "truth": truth.text(),
        "effects": sorted(effects),
        "is_frozen": plant.is_frozen,
        **{name: answer[name] for name in ("reason", "names", "classes") if name in answer},
        "flagged": flagged,
        "silent": has_answer and not names,
        "quiet": has_answer and not names and not flagged,
        "no_false_name": has_answer and names <= effects,
        "exact": has_answer and names == effects,
        "in_class": has_answer and is_in_class(effects, classes),
        "detected": has_answer and (flagged or bool(names)),
        "left_open": has_answer and flagged and not names,
        "intervals": intervals(truth, answer),
        "error_m": end_error(answer.get("ends_w"), plant.ends_w),
        "cpu_s": answer.get("cpu_s"),
    }


def is_in_class(effects: set[str], classes: dict[str, set[str]]) -> bool:
    """Return whether each effect is in the class of a name of its own."""
    if len(classes) < len(effects):
        return False
    fits = np.array([[effect in names for names in classes.values()] for effect in sorted(effects)])
    if not effects:
        return True
    rows, columns = linear_sum_assignment(fits, maximize=True)
    return bool(fits[rows, columns].all())


def intervals(truth: Truth, answer: Line) -> dict[str, list[float]]:
    """Return true value, value and interval of parameters that a method names rightly."""
    result = {}
    for parameter, numbers in answer.get("values", {}).items():
        name, _, field = parameter.partition(".")
        true = truth.effects.get(name, {})
        if name in answer["names"] and name not in OTHER_LAW and field in true:
            result[parameter] = [float(f"{value:.6g}") for value in (true[field], *numbers)]
    return result


def end_error(predicted_w: Any, ends_w: np.ndarray) -> float | None:
    """Return the RMS distance of predicted from true positions (m); None without predictions."""
    if predicted_w is None:
        return None
    squares = np.sum((np.array(predicted_w) - ends_w) ** 2, axis=1)
    return float(f"{np.sqrt(np.mean(squares)):.4g}")


def summarize(lines: Sequence[Line]) -> dict[str, Any]:
    """Return shares, coverage, errors and CPU seconds, with 95 % intervals by plants."""
    result: dict[str, Any] = {
        name: share([line[name] for line in lines if is_counted(line)])
        for name, (_, is_counted) in SHARES.items()
    }
    named = [line for line in lines if line["row"] in NAMED_ROWS]
    result["coverage"] = coverage([line["intervals"] for line in named])
    result["error_m"] = {
        row: median([line["error_m"] for line in lines if line["row"] in rows])
        for row, rows in (
            ("named", NAMED_ROWS),
            ("clean", ("clean",)),
            ("outside", ("outside",)),
        )
    }
    sizes = [
        1 + len(line["classes"].get(name, ())) for line in named for name in line.get("names", ())
    ]
    result["class_size"] = None if not sizes else round(float(np.mean(sizes)), 3)
    result["no_answer"] = sum("reason" in line for line in lines)
    result["cpu_s"] = median([line["cpu_s"] for line in lines])
    return result


def share(flags: Sequence[bool]) -> Line:
    """Return how many flags are true, of how many, and the exact binomial interval."""
    if not flags:
        return {"k": 0, "n": 0, "ci95": None}
    interval = binomtest(sum(flags), len(flags)).proportion_ci(COVERED, method="exact")
    return {"k": sum(flags), "n": len(flags), "ci95": [round(float(end), 4) for end in interval]}


def coverage(by_plant: Sequence[dict[str, list[float]]]) -> Line:
    """Return the share of intervals that cover the truth, bootstrapped over plants."""
    counts = np.array(
        [
            [sum(low <= true <= high for true, _, low, high in one.values()), len(one)]
            for one in by_plant
            if one
        ]
    )
    if not len(counts):
        return {"k": 0, "n": 0, "plants": 0, "ci95": None}
    drawn = np.random.default_rng(0).integers(len(counts), size=(DRAWS, len(counts)))
    sums = counts[drawn].sum(axis=1)
    k, n = counts.sum(axis=0).tolist()
    return {"k": k, "n": n, "plants": len(counts), "ci95": _middle(sums[:, 0] / sums[:, 1])}


def median(values: Sequence[float | None]) -> Line | None:
    """Return the median over plants with its bootstrapped interval; what is missing is worst."""
    if all(value is None for value in values):
        return None
    known = np.array([np.inf if value is None else value for value in values])
    drawn = np.random.default_rng(0).integers(len(known), size=(DRAWS, len(known)))
    ends = np.quantile(known[drawn], 0.5, axis=1, method="lower")
    middle = float(np.quantile(known, 0.5, method="lower"))
    return {"median": _finite(middle), "n": len(known), "ci95": _middle(ends)}


def _middle(values: np.ndarray) -> list[float | None]:
    tail = 0.5 * (1.0 - COVERED)
    ends = np.quantile(values, (tail, 1.0 - tail), method="nearest")
    return [_finite(float(end)) for end in ends]


def _finite(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None
