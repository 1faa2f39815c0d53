"""The check of a simulator that somebody else wrote: flown by a standard excitation.

Each episode starts at rest and lasts a second or two, so that it needs no controller: a tilt, held
and taken back, with a turn about z, under some thrust.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.state import BATTERY, POSITION, QUATERNION, RATES, STATE_SIZE, VELOCITY
from flytrack_env.validation import Fields, Finite, Positive, convert
from flytrack_sysid.check.result import Check, check_log
from flytrack_sysid.check.thrust import hover_command
from flytrack_sysid.log import FlightLog, LogError
from flytrack_sysid.log_file import load_toml

Step = Callable[[np.ndarray, np.ndarray], np.ndarray | None]
NUM_EPISODES, EPISODE_S = 60, 1.6
PULSE_S, TILTED_S = 0.15, 0.6  # of a rate command; between it and its opposite
LARGEST_PULSE = 0.35  # of the full stick
SEED = 0
Index = Annotated[int, Meta(ge=0)]
Three = tuple[Index, Index, Index]


class Layout(Fields):
    """What the numbers of a plant's state are.

    Attributes:
        dt: s, between states.
        p: indices of the position.
        v: of the velocity.
        w: of the body rates.
        q: of the attitude: 4 are a quaternion, 3 roll, pitch and yaw, 9 a matrix by rows.
        x0: the state at rest; an environment has its own.
    """

    dt: Positive
    p: Three | None = None
    v: Three | None = None
    w: Three | None = None
    q: Annotated[tuple[Index, ...], Meta(min_length=3, max_length=9)] | None = None
    x0: tuple[Finite, ...] | None = None


def handout_layout() -> Layout:
    """Return the layout of the handout's state; it begins at rest, 5 m up."""
    x0 = np.zeros(STATE_SIZE)
    x0[POSITION][2], x0[QUATERNION][0] = 5.0, 1.0
    x0[BATTERY] = nominal_parameters().battery.full_v
    places = {"p": POSITION, "v": VELOCITY, "q": QUATERNION, "w": RATES}
    indices = {name: list(range(STATE_SIZE))[where] for name, where in places.items()}
    return convert("layout", {"dt": 0.01, "x0": x0.tolist(), **indices}, Layout, LogError)


def load_layout(path: str | Path) -> Layout:
    """Return the layout in a TOML file; raises LogError naming file and field."""
    return convert(str(path), load_toml(Path(path)), Layout, LogError)


def excitation(dt: float, rng: np.random.Generator) -> np.ndarray:
    """Return the commands of an episode, (num_steps, 4) in [-1, 1]."""
    steps, pulse, tilted = (round(seconds / dt) for seconds in (EPISODE_S, PULSE_S, TILTED_S))
    commands = np.zeros((steps, 4))
    for axis in range(3):
        start = rng.integers(1, max(2, steps - tilted - 2 * pulse))
        size = rng.uniform(0.1, LARGEST_PULSE) * rng.choice([-1.0, 1.0])
        commands[start : start + pulse, axis] = size
        back = start + pulse + tilted
        commands[back : back + pulse, axis] = -size
    levels = rng.uniform(-1.0, 1.0, 4)
    commands[:, 3] = np.repeat(levels, -(-steps // len(levels)))[:steps]
    return commands


def fly(
    step: Step, layout: Layout, seed: int = SEED, start: Callable[[], np.ndarray] | None = None
) -> FlightLog:
    """Return the log of episodes of a plant, a segment each.

    Args:
        step: the state after ``dt`` from a state and an action, both (n,); None ends the episode.
        layout: of the state.
        seed: of the excitation.
        start: returns a first state; ``x0`` of the layout if None.

    Raises:
        LogError: the state is too short for the layout, or ``x0`` is missing.
    """
    rng = np.random.default_rng(seed)
    states: list[np.ndarray] = []
    commands, segments = [], []
    for episode in range(NUM_EPISODES):
        x: np.ndarray | None = _first(layout) if start is None else np.asarray(start(), float)
        for command in excitation(layout.dt, rng):
            if x is None:
                break
            states.append(np.asarray(x, float).ravel())
            commands.append(command)
            segments.append(episode)
            x = step(states[-1], command)
    values = np.array(states)
    channels = {"u": np.array(commands)}
    for name in ("p", "v", "q", "w"):
        indices = getattr(layout, name)
        if indices is None:
            continue
        if max(indices) >= values.shape[1]:
            found = f"found a state of {values.shape[1]} numbers"
            raise LogError(f"{name}: {found}, expected more than {max(indices)} by the layout")
        numbers = values[:, list(indices)]
        channels[name] = quaternions_of(numbers) if name == "q" else numbers
    time = np.arange(len(values)) * layout.dt
    return FlightLog(time, channels, np.array(segments), "plant", "simulated")


def _first(layout: Layout) -> np.ndarray:
    if layout.x0 is None:
        raise LogError("x0: missing in the layout: the state at rest, from which episodes start")
    return np.array(layout.x0)


def quaternions_of(numbers: np.ndarray) -> np.ndarray:
    """Return quaternions, (num_rows, 4), of an attitude in 4, 3 or 9 numbers."""
    if numbers.shape[1] == 4:
        return numbers / np.linalg.norm(numbers, axis=1, keepdims=True)
    if numbers.shape[1] == 3:
        attitude = Rotation.from_euler("ZYX", numbers[:, ::-1])
    else:
        attitude = Rotation.from_matrix(numbers.reshape(-1, 3, 3))
    return attitude.as_quat(scalar_first=True)


def check_plant(
    step: Step, layout: Layout | dict[str, Any] | None = None, seed: int = SEED
) -> Check:
    """Return where a plant's conventions differ from FlyTrack's.

    Args:
        step: as for ``fly``.
        layout: of the state, or a dictionary of its fields; the handout's if None.
        seed: of the excitation.
    """
    return _with_hover(check_log(fly(step, _layout(layout), seed)))


def check_environment(environment: Any, layout: Layout | dict[str, Any], seed: int = SEED) -> Check:
    """Return where a Gymnasium environment's conventions differ from FlyTrack's.

    Args:
        environment: whose observations the layout describes; actions are limited to its space.
        layout: as for ``check_plant``.
        seed: of the excitation.
    """
    space = environment.action_space

    def step(_: np.ndarray, command: np.ndarray) -> np.ndarray | None:
        action = np.clip(command, space.low, space.high).astype(space.dtype)
        observation, _, terminated, truncated, _ = environment.step(action)
        return None if terminated or truncated else observation

    def start() -> np.ndarray:
        return np.asarray(environment.reset(seed=seed)[0])

    return _with_hover(check_log(fly(step, _layout(layout), seed, start)))


def _with_hover(check: Check) -> Check:
    """Return a check of a plant with a remark on the thrust command at which it hovers."""
    hover = hover_command(check.corrected)
    if hover is None:
        return check
    return replace(check, remarks=(f"The plant hovers at a thrust command of {hover:+.2f}.",))


def _layout(given: Layout | dict[str, Any] | None) -> Layout:
    if given is None:
        return handout_layout()
    if isinstance(given, Layout):
        return given
    numbers = {
        name: np.asarray(value).tolist() if name != "dt" else float(value)
        for name, value in given.items()
        if name in Layout.__struct_fields__
    }
    return convert("layout", numbers, Layout, LogError)
