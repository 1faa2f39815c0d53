"""Black boxes: plants that come as a file, as the handout's ``acro_step.bin`` does.

``load`` takes anyone's artifact of ``jax.export`` with the signature (n,), (4,) -> (n,), float32:

- n = 21: the state of ``flytrack_env.state``.
- n = 18: position 3, velocity 3, acceleration 3, quaternion 4, angular velocity 3, previous thrust
  action 1, battery 1. Such a plant does not report the lagged rate actions; they are reconstructed
  as angular velocity / max_rate, which is exact where the rates follow the handout's equation 2.

What loading can do: the file holds StableHLO, which XLA compiles and runs in this process. It can
take any time and memory. Nothing in it is unpickled and it holds no Python; calls back into Python
are refused. What loading cannot do: tell whether the plant is a sensible drone, or survive every
file. A truncated file is an error, but bytes changed in the middle of one can crash the compiler,
and with it the process. Load files of people whose programs you would run.
"""

import math
import re
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.custom_batching import custom_vmap

from flytrack_env.dynamics import ModelParameters
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

# Of the handout's 21 components, those that an 18-component artifact has: all but the rate actions.
_REDUCED = np.r_[0:16, 19:21]


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


def _deserialize(path: Path) -> tuple[export.Exported, str]:
    """Return the artifact and its StableHLO as text."""
    content = bytearray(_read(path))
    try:
        exported = export.deserialize(content)
        return exported, str(exported.mlir_module())
    # Damaged bytes come back as almost any exception: struct.error, IndexError, MLIRError, ...
    except Exception as error:
        raise BlackBoxError(
            f"{path}: found {len(content)} bytes that cannot be deserialised "
            f"({type(error).__name__}: {error}), expected a jax.export artifact"
        ) from error


def _check_signature(path: Path, exported: export.Exported) -> int:
    """Return the number of components of the artifact's state."""
    if "cpu" not in exported.platforms:
        raise BlackBoxError(f"{path}: platforms: found {exported.platforms}, expected ('cpu',)")
    if exported.nr_devices != 1:
        raise BlackBoxError(f"{path}: devices: found {exported.nr_devices}, expected 1")
    for size in (STATE_SIZE, REDUCED_STATE_SIZE):
        state = ((size,), np.dtype(np.float32))
        action = ((ACTION_SIZE,), np.dtype(np.float32))
        inputs = [(aval.shape, aval.dtype) for aval in exported.in_avals]
        outputs = [(aval.shape, aval.dtype) for aval in exported.out_avals]
        if inputs == [state, action] and outputs == [state]:
            return size
    raise BlackBoxError(
        f"{path}: signature: found ({', '.join(map(str, exported.in_avals))}) -> "
        f"({', '.join(map(str, exported.out_avals))}), expected (float32[n], "
        f"float32[{ACTION_SIZE}]) -> (float32[n]) with n = {STATE_SIZE} or {REDUCED_STATE_SIZE}"
    )


def _check_closed(path: Path, exported: export.Exported, module: str) -> None:
    """Raise if the artifact has side effects or calls Python."""
    effects = [str(effect) for effect in exported.ordered_effects + exported.unordered_effects]
    targets = re.findall(r'custom_call @"?([^\s("]+)', module)
    callbacks = [target for target in targets if "callback" in target]
    if effects or callbacks:
        raise BlackBoxError(
            f"{path}: found {', '.join(effects + callbacks)}, expected a pure function without callbacks"
        )


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
        arguments, keywords = jax.tree.unflatten(exported.in_tree, row)
        return jax.tree.leaves(exported.call(*arguments, **keywords))[0]

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


class BlackBox:
    """A plant (``flytrack_env.plants``) that steps an artifact; ``load`` makes one.

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


def _check_runs(path: Path, box: BlackBox) -> None:
    """Compile the artifact and run it once, because a damaged body shows only then."""
    try:
        with jax.default_device(jax.devices("cpu")[0]):
            after = np.asarray(jax.jit(box.step_vector)(start_vector(), jnp.zeros(ACTION_SIZE)))
    except Exception as error:
        raise BlackBoxError(
            f"{path}: found a body that does not run on the CPU ({type(error).__name__}: {error}), "
            "expected one step from the start state"
        ) from error
    bad = np.flatnonzero(~np.isfinite(after))
    if bad.size:
        raise BlackBoxError(
            f"{path}: components {bad.tolist()} after one step from the start state: found "
            f"{after[bad].tolist()}, expected finite numbers"
        )


def load(path: str | Path, max_rate: tuple[float, float, float] = MAX_RATE_DEG_S) -> BlackBox:
    """Return the plant in a file; see the module for what a file may hold and what that risks.

    ``max_rate``: deg/s, body rates at full stick, used with 18-component artifacts only.

    Raises:
        BlackBoxError: missing, unreadable, too large, damaged, for another platform, another
            signature, not pure, or not finite after one step from the start state.
    """
    path = Path(path)
    exported, module = _deserialize(path)
    _check_signature(path, exported)
    _check_closed(path, exported, module)
    box = BlackBox(path, exported, max_rate)
    _check_runs(path, box)
    return box
