"""Black boxes: plants that come as a file, as the handout's ``acro_step.bin`` does.

``load`` takes anyone's artifact of ``jax.export`` with the signature (n,), (4,) -> (n,), float32:

- n = 21: the state of ``flytrack_env.state``.
- n = 18: position 3, velocity 3, acceleration 3, quaternion 4, angular velocity 3, previous thrust
  action 1, battery 1. Such a plant does not report the lagged rate actions; they are reconstructed
  as angular velocity / max_rate, which is exact where the rates follow the handout's equation 2.

The file holds StableHLO, a program for XLA's compiler. ``load`` does not trust it: it is read,
compiled and run for one step in a process of its own (``flytrack_env.sandbox``), with limits on
time and memory (``limits``), so that a file that crashes, hangs or exhausts the compiler is a
BlackBoxError. Bytes that passed are not tried again by the same process; the shipped black box is
known and never tried.

Nothing in a file is unpickled, and it cannot call Python or native code (``custom_call``), not even
LAPACK unless ``limits`` is None. The trial cannot show that the plant is a sensible drone, nor what
it does later: the program then runs in this process, for any state. Windows limits only the
wall-clock time of a trial, macOS does not limit its memory.
"""

import hashlib
import math
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.custom_batching import sequential_vmap

from flytrack_env import artifact, sandbox
from flytrack_env.battery import Battery
from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import read_at_most
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Scalar
from flytrack_env.sandbox import ResourceLimits, SandboxError
from flytrack_env.state import (
    ACTION_SIZE,
    APPLIED_ACTION,
    BATTERY,
    BATTERY_FULL_V,
    QUATERNION,
    RATES,
    STATE_SIZE,
    Action,
    Drone,
    pack,
    unpack,
)

DT = 0.01  # s, baked into every artifact
MAX_FILE_BYTES = 64 * 2**20
MAX_RATE_DEG_S = (618.0, 618.0, 120.0)
SHIPPED = Path(__file__).with_name(
    "acro_step.bin"
)  # in the repository a link to blackbox/acro_step.bin
SHIPPED_SHA256 = "c05e6c001da095b5b0434f7bbc4df90e7d01e548f56eb8e03a615383e383aedd"

# Components of the handout's 21 that an 18-component artifact has: all but the rate actions.
_REDUCED = np.r_[0:16, 19:21]
# One thread, so that the memory XLA's threads need does not depend on the machine's cores.
_TRIAL_ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "JAX_ENABLE_COMPILATION_CACHE": "false",
    "NPROC": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
_PASSED: set[str] = set()  # digests of files that passed a trial in this process


class BlackBoxError(ValueError):
    """A black box that cannot be used; the message names file, what was found and expected."""


def start_vector() -> np.ndarray:
    """Return the handout's start state, (21,): all 0 but q = (1, 0, 0, 0), no thrust, 24 V."""
    start = np.zeros(STATE_SIZE, np.float32)
    start[QUATERNION], start[APPLIED_ACTION], start[BATTERY] = (
        (1, 0, 0, 0),
        (0, 0, 0, -1),
        BATTERY_FULL_V,
    )
    return start


class BlackBox(Plant):
    """A plant that steps an artifact; ``load`` makes one.

    Its state is the drone with scalar leaves: environments choose between states leaf by leaf.
    Works under ``jit``, ``vmap`` and ``scan`` on the CPU; nothing differentiates through it. Where
    the default device is another, run inside ``with jax.default_device(jax.devices("cpu")[0])``;
    JAX raises a ValueError otherwise.

    Attributes:
        path: the artifact's file.
        state_size: components of the artifact's own state, 21 or 18.
        dt: s, baked in.
        battery: the handout's, which is part of the contract of these files.
    """

    dt = DT
    battery = Battery()

    def __init__(self, path: Path, exported: export.Exported, max_rate: tuple[float, ...]):
        self.path = path
        self.state_size: int = exported.in_avals[0].shape[0]
        self._full_stick_rad_s = np.deg2rad(np.array(max_rate, np.float32))
        # An exported function has no batching rule: a batch runs row by row in a compiled loop.
        self._call = sequential_vmap(partial(artifact.call, exported))

    def __repr__(self) -> str:
        return f"BlackBox({str(self.path)!r}, state_size={self.state_size})"

    def step_vector(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return the handout's state 0.01 s later: (21,), (4,) -> (21,) float32.

        Of 18 components, the lagged rate actions are angular velocity / max_rate.
        """
        x, u = jnp.asarray(x, jnp.float32), jnp.asarray(u, jnp.float32)
        if self.state_size == STATE_SIZE:
            return self._call(x, u)
        after = self._call(x[_REDUCED], u)
        rate_actions = after[RATES] / self._full_stick_rad_s
        return jnp.concatenate([after[:16], rate_actions, after[16:]])

    def reset(self, drone: Drone, model: ModelParameters) -> Drone:
        """Return the drone with float32 leaves, as a step returns them; ``model`` is not used."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone)

    def step(self, state: Drone, command: Action, dt: Scalar, model: ModelParameters) -> Drone:
        """Return the artifact's next drone under a held command; ``model`` is not used.

        Raises:
            ValueError: another ``dt`` than 0.01 s. Inside ``jit`` its value is not known here,
                and the step is 0.01 s long whatever the caller asks for.
        """
        if not isinstance(dt, jax.core.Tracer) and not math.isclose(float(dt), DT, rel_tol=1e-5):
            raise ValueError(f"dt: found {dt} s, expected {DT} s, which {self.path} has baked in")
        u = jnp.stack([jnp.asarray(value, jnp.float32) for value in command])
        return unpack(self.step_vector(pack(state), u))

    def drone(self, state: Drone) -> Drone:
        """Return the drone."""
        return state


def _check(content: bytes, limits: ResourceLimits | None) -> None:
    """Raise ArtifactError or SandboxError unless a file's bytes are a plant."""
    digest = hashlib.sha256(content).hexdigest()
    start = start_vector()
    starts = [start.tolist(), start[_REDUCED].tolist()]
    if limits is None or digest == SHIPPED_SHA256:
        artifact.check(content, starts, ACTION_SIZE, is_trusted=limits is None)
    elif digest not in _PASSED:
        file, argument = Path(artifact.__file__), [starts, ACTION_SIZE]
        sandbox.run(file, "check_untrusted", argument, content, limits, _TRIAL_ENVIRONMENT)
        _PASSED.add(digest)


def load(
    path: str | Path,
    max_rate: tuple[float, float, float] = MAX_RATE_DEG_S,
    limits: ResourceLimits | None = ResourceLimits(),  # noqa: B008, a tuple of constants
) -> BlackBox:
    """Return the plant in a file.

    The module's docstring says what a file may hold, and what the risks are.

    Args:
        max_rate: deg/s, body rates at full stick, used with 18-component artifacts only.
        limits: of the trial; with None there is no trial, and native calls are allowed: only for
            files from people whose programs you would run.

    Raises:
        BlackBoxError: missing, unreadable, too large, damaged, for another platform, of another
            signature, not pure, not finite after one step from the start state, or it crashed or
            exceeded ``limits``.
    """
    path = Path(path)
    try:
        content = read_at_most(path, MAX_FILE_BYTES)
        _check(content, limits)
        exported = artifact.deserialize(content)
    except (OSError, artifact.ArtifactError, SandboxError) as error:
        raise BlackBoxError(f"{path}: {error}") from error
    return BlackBox(path, exported, max_rate)
