"""What came of a sweep: a table and a picture of its trials."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import new_figure, plain, png_of
from flytrack_env.scene import BLUE

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
    axes = figure.subplots(2, len(names), squeeze=False, sharex="col", sharey="row")
    whole = [trial for trial in trials if trial.error is None]
    for column, name in enumerate(names):
        places = _place(axes[1, column], [trial.settings[name] for trial in whole])
        for row, (key, scale) in enumerate(((SUCCESS, 100.0), (LAP_S, 1.0))):
            shown = [scale * trial.evaluation.get(key, float("nan")) for trial in whole]
            plain(axes[row, column]).plot(places, shown, "o", color=BLUE)
        axes[1, column].set_xlabel(name)
    axes[0, 0].set_ylabel("success (%)")
    axes[0, 0].set_ylim(-5.0, 105.0)
    axes[1, 0].set_ylabel("flying lap (s)")
    return figure


def _place(axes: Axes, values: list[Any]) -> list[float]:
    """Return where values stand along x: numbers where they are, others side by side, with their names."""
    if all(isinstance(value, float) for value in values):
        if values and min(values) > 0.0 and max(values) > 5.0 * min(values):
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        return values
    known = sorted(set(values))
    axes.set_xticks(range(len(known)), [str(value) for value in known])
    axes.set_xlim(-0.5, len(known) - 0.5)
    return [float(known.index(value)) for value in values]
