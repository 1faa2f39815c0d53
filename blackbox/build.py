"""Build ``acro_step.bin``: ``python -m blackbox.build [--out PATH]`` in the repository's root."""

import argparse
import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import export
from jax.extend import mlir
from jax.extend.mlir import passmanager
from jax.extend.mlir.dialects import stablehlo
from jax.interpreters.mlir import make_ir_context

from blackbox.plant import ACTION_SIZE, STATE_SIZE, PlantParameters, step

DEFAULT_PATH = Path(__file__).with_name("acro_step.bin")


def without_locations(module: bytes) -> bytes:
    """Return a serialised StableHLO module without names of functions and files of its source.

    They would give away the effects inside, and make the artifact depend on where it was built.
    """
    target = stablehlo.get_version_from_compatibility_requirement(
        stablehlo.StablehloCompatibilityRequirement.WEEK_12
    )
    with make_ir_context():
        parsed = mlir.deserialize_portable_artifact(module)
        passmanager.PassManager.parse("builtin.module(strip-debuginfo)").run(parsed.operation)
        return bytes(mlir.serialize_portable_artifact(parsed, target))


def serialize(parameters: PlantParameters) -> bytes:
    """Return the plant with these parameters baked in, exported for the CPU."""
    # A name of its own, because the name of the function is stored in the artifact.
    acro_step = partial(step, parameters=parameters)
    acro_step.__name__ = "acro_step"  # type: ignore[attr-defined]
    state = jax.ShapeDtypeStruct((STATE_SIZE,), jnp.float32)
    action = jax.ShapeDtypeStruct((ACTION_SIZE,), jnp.float32)
    exported = export.export(jax.jit(acro_step), platforms=["cpu"])(state, action)
    module = without_locations(exported.mlir_module_serialized)
    return bytes(dataclasses.replace(exported, mlir_module_serialized=module).serialize())


def build(parameters: PlantParameters, path: str | Path) -> Path:
    """Write the artifact of a plant with any parameters, and return its path.

    It is written under another name and renamed, so that nobody reads half of it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.unfinished")
    unfinished.write_bytes(serialize(parameters))
    return unfinished.replace(path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Build the shipped plant."""
    # Here and not above, so that nobody comes by the numbers through this module.
    from blackbox.hidden_parameters import PARAMETERS

    parser = argparse.ArgumentParser(description="Export the shipped plant as a black box.")
    parser.add_argument("--out", type=Path, default=DEFAULT_PATH, help="default: %(default)s")
    path = build(PARAMETERS, parser.parse_args(arguments).out)
    print(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
