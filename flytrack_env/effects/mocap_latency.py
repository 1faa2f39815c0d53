"""Late poses: motion capture, its network, an estimator of position, velocity and attitude."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Memory, Pose, Range, Search, StepContext
from flytrack_env.effects.command_delay import MAX_DELAY_STEPS, late
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import Drone

MAX_LATENCY_S = 0.12


class MocapLatency(NamedTuple):
    """Delay of position, velocity and attitude, s; need not be whole steps."""

    latency_s: Scalar = 0.0


PastPoses = tuple[Pose, ...]  # true ones before the present one, the latest first


def start(latency: MocapLatency, drone: Drone, num_steps: int) -> PastPoses:
    """Return the memory of an episode that begins: as if the drone had been there all along."""
    return (Pose.of(drone),) * num_steps


def _same_sign(quat: Quaternion, like: Quaternion) -> Quaternion:
    """Return q or -q, which are one attitude: the one nearer to another."""
    sign = jnp.where(sum(a * b for a, b in zip(quat, like, strict=True)) < 0.0, -1.0, 1.0)
    return Quaternion(*(sign * part for part in quat))


def _pose(latency: MocapLatency, past: PastPoses, pose: Pose, dt: Scalar) -> Pose:
    """Return the mean of the poses between which the delayed time lies, by their nearness."""
    poses = (
        pose,
        *(past_pose._replace(quat=_same_sign(past_pose.quat, pose.quat)) for past_pose in past),
    )

    def mean(*vectors: tuple[Scalar, ...]) -> list[Scalar]:
        return [late(parts, latency.latency_s, dt) for parts in zip(*vectors, strict=True)]

    pos_w, vel_w, quat = (mean(*vectors) for vectors in zip(*poses, strict=True))
    is_late = jnp.asarray(latency.latency_s) > 0.0
    pairs = zip(Quaternion(*quat).normalize(), pose.quat, strict=True)
    return Pose(
        Vec3(*pos_w), Vec3(*vel_w), Quaternion(*(jnp.where(is_late, *pair) for pair in pairs))
    )


def remember(latency: MocapLatency, past: PastPoses, context: StepContext) -> PastPoses:
    """Return the memory after a step."""
    return (Pose.of(context.drone), *past[:-1])


MOCAP_LATENCY = Effect(
    name="mocap_latency",
    parameters=MocapLatency,
    ranges={"latency_s": Range(0.0, MAX_LATENCY_S, "s")},
    notable={"latency_s": 0.002},
    equation=r"(\mathbf{p}, \mathbf{v}, \mathbf{q})_\text{measured}(t) = "
    r"(\mathbf{p}, \mathbf{v}, \mathbf{q})(t - \text{latency})",
    source="assumption: the same for all three, linear between steps",
    max_steps={"latency_s": MAX_DELAY_STEPS},
    hooks={"pose": _pose},
    memory=Memory(start=start, remember=remember),
    search=Search(needs=("q", "w"), probes={"latency_s": (0.005, 0.01, 0.02, 0.03)}),
)
