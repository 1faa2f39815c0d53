"""The time-optimal flying lap and standing start of a track: ``python -m benchmarks.time_optimal``.

Finds them with CasADi and IPOPT (``pip install .[optimal]``), writes them as data, flies them again in the
simulator and writes docs/results/time_optimal.md. With ``--verify`` it only flies what is there, which needs
no solver. In Python: ``benchmarks.optimal.shipped_reference("flytrack", "flying").time_s``.
"""

import argparse
import platform
import shlex
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.optimal.replay import Replay, replay
from flytrack_env import FlyTrack, ModelParameters, Track, available_tracks, blackbox, load_model, load_track
from flytrack_env import nominal_parameters as nominal
from flytrack_env.dynamics import SECONDS_PER_MINUTE, step
from flytrack_env.references import (
    FOLDER,
    KINDS,
    Reference,
    ReferenceFileError,
    load_reference,
    save_reference,
    track_digest,
)
from flytrack_env.resets import STILL_THRUST
from flytrack_env.state import (
    ACTION_SIZE,
    APPLIED_ACTION,
    BATTERY,
    BATTERY_EMPTY_V,
    BATTERY_FULL_V,
    POSITION,
    QUATERNION,
    STATE_SIZE,
)

PAGE = Path("docs/results/time_optimal.md")
SHIPPED_BLACK_BOX = Path(__file__).parents[1] / "blackbox" / "acro_step.bin"
NOMINAL, BLACK_BOX = "nominal", "black_box"
LATEST_S = 1e-3  # s, how far from the optimum the replay's time may be


def start_state(track: Track, battery_v: float) -> np.ndarray:
    """Return the state at rest at the start pose, rotors still, (21,)."""
    state = np.zeros(STATE_SIZE)
    state[POSITION], state[QUATERNION] = track.start_position, track.start_quaternion
    state[APPLIED_ACTION][-1], state[BATTERY] = STILL_THRUST, battery_v
    return state


def drained_in_float32(model: ModelParameters, start: np.ndarray, dt_s: float) -> ModelParameters:
    """Return the model with the battery drain that float32 makes of it, for the optimiser, which is exact.

    A step drains so little that rounding the voltage changes it by up to a percent, in every step the same
    way: millimetres on a path, after seconds. start: (21,), whose voltage is rounded as others are.
    """
    rounded = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), model._replace(effects=()))
    after = step(jnp.asarray(start, jnp.float32), jnp.zeros(ACTION_SIZE), np.float32(dt_s), rounded)
    drained_v = float(np.float32(start[BATTERY])) - float(after[BATTERY])
    return model._replace(battery_drain_v_per_min=drained_v / dt_s * SECONDS_PER_MINUTE)


def optimise(
    track: Track, kind: str, model: ModelParameters, model_name: str, battery_v: float, command: str
) -> Reference:
    """Return the time-optimal flight of a track and a model; needs CasADi.

    Raises:
        UnsupportedModelError: a model with an effect that cannot be expressed. UnsolvedError: none found.
    """
    import casadi  # an extra, and needed for this alone

    from benchmarks.optimal.problem import CLEARANCE_M, SMOOTHING_S, Task
    from benchmarks.optimal.solve import find_optimum

    env = FlyTrack(track=track, model=model)
    params = env.default_params
    dt_s, start = float(params.dt), start_state(track, battery_v)
    task = Task(kind, params.course, float(params.drone_radius), start)
    optimum = find_optimum(task, drained_in_float32(model, start, dt_s), dt_s)
    about = {
        "command": command,
        "casadi": casadi.__version__,
        "jax": jax.__version__,
        "machine": platform.machine(),
        "battery_v": battery_v,
        "drone_radius_m": task.radius_m,
        "clearance_m": CLEARANCE_M,
        "smoothing_s": SMOOTHING_S,
    }
    return Reference(
        track=track.name,
        track_sha256=track_digest(track),
        kind=kind,
        model_name=model_name,
        model=model,
        dt_s=dt_s,
        time_s=float(optimum.gate_times_s[-1]),
        states=optimum.flight.states,
        commands=optimum.flight.commands,
        gate_times_s=optimum.gate_times_s,
        found=optimum.found | about,
    )


def is_verified(reference: Reference, flown: Replay) -> bool:
    """Return whether a replay passed every gate, touched no frame and took the time that it should."""
    is_whole = flown.gates_passed == len(reference.gate_times_s) and not flown.ended_by
    return is_whole and flown.frames_touched == 0 and abs(flown.time_s - reference.time_s) <= LATEST_S


def verify(
    folder: Path, black_box: Path, tracks: list[Track]
) -> tuple[list[tuple[Reference, str, Replay]], bool]:
    """Return every reference of a folder with its replays, and whether those in its own model are right.

    References of the model ``black_box`` are flown on the black box, too. tracks: those that are not shipped.

    Raises:
        ReferenceFileError, TrackError, BlackBoxError: a file that cannot be used, or no references.
    """
    plant = blackbox.load(black_box)
    replays, is_good = [], True
    references = list(map(load_reference, folder.glob("*.npz")))
    if not references:
        raise ReferenceFileError(f"{folder}: found no .npz, expected references")
    known = {track.name: track for track in tracks}
    for reference in sorted(
        references, key=lambda found: (found.model_name != NOMINAL, found.track, found.kind)
    ):
        track = known.get(reference.track) or load_track(reference.track)
        flown = replay(reference, track)
        is_good &= is_verified(reference, flown) and track_digest(track) == reference.track_sha256
        replays.append((reference, "simulator", flown))
        if reference.model_name == BLACK_BOX:
            replays.append((reference, "black box", replay(reference, track, plant)))
    return replays, is_good


def describe(reference: Reference, flown_by: str, flown: Replay) -> str:
    """Return one line on a replay."""
    return (
        f"{reference.track} {reference.kind} {reference.model_name}: {reference.time_s:.4f} s; {flown_by}: "
        f"{flown.gates_passed} of {len(reference.gate_times_s)} gates, {flown.time_s:.4f} s, "
        f"drift {flown.drift_m:.4f} m, {flown.frames_touched} frames touched {' '.join(flown.ended_by)}"
    )


def run(arguments: argparse.Namespace) -> bool:
    """Do what the command line asks; return whether all references are verified."""
    model = nominal() if arguments.model is None else load_model(arguments.model)
    name = arguments.name or (NOMINAL if arguments.model is None else arguments.model.stem)
    command = shlex.join(["python", "-m", "benchmarks.time_optimal", *sys.argv[1:]])
    tracks = list(map(load_track, arguments.tracks))
    for track in [] if arguments.verify else tracks:
        for kind in arguments.kinds:
            found = optimise(track, kind, model, name, arguments.battery_v, command)
            save_reference(arguments.out / f"{track.name}_{name}_{kind}.npz", found)
            print(f"{track.name} {kind}: {found.time_s:.4f} s, {found.found['cpu_s']} CPU s", flush=True)
    replays, is_good = verify(arguments.out, arguments.black_box, tracks)
    for entry in replays:
        print(describe(*entry))
    if arguments.page is not None:
        from benchmarks.optimal.page import write_page, write_pictures  # matplotlib, for this alone

        write_page(arguments.page, replays, command)
        write_pictures(arguments.page, [reference for reference, _, _ in replays], tracks)
    return is_good


def main() -> None:
    """Parse the command line; exit 1 if a replay is not as it should be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tracks", nargs="+", default=list(available_tracks()), metavar="NAME_OR_FILE")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--model", type=Path, help="a model file; default: the simulator's nominal model")
    parser.add_argument("--name", help="of the model in file names; default: that of its file")
    parser.add_argument("--battery-v", type=float, default=BATTERY_FULL_V, help="at the start")
    parser.add_argument("--verify", action="store_true", help="find nothing, fly what is there")
    parser.add_argument("--black-box", type=Path, default=SHIPPED_BLACK_BOX)
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder of the references")
    parser.add_argument("--page", type=Path, help=f"write a page and pictures, such as {PAGE}")
    arguments = parser.parse_args()
    if not BATTERY_EMPTY_V < arguments.battery_v <= BATTERY_FULL_V:
        parser.error(
            f"--battery-v: found {arguments.battery_v}, expected {BATTERY_EMPTY_V:g} to {BATTERY_FULL_V:g}"
        )
    try:
        is_good = run(arguments)
    except ImportError as error:
        parser.error(f"{error}; pip install .[optimal]")
    except (ValueError, OSError, RuntimeError) as error:
        parser.error(str(error))
    raise SystemExit(0 if is_good else 1)


if __name__ == "__main__":
    main()
