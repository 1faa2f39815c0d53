"""What a recording shows: checked trajectories, the race of each, and gates as a track."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property

import numpy as np

from flytrack_env.flown_race import STEP_S, FlownRace, follow_race, gates_passed, why_ended
from flytrack_env.state import ACTION_SIZE, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from flytrack_env.tracks import Gate, Track

GATE_OUTER_M, GATE_INNER_M = 2.7, 1.5
GATE_COLUMNS = 8
UNIT_NORM_TOLERANCE = 1e-3
MAX_FINITE = 1e30  # Rerun stores float32, where larger numbers are infinite


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """A flight to record; outside the pose, a number that is not finite is a gap in its plot.

    Attributes:
        name: of its plots and paths.
        states: (T, 21).
        actions: (T, 4), commanded.
        time_s: (T,), s, growing; None: a step of 0.01 s from 0 on.
        ended: why the flight ended; None: derived from its last state.
        restarts: (T,) bool, rows at which the path begins anew; None: none.
        residuals_w: by the name of a model, (T, 3), the specific force that it does not explain,
            world frame, m/s^2.
    """

    name: str
    states: np.ndarray
    actions: np.ndarray
    time_s: np.ndarray | None = None
    ended: str | None = None
    restarts: np.ndarray | None = None
    residuals_w: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @property
    def positions(self) -> np.ndarray:
        """The positions, (T, 3), world, m."""
        return self.states[:, POSITION]

    @cached_property
    def time_ns(self) -> np.ndarray:
        """The time of each row, whole ns, (T,): in s, 0.01 would drift off the grid of steps."""
        if self.time_s is None:
            return np.arange(len(self.states)) * round(STEP_S * 1e9)
        return np.rint((self.time_s - self.time_s[0]) * 1e9).astype(np.int64)

    def race(self, track: Track | None) -> FlownRace | None:
        """Return the flown race; None without gates, or where rows are not 0.01 s apart."""
        if track is None or not track.gates or self.time_s is not None:
            return None
        return follow_race(self.positions, track, last_vel_w=self.states[-1, VELOCITY])

    def reason_ended(self, track: Track | None, race: FlownRace | None) -> str:
        """Return why the flight ended."""
        if self.ended is not None:
            return self.ended
        return (
            "all steps flown"
            if race is None or track is None
            else why_ended(self.states, track, race)
        )


def checked(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory in float64 with unit quaternions.

    Raises:
        ValueError: no steps, wrong shapes, times that do not grow, a pose that is not finite, or a
            quaternion whose norm is not 1 within 1e-3.
    """
    states, actions = (np.array(part, float) for part in (trajectory.states, trajectory.actions))
    count = len(states) if states.ndim else 0
    if count == 0:
        raise ValueError(f"{trajectory.name}: found no steps, expected at least one")
    shapes: list[tuple[str, np.ndarray | None, tuple[int, ...]]] = [
        ("states", states, (count, STATE_SIZE)),
        ("actions", actions, (count, ACTION_SIZE)),
        ("time_s", trajectory.time_s, (count,)),
        ("restarts", trajectory.restarts, (count,)),
        *(
            (f"residuals_w {name}", force, (count, 3))
            for name, force in trajectory.residuals_w.items()
        ),
    ]
    for name, array, shape in shapes:
        if array is not None and np.shape(array) != shape:
            raise ValueError(
                f"{trajectory.name}: {name}: found shape {np.shape(array)}, expected {shape}"
            )
    time_s = trajectory.time_s
    if time_s is not None and not (np.diff(time_s, prepend=-np.inf) > 0.0).all():
        raise ValueError(
            f"{trajectory.name}: time_s: found times that do not grow, expected growing ones"
        )
    _normalise_poses(f"{trajectory.name}: states", states, POSITION, QUATERNION)
    return dataclasses.replace(trajectory, states=states, actions=actions)


def track_of_gates(gates: np.ndarray, positions: np.ndarray) -> Track:
    """Return gates as a track without bounds.

    Gates have the handout's size, and are flown as the flight first passes them.

    A gate that the flight does not pass is flown towards its local +y.

    Args:
        gates: (N, >=8) with id, x, y, z, qw, qx, qy, qz (to world).
        positions: (T, 3), of the flight.

    Raises:
        ValueError: another shape, or a pose that is not finite or no rotation.
    """
    gates = np.asarray(gates, float)
    if gates.ndim != 2 or gates.shape[1] < GATE_COLUMNS:
        raise ValueError(f"gates: found shape {gates.shape}, expected (N, >={GATE_COLUMNS})")
    rows = gates[:, :GATE_COLUMNS].copy()
    _normalise_poses("gates", rows, slice(1, 4), slice(4, 8))

    def track(directions: np.ndarray) -> Track:
        made = [
            Gate(
                id=int(row[0]),
                position=tuple(row[1:4].tolist()),
                quaternion=tuple(row[4:8].tolist()),
                direction=direction,
                opening=GATE_INNER_M,
                frame=GATE_OUTER_M,
            )
            for row, direction in zip(rows, directions.tolist(), strict=True)
        ]
        return Track(
            "gates",
            tuple(made),
            (0.0, 0.0, 0.0),
            (1.0, 0.0, 0.0, 0.0),
            (-np.inf,) * 3,
            (np.inf,) * 3,
        )

    forwards = np.ones(len(rows))
    if not len(rows):
        return track(forwards)
    never = np.ones((1, len(rows)), bool)
    first = [
        np.concatenate([gates_passed(positions, track(directions)), never]).argmax(axis=0)
        for directions in (forwards, -forwards)
    ]
    return track(np.where(first[1] < first[0], -1.0, 1.0))


def _normalise_poses(name: str, rows: np.ndarray, position: slice, quaternion: slice) -> None:
    """Refuse rows whose pose is not finite or not a rotation, and renormalise the rest in place."""
    is_finite = (np.abs(rows[:, position]) < MAX_FINITE).all(axis=1)
    is_finite &= np.isfinite(rows[:, quaternion]).all(axis=1)
    if not is_finite.all():
        row = int(np.argmin(is_finite))
        found = f"position {rows[row, position]} and quaternion {rows[row, quaternion]}"
        raise ValueError(f"{name}[{row}]: found {found}, expected finite numbers within float32")
    norms = np.linalg.norm(rows[:, quaternion], axis=1)
    is_unit = np.abs(norms - 1.0) <= UNIT_NORM_TOLERANCE
    if not is_unit.all():
        row = int(np.argmin(is_unit))
        expected = f"1 within {UNIT_NORM_TOLERANCE:g}"
        raise ValueError(
            f"{name}[{row}]: found quaternion norm {norms[row]:.6g}, expected {expected}"
        )
    rows[:, quaternion] /= norms[:, None]
