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

    step_s: time between two steps, s.

    Raises:
        ImportError: pygame is not installed.
    """

    def __init__(self, step_s: float):
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        self.pygame: ModuleType = importlib.import_module("pygame")
        self.step_s = step_s
        self.step_due_s = self.picture_due_s = time.monotonic()
        try:
            self.pygame.display.init()
            is_visible = DRIVER in os.environ or self.pygame.display.get_driver() != INVISIBLE
        except self.pygame.error:
            if DRIVER in os.environ:
                raise
            is_visible = False
        if not is_visible:
            LOGGER.warning("no display was found: the window uses SDL's dummy driver and is invisible")
            self.pygame.display.quit()
            os.environ[DRIVER] = "dummy"
            self.pygame.display.init()
            del os.environ[DRIVER]

    def show(self, draw: Callable[[], np.ndarray], is_first: bool) -> None:
        """Wait until the next step is due, and draw and show a picture if one is due.

        draw: returns a picture (height, width, 3), uint8. is_first: whether an episode begins, whose first
        picture is always shown, at once.
        """
        now_s = time.monotonic()
        self.step_due_s += self.step_s
        if is_first or self.step_due_s < now_s - LATE_S:
            self.step_due_s = now_s
        time.sleep(max(self.step_due_s - now_s, 0.0))
        if not is_first and time.monotonic() < self.picture_due_s:
            return
        self.picture_due_s = time.monotonic() + 1.0 / PICTURES_PER_S
        picture = draw()
        size = (picture.shape[1], picture.shape[0])
        surface = self.pygame.display.get_surface() or self.pygame.display.set_mode(size)
        surface.blit(self.pygame.image.frombuffer(picture.tobytes(), size, "RGB"), (0, 0))
        self.pygame.display.flip()
        self.pygame.event.pump()

    def close(self) -> None:
        """Close the window; more than once is allowed."""
        self.pygame.display.quit()
