"""Small plants with the conventions of ten simulators, as their documentation states them.

All share one quadcopter; a ``Simulator`` states how its state and its actions are written, and
``simulators.toml`` has all of them. They
take FlyTrack's actions, (roll, pitch, yaw, thrust) in [-1, 1], through the adapter that one writes
first: fractions of full rate, passed on in the simulator's own axes. Where a simulator has no rate
mode, a rate loop is assumed. ``expected`` is what differs from FlyTrack's conventions.

Besides the kinds of ``faults``: ``frame`` of w, "world" if angular velocity is not in body axes.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.seams.craft import GRAVITY
from benchmarks.seams.faults import Change, Truth, axes_matrix

FLU = "x y z"
MAX_RATE = np.deg2rad([600.0, 600.0, 250.0])  # rad/s
LAGS_S = np.array([0.03, 0.035, 0.05, 0.03])  # roll, pitch, yaw, thrust
THRUST_TO_WEIGHT, DRAG_PER_S = 3.0, 0.3
SUBSTEP_S = 0.002
Layout = dict[str, Any]


@dataclass(frozen=True)
class Simulator:
    """A plant with a simulator's conventions.

    Attributes:
        name: of the simulator.
        source: documentation of these conventions.
        assumed: what it leaves open.
        blocks: order of position, velocity, attitude and rates in the state.
        attitude: "wxyz", "xyzw", "euler" (roll, pitch, yaw, rad) or "columns" (of the rotation
            matrix, one after the other).
        position_axes: world axes of position.
        world: world axes of attitude; those of velocity are ``velocity_axes``.
        velocity_axes: world axes of velocity.
        body: body axes of attitude and rates.
        has_world_rates: whether angular velocity is in world axes.
        sticks: axes about which actions turn the craft.
        throttle: "-1..1" or "0..1".
        dt: s.
    """

    name: str
    source: str
    assumed: str = ""
    blocks: str = "pvqw"
    attitude: str = "wxyz"
    position_axes: str = FLU
    world: str = FLU
    velocity_axes: str = FLU
    body: str = FLU
    has_world_rates: bool = False
    sticks: str = FLU
    throttle: str = "-1..1"
    dt: float = 0.01

    @property
    def layout(self) -> Layout:
        """How ``check_plant`` reads states.

        dt (s); actions, their number; x0, at rest; indices of p, v, w and of q: 4 are a quaternion,
        3 Euler angles, 9 a matrix, row by row. The last number of a state is the throttle.
        """
        indices, start = {}, 0
        for block in self.blocks:
            size = {"euler": 3, "columns": 9}.get(self.attitude, 4) if block == "q" else 3
            indices[block] = list(range(start, start + size))
            start += size
        hover = THRUST_TO_WEIGHT**-0.5
        at_rest = np.zeros(3)
        x0 = self._write(np.array([0.0, 0.0, 5.0]), at_rest, Rotation.identity(), at_rest, hover)
        return {"dt": self.dt, "actions": 4, "x0": x0, **indices}

    @property
    def expected(self) -> Truth:
        """Changes that a checker should find."""
        transposed = self.attitude == "columns"
        rows = [
            (self.attitude == "xyzw", Change("q", "order", "xyzw")),
            (transposed, Change("q", "conjugate", True)),
            (self.position_axes != FLU, Change("p", "axes", self.position_axes)),
            (self.velocity_axes != FLU, Change("v", "axes", self.velocity_axes)),
            (self.world != FLU, Change("q", "world", self.world)),
            (self.body != FLU, Change("q", "body", self.body)),
            (self.body != FLU, Change("w", "axes", self.body)),
            (self.has_world_rates, Change("w", "frame", "world")),
            (self.sticks != FLU, Change("u_rates", "axes", self.sticks)),
            (self.throttle != "-1..1", Change("u_thrust", "range", self.throttle)),
        ]
        return frozenset(change for is_there, change in rows if is_there)

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the state after ``dt`` with an action held; both as the simulator writes them."""
        p, v, attitude, w, throttle = self._read(np.asarray(x, float))
        u = np.asarray(u, float)
        aim_w = axes_matrix(self.sticks).T @ np.clip(u[:3], -1.0, 1.0) * MAX_RATE
        thrust = u[3] if self.throttle == "0..1" else 0.5 * (u[3] + 1.0)
        aim_throttle = np.clip(thrust, 0.0, 1.0)
        steps = round(self.dt / SUBSTEP_S)
        h = self.dt / steps
        blend = 1.0 - np.exp(-h / LAGS_S)
        for _ in range(steps):
            new_w = w + blend[:3] * (aim_w - w)
            attitude = attitude * Rotation.from_rotvec(0.5 * h * (w + new_w))
            w = new_w
            throttle += blend[3] * (aim_throttle - throttle)
            lift = np.array([0.0, 0.0, THRUST_TO_WEIGHT * GRAVITY * throttle**2])
            a = attitude.apply(lift) - DRAG_PER_S * v - [0.0, 0.0, GRAVITY]
            p = p + h * v + 0.5 * h * h * a
            v = v + h * a
        return self._write(p, v, attitude, w, throttle)

    def _write(
        self, p: np.ndarray, v: np.ndarray, attitude: Rotation, w: np.ndarray, throttle: float
    ) -> np.ndarray:
        """Return a state in the simulator's conventions."""
        matrix = axes_matrix(self.world) @ attitude.as_matrix() @ axes_matrix(self.body).T
        rates = axes_matrix(self.body) @ w
        blocks = {
            "p": axes_matrix(self.position_axes) @ p,
            "v": axes_matrix(self.velocity_axes) @ v,
            "q": TO_NUMBERS[self.attitude](matrix),
            "w": matrix @ rates if self.has_world_rates else rates,
        }
        return np.concatenate([*(blocks[block] for block in self.blocks), [throttle]])

    def _read(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, Rotation, np.ndarray, float]:
        """Return what ``_write`` was given."""
        sizes = [len(TO_NUMBERS[self.attitude](np.eye(3))) if b == "q" else 3 for b in self.blocks]
        parts = dict(zip(self.blocks, np.split(x, np.cumsum(sizes)), strict=False))
        matrix = FROM_NUMBERS[self.attitude](parts["q"])
        rates = matrix.T @ parts["w"] if self.has_world_rates else parts["w"]
        return (
            axes_matrix(self.position_axes).T @ parts["p"],
            axes_matrix(self.velocity_axes).T @ parts["v"],
            Rotation.from_matrix(axes_matrix(self.world).T @ matrix @ axes_matrix(self.body)),
            axes_matrix(self.body).T @ rates,
            float(x[-1]),
        )


TO_NUMBERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "wxyz": lambda matrix: Rotation.from_matrix(matrix).as_quat(scalar_first=True),
    "xyzw": lambda matrix: Rotation.from_matrix(matrix).as_quat(),
    "euler": lambda matrix: Rotation.from_matrix(matrix).as_euler("xyz"),
    "columns": lambda matrix: matrix.T.ravel(),
}
FROM_NUMBERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "wxyz": lambda numbers: Rotation.from_quat(numbers, scalar_first=True).as_matrix(),
    "xyzw": lambda numbers: Rotation.from_quat(numbers).as_matrix(),
    "euler": lambda numbers: Rotation.from_euler("xyz", numbers).as_matrix(),
    "columns": lambda numbers: numbers.reshape(3, 3).T,
}
SIMULATORS = tuple(
    Simulator(**fields)
    for fields in tomllib.loads(Path(__file__).with_suffix(".toml").read_text())["simulator"]
)
