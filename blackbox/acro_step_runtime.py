"""Run ``acro_step.bin``: ``from acro_step_runtime import step; x_next = step(x, u)``.

Needs JAX and flatbuffers, and nothing else of FlyTrack.
"""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import export
from jax.typing import ArrayLike

DEFAULT_PATH = Path(__file__).with_name("acro_step.bin")


@lru_cache(maxsize=16)
def _load(path: Path) -> Callable[[jax.Array, jax.Array], jax.Array]:
    return jax.jit(export.deserialize(bytearray(path.read_bytes())).call)


def step(x: ArrayLike, u: ArrayLike, bin_path: str | Path = DEFAULT_PATH) -> jax.Array:
    """Return the state 0.01 s later: (21,), (4,) -> (21,) float32, on the CPU.

    A file is read once; replacing it shows in the next process only.

    Raises:
        OSError: the file cannot be read.
        ValueError: the artifact takes other shapes.
    """
    with jax.default_device(jax.devices("cpu")[0]):
        transition = _load(Path(bin_path).resolve())
        return transition(jnp.asarray(x, jnp.float32), jnp.asarray(u, jnp.float32))
