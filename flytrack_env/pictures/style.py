"""What all pictures share; colours of M. Okabe and K. Ito, which colour-blind people can tell apart."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINES = ("-", "--", ":", "-.")
DPI = 100
LETTER_IN = 0.068  # of a small text's width


def literal(text: str) -> str:
    """Return a text that matplotlib writes as it is: no mathematics between dollars, no hidden label."""
    text = text.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure of that size; it belongs to no window and no global state."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def plain(axes: Axes) -> Axes:
    """Return axes with a faint grid and without the box."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    return axes


def with_room(labels: Sequence[tuple[float, str]], inch: float) -> set[tuple[float, str]]:
    """Return those of the labels (place, small text), in order, that overlap none before; inch: in places."""
    kept, end = set(), -np.inf
    for place, text in sorted(labels):
        half = 0.5 * inch * LETTER_IN * (len(text) + 1)
        if place - half >= end:
            kept.add((place, text))
            end = place + half
    return kept


def png_of(figure: Figure, dpi: int = DPI, metadata: dict[str, str] | None = None) -> bytes:
    """Return a figure as a PNG file; metadata: the texts that it carries."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None, **(metadata or {})})
    return content.getvalue()
