"""What a gate detector reports: corners in the image, beside gyro and accelerometer."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env import camera
from flytrack_env.camera import CameraPose, Lens, Pixel
from flytrack_env.effects import Range
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.fusion import compute_once
from flytrack_env.observations import OBSERVATION, Entry
from flytrack_env.params import EnvParams
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.randomness import Draws, seeds_of
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers.camera_view import CameraView

NUM_CORNERS = 4
# Latency and time between frames together: 25 frames a second, or 50 that are 20 ms late. Each step
# remembered costs 0.04 of a plain step.
MAX_AGE_S = 0.04
HALF_BITS = 16
ROUNDING = 1e-3  # steps or frames: what float32 loses in time times rate


class CornersParams(NamedTuple):
    """A camera and its gate detector; the defaults are those of a perfect detector.

    Attributes:
        field_of_view_deg: horizontal, without distortion.
        pitch_deg: of the optical axis above body x.
        width_px: columns of the image.
        height_px: rows of the image.
        k1, k2: radial distortion, see ``flytrack_env.camera.Lens``.
        noise_px: standard deviation of a corner's image coordinates.
        missed: probability that a visible corner is not detected in a frame.
        swapped: probability that a gate's upper or lower two corners are taken for each other in a
            frame.
        frame_rate_hz: frames per second.
        latency_s: from exposure to observation; a frame is exposed at the step nearest to its time.
    """

    field_of_view_deg: Scalar = camera.FIELD_OF_VIEW_DEG
    pitch_deg: Scalar = camera.PITCH_DEG
    width_px: Scalar = 640.0
    height_px: Scalar = 480.0
    k1: Scalar = 0.0
    k2: Scalar = 0.0
    noise_px: Scalar = 0.0
    missed: Scalar = 0.0
    swapped: Scalar = 0.0
    frame_rate_hz: Scalar = 100.0
    latency_s: Scalar = 0.0

    @property
    def lens(self) -> Lens:
        """The lens of the image."""
        return camera.make_lens(
            self.field_of_view_deg, self.width_px, self.height_px, self.k1, self.k2
        )


NOISY_DETECTOR = CornersParams(noise_px=2.0, missed=0.05, frame_rate_hz=50.0, latency_s=0.02)


def _gate_entries(key: str, name: str) -> tuple[Entry, Entry]:
    order = "top left, top right, bottom right, bottom left"
    return (
        Entry(
            f"{key}_corners",
            f"corners of the opening of {name}, {order}: right and down from the middle of the "
            "image; 0 where not detected",
            2 * NUM_CORNERS,
            "image",
            "half image",
            1.0,
            1.25,
        ),
        Entry(
            f"{key}_detected", "whether each of them is detected", NUM_CORNERS, "-", "1", 1.0, 1.0
        ),
    )


KEPT = {entry.key: entry for entry in OBSERVATION if entry.key in ("rates", "battery")}
ACCELEROMETER = Entry(
    "accelerometer", "specific force, as an accelerometer reads it", 3, "body", "m/s^2", 20.0, 5.0
)
TABLE = (
    *_gate_entries("gate", "the gate"),
    *_gate_entries("next_gate", "the next gate"),
    KEPT["rates"],
    ACCELEROMETER,
    KEPT["battery"],
)


class CornersState(NamedTuple):
    """The inner state, and what frames are made of.

    Attributes:
        past: where the camera was at the steps before, the latest first.
        steps: since the episode began.
        word: that the detector's errors are drawn from.
    """

    inner: Any
    past: tuple[CameraPose, ...]
    steps: jax.Array
    word: jax.Array


class GateCorners(CameraView):
    """Observe the corners of the next two gates in the camera's image, and inertial sensors.

    The camera and the detector are ``params.wrappers["gate_corners"]``, a ``CornersParams``.
    Neither position, velocity nor attitude is observed. Gates hide nothing behind them. Which gate
    is next is known as soon as one is passed; pixels are as old as their frame.

    Args:
        detector: default parameters.
        max_age_s: the oldest frame that the state has room for; see ``check_params``.

    Raises:
        WrapperError: as ``CameraView``.
    """

    key = "gate_corners"
    ranges: Mapping[str, Range] = {
        **camera.RANGES,
        "width_px": Range(camera.MIN_RESOLUTION, camera.MAX_PIXELS, "px"),
        "height_px": Range(camera.MIN_RESOLUTION, camera.MAX_PIXELS, "px"),
        "k1": Range(-10.0, 10.0, "1"),
        "k2": Range(-10.0, 10.0, "1"),
        "noise_px": Range(0.0, 1e3, "px"),
        "missed": Range(0.0, 1.0, "1"),
        "swapped": Range(0.0, 1.0, "1"),
        "frame_rate_hz": Range(25.0, 1000.0, "Hz"),
        "latency_s": Range(0.0, 1.0, "s"),
    }

    def __init__(
        self,
        env: EpisodicEnvironment,
        detector: CornersParams = CornersParams(),  # noqa: B008, immutable
        max_age_s: float = MAX_AGE_S,
    ):
        super().__init__(env)
        self._default = detector
        self.num_past = math.ceil(max_age_s / float(env.default_params.dt) - ROUNDING) - 1

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """Corners of both gates, angular velocity, specific force and battery."""
        return TABLE

    def own_defaults(self) -> CornersParams:
        """Return the detector that the wrapper was made with."""
        return self._default

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError, naming the field, for a camera beyond ``ranges`` or too late."""
        super().check_params(params)
        own = self.own_params(params)
        camera.check_pixels(own.width_px, own.height_px, f"params.wrappers[{self.key!r}].")
        oldest_s = np.asarray(own.latency_s) + 1.0 / np.asarray(own.frame_rate_hz)
        longest_s = (self.num_past + 1 + ROUNDING) * np.asarray(params.dt)
        if not np.all(oldest_s <= longest_s):
            raise ValueError(
                f"params.wrappers[{self.key!r}].latency_s: found {own.latency_s} s and frames "
                f"{own.frame_rate_hz} times a second, expected latency and time between frames of "
                f"{float(np.min(longest_s)):.3g} s together; GateCorners(max_age_s=...) has more"
            )

    def begin(
        self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0
    ) -> CornersState:
        """Return the state of a new episode, as if the drone had been there all along."""
        inner = self.env.begin(drone, gate_index, params, seed)
        past = (CameraPose(drone.pos_w, drone.quat),) * self.num_past
        return CornersState(inner, past, jnp.int32(0), Draws(seed).word(self.key))

    def advance(
        self, state: CornersState, command: Action, params: EnvParams
    ) -> tuple[CornersState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment, and the pose before remembered."""
        before = self.drone(state)
        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        past = (CameraPose(before.pos_w, before.quat), *state.past)[: self.num_past]
        after = CornersState(inner, past, state.steps + 1, state.word)
        return after, reward, terminated, info

    def observe_drone(
        self, drone: Drone, state: CornersState, params: EnvParams
    ) -> list[jax.Array]:
        """Return corners, angular velocity, specific force and battery, float32 scalars.

        ``drone`` is as the sensors report it: its angular velocity is the gyro's. What the camera
        and the accelerometer see is the true drone.
        """
        inner = iter(self.env.observe_drone(drone, state.inner, params))
        kept = {
            entry.key: [next(inner) for _ in range(entry.size)]
            for entry in self.env.observation_table
        }
        true = self.drone(state)
        force_w = true.acc_w + Vec3(0.0, 0.0, params.model.g)
        force_b = [axis.dot(force_w) for axis in true.quat.axes()]
        scale, limit = 1.0 / ACCELEROMETER.scale, ACCELEROMETER.limit
        return [
            *self._detect(state, params),
            *kept["rates"],
            *(jnp.clip(part * scale, -limit, limit) for part in force_b),
            *kept["battery"],
        ]

    def _frame(self, state: CornersState, params: EnvParams) -> tuple[CameraPose, jax.Array]:
        """Return where the camera was when the observed frame was exposed, and its number.

        The number is an int32 and counts from the exposure at the reset.
        """
        own, true = self.own_params(params), self.drone(state)
        frames_per_step = own.frame_rate_hz * params.dt
        now = state.steps.astype(jnp.result_type(true.pos_w.x))
        elapsed = now * frames_per_step - own.latency_s * own.frame_rate_hz
        frame = jnp.floor(elapsed + ROUNDING)
        age = jnp.clip(jnp.round(now - frame / frames_per_step), 0, self.num_past)
        age, frame = compute_once((age.astype(jnp.int32), frame.astype(jnp.int32)))
        pose = CameraPose(true.pos_w, true.quat)
        for steps, past in enumerate(state.past, start=1):
            is_it = age == steps
            pose = jax.tree.map(
                lambda old, new, is_it=is_it: jnp.where(is_it, old, new), past, pose
            )
        return compute_once(pose), frame

    def _detect(self, state: CornersState, params: EnvParams) -> list[jax.Array]:
        """Return the detector's rows: per gate the corners' coordinates, then their flags."""
        own, race = self.own_params(params), self.race(state)
        pose, frame = self._frame(state, params)
        draws = Draws(compute_once(seeds_of(state.word, frame)))
        sides = compute_once(_draw_sides(own, draws))
        scales = compute_once((2.0 / own.width_px, 2.0 / own.height_px))
        axes = compute_once(camera.camera_axes(pose.quat, own.pitch_deg))
        gates = [
            camera.opening_corners(axes, pose.pos_w, gate, *side)
            for gate, side in zip((race.gate, race.next_gate), sides, strict=True)
        ]
        pixels_of_gates = compute_once(
            [[camera.project(corner, own.lens) for corner in corners] for corners in gates]
        )
        rows: list[jax.Array] = []
        for gate, pixels in enumerate(pixels_of_gates):
            missed = _draw_missed(own, draws, gate)
            corners = []
            for index, pixel in enumerate(pixels):
                right, down = draws.normal_pair(f"noise_{gate}_{index}")
                errors_px = own.noise_px * right, own.noise_px * down
                corners.append(_detect_corner(pixel, missed[index], errors_px, scales))
            rows += [value for corner in corners for value in corner[:2]]
            rows += [corner[2] for corner in corners]
        return rows


def _draw_sides(own: CornersParams, draws: Draws) -> list[tuple[jax.Array, jax.Array]]:
    """Return for each gate -1 if the upper, and if the lower corners are exchanged, else 1."""
    half = compute_once(_threshold(0.5 * own.swapped))
    return [
        (
            jnp.where(draw < half, -1.0, 1.0),
            jnp.where(draw >= jnp.uint32(2**HALF_BITS) - half, -1.0, 1.0),
        )
        for draw in _halves(draws.word("swapped"))
    ]


def _draw_missed(own: CornersParams, draws: Draws, gate: int) -> list[jax.Array]:
    """Return whether each corner of a gate is missed."""
    threshold = compute_once(_threshold(own.missed))
    words = [draws.word(f"missed_{gate}_{pair}") for pair in range(NUM_CORNERS // 2)]
    return [half < threshold for word in words for half in _halves(word)]


def _halves(word: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return two random uint32 below 2^16 of one word: a hash costs as much as a corner."""
    return word >> HALF_BITS, word & (2**HALF_BITS - 1)


def _threshold(probability: Scalar) -> jax.Array:
    """Return the uint32 below which such a half lies with a probability, in steps of 2^-16."""
    return jnp.round(probability * 2.0**HALF_BITS).astype(jnp.uint32)


def _detect_corner(
    pixel: Pixel,
    is_missed: jax.Array,
    errors_px: tuple[Scalar, Scalar],
    scales: tuple[Scalar, Scalar],
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return a corner as observed: right and down in half images, and 1; all 0 if not detected.

    Args:
        pixel: where it is.
        is_missed: whether the detector overlooks it.
        errors_px: the detector's, to the right and down.
        scales: half images per px, to the right and down.
    """
    limit = TABLE[0].limit
    detected = compute_once(jnp.asarray(pixel.is_visible & ~is_missed))
    coordinates = (
        jnp.where(detected, jnp.clip((offset_px + error_px) * scale, -limit, limit), 0.0)
        for offset_px, error_px, scale in zip(pixel[:2], errors_px, scales, strict=True)
    )
    right, down = coordinates
    return right, down, jnp.where(detected, 1.0, 0.0)
