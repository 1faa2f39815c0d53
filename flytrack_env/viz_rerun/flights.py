"""What is shown: flights with the race that each flew, checked, and the gates as a track."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from flytrack_env.flown_race import STEP_S, FlownRace, follow_race, gates_passed, why_ended
from flytrack_env.state import ACTION_SIZE, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from flytrack_env.tracks import Gate, Track

GATE_OUTER_M = 2.7
GATE_INNER_M = 1.5
GATE_COLUMNS = 8
UNIT_NORM_TOLERANCE = 1e-3
LARGEST_M = 1e30

Pairs = Sequence[tuple[np.ndarray, np.ndarray]]


@dataclasses.dataclass(frozen=True, eq=False)
class ShownFlight:
    """A flight to be shown; outside the pose, a number that is not finite is a gap in its plot.

    name: of its plots and paths. states: (T, 21). actions: (T, 4), commanded. time_s: (T,), s, growing; a
    step of 0.01 s from 0 on if None. ended: why the flight ended; told from its last state if None.
    restarts: (T,) bool, rows that do not go on from the row before them, whose path begins anew; none if
    None. residuals_w: by the name of a model, (T, 3), the specific force that it leaves open, world, m/s^2.
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
        """The time of each row in whole nanoseconds, (T,): in s, 0.01 would drift off the grid of steps."""
        if self.time_s is None:
            return np.arange(len(self.states)) * round(STEP_S * 1e9)
        return np.rint((self.time_s - self.time_s[0]) * 1e9).astype(np.int64)


def checked(flight: ShownFlight, where: str | None = None) -> ShownFlight:
    """Return the flight in float64 with unit quaternions.

    where: what errors name as the place of a row; the flight's states if None.

    Raises:
        ValueError: no steps, wrong shapes, a pose that is not finite, or a quaternion whose norm is not 1
            within 1e-3.
    """
    states, actions = (np.array(part, float) for part in (flight.states, flight.actions))
    count = len(states) if states.ndim else 0
    if count == 0:
        raise ValueError(f"{flight.name}: found no steps, expected at least one")
    shapes: dict[str, tuple[np.ndarray, tuple[int, ...]]] = {
        "states": (states, (count, STATE_SIZE)),
        "actions": (actions, (count, ACTION_SIZE)),
    }
    optional = {"time_s": flight.time_s, "restarts": flight.restarts}
    shapes |= {name: (part, (count,)) for name, part in optional.items() if part is not None}
    shapes |= {f"residuals_w {name}": (one, (count, 3)) for name, one in flight.residuals_w.items()}
    for name, (array, shape) in shapes.items():
        if np.shape(array) != shape:
            raise ValueError(f"{flight.name}: {name}: found shape {np.shape(array)}, expected {shape}")
    if flight.time_s is not None and not (np.diff(flight.time_s, prepend=-np.inf) > 0.0).all():
        raise ValueError(f"{flight.name}: time_s: found times that do not grow, expected each after the last")
    check_poses(where or f"{flight.name}: states", states, POSITION, QUATERNION)
    return dataclasses.replace(flight, states=states, actions=actions)


def flight_of_pairs(sequence: Pairs) -> ShownFlight:
    """Return the flight of pairs of state (21,) and action (4,).

    Raises:
        ValueError: no pairs, or wrong shapes.
    """
    if len(sequence) == 0:
        raise ValueError("sequence: found no steps, expected at least one (x, u) pair")
    states = np.empty((len(sequence), STATE_SIZE))
    actions = np.empty((len(sequence), ACTION_SIZE))
    for step, pair in enumerate(sequence):
        shapes = [np.shape(part) for part in pair] if isinstance(pair, Sequence | np.ndarray) else pair
        if shapes != [(STATE_SIZE,), (ACTION_SIZE,)]:
            expected = f"(x ({STATE_SIZE},), u ({ACTION_SIZE},))"
            raise ValueError(f"sequence[{step}]: found shapes {shapes}, expected {expected}")
        states[step], actions[step] = pair
    return ShownFlight("flight", states, actions)


def track_of_gates(gates: np.ndarray, positions: np.ndarray) -> Track:
    """Return gates as a track, in the handout's size, each to be flown as the flight first passes it.

    gates: (N, >=8) with id, x, y, z, qw, qx, qy, qz (to world). positions: (T, 3), of the flight. A gate that
    it does not pass is flown towards its local +y. There are no bounds.

    Raises:
        ValueError: another shape, or a pose that is not finite or no rotation.
    """
    try:
        gates = np.asarray(gates, float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"gates: {error}; expected numbers (N, >={GATE_COLUMNS})") from error
    found = gates.shape
    if len(found) != 2 or found[1] < GATE_COLUMNS:
        raise ValueError(f"gates: found shape {found}, expected (N, >={GATE_COLUMNS})")
    rows = gates[:, :GATE_COLUMNS].copy()
    if not np.isfinite(rows[:, 0]).all():
        raise ValueError(f"gates: found ids {rows[:, 0]}, expected numbers")
    check_poses("gates", rows, slice(1, 4), slice(4, 8))

    def flown(direction: float, of: np.ndarray) -> Track:
        made = [
            Gate(
                id=int(row[0]) if row[0] == int(row[0]) else row[0],
                position=tuple(row[1:4].tolist()),
                quaternion=tuple(row[4:8].tolist()),
                direction=direction * sign,
                opening=GATE_INNER_M,
                frame=GATE_OUTER_M,
            )
            for row, sign in zip(rows, of, strict=True)
        ]
        nowhere = (np.inf, np.inf, np.inf)
        return Track("gates", tuple(made), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (-np.inf,) * 3, nowhere)

    alike = np.ones(len(rows))
    if not len(rows):
        return flown(1.0, alike)
    never = np.ones((1, len(rows)), bool)
    first = [
        np.concatenate([gates_passed(positions, flown(direction, alike)), never]).argmax(axis=0)
        for direction in (1.0, -1.0)
    ]
    return flown(1.0, np.where(first[1] < first[0], -1.0, 1.0))


def race_of(flight: ShownFlight, track: Track | None) -> FlownRace | None:
    """Return the race that the flight flew; None without gates, or where it is not flown at 100 Hz."""
    if track is None or not track.gates or flight.time_s is not None:
        return None
    return follow_race(flight.positions, track, last_vel_w=flight.states[-1, VELOCITY])


def end_of(flight: ShownFlight, track: Track | None, race: FlownRace | None) -> str:
    """Return why the flight ended."""
    if flight.ended is not None:
        return flight.ended
    return "all steps flown" if race is None or track is None else why_ended(flight.states, track, race)


def check_poses(name: str, rows: np.ndarray, position: slice, quaternion: slice) -> None:
    """Refuse rows whose pose is not finite or not a rotation, and renormalise the rest in place."""
    # What is shown has float32: what is beyond is infinite there.
    is_finite = (np.abs(rows[:, position]) < LARGEST_M).all(axis=1)
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
        raise ValueError(f"{name}[{row}]: found quaternion norm {norms[row]:.6g}, expected {expected}")
    rows[:, quaternion] /= norms[:, None]
