"""What came of a sweep: a table and a picture of its trials."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from flytrack_env.files import write_atomically
from flytrack_env.pictures.style import new_figure, plain, png_of

PANEL_IN = 3.0
SUCCESS, LAP_S = "evaluation_success", "evaluation_flying_lap_s"


class Trial(NamedTuple):
    """A trial: its folder, what was drawn for it, its last evaluation, and why it failed, if it did."""

    folder: Path
    settings: dict[str, Any]
    evaluation: dict[str, float]
    error: str | None


def in_order(trials: list[Trial]) -> list[Trial]:
    """Return trials, the best first: by success, then by lap; those that failed are last."""

    def place(trial: Trial) -> tuple[bool, float, float]:
        found = trial.evaluation
        return trial.error is not None, -found.get(SUCCESS, 0.0), found.get(LAP_S, float("inf"))

    return sorted(trials, key=place)


def table(trials: list[Trial]) -> str:
    """Return the trials as lines of text, the best first."""
    lines = []
    for trial in in_order(trials):
        drawn = ", ".join(f"{name} {_text(value)}" for name, value in trial.settings.items())
        lap_s = trial.evaluation.get(LAP_S)
        race = f"success {trial.evaluation.get(SUCCESS, 0.0):.1%}, flying lap " + (
            "-" if lap_s is None else f"{lap_s:.3f} s"
        )
        lines.append(f"{trial.folder}: {trial.error or race}; {drawn}")
    return "\n".join(lines)


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_results(out: Path, trials: list[Trial]) -> list[Path]:
    """Write sweep.json and sweep.png; return their paths."""
    values = [{**trial._asdict(), "folder": trial.folder.name} for trial in in_order(trials)]
    paths = [out / "sweep.json", out / "sweep.png"]
    write_atomically(paths[0], (json.dumps(values, indent=2) + "\n").encode())
    write_atomically(paths[1], png_of(draw(trials)))
    return paths


def draw(trials: list[Trial]) -> Figure:
    """Return a picture: for each setting that was drawn, success and flying lap over its values."""
    names = list(trials[0].settings)
    figure = new_figure(PANEL_IN * len(names) + 1.0, 2 * PANEL_IN)
    axes = figure.subplots(2, len(names), squeeze=False, sharey="row")
    whole = [trial for trial in trials if trial.error is None]
    for column, name in enumerate(names):
        values = [trial.settings[name] for trial in whole]
        is_number = all(isinstance(value, float) for value in values)
        places = values if is_number else [str(value) for value in values]
        for row, (key, scale) in enumerate(((SUCCESS, 100.0), (LAP_S, 1.0))):
            shown = [scale * trial.evaluation.get(key, float("nan")) for trial in whole]
            plain(axes[row, column]).plot(places, shown, "o")
        if is_number and values and min(values) > 0.0 and max(values) > 5.0 * min(values):
            axes[0, column].set_xscale("log")
            axes[1, column].set_xscale("log")
        axes[1, column].set_xlabel(name)
    axes[0, 0].set_ylabel("success (%)")
    axes[1, 0].set_ylabel("flying lap (s)")
    return figure
