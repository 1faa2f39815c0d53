"""The keyboard, the gamepad and the loop of pictures and steps, through pygame."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pygame

from flytrack_env.rendering import make_renderer
from flytrack_fly.session import Session, steps_due
from flytrack_fly.sticks import NAMES, Gamepad, move_by_keys

PICTURES_PER_S = 60
# Which stick a key pulls, and where to.
KEYS = {
    pygame.K_RIGHT: (0, 1.0),
    pygame.K_LEFT: (0, -1.0),
    pygame.K_UP: (1, 1.0),
    pygame.K_DOWN: (1, -1.0),
    pygame.K_a: (2, 1.0),
    pygame.K_d: (2, -1.0),
    pygame.K_w: (3, 1.0),
    pygame.K_s: (3, -1.0),
}
SHIFTS = {pygame.K_LSHIFT, pygame.K_RSHIFT}
HELP = """
W, S: throttle up, down; released: hover
A, D: yaw left, right
Arrows: roll; pitch, up is nose down
Shift: full stick
R: back to the start
H: hide the keys
Esc: save and quit"""


class Controls:
    """What keys and axes say: takes pygame's events, gives the sticks.

    Raises:
        ValueError: no gamepad of that number, or an axis that it does not have.
    """

    def __init__(self, gamepad: Gamepad):
        self.held: set[int] = set()
        self.is_over = self.is_restart = self.shows_help = False
        self._keys, self._values, self._gamepad = (
            np.zeros(len(NAMES)),
            np.zeros(len(NAMES)),
            gamepad,
        )
        self._joystick: Any = None
        if gamepad.gamepad is not None:
            self._joystick = _open(gamepad, gamepad.gamepad)
            # Events tell changes only.
            self._values = np.array([self._joystick.get_axis(axis) for axis in gamepad.axes])

    def take(self, event: pygame.event.Event) -> None:
        """Take notice of an event."""
        if event.type == pygame.QUIT:
            self.is_over = True
        elif event.type == pygame.KEYUP:
            self.held.discard(event.key)
        elif event.type == pygame.KEYDOWN:
            self.held.add(event.key)
            self.is_over |= event.key == pygame.K_ESCAPE
            self.is_restart |= event.key == pygame.K_r
            self.shows_help ^= event.key == pygame.K_h
        elif event.type == pygame.JOYAXISMOTION and self._joystick is not None:
            is_mine = event.instance_id == self._joystick.get_instance_id()
            self._values[is_mine & (np.array(self._gamepad.axes) == event.axis)] = event.value

    def sticks(self, dt_s: float) -> np.ndarray:
        """Return the sticks (4,) after ``dt_s`` s more: those of the keys plus the gamepad's."""
        pulls = np.zeros(len(NAMES))
        for stick, pull in (KEYS[key] for key in self.held & KEYS.keys()):
            pulls[stick] += pull
        self._keys = move_by_keys(self._keys, pulls, bool(self.held & SHIFTS), dt_s)
        return np.clip(self._keys + self._gamepad.sticks(self._values), -1.0, 1.0)


def _open(gamepad: Gamepad, number: int) -> "pygame.joystick.JoystickType":
    pygame.joystick.init()
    count = pygame.joystick.get_count()
    if not 0 <= number < count:
        expected = f"0 to {count - 1}" if count else "none, as no gamepad is connected"
        raise ValueError(f"--gamepad: found {number}, expected {expected}")
    joystick = pygame.joystick.Joystick(number)
    most = joystick.get_numaxes() - 1
    if not all(0 <= axis <= most for axis in gamepad.axes):
        raise ValueError(
            f"--axes: found {gamepad.axes}, expected 0 to {most} of {joystick.get_name()}"
        )
    return joystick


def play(
    session: Session,
    controls: Controls,
    show: Callable[[np.ndarray], None],
    tick: Callable[[], float],
) -> None:
    """Let a pilot fly in real time until he quits.

    Args:
        show: shows a picture.
        tick: waits until the next one is due; returns the time since the last one, s.
    """
    renderer, behind_s = make_renderer(session.params.course, session.gate_ids), 0.0
    while not controls.is_over:
        notes = session.notes() + (HELP if controls.shows_help else "")
        show(renderer.draw(session.now.log, session.ghost_state(), follows_nose=True, notes=notes))
        steps, behind_s = steps_due(behind_s, tick(), session.step_s)
        for event in pygame.event.get():
            controls.take(event)
        if controls.is_restart:
            session.restart()
            controls.is_restart = False
        for _ in range(steps):
            session.advance(controls.sticks(session.step_s))


def tick_of_clock() -> Callable[[], float]:
    """Return what waits for the next of ``PICTURES_PER_S`` pictures."""
    clock = pygame.time.Clock()
    return lambda: 1e-3 * clock.tick(PICTURES_PER_S)
