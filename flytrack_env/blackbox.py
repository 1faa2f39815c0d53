"""Black boxes: plants that come as a file, as the handout's ``acro_step.bin`` does.

``load`` takes anyone's artifact of ``jax.export`` with the signature (n,), (4,) -> (n,), float32:

- n = 21: the state of ``flytrack_env.state``.
- n = 18: position 3, velocity 3, acceleration 3, quaternion 4, angular velocity 3, previous thrust
  action 1, battery 1. Such a plant does not report the lagged rate actions; they are reconstructed
  as angular velocity / max_rate, which is exact where the rates follow the handout's equation 2.

The file holds StableHLO, a program for XLA's compiler. ``load`` lets nobody's program into this process
untried. It reads, compiles and runs it for one step in a process of its own first, which may write no file
and use 4 s of processor time and 1 GiB of memory (``limits``): a file that makes the compiler crash, hang or
eat memory is a BlackBoxError. Bytes that went well are not tried again by this process, and the shipped
black box never is.

What loading can do: nothing in a file is unpickled, it holds no Python, and it calls none. It can call no
other native code either (``custom_call``), LAPACK's functions included, unless ``limits`` is None.

What loading cannot do: tell whether the plant is a sensible drone, or what it does later. After a good trial
the program is compiled and run here, at full rights, for any state: a loop that ends from the start state
may not end from another, and a program made to misuse a bug in XLA itself is not stopped. Without
``os.fork`` (Windows) there is no trial, and files other than the shipped one need ``limits=None``; macOS
bounds a trial's time but not its memory.
"""

import hashlib
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.custom_batching import custom_vmap

from flytrack_env import artifact
from flytrack_env.apart import Apart, ApartError, ResourceLimits, is_possible
from flytrack_env.dynamics import ModelParameters
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import (
    ACTION_SIZE,
    BATTERY_FULL_V,
    RATES,
    STATE_SIZE,
    Action,
    Drone,
    pack,
    unpack,
)

DT = 0.01  # s, baked into every artifact
REDUCED_STATE_SIZE = 18
MAX_FILE_BYTES = 64 * 2**20
MAX_RATE_DEG_S = (618.0, 618.0, 120.0)
SHIPPED_SHA256 = "c05e6c001da095b5b0434f7bbc4df90e7d01e548f56eb8e03a615383e383aedd"  # blackbox/acro_step.bin

# Of the handout's 21 components, those that an 18-component artifact has: all but the rate actions.
_REDUCED = np.r_[0:16, 19:21]

# One thread, so that what XLA's threads take of the memory does not depend on the machine's cores.
_TRIAL = Apart(
    Path(artifact.__file__),
    "try_out",
    {
        "JAX_PLATFORMS": "cpu",
        "JAX_ENABLE_COMPILATION_CACHE": "false",
        "NPROC": "1",
        "OPENBLAS_NUM_THREADS": "1",
    },
)
_TRIED: set[str] = set()  # digests of what went well in this process


class BlackBoxError(ValueError):
    """A black box that cannot be used; the message names file, what was found and expected."""


def _read(path: Path) -> bytes:
    try:
        if not path.is_file():
            found = "a directory or device" if path.exists() else "nothing"
            raise BlackBoxError(f"{path}: found {found}, expected a file")
        size = path.stat().st_size
        if not 0 < size <= MAX_FILE_BYTES:
            raise BlackBoxError(f"{path}: found {size} bytes, expected 1 to {MAX_FILE_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise BlackBoxError(f"{path}: cannot be read: {error}") from error


def start_vector() -> jax.Array:
    """Return the handout's start state, (21,): all 0 but q = (1, 0, 0, 0), no thrust, 24 V."""
    zero = Vec3(0.0, 0.0, 0.0)
    return pack(
        Drone(
            pos_w=zero,
            vel_w=zero,
            acc_w=zero,
            quat=Quaternion(1.0, 0.0, 0.0, 0.0),
            rates_b=zero,
            applied=Action(0.0, 0.0, 0.0, -1.0),
            battery_v=BATTERY_FULL_V,
        )
    )


def _mapped(exported: export.Exported) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Return the artifact as a function of rows: (m, n), (m, 4) -> (m, n), under any ``vmap``.

    An exported function has no batching rule, so rows are run one after the other in one
    compiled loop. Nested ``vmap`` adds rows to that loop instead of nesting loops.
    """

    def call_one(row: tuple[jax.Array, jax.Array]) -> jax.Array:
        return artifact.call(exported, *row)

    @custom_vmap
    def call_rows(states: jax.Array, actions: jax.Array) -> jax.Array:
        if states.shape[0] == 1:
            return call_one((states[0], actions[0]))[None]
        return jax.lax.map(call_one, (states, actions))

    @call_rows.def_vmap
    def _batch_rule(size, batched, states, actions):  # type: ignore[no-untyped-def]
        whole = [
            array if is_batched else jnp.broadcast_to(array, (size, *array.shape))
            for array, is_batched in zip((states, actions), batched, strict=True)
        ]
        rows = [array.reshape(-1, array.shape[-1]) for array in whole]
        return call_rows(*rows).reshape(whole[0].shape), True

    return call_rows


class BlackBox(Plant):
    """A plant that steps an artifact; ``load`` makes one.

    Its state is the drone with scalar leaves: environments choose between states leaf by leaf.
    Works under ``jit``, ``vmap`` and ``scan`` on the CPU; nothing differentiates through it. Where
    the default device is another, run inside ``with jax.default_device(jax.devices("cpu")[0])``;
    JAX raises a ValueError otherwise.

    path: the artifact's file. state_size: components of the artifact's own state, 21 or 18. dt: s, baked in.
    """

    dt = DT

    def __init__(self, path: Path, exported: export.Exported, max_rate: tuple[float, ...]):
        self.path = path
        self.state_size: int = exported.in_avals[0].shape[0]
        self._full_stick_rad_s = np.deg2rad(np.array(max_rate, np.float32))
        self._call_rows = _mapped(exported)

    def __repr__(self) -> str:
        return f"BlackBox({str(self.path)!r}, state_size={self.state_size})"

    def step_vector(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return the handout's state 0.01 s later: (21,), (4,) -> (21,) float32.

        Of 18 components, the lagged rate actions are angular velocity / max_rate.
        """
        x, u = jnp.asarray(x, jnp.float32), jnp.asarray(u, jnp.float32)
        if self.state_size == STATE_SIZE:
            return self._call_rows(x[None], u[None])[0]
        after = self._call_rows(x[_REDUCED][None], u[None])[0]
        rate_actions = after[RATES] / self._full_stick_rad_s
        return jnp.concatenate([after[:16], rate_actions, after[16:]])

    def reset(self, drone: Drone, model: ModelParameters) -> Drone:
        """Return the drone with its leaves as float32, as a step returns them; ``model`` is not used."""
        del model
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone)

    def step(self, state: Drone, command: Action, dt: Scalar, model: ModelParameters) -> Drone:
        """Return the artifact's next drone under a held command; ``model`` is not used.

        Raises:
            ValueError: another ``dt`` than 0.01 s. Inside ``jit`` its value is not known here,
                and the step is 0.01 s long whatever the caller asks for.
        """
        del model
        if not isinstance(dt, jax.core.Tracer) and not math.isclose(float(dt), DT, rel_tol=1e-5):
            raise ValueError(f"dt: found {dt} s, expected {DT} s, which {self.path} has baked in")
        u = jnp.stack([jnp.asarray(value, jnp.float32) for value in command])
        return unpack(self.step_vector(pack(state), u))

    def drone(self, state: Drone) -> Drone:
        """Return the drone."""
        return state


@cache
def _starts() -> list[list[float]]:
    """Return the start state as both kinds of artifact have it."""
    start = np.asarray(start_vector())
    return [start.tolist(), start[_REDUCED].tolist()]


def _try_out(content: bytes, limits: ResourceLimits) -> None:
    """Raise ApartError unless a stranger's bytes go well in a process of their own."""
    if not is_possible():
        raise ApartError(
            "this system has no os.fork to try it out in a process of its own; if you trust the file, load "
            "it with limits=None"
        )
    _TRIAL([_starts(), ACTION_SIZE], content, limits)


def load(
    path: str | Path,
    max_rate: tuple[float, float, float] = MAX_RATE_DEG_S,
    limits: ResourceLimits | None = ResourceLimits(),  # noqa: B008, a tuple of constants
) -> BlackBox:
    """Return the plant in a file; see the module for what a file may hold and what that risks.

    max_rate: deg/s, body rates at full stick, used with 18-component artifacts only. limits: of the trial; a
    large plant may need more. None: no trial, and what it calls is let through (but Python), for files of
    those whose programs you would run.

    Raises:
        BlackBoxError: missing, unreadable, too large, damaged, for another platform, another signature, not
            pure, or not finite after one step from the start state; or the trial ended in another way.
    """
    path = Path(path)
    content = _read(path)
    digest = hashlib.sha256(content).hexdigest()
    is_known = digest == SHIPPED_SHA256
    try:
        if limits is None or is_known:
            artifact.check(content, _starts(), ACTION_SIZE, is_trusted=limits is None)
        elif digest not in _TRIED:
            _try_out(content, limits)
            _TRIED.add(digest)
        exported = artifact.deserialize(content)
    except (artifact.ArtifactError, ApartError) as error:
        raise BlackBoxError(f"{path}: {error}") from error
    return BlackBox(path, exported, max_rate)
