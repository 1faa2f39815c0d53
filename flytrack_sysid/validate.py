"""One-step errors on held-out data, and what the minimal structure leaves open."""

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters, step
from flytrack_env.state import ACCELERATION, POSITION, QUATERNION, RATES, VELOCITY
from flytrack_sysid.collect import DT, Excitation

CHANNELS = {"position": POSITION, "velocity": VELOCITY, "quaternion": QUATERNION, "rates": RATES}
SPEED_EDGES = (0.0, 2.0, 5.0, 10.0, 20.0)


class Validation(NamedTuple):
    """Errors of the model's one-step prediction from the measured state, on held-out data.

    mse: mean squared error per channel (per component: m^2, (m/s)^2, 1, (rad/s)^2).
    open_force: rms of measured minus modelled specific force, body x, y, z, m/s^2.
    open_force_by_speed: (speed from, speed to, rms of that force's norm), m/s and m/s^2.
    """

    mse: dict[str, float]
    open_force: tuple[float, float, float]
    open_force_by_speed: tuple[tuple[float, float, float], ...]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        return {
            "one_step_mse": self.mse,
            "open": {
                "what": "specific force that the model does not explain",
                "rms_body_xyz_m_per_s2": list(self.open_force),
                "rms_by_speed_m_per_s": [list(row) for row in self.open_force_by_speed],
            },
        }


def validate(model: ModelParameters, data: Excitation) -> Validation:
    """Return the errors of a model on data that it was not fitted to."""
    flat = [array.reshape(-1, array.shape[-1]) for array in data[:3]]
    states, actions, measured = flat
    predicted = np.asarray(jax.jit(jax.vmap(step, in_axes=(0, 0, None, None)))(states, actions, DT, model))
    error = measured.astype(float) - predicted
    mse = {name: float(np.mean(error[:, where] ** 2)) for name, where in CHANNELS.items()}

    attitude = Rotation.from_quat(states[:, QUATERNION], scalar_first=True)
    force_b = attitude.inv().apply(error[:, ACCELERATION])
    speed = np.linalg.norm(states[:, VELOCITY], axis=1)
    by_speed = []
    for low, high in pairwise(SPEED_EDGES):
        is_in = (speed >= low) & (speed < high)
        if is_in.any():
            rms = np.sqrt(np.mean(np.sum(force_b[is_in] ** 2, axis=1)))
            by_speed.append((low, high, float(rms)))
    return Validation(
        mse=mse,
        open_force=tuple(float(rms) for rms in np.sqrt(np.mean(force_b**2, axis=0))),  # type: ignore
        open_force_by_speed=tuple(by_speed),
    )
