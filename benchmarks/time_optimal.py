"""The time-optimal flying lap and standing start of a track: ``python -m benchmarks.time_optimal``.

Finds them with CasADi and IPOPT (``pip install .[optimal]``), writes them as data, replays them in
the simulator and writes docs/results/time_optimal.md. With ``--verify`` it only replays existing
files, which needs no solver. In Python: ``flytrack_env.references.shipped_reference("flytrack",
"flying").time_s``.
"""

from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from benchmarks import report
from flytrack_env import EnvParams, EnvState, FlyTrack, ModelParameters, Track, blackbox
from flytrack_env import nominal_parameters as nominal
from flytrack_env import references as files
from flytrack_env import state as layout
from flytrack_env.dynamics import SECONDS_PER_MINUTE, step
from flytrack_env.files import write_atomically
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Vec3
from flytrack_env.references import Reference
from flytrack_env.resets import IDLE_THRUST
from flytrack_env.state import pack, unpack, unpack_action
from flytrack_env.tracks import cross_gate

NOMINAL, BLACK_BOX = "nominal", "black_box"
MAX_ERROR_S = 1e-3  # s, of the replay's time
TITLES = {"flying": "flying lap", "standing": "standing start"}
MILLI = 1e3
HEADER = (
    "track | model | flight | time (s) | free times (s) | starts agree | highest speed (m/s) | "
    "replay: off (ms) | drift (mm) | on the black box"
)
CONDITIONS = (
    "casadi {casadi}, jax {jax}, one core of {machine}; battery at the start {battery_v:g} V; "
    "gates passed {clearance_m:g} m inside what a drone of radius {drone_radius_m:g} m may; "
    "squared changes of commands cost {smoothing_s:g} s each, so that they do not chatter"
)
AGREE_SHARE = 1e-3  # of the time: starts this near the best found about the same flight


def start_state(track: Track, battery_v: float) -> np.ndarray:
    """Return the state at rest at the start pose, rotors still, (21,)."""
    state = np.zeros(layout.STATE_SIZE)
    state[layout.POSITION], state[layout.QUATERNION] = track.start_position, track.start_quaternion
    state[layout.APPLIED_ACTION][-1], state[layout.BATTERY] = IDLE_THRUST, battery_v
    return state


def drained_in_float32(model: ModelParameters, start: np.ndarray, dt_s: float) -> ModelParameters:
    """Return the model with the battery drain of float32 steps, for the optimiser in float64.

    A step drains so little that rounding the voltage changes the drain by up to a percent, in every
    step the same way: millimetres on a path, after seconds. start: (21,), the state at which
    rounding is measured.
    """
    rounded = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), model._replace(effects=()))
    after = step(
        jnp.asarray(start, jnp.float32), jnp.zeros(layout.ACTION_SIZE), np.float32(dt_s), rounded
    )
    drained_v = float(np.float32(start[layout.BATTERY])) - float(after[layout.BATTERY])
    return model._replace(battery_drain_v_per_min=drained_v / dt_s * SECONDS_PER_MINUTE)


def optimise(track: Track, kind: str, model: ModelParameters, model_name: str) -> Reference:
    """Return the time-optimal flight of a track and a model, with a full battery; needs CasADi.

    Raises:
        ValueError: an effect that cannot be expressed. RuntimeError: no optimum was found.
    """
    import casadi  # an extra, needed only here

    from benchmarks.optimal import CLEARANCE_M, SMOOTHING_S, Task, find_optimum

    env = FlyTrack(track=track, model=model)
    params = env.default_params
    dt_s, start = float(params.dt), start_state(track, layout.BATTERY_FULL_V)
    task = Task(kind, params.course, float(params.drone_radius), start)
    flight, how = find_optimum(task, drained_in_float32(model, start, dt_s), dt_s)
    about = {
        "command": report.command_line(),
        "casadi": casadi.__version__,
        "jax": jax.__version__,
        "battery_v": layout.BATTERY_FULL_V,
        "drone_radius_m": task.radius_m,
        "clearance_m": CLEARANCE_M,
        "smoothing_s": SMOOTHING_S,
        **report.provenance(),
    }
    return Reference(
        track=track.name,
        track_sha256=files.track_digest(track),
        kind=kind,
        model_name=model_name,
        model=model,
        dt_s=dt_s,
        time_s=float(flight.gate_times_s[-1]),
        states=flight.states,
        commands=flight.commands,
        gate_times_s=flight.gate_times_s,
        found=how | about,
    )


class Replay(NamedTuple):
    """The outcome of a reference's commands.

    Attributes:
        states: (N + 1, 21), float32.
        gates_passed: in order, by the environment.
        time_s: to the last gate as the environment interpolates it, NaN if it was not passed.
        ended_by: causes of termination.
        drift_m: largest distance from the reference.
        frames_touched: of all gates, also those that were not next.
    """

    states: np.ndarray
    gates_passed: int
    time_s: float
    ended_by: tuple[str, ...]
    drift_m: float
    frames_touched: int


@cache
def _environment(plant: Plant | None) -> tuple[FlyTrack, Any]:
    """Return the environment and its compiled step, shared by all tracks and models of one form."""
    env = FlyTrack(plant=plant)

    def fly(state: EnvState, command: jax.Array, params: EnvParams) -> tuple[EnvState, Any]:
        after, _, causes, _ = env.transition(state, unpack_action(command), params)
        return after, (pack(env.drone(after)), causes, env.race(after))

    return env, jax.jit(fly)


def replay(reference: Reference, track: Track, plant: Plant | None = None) -> Replay:
    """Return how a reference's commands fly, open loop, as judged by the environment.

    The environment is that of ``FlyTrack-v0`` with the reference's model, float32, or with another
    plant, such as a black box; the flight ends at the first cause of termination.
    """
    env, step = _environment(plant)
    model = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), reference.model)
    params = FlyTrack(track=track, model=model).default_params.replace(dt=reference.dt_s)
    params = jax.device_put(params)  # once, not in every step
    first = jnp.asarray(reference.states[0], jnp.float32)
    state, steps = env.begin(unpack(first), 0, params), []
    for command in np.asarray(reference.commands, np.float32):
        state, outputs = step(state, command, params)
        steps.append(outputs)
    packed, causes, races = jax.tree.map(lambda *leaves: np.stack(leaves), *steps)
    is_over = np.any(np.stack(causes), axis=0)
    last = int(np.argmax(is_over)) if is_over.any() else len(steps) - 1
    states = np.concatenate([np.asarray(first)[None], packed[: last + 1]])
    drift = np.linalg.norm(
        states[:, layout.POSITION] - reference.states[: last + 2, layout.POSITION], axis=1
    )
    race = jax.tree.map(lambda leaf: leaf[last], races)
    ends = (states[:-1, layout.POSITION], states[1:, layout.POSITION])
    begin, end = (Vec3(*(jnp.asarray(axis)[:, None] for axis in points.T)) for points in ends)
    crossing = cross_gate(params.course.gates, begin, end, params.drone_radius)
    return Replay(
        states=states,
        gates_passed=int(race.gates_passed),
        time_s=float(race.lap_time_s) if int(race.laps) else float("nan"),
        ended_by=tuple(name for name, cause in causes._asdict().items() if cause[last]),
        drift_m=float(drift.max()),
        frames_touched=int(np.asarray(crossing.is_frame).any(axis=0).sum()),
    )


def is_verified(reference: Reference, flown: Replay) -> bool:
    """Return whether a replay passed every gate, touched no frame and took the expected time."""
    is_whole = flown.gates_passed == len(reference.gate_times_s) and not flown.ended_by
    is_on_time = abs(flown.time_s - reference.time_s) <= MAX_ERROR_S
    return is_whole and flown.frames_touched == 0 and is_on_time


class Flown(NamedTuple):
    """A reference, and its replays in its own model and, if that is of it, on the black box."""

    reference: Reference
    replay: Replay
    on_black_box: Replay | None


def verified(folder: Path, tracks: list[Track]) -> tuple[list[Flown], bool]:
    """Return a folder's references with their replays, and whether those in their model are right.

    Args:
        tracks: where references may be of tracks that are not shipped.

    Raises:
        files.ReferenceFileError, TrackError: a file that cannot be used, or no references.
    """
    plant = blackbox.load(blackbox.SHIPPED)
    references = list(map(files.load_reference, folder.glob("*.npz")))
    if not references:
        raise files.ReferenceFileError(f"{folder}: found no .npz, expected references")
    references.sort(key=lambda one: (one.model_name != NOMINAL, one.track, one.kind))
    by_name = {track.name: track for track in tracks}
    flights, is_good = [], True
    for reference in references:
        track = by_name.get(reference.track) or flytrack_env.load_track(reference.track)
        has_box = reference.model_name == BLACK_BOX
        on_black_box = replay(reference, track, plant) if has_box else None
        flights.append(Flown(reference, replay(reference, track), on_black_box))
        is_good &= is_verified(reference, flights[-1].replay)
        is_good &= files.track_digest(track) == reference.track_sha256
    return flights, is_good


def write_pictures(page: Path, references: list[Reference], tracks: list[Track]) -> None:
    """Write, beside the page, a picture per track of its flying lap from above, by speed."""
    from flytrack_env.pictures import draw_flight, make_flight
    from flytrack_env.pictures.drawing import png_of  # matplotlib, needed only here

    laps = {one.track: one for one in reversed(references) if one.kind == "flying"}
    for track in tracks:
        lap = laps.get(track.name)
        if lap is None:
            continue
        name = f"{lap.model_name} model, {TITLES[lap.kind]}"
        commands = np.concatenate([lap.commands, lap.commands[-1:]])  # one per state
        flight = make_flight(name, lap.states.astype(np.float32), commands, track)
        picture = png_of(draw_flight(flight)["top"])
        write_atomically(page.with_name(f"{page.stem}_{track.name}.png"), picture)


def _row(flown: Flown) -> list[str]:
    """Return a reference, its replay in the simulator, and the one on the black box if any."""
    reference, replay, on_black_box = flown
    times_s = [seconds for seconds in reference.found["coarse_times_s"] if seconds is not None]
    num_agree = sum(seconds <= min(times_s) * (1.0 + AGREE_SHARE) for seconds in times_s)
    speeds = np.linalg.norm(reference.states[:, layout.VELOCITY], axis=1)
    gates = "-"
    if on_black_box is not None:
        passed = f"{on_black_box.gates_passed} of {len(reference.gate_times_s)}"
        gates = ", ".join([passed, *on_black_box.ended_by])
    return [
        reference.track,
        reference.model_name,
        TITLES[reference.kind],
        f"{reference.time_s:.4f}",
        f"{reference.found['free_time_s']:.4f}",
        f"{num_agree} of {len(reference.found['coarse_times_s'])}",
        f"{speeds.max():.1f}",
        f"{MILLI * (replay.time_s - reference.time_s):+.3f}",
        f"{MILLI * replay.drift_m:.2f}",
        gates,
    ]


def write_page(path: Path | None, flights: list[Flown]) -> None:
    """Print, and write unless the path is None, the tables of references and their replays."""
    references = [flown.reference for flown in flights]
    commands = sorted({reference.found["command"].strip("`") for reference in references})
    tracks = sorted({reference.track for reference in references})
    pictures = [f"![{name}]({path.stem}_{name}.png)\n\n" for name in tracks if path is not None]
    conditions = sorted({CONDITIONS.format(**reference.found) for reference in references})
    report.fill_page(
        path,
        "time_optimal",
        commands="\n".join(f"- `{line}`" for line in commands),
        agree=AGREE_SHARE,
        conditions="\n".join(f"- {line}" for line in conditions),
        flights=report.table(HEADER, map(_row, flights)),
        pictures="".join(pictures),
    )


def main(
    tracks: tuple[str, ...] = tuple(flytrack_env.available_tracks()),
    kinds: tuple[Literal["flying", "standing"], ...] = ("flying", "standing"),
    model: Path | None = None,
    verify: bool = False,
    out: Path = files.FOLDER,
    page: Path | None = None,
) -> None:
    """Find references, replay all and write the page; exit 1 if a replay is not as it should be.

    Args:
        tracks: names or files.
        model: file; by default the simulator's nominal model.
        verify: only replay existing references.
        out: their folder.
        page: to write, with pictures beside it.
    """
    courses = list(map(flytrack_env.load_track, tracks))
    if not verify:
        flown = nominal() if model is None else flytrack_env.load_model(model)
        name = NOMINAL if model is None else model.stem
        for track, kind in product(courses, kinds):
            reference = optimise(track, kind, flown, name)
            files.save_reference(out / f"{track.name}_{name}_{kind}.npz", reference)
            cpu_s = reference.found["cpu_s"]
            print(f"{track.name} {kind}: {reference.time_s:.4f} s, {cpu_s} CPU s", flush=True)
    flights, is_good = verified(out, courses)
    write_page(page, flights)
    if page is not None:
        write_pictures(page, [flown.reference for flown in flights], courses)
    raise SystemExit(0 if is_good else 1)


if __name__ == "__main__":
    report.command(main)
