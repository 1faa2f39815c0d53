"""A flight as a Rerun recording; needs the extra ``flytrack[viz]``.

The entities, all in the world frame unless said otherwise:

=================================  ======  ====================================================
entity                             when    what
=================================  ======  ====================================================
world                              static  ViewCoordinates.RIGHT_HAND_Z_UP
world/gates/{centre,outer,inner}   static  one instance per gate, in the order of the rows
world/drone                        step    pose: translation in m, rotation body to world
world/drone/{motors,arms,camera}   static  body frame; moves with the pose above it
world/trajectory/{flown,recent}    step    the path so far: finished blocks, and the rest
plots/{speed,angular_speed}        step    m/s and rad/s
plots/action/{roll,...,thrust}     step    commanded action, in [-1, 1]
=================================  ======  ====================================================
"""

import argparse
import math
import os
import sys
import uuid
from pathlib import Path

import numpy as np

from flytrack_env.rollout import load_rollout
from flytrack_env.state import (
    ACTION_SIZE,
    POSITION,
    QUATERNION,
    RATES,
    STATE_SIZE,
    VELOCITY,
    Action,
)
from flytrack_env.tracks import load_track

try:
    import rerun as rr
except ImportError as error:
    raise ImportError(
        "recordings need rerun-sdk, which is not installed: pip install 'flytrack[viz]'"
    ) from error

STEP_NS = 10_000_000
GATE_OUTER_M = 2.7
GATE_INNER_M = 1.5
GATE_COLUMNS = 8
UNIT_NORM_TOLERANCE = 1e-3
CAMERA_PITCH_RAD = math.radians(40.0)
CAMERA_RAY_M = 0.3

# Body frame, m: x forward, y left, z up.
FRONT_LEFT, FRONT_RIGHT = (0.15, 0.09, 0.0), (0.15, -0.09, 0.0)
BACK_LEFT, BACK_RIGHT = (-0.15, 0.14, 0.0), (-0.15, -0.14, 0.0)
MOTORS_B = np.array([FRONT_LEFT, FRONT_RIGHT, BACK_LEFT, BACK_RIGHT])
ARMS_B = np.array([[FRONT_LEFT, BACK_RIGHT], [FRONT_RIGHT, BACK_LEFT]])
CAMERA_RAY_B = CAMERA_RAY_M * np.array([math.cos(CAMERA_PITCH_RAD), 0.0, math.sin(CAMERA_PITCH_RAD)])

GATE_COLOUR = (255, 140, 0)
DRONE_COLOUR = (230, 230, 230)
CAMERA_COLOUR = (80, 200, 255)
PATH_COLOUR = (120, 220, 120)


def visualize_state_action_sequence(
    sequence: list[tuple[np.ndarray, np.ndarray]],
    gates: np.ndarray,
    recording_path: str = "rollout.rrd",
    app_id: str = "flytrack_viz",
) -> None:
    """Write a flight as a Rerun recording, with timelines ``step`` and ``sim_time`` (100 Hz).

    sequence: pairs of state (21,) and action (4,), one per step. Outside the pose, a number that is
    not finite is a gap in its plot. gates: (N, >=8) with id, x, y, z, qw, qx, qy, qz (to world),
    drawn in the handout's size, 2.7 m outside and 1.5 m inside.

    Raises:
        ValueError: no steps, wrong shapes, a pose that is not finite, a quaternion whose norm is
            not 1 within 1e-3, or a path that cannot be written, which leaves no file behind.
    """
    states, actions = _check_sequence(sequence)
    gates = _check_gates(gates)
    try:
        _write_recording(Path(recording_path), app_id, states, actions, gates)
    except (OSError, RuntimeError) as error:  # Rerun reports a full disk as a RuntimeError
        reason = f"found a path that cannot be written ({error}), expected a writable file name"
        raise ValueError(f"recording_path {recording_path}: {reason}") from error


def gate_corners(gates: np.ndarray, edge_m: float) -> np.ndarray:
    """Return the corners of squares of that edge in the gates' local x-z planes, (N, 4, 3).

    gates: (N, >=8) with id, x, y, z, qw, qx, qy, qz, unit quaternions. World frame, m; in order
    around the square.
    """
    w, x, y, z = (gates[:, column] for column in range(4, 8))
    local_x = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)
    local_z = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    signs = 0.5 * edge_m * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    offsets = signs[:, :1] * local_x[:, None] + signs[:, 1:] * local_z[:, None]
    return gates[:, None, 1:4] + offsets


def _write_recording(
    path: Path, app_id: str, states: np.ndarray, actions: np.ndarray, gates: np.ndarray
) -> None:
    """Write the recording under a temporary name and rename it; makes missing folders."""
    if path.is_dir():
        raise IsADirectoryError("it is a folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    # Rerun writes from a thread of its own and only prints that it could not open the file.
    temporary.touch(exist_ok=False)
    try:
        _record(temporary, app_id, states, actions, gates)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _record(path: Path, app_id: str, states: np.ndarray, actions: np.ndarray, gates: np.ndarray) -> None:
    """Write the recording through a stream of its own, closed when this returns."""
    recording = rr.RecordingStream(app_id)
    if not rr.is_enabled(recording):
        # A disabled stream ignores everything it is told and would leave an empty file.
        raise ValueError("environment variable RERUN: found it turned off, expected on or unset")
    recording.save(path)
    try:
        _log_static(recording, gates)
        _send_pose(recording, states)
        _send_trajectory(recording, states[:, POSITION])
        _send_scalars(recording, states, actions)
        recording.flush()
    finally:
        recording.disconnect()


def _log_static(recording: rr.RecordingStream, gates: np.ndarray) -> None:
    """Log what does not change: axes, gates, and the drone's body in its own frame."""

    def log(entity: str, archetype: rr.AsComponents) -> None:
        recording.log(entity, archetype, static=True, strict=True)

    log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    names = [f"gate {gate_id:g}" for gate_id in gates[:, 0]]
    centres = rr.Points3D(gates[:, 1:4], labels=names, radii=0.05, colors=GATE_COLOUR)
    log("world/gates/centre", centres)
    for name, edge_m in (("outer", GATE_OUTER_M), ("inner", GATE_INNER_M)):
        corners = gate_corners(gates, edge_m)
        closed = np.concatenate([corners, corners[:, :1]], axis=1)
        log(f"world/gates/{name}", rr.LineStrips3D(closed, radii=0.02, colors=GATE_COLOUR))
    log("world/drone/motors", rr.Points3D(MOTORS_B, radii=0.03, colors=DRONE_COLOUR))
    log("world/drone/arms", rr.LineStrips3D(ARMS_B, radii=0.01, colors=DRONE_COLOUR))
    ray = rr.Arrows3D(vectors=[CAMERA_RAY_B], origins=[(0.0, 0.0, 0.0)], colors=CAMERA_COLOUR)
    log("world/drone/camera", ray)
    for name in ("flown", "recent"):
        style = rr.LineStrips3D.from_fields(radii=0.01, colors=PATH_COLOUR)
        log(f"world/trajectory/{name}", style)


def _send(
    recording: rr.RecordingStream, entity: str, steps: np.ndarray, columns: rr.ComponentColumnList
) -> None:
    """Send one entity's columns, a row per step."""
    indexes = [
        rr.TimeColumn("step", sequence=steps),
        # Whole nanoseconds: 0.01 s in floating point would drift off the grid of steps.
        rr.TimeColumn("sim_time", duration=(steps * STEP_NS).astype("timedelta64[ns]")),
    ]
    recording.send_columns(entity, indexes, columns, strict=True)


def _send_pose(recording: rr.RecordingStream, states: np.ndarray) -> None:
    """Send the drone's pose; the body is logged once below it and moves along."""
    w_first = states[:, QUATERNION]
    x_first = np.roll(w_first, -1, axis=1)
    pose = rr.Transform3D.columns(translation=states[:, POSITION], quaternion=x_first)
    _send(recording, "world/drone", np.arange(len(states)), pose)


def _send_trajectory(recording: rr.RecordingStream, positions: np.ndarray) -> None:
    """Send the path flown so far, for every step from 1 on; positions (T, 3), world, m.

    The whole path in every row would grow with T^2. So ``flown`` holds it up to the last multiple
    of ``block`` and changes once a block, and ``recent`` holds the rest; sqrt(T) balances the two.
    """
    block = max(1, math.isqrt(len(positions)))
    steps = np.arange(1, len(positions))
    starts = (steps - 1) // block * block
    is_new_block = (starts == steps - 1) & (starts > 0)
    paths = {
        "recent": (steps, [positions[a : b + 1] for a, b in zip(starts, steps, strict=True)]),
        "flown": (steps[is_new_block], [positions[: a + 1] for a in starts[is_new_block]]),
    }
    for name, (rows, strips) in paths.items():
        if strips:
            columns = rr.LineStrips3D.columns(strips=strips)
            _send(recording, f"world/trajectory/{name}", rows, columns)


def _send_scalars(recording: rr.RecordingStream, states: np.ndarray, actions: np.ndarray) -> None:
    """Send speed, angular speed and the four actions, and their names with units once."""
    plots = {
        "plots/speed": ("speed [m/s]", np.linalg.norm(states[:, VELOCITY], axis=1)),
        "plots/angular_speed": ("angular speed [rad/s]", np.linalg.norm(states[:, RATES], axis=1)),
    }
    for column, name in enumerate(Action._fields):
        plots[f"plots/action/{name}"] = (f"{name} action", actions[:, column])
    for entity, (label, values) in plots.items():
        recording.log(entity, rr.SeriesLines(names=label), static=True, strict=True)
        _send(recording, entity, np.arange(len(values)), rr.Scalars.columns(scalars=values))


def _check_sequence(
    sequence: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """Return states (T, 21) with unit quaternions and actions (T, 4), float64."""
    if len(sequence) == 0:
        raise ValueError("sequence: found no steps, expected at least one (x, u) pair")
    states = np.empty((len(sequence), STATE_SIZE))
    actions = np.empty((len(sequence), ACTION_SIZE))
    for step, pair in enumerate(sequence):
        shapes = [np.shape(part) for part in pair]
        if shapes != [(STATE_SIZE,), (ACTION_SIZE,)]:
            expected = f"(x ({STATE_SIZE},), u ({ACTION_SIZE},))"
            raise ValueError(f"sequence[{step}]: found shapes {shapes}, expected {expected}")
        states[step], actions[step] = pair
    _check_poses("sequence", states, POSITION, QUATERNION)
    return states, actions


def _check_gates(gates: np.ndarray) -> np.ndarray:
    """Return the gates (N, 8) with unit quaternions, float64."""
    found = np.shape(gates)
    if len(found) != 2 or found[1] < GATE_COLUMNS:
        raise ValueError(f"gates: found shape {found}, expected (N, >={GATE_COLUMNS})")
    checked = np.array(gates, float)[:, :GATE_COLUMNS]
    _check_poses("gates", checked, slice(1, 4), slice(4, 8))
    return checked


def _check_poses(name: str, rows: np.ndarray, position: slice, quaternion: slice) -> None:
    """Refuse rows whose pose is not finite or not a rotation, and renormalise the rest in place."""
    is_finite = np.isfinite(rows[:, position]).all(axis=1)
    is_finite &= np.isfinite(rows[:, quaternion]).all(axis=1)
    if not is_finite.all():
        row = int(np.argmin(is_finite))
        found = f"position {rows[row, position]} and quaternion {rows[row, quaternion]}"
        raise ValueError(f"{name}[{row}]: found {found}, expected finite numbers")
    norms = np.linalg.norm(rows[:, quaternion], axis=1)
    is_unit = np.abs(norms - 1.0) <= UNIT_NORM_TOLERANCE
    if not is_unit.all():
        row = int(np.argmin(is_unit))
        expected = f"1 within {UNIT_NORM_TOLERANCE:g}"
        raise ValueError(f"{name}[{row}]: found quaternion norm {norms[row]:.6g}, expected {expected}")
    rows[:, quaternion] /= norms[:, None]


def main(arguments: list[str] | None = None) -> int:
    """Record a rollout file from the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m flytrack_env.viz_rerun", description="Write a rollout as a Rerun recording."
    )
    parser.add_argument("rollout", help="rollout file (.npy)")
    parser.add_argument("--out", required=True, help="recording to write (.rrd)")
    parser.add_argument("--track", default="flytrack", help="track name or .toml (%(default)s)")
    options = parser.parse_args(arguments)
    try:
        states, actions = load_rollout(options.rollout)
        sequence = list(zip(states, actions, strict=True))
        visualize_state_action_sequence(sequence, load_track(options.track).rows(), options.out)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{options.out}: {len(states)} steps, {Path(options.out).stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
