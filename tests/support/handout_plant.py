"""The handout's equations in NumPy and float64: a truth that shares nothing with the simulator."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.excitation import script
from flytrack_sysid.log import log_of_states

GRAVITY = 9.80665
HOVER = -0.25  # about what holds the weight of ``HandoutPlant``


@dataclass(frozen=True)
class HandoutPlant:
    """A plant ``step(x, u)`` with parameters that no tool is told; one state or many at once.

    Attributes:
        tau: s.
        coeffs: N on 1 kg.
        max_rate: deg/s.
        drain: V/min.
        drag_b: 1/s, linear drag along the body's axes.
        gravity: m/s^2.
    """

    tau: tuple[float, ...] = (0.021, 0.034, 0.057, 0.045)
    coeffs: tuple[float, ...] = (-6.0, -4.0, 3.5, 0.4, 0.8, 0.9)
    max_rate: tuple[float, ...] = (618.0, 618.0, 120.0)
    drain: float = 1.0
    drag_b: tuple[float, ...] = (0.0, 0.0, 0.0)
    dt: float = 0.01
    gravity: float = GRAVITY

    def model(self):
        """Return what a fit without effects should find."""
        arrays = map(np.array, (self.tau, self.coeffs, self.max_rate))
        return ModelParameters(*arrays, 1.0, self.gravity, self.drain)

    def __call__(self, x, u, dt=None):
        """Return the state ``dt`` later, (21,) or (n, 21)."""
        dt = self.dt if dt is None else dt
        rows = np.atleast_2d(np.asarray(x, float))
        p, v, applied, volt = rows[:, 0:3], rows[:, 3:6], rows[:, 16:20], rows[:, 20]
        applied = applied + (1.0 - np.exp(-dt / np.array(self.tau))) * (u - applied)
        omega = np.radians(np.array(self.max_rate) * applied[:, :3])
        attitude = Rotation.from_quat(rows[:, 9:13], scalar_first=True)
        # q + 0.5 dt q (x) [0, omega], normalised
        half_turn = np.insert(0.5 * dt * omega, 0, 1.0, axis=1)
        turned = attitude * Rotation.from_quat(half_turn, scalar_first=True)
        s = applied[:, 3]
        c = self.coeffs
        thrust = c[0] + c[1] * s + c[2] * s**2 + c[3] * s**3 + c[4] * volt + c[5] * s * volt
        force_b = -np.array(self.drag_b) * attitude.inv().apply(v)
        force_b[:, 2] += thrust
        a = attitude.apply(force_b) - [0.0, 0.0, self.gravity]
        after = [
            p + v * dt + 0.5 * a * dt**2,
            v + a * dt,
            a,
            turned.as_quat(scalar_first=True),
            omega,
            applied,
            volt - self.drain / 60.0 * dt,
        ]
        return np.column_stack(after).reshape(np.shape(x))


def states_of(log):
    """Return the states of a log that has all of them, (num_rows, 21)."""
    names = ("p", "v", "a", "q", "w", "uprev", "v_bat")
    return np.concatenate([log[name] for name in names], axis=1)


def excited(plant, repeat=1, jitter=0.0):
    """Return the log of the excitation on a plant, float64, without noise.

    Args:
        repeat: of commands, for steps of 0.01 s over repeat.
        jitter: of steps, relative.
    """
    rng = np.random.default_rng(5)
    planned = script(24, HOVER, rng)
    commands = np.stack([flight.command for flight in planned]).repeat(repeat, axis=1)
    step_s = 0.01 / repeat
    steps_s = step_s * (1.0 + rng.uniform(-jitter, jitter, commands.shape[1]))
    states = [np.stack([flight.start for flight in planned]).astype(float)]
    for number, held_s in enumerate(steps_s[:-1]):
        states.append(plant(states[-1], commands[:, number], held_s))
    log = log_of_states(zip(np.stack(states, axis=1), commands, strict=True), step_s, "handout.npz")
    return replace(log, time=np.tile(np.cumsum(steps_s) - steps_s, len(planned)))
