"""From what a pilot does to a command: keys and axes move sticks, sticks become a command.

Sticks are arrays (4,) in [-1, 1], 0 in the middle: roll to the right, pitch nose down, yaw to the
left, throttle up. A command is laid out like ``flytrack_env.state.Action``.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import tyro

NAMES = ("roll", "pitch", "yaw", "throttle")
KEY_REACH = np.array(
    [0.4, 0.4, 1.0, 0.25]
)  # where a held key takes a stick; Shift takes it all the way
OUT_PER_S, BACK_PER_S = 3.0, 6.0  # speeds of a stick that keys move, outwards and to the middle


@dataclass(frozen=True)
class Gamepad:
    """Which gamepad is flown with, and how its axes become sticks."""

    gamepad: Annotated[
        int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(optional)")
    ] = None
    """Number of a gamepad, from 0, to fly with besides the keyboard."""
    axes: tuple[int, int, int, int] = (3, 4, 0, 1)
    """Its axes for roll, pitch, yaw and throttle."""
    invert: tuple[Literal["roll", "pitch", "yaw", "throttle"], ...] = ("pitch", "throttle")
    """Sticks whose axes grow to the left, or downwards as most gamepads' do."""
    deadzone: float = 0.05
    """Share of each axis about its middle that does nothing, 0 to 0.9."""
    expo: float = 0.3
    """Cubic share of the roll, pitch and yaw axes, 0 to 1: larger is gentler about the middle."""

    def check(self) -> None:
        """Raise ValueError, naming the flag, for settings that cannot be used."""
        for name, most in (("deadzone", 0.9), ("expo", 1.0)):
            if not 0.0 <= getattr(self, name) <= most:
                raise ValueError(f"--{name}: found {getattr(self, name)}, expected 0 to {most}")

    def sticks(self, values: np.ndarray) -> np.ndarray:
        """Return the sticks (4,) of the values (4,) of the four axes, each in [-1, 1]."""
        signs = [-1.0 if name in self.invert else 1.0 for name in NAMES]
        # The yaw axis grows to the right, its stick to the left.
        values = values * signs * [1.0, 1.0, -1.0, 1.0]
        moved = np.clip((np.abs(values) - self.deadzone) / (1.0 - self.deadzone), 0.0, 1.0)
        sticks = np.sign(values) * moved
        return sticks + np.array([self.expo] * 3 + [0.0]) * (sticks**3 - sticks)


def move_by_keys(sticks: np.ndarray, pulls: np.ndarray, is_full: bool, dt_s: float) -> np.ndarray:
    """Return sticks (4,) after ``dt_s`` s of held keys; released, they go back to the middle.

    Args:
        pulls: (4,), the direction in which keys pull each stick: -1, 0 or 1.
        is_full: Shift is held.
    """
    targets = pulls if is_full else pulls * KEY_REACH
    is_outwards = (pulls != 0.0) & ((targets - sticks) * pulls > 0.0)
    most = dt_s * np.where(is_outwards, OUT_PER_S, BACK_PER_S)
    return sticks + np.clip(targets - sticks, -most, most)


def command_of(sticks: np.ndarray, hover: float) -> np.ndarray:
    """Return the command (4,) of sticks (4,).

    Throttle: the middle is ``hover``, the ends are -1 and 1.
    """
    thrust = hover + sticks[3] * (1.0 - hover if sticks[3] > 0.0 else 1.0 + hover)
    return np.array([*sticks[:3], thrust], np.float32)
