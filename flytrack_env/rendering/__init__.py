"""Pictures of a flight, without a display: a top view of the course beside a chase view.

Needs the extra ``flytrack[render]``; importing this package does not. ``scene_row`` returns, inside
a compiled step, the numbers of a picture; ``FlightLog`` collects such rows; ``make_renderer`` draws
them.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from flytrack_env.extras import check_installed, is_installed
from flytrack_env.rendering.flight_log import SCENE_SIZE, FlightLog, scene_row
from flytrack_env.tracks import Course

if TYPE_CHECKING:
    from flytrack_env.rendering.views import Renderer
    from flytrack_env.rendering.window import Window

__all__ = ["SCENE_SIZE", "FlightLog", "can_render", "make_renderer", "open_window", "scene_row"]


def can_render(mode: str) -> bool:
    """Return whether what a render mode, "rgb_array" or "human", needs is installed."""
    return is_installed("PIL") and (mode != "human" or is_installed("pygame"))


def make_renderer(course: Course, gate_ids: Sequence[int]) -> "Renderer":
    """Return what draws flights on a course whose gates have these numbers.

    Raises:
        ImportError: Pillow is not installed; the message says how to install it.
    """
    check_installed("render", "pictures", "PIL")
    from flytrack_env.rendering.views import Renderer

    return Renderer(course, gate_ids)


def open_window(step_s: float, must_be_seen: bool = False) -> "Window":
    """Return a window that shows pictures of a flight in real time, a step every ``step_s`` s.

    Raises:
        ImportError: pygame is not installed; the message says how to install it.
        OSError: there is no display, and the window ``must_be_seen``.
    """
    check_installed("render", "windows", "pygame")
    from flytrack_env.rendering.window import Window

    return Window(step_s, must_be_seen)
