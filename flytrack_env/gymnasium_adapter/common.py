"""What the single and the vector environment share."""

from typing import Any

import gymnasium
import numpy as np

from flytrack_env.gymnasium_adapter.simulation import Simulation


def box(space: Any) -> gymnasium.spaces.Box:
    """Return a Gymnasium box with the limits of a gymnax one."""
    low, high = (
        np.broadcast_to(np.asarray(limit, np.float32), space.shape) for limit in (space.low, space.high)
    )
    return gymnasium.spaces.Box(low, high, space.shape, np.float32)


def as_float32(actions: Any) -> np.ndarray:
    """Return actions as an array of float32; what is beyond it is infinite, and clipped as such."""
    with np.errstate(over="ignore"):
        return np.asarray(actions, np.float32)


def metadata_of(simulation: Simulation, render_modes: tuple[str, ...]) -> dict[str, Any]:
    """Return an environment's metadata; a step is a picture."""
    return {"render_modes": list(render_modes), "render_fps": round(1.0 / float(simulation.params.dt))}


def check_render_mode(render_mode: str | None, render_modes: tuple[str, ...]) -> None:
    """Raise ValueError for a mode that is not offered."""
    if render_mode is not None and render_mode not in render_modes:
        expected = ", ".join(map(repr, render_modes))
        raise ValueError(f"render_mode: found {render_mode!r}, expected None, {expected}")
