"""All thrust scaled: a payload, worn propellers, warm motors; no log tells these from mass."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, StepContext
from flytrack_env.quaternion import Scalar


class ThrustScale(NamedTuple):
    """Factor on the collective thrust, 1."""

    factor: Scalar = 1.0


def _thrust(scale: ThrustScale, memory: None, thrust_n: Scalar, context: StepContext) -> Scalar:
    return scale.factor * thrust_n


THRUST_SCALE = Effect(
    name="thrust_scale",
    parameters=ThrustScale,
    ranges={"factor": Range(0.5, 1.5, "1")},
    notable={"factor": 0.02},
    equation=r"T \leftarrow \text{factor} \cdot T",
    source="assumption: the shape of the thrust curve stays",
    hooks={"thrust": _thrust},
)
