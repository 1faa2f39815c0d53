"""A window that shows a flight in real time."""

import importlib
import logging
import os
import time
from collections.abc import Callable
from types import ModuleType

import numpy as np

LOGGER = logging.getLogger(__name__)

PICTURES_PER_S = 30.0
LATE_S = 0.1  # delays longer than this are not caught up on
DRIVER = "SDL_VIDEODRIVER"
INVISIBLE = "offscreen"  # what SDL takes by itself where there is no display


class Window:
    """Shows pictures through pygame; without a display it is invisible, and a warning is logged.

    Args:
        step_s: time between two steps, s.
        must_be_seen: refuse to be invisible.

    Raises:
        ImportError: pygame is not installed.
        OSError: there is no display, and ``must_be_seen``.
    """

    def __init__(self, step_s: float, must_be_seen: bool = False):
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        self.pygame: ModuleType = importlib.import_module("pygame")
        self.step_s = step_s
        self.step_due_s = self.picture_due_s = time.monotonic()
        try:
            self.pygame.display.init()
            is_visible = DRIVER in os.environ or self.pygame.display.get_driver() != INVISIBLE
        except self.pygame.error:
            if DRIVER in os.environ and not must_be_seen:
                raise
            is_visible = False
        if not is_visible:
            if must_be_seen:
                raise OSError("display: found none, expected a screen (DISPLAY or WAYLAND_DISPLAY)")
            LOGGER.warning(
                "no display was found: the window uses SDL's dummy driver and is invisible"
            )
            self.pygame.display.quit()
            os.environ[DRIVER] = "dummy"
            self.pygame.display.init()
            del os.environ[DRIVER]

    def show(self, draw: Callable[[], np.ndarray], is_first: bool) -> None:
        """Wait until the next step is due, and draw and show a picture if one is due.

        Args:
            draw: returns a picture (height, width, 3), uint8.
            is_first: whether an episode begins, whose first picture is always shown, at once.
        """
        now_s = time.monotonic()
        self.step_due_s += self.step_s
        if is_first or self.step_due_s < now_s - LATE_S:
            self.step_due_s = now_s
        time.sleep(max(self.step_due_s - now_s, 0.0))
        if not is_first and time.monotonic() < self.picture_due_s:
            return
        self.picture_due_s = time.monotonic() + 1.0 / PICTURES_PER_S
        self.put(draw())
        self.pygame.event.pump()

    def put(self, picture: np.ndarray) -> None:
        """Show a picture (height, width, 3), uint8, fitted to the window; the first opens it."""
        pygame, size = self.pygame, (picture.shape[1], picture.shape[0])
        surface = pygame.display.get_surface() or pygame.display.set_mode(size, pygame.RESIZABLE)
        image = pygame.image.frombuffer(picture.tobytes(), size, "RGB")
        factor = min(surface.get_width() / size[0], surface.get_height() / size[1])
        surface.blit(image if factor == 1.0 else pygame.transform.scale_by(image, factor), (0, 0))
        pygame.display.flip()

    def close(self) -> None:
        """Close the window; more than once is allowed."""
        self.pygame.display.quit()
