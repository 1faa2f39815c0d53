"""A track as arrays for ``jit``, and the geometry of flying through a gate.

Every gate has a *flight frame*: x along the direction of flight (normal to the gate), z along
the gate's local z, y to the left. Observations and crossings are expressed in it, so that "in front
of the gate" means x < 0 whichever side of its local y axis the gate is flown from.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import compute_once, is_unfused
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.tracks.track import Track

LENGTH_SAMPLES = 1000


class GateFrame(NamedTuple):
    """Flight frame of one gate.

    The leaves are scalars, or arrays of shape (num_gates,) for the gates of a course.

    Attributes:
        centre: m.
        forward, up: its axes x and z in the world.
        half_opening, half_frame: half edges of the inner and the outer square, m.
    """

    centre: Vec3
    forward: Vec3
    up: Vec3
    half_opening: Scalar
    half_frame: Scalar

    def left(self) -> Vec3:
        """Return the frame's y axis."""
        return self.up.cross(self.forward)

    def to_frame(self, vector_w: Vec3) -> Vec3:
        """Return a world-frame vector's components in the flight frame."""
        return Vec3(self.forward.dot(vector_w), self.left().dot(vector_w), self.up.dot(vector_w))


class Course(NamedTuple):
    """What the environment needs of a track; a pytree of arrays, so that courses can be batched.

    Attributes:
        gates: leaves (num_gates,), in flying order.
        start_pos_w: m.
        start_quat: body to world.
        bounds_low, bounds_high: m.
    """

    gates: GateFrame
    start_pos_w: Vec3
    start_quat: Quaternion
    bounds_low: Vec3
    bounds_high: Vec3

    @property
    def num_gates(self) -> int:
        """Number of gates of one lap (static)."""
        return int(np.shape(self.gates.half_opening)[0])

    def gate(self, index: jax.Array) -> GateFrame:
        """Return the gate of an index in [0, num_gates), as scalars.

        A tree of selects on the bits of the index: on a CPU under ``vmap`` this vectorises,
        which a gather does not.
        """
        if is_unfused():  # no vmap: read where it is
            return jax.tree.map(lambda table: _read(table, index), self.gates)
        bits = [(index & (1 << bit)) != 0 for bit in range((self.num_gates - 1).bit_length())]

        def select(table: jax.Array) -> jax.Array:
            level = [table[i] for i in range(self.num_gates)]
            for bit in bits:
                pairs = [level[i : i + 2] for i in range(0, len(level), 2)]
                level = [jnp.where(bit, pair[-1], pair[0]) for pair in pairs]
            return level[0]

        return compute_once(jax.tree.map(select, self.gates))

    def next_index(self, index: jax.Array) -> jax.Array:
        """Return the index of the gate after this one, cyclically; a scalar, as the index is."""
        return jnp.where(index + 1 >= self.num_gates, 0, index + 1)


def _read(table: jax.Array, index: jax.Array) -> jax.Array:
    # Unsigned, since of a signed index JAX asks whether it counts from the end.
    unsigned = index.astype(jnp.uint32)
    return jax.lax.dynamic_index_in_dim(jnp.asarray(table), unsigned, keepdims=False)


class Crossing(NamedTuple):
    """How a straight segment meets a gate's plane in the direction of flight.

    Attributes:
        is_pass, is_frame, is_miss: through the opening, on the frame, outside it; at most one is
            true.
        fraction: where on the segment, in [0, 1]; 1 where the plane is not crossed.
        offset: distance of the crossing from the centre over the free half opening, along the worse
            of the gate's two axes: 0 at the centre, 1 at the edge.
    """

    is_pass: jax.Array
    is_frame: jax.Array
    is_miss: jax.Array
    fraction: jax.Array
    offset: jax.Array


def cross_gate(gate: GateFrame, start_w: Vec3, end_w: Vec3, radius: Scalar) -> Crossing:
    """Return how a drone of that radius (m) flying a straight segment (world, m) meets a gate.

    The point of crossing is interpolated, so the answer does not depend on how a path is cut into
    segments. A point exactly on the plane counts as beyond it: the segment that ends there crosses,
    the one that starts there does not. Backwards through the opening is no event; the frame is
    solid from both sides.
    """
    start = gate.to_frame(start_w - gate.centre)
    end = gate.to_frame(end_w - gate.centre)
    start_x, end_x = compute_once((jnp.asarray(start.x), jnp.asarray(end.x)))
    is_forward = (start_x < 0.0) & (end_x >= 0.0)
    is_backward = (start_x >= 0.0) & (end_x < 0.0)
    is_crossing = is_forward | is_backward
    # The denominator is non-zero wherever the plane is crossed; elsewhere it is not used.
    travel = jnp.where(is_crossing, end_x - start_x, 1.0)
    fraction = compute_once(jnp.where(is_crossing, -start_x / travel, 1.0))
    across = jnp.abs(start.y + fraction * (end.y - start.y))
    along = jnp.abs(start.z + fraction * (end.z - start.z))
    distance = compute_once(jnp.maximum(across, along))
    free = gate.half_opening - radius
    is_within_opening = distance <= free
    is_within_frame = distance <= gate.half_frame + radius
    return Crossing(
        is_pass=is_forward & is_within_opening,
        is_frame=is_crossing & ~is_within_opening & is_within_frame,
        is_miss=is_forward & ~is_within_frame,
        fraction=fraction,
        offset=distance / free,
    )


def build_course(track: Track) -> Course:
    """Return a track as arrays, float32: the gates' flight frames, start pose and bounds."""

    def vectors(rows: Sequence[tuple[Scalar, ...]]) -> Vec3:
        return Vec3(*np.array(rows, np.float32).reshape(-1, 3).T)

    forward, up = [], []
    for gate in track.gates:
        _, local_y, local_z = Quaternion(*gate.quaternion).axes()
        forward.append(local_y.scale(gate.direction))
        up.append(local_z)
    return Course(
        gates=GateFrame(
            centre=vectors([gate.position for gate in track.gates]),
            forward=vectors(forward),
            up=vectors(up),
            half_opening=np.array([0.5 * gate.opening for gate in track.gates], np.float32),
            half_frame=np.array([0.5 * gate.frame for gate in track.gates], np.float32),
        ),
        start_pos_w=Vec3(*map(np.float32, track.start_position)),
        start_quat=Quaternion(*map(np.float32, track.start_quaternion)),
        bounds_low=Vec3(*map(np.float32, track.bounds_low)),
        bounds_high=Vec3(*map(np.float32, track.bounds_high)),
    )


def hermite_curve(start: Vec3, leave: Vec3, end: Vec3, meet: Vec3, s: Scalar) -> tuple[Vec3, Vec3]:
    """Return point and tangent, m, at ``s`` in [0, 1] of the cubic curve from ``start`` to ``end``.

    It leaves with the tangent ``leave`` and meets the end with the tangent ``meet``, m. Cubic
    Hermite interpolation; numpy arrays stay numpy arrays.
    """
    chord = end - start
    point = (
        start
        + leave.scale(s * (1.0 - s) * (1.0 - s))
        + chord.scale(s * s * (3.0 - 2.0 * s))
        + meet.scale(s * s * (s - 1.0))
    )
    tangent = (
        leave.scale((1.0 - s) * (1.0 - 3.0 * s))
        + chord.scale(6.0 * s * (1.0 - s))
        + meet.scale(s * (3.0 * s - 2.0))
    )
    return point, tangent


def sample_way(course: Course, num_samples: int) -> np.ndarray:
    """Return points of the way round a course, (num_gates, num_samples, 3), world, m, float64.

    Row n leads from gate n to the gate after it, both ends included, on the curve along which
    episodes start in flight (``flytrack_env.resets``): it leaves and meets the gates along their
    directions of flight, with tangents as long as the gates are apart.
    """
    before = jax.tree.map(lambda leaf: np.asarray(leaf, float)[:, None], course.gates)
    gate = jax.tree.map(lambda leaf: np.roll(leaf, -1, axis=0), before)
    chord = gate.centre - before.centre
    length = np.sqrt(chord.dot(chord))
    leave, meet = before.forward.scale(length), gate.forward.scale(length)
    s = np.linspace(0.0, 1.0, num_samples)
    return np.stack(hermite_curve(before.centre, leave, gate.centre, meet, s)[0], axis=-1)


def way_length(course: Course) -> float:
    """Return the length of ``sample_way`` round a course, m, within a millimetre per gate."""
    way = sample_way(course, LENGTH_SAMPLES)
    return float(np.linalg.norm(np.diff(way, axis=1), axis=-1).sum())
