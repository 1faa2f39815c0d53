"""Black boxes of the tests: the shipped one, others, and states to fly them from."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from blackbox.plant import PlantParameters
from flytrack_env import blackbox
from flytrack_env.state import APPLIED_ACTION, BATTERY, QUATERNION
from tests.support.handout_plant import GRAVITY
from tests.support.pages import ROOT

SHIPPED = ROOT / "blackbox" / "acro_step.bin"
# Put together, so that this file passes its own search for the word.
FORBIDDEN = "_".join(("hidden", "parameters"))

# A drone in empty space: the minimal model, with numbers of the test's own.
AIRLESS = PlantParameters(
    mass=1.2,
    gravity=GRAVITY,
    battery_drain=1.0,
    lag=(0.02, 0.03, 0.05, 0.04),
    max_rate=(600.0, 500.0, 100.0),
    thrust=(-9.0, -6.0, 3.0, -0.3, 0.98, 0.98),
    body_drag=(0.0, 0.0, 0.0),
    rotor_drag=0.0,
    translational_lift=0.0,
    translational_speed=5.0,
    ground_radius=0.0,
)


def start(applied=(0.0, 0.0, 0.0, -1.0)):
    """The handout's start state, 3 m up, with an applied action."""
    x = np.array(blackbox.start_vector())
    x[2], x[APPLIED_ACTION] = 3.0, applied
    return x


def random_inputs(count, seed=0):
    """States (count, 21) all over the flight envelope and actions (count, 4)."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 21)) * np.array([*[5.0] * 3, *[8.0] * 3, *[1.0] * 15])
    x[:, 2] = rng.uniform(0.0, 8.0, count)
    x[:, QUATERNION] /= np.linalg.norm(x[:, QUATERNION], axis=1, keepdims=True)
    x[:, APPLIED_ACTION] = rng.uniform(-1.0, 1.0, (count, 4))
    x[:, BATTERY] = rng.uniform(22.0, 24.0, count)
    return x.astype(np.float32), rng.uniform(-1.0, 1.0, (count, 4)).astype(np.float32)


def write_artifact(
    path, function, shapes=((21,), (4,)), dtype=jnp.float32, platforms=("cpu",), disabled_checks=()
):
    """Export any function as an artifact."""
    arguments = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    options = {"platforms": platforms, "disabled_checks": disabled_checks}
    exported = export.export(jax.jit(function), **options)(*arguments)
    path.write_bytes(exported.serialize())
    return path
