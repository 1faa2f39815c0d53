"""The drone's camera: pinhole projection, with radial distortion, and masks of gate frames.

The camera sits at the drone's centre. Its frame has x along the optical axis, y left, z up; the
optical axis is pitched up from body x and meets the image in its middle.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.effects import Range
from flytrack_env.fusion import compute_once
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.tracks import GateFrame

PITCH_DEG = 40.0  # of the camera's ray in recordings
FIELD_OF_VIEW_DEG = 120.0  # of wide lenses, as racing drones have them
MIN_RESOLUTION, MAX_PIXELS = 8, 1_000_000
# A field of view of 180 degrees has no pinhole image; near it, a pixel in the middle is degrees.
RANGES = {
    "field_of_view_deg": Range(1.0, 170.0, "deg"),
    "pitch_deg": Range(-90.0, 90.0, "deg"),
}
MIN_DEPTH_M = 1e-3
MIN_SLOPE = 1e-6  # of a border of a mask, below which it counts as vertical
WORD_BITS = 32  # pixels of a row of a mask that one word holds
WHITE = 255


class CameraPose(NamedTuple):
    """Where the camera is, world, m, and the drone's attitude, body to world."""

    pos_w: Vec3
    quat: Quaternion


class Lens(NamedTuple):
    """Focal length and half size of an image, px, and its radial distortion.

    Attributes:
        k1, k2: a point at distance r from the optical axis, in focal lengths, is seen at
            r (1 + k1 r^2 + k2 r^4).
        max_square_radius: r^2 up to which the distortion keeps the order of points; beyond, it
            folds the image over.
    """

    focal_px: Scalar
    half_width_px: Scalar
    half_height_px: Scalar
    k1: Scalar
    k2: Scalar
    max_square_radius: Scalar


def make_lens(
    field_of_view_deg: Scalar,
    width_px: Scalar,
    height_px: Scalar,
    k1: Scalar = 0.0,
    k2: Scalar = 0.0,
) -> Lens:
    """Return the lens of an image with that horizontal field of view (without distortion).

    The distortion keeps the order of points up to the first root of its slope
    1 + 3 k1 s + 5 k2 s^2 in s = r^2, if there is one.
    """
    half = jnp.deg2rad(0.5 * field_of_view_deg)
    discriminant = 9.0 * k1 * k1 - 20.0 * k2
    is_real = discriminant > 0.0
    denominator = jnp.sqrt(jnp.where(is_real, discriminant, 1.0)) - 3.0 * k1
    is_root = is_real & (denominator > 0.0)
    return compute_once(
        Lens(
            focal_px=0.5 * width_px * jnp.cos(half) / jnp.sin(half),
            half_width_px=0.5 * width_px,
            half_height_px=0.5 * height_px,
            k1=k1,
            k2=k2,
            max_square_radius=jnp.where(
                is_root, 2.0 / jnp.where(is_root, denominator, 1.0), jnp.inf
            ),
        )
    )


class Pixel(NamedTuple):
    """Where an image shows a point: right and down of its middle, px; and whether it does, bool."""

    right_px: Scalar
    down_px: Scalar
    is_visible: Scalar


def check_pixels(width_px: Any, height_px: Any, prefix: str) -> None:
    """Raise ValueError, naming the field behind a prefix, for an image too small or too large."""
    for name, value in (("width_px", width_px), ("height_px", height_px)):
        if not np.all(np.asarray(value) >= MIN_RESOLUTION):
            raise ValueError(f"{prefix}{name}: found {value}, expected at least {MIN_RESOLUTION}")
    if not np.all(np.asarray(width_px, float) * np.asarray(height_px, float) <= MAX_PIXELS):
        raise ValueError(
            f"{prefix}width_px: found {width_px} beside height_px {height_px}, expected at most "
            f"{MAX_PIXELS:,} pixels together"
        )


def camera_axes(quat: Quaternion, pitch_deg: Scalar) -> tuple[Vec3, Vec3, Vec3]:
    """Return the camera's axes x (optical), y (left) and z (up), world."""
    axis_x, axis_y, axis_z = quat.axes()
    pitch = jnp.deg2rad(pitch_deg)
    cos, sin = compute_once((jnp.cos(pitch), jnp.sin(pitch)))
    return axis_x.scale(cos) + axis_z.scale(sin), axis_y, axis_z.scale(cos) - axis_x.scale(sin)


def to_camera(axes: tuple[Vec3, Vec3, Vec3], vector_w: Vec3) -> Vec3:
    """Return a world-frame vector's components along the camera's axes."""
    return Vec3(*(axis.dot(vector_w) for axis in axes))


def opening_corners(
    axes: tuple[Vec3, Vec3, Vec3],
    pos_w: Vec3,
    gate: GateFrame,
    top_side: Scalar = 1.0,
    bottom_side: Scalar = 1.0,
) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Return the corners of a gate's opening in the camera's frame, m.

    Top left, top right, bottom right, bottom left as they are for who flies through.

    Args:
        axes: of the camera, world.
        pos_w: of the camera, m.
        gate: whose opening it is.
        top_side: -1 exchanges the upper two corners.
        bottom_side: -1 exchanges the lower two corners.
    """
    centre, left, up = compute_once(
        (
            to_camera(axes, gate.centre - pos_w),
            to_camera(axes, gate.left()).scale(gate.half_opening),
            to_camera(axes, gate.up).scale(gate.half_opening),
        )
    )
    top, bottom = centre + up, centre - up
    top_left, bottom_left = left.scale(top_side), left.scale(bottom_side)
    return top + top_left, top - top_left, bottom - bottom_left, bottom + bottom_left


def project(point_c: Vec3, lens: Lens) -> Pixel:
    """Return where the image shows a point of the camera's frame, m.

    Behind the camera, or where the distortion folds over, the coordinates mean nothing and the
    point is not visible.
    """
    is_ahead = point_c.x > MIN_DEPTH_M
    inverse = -1.0 / jnp.where(is_ahead, point_c.x, 1.0)
    right, down = point_c.y * inverse, point_c.z * inverse
    square = right * right + down * down
    factor = lens.focal_px * (1.0 + square * (lens.k1 + square * lens.k2))
    right_px, down_px = factor * right, factor * down
    is_inside = (jnp.abs(right_px) <= lens.half_width_px) & (
        jnp.abs(down_px) <= lens.half_height_px
    )
    return Pixel(right_px, down_px, is_ahead & is_inside & (square < lens.max_square_radius))


def draw_frames(
    pose: CameraPose,
    gates: GateFrame,
    pitch_deg: Scalar,
    field_of_view_deg: Scalar,
    size: tuple[int, int],
) -> jax.Array:
    """Draw the frames of all gates as a mask, (height, width, 1) uint8: 255 on a frame, else 0.

    A ray d = (1, left, up) of the camera's frame meets the plane of a gate, with normal n towards
    the gate, in front of the camera within a square of half edge h where (h n.d +- (n.c) a.d -+
    (a.c) n.d) >= 0 for both axes a of the square and its centre c: four half planes of the image,
    which need no clipping of what is behind the camera. A row of pixels meets them in one interval,
    and the bits of a word are the pixels of a row.

    Args:
        gates: leaves (num_gates,).
        size: height and width, px.
    """
    height, width = size
    lens = make_lens(field_of_view_deg, float(width), float(height))
    axes = camera_axes(pose.quat, pitch_deg)
    centre, normal = to_camera(axes, gates.centre - pose.pos_w), to_camera(axes, gates.forward)
    squares = [to_camera(axes, axis) for axis in (gates.left(), gates.up)]
    sign = jnp.where(normal.dot(centre) < 0.0, -1.0, 1.0)
    normal = normal.scale(sign)
    distance = normal.dot(centre)
    above_px = lens.half_height_px - (jnp.arange(height) + 0.5)
    spans = []
    for half in (gates.half_frame, gates.half_opening):
        shape = (*jnp.shape(half), height)
        first, last = jnp.full(shape, -jnp.inf), jnp.full(shape, jnp.inf)
        for axis in squares:
            for side in (1.0, -1.0):
                border = normal.scale(half - side * axis.dot(centre)) + axis.scale(side * distance)
                slope = jnp.where(jnp.abs(border.y) < MIN_SLOPE, MIN_SLOPE, border.y)
                middle = lens.half_width_px + lens.focal_px * border.x / slope
                edge = middle[..., None] + (border.z / slope)[..., None] * above_px
                is_left = (slope < 0.0)[..., None]
                first = jnp.where(is_left, jnp.maximum(first, edge), first)
                last = jnp.where(is_left, last, jnp.minimum(last, edge))
        spans.append(_span_words(first, last, width))
    frames = [outer & ~inner for outer, inner in zip(*spans, strict=True)]
    # Fenced, so that a word is not computed again for each of its bits.
    rows = compute_once(jnp.stack([_union(words) for words in frames], axis=-1))
    bits = (rows[..., None] >> jnp.arange(WORD_BITS, dtype=jnp.uint32)) & 1
    pixels = bits.reshape(height, -1)[:, :width, None]
    return pixels.astype(jnp.uint8) * jnp.uint8(WHITE)


def _span_words(first: jax.Array, last: jax.Array, width: int) -> list[jax.Array]:
    """Return words (...), uint32, whose bits are 1 from one coordinate (...), px, to another."""

    def count_before(edge: jax.Array) -> jax.Array:
        return jnp.clip(edge, 0.0, width).astype(jnp.int32)

    begin, end = count_before(jnp.ceil(first - 0.5)), count_before(jnp.floor(last + 0.5))
    end = jnp.maximum(begin, end)

    def below(count: jax.Array, word: int) -> jax.Array:
        bits = jnp.clip(count - word * WORD_BITS, 0, WORD_BITS).astype(jnp.uint32)
        return jnp.left_shift(jnp.uint32(1), bits) - 1

    num_words = -(-width // WORD_BITS)
    return [below(end, word) & ~below(begin, word) for word in range(num_words)]


def _union(words: jax.Array) -> jax.Array:
    """Return the bits that any of words (count, ...) has; unrolled, which XLA vectorises."""
    bits = words[0]
    for word in words[1:]:
        bits = bits | word
    return bits
