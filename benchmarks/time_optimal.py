"""The time-optimal flying lap and standing start of a track: ``python -m benchmarks.time_optimal``.

Finds them with CasADi and IPOPT (``pip install .[optimal]``), writes them as data, replays them in the
simulator and writes docs/results/time_optimal.md. With ``--verify`` it only replays existing files, which
needs no solver. In Python: ``flytrack_env.references.shipped_reference("flytrack", "flying").time_s``.
"""

import sys
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import report
from benchmarks.optimal.page import write_page, write_pictures
from benchmarks.optimal.replay import Replay, replay
from flytrack_env import FlyTrack, ModelParameters, Track, available_tracks, blackbox, load_model, load_track
from flytrack_env import nominal_parameters as nominal
from flytrack_env import state as layout
from flytrack_env.dynamics import SECONDS_PER_MINUTE, step
from flytrack_env.references import (
    FOLDER,
    Reference,
    ReferenceFileError,
    load_reference,
    save_reference,
    track_digest,
)
from flytrack_env.resets import STILL_THRUST

NOMINAL, BLACK_BOX = "nominal", "black_box"
LARGEST_ERROR_S = 1e-3  # s, of the replay's time


def start_state(track: Track, battery_v: float) -> np.ndarray:
    """Return the state at rest at the start pose, rotors still, (21,)."""
    state = np.zeros(layout.STATE_SIZE)
    state[layout.POSITION], state[layout.QUATERNION] = track.start_position, track.start_quaternion
    state[layout.APPLIED_ACTION][-1], state[layout.BATTERY] = STILL_THRUST, battery_v
    return state


def drained_in_float32(model: ModelParameters, start: np.ndarray, dt_s: float) -> ModelParameters:
    """Return the model with the battery drain that results from float32, for the optimiser in float64.

    A step drains so little that rounding the voltage changes the drain by up to a percent, in every step the
    same way: millimetres on a path, after seconds. start: (21,), the state at which rounding is measured.
    """
    rounded = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), model._replace(effects=()))
    after = step(jnp.asarray(start, jnp.float32), jnp.zeros(layout.ACTION_SIZE), np.float32(dt_s), rounded)
    drained_v = float(np.float32(start[layout.BATTERY])) - float(after[layout.BATTERY])
    return model._replace(battery_drain_v_per_min=drained_v / dt_s * SECONDS_PER_MINUTE)


def optimise(track: Track, kind: str, model: ModelParameters, model_name: str) -> Reference:
    """Return the time-optimal flight of a track and a model, with a full battery; needs CasADi.

    Raises:
        UnsupportedModelError: an effect that cannot be expressed. UnsolvedError: no optimum was found.
    """
    import casadi  # an extra, needed only here

    from benchmarks.optimal.problem import CLEARANCE_M, SMOOTHING_S, Task
    from benchmarks.optimal.solve import find_optimum

    env = FlyTrack(track=track, model=model)
    params = env.default_params
    dt_s, start = float(params.dt), start_state(track, layout.BATTERY_FULL_V)
    task = Task(kind, params.course, float(params.drone_radius), start)
    optimum = find_optimum(task, drained_in_float32(model, start, dt_s), dt_s)
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
    """Return whether a replay passed every gate, touched no frame and took the expected time."""
    is_whole = flown.gates_passed == len(reference.gate_times_s) and not flown.ended_by
    return is_whole and flown.frames_touched == 0 and abs(flown.time_s - reference.time_s) <= LARGEST_ERROR_S


def verified(folder: Path, tracks: list[Track]) -> tuple[list[tuple[Reference, str, Replay]], bool]:
    """Return a folder's references with their replays, and whether those in the reference's model are right.

    References of the model ``black_box`` are flown on the shipped black box as well. tracks: where references
    may be of tracks that are not shipped.

    Raises:
        ReferenceFileError, TrackError: a file that cannot be used, or no references.
    """
    plant = blackbox.load(blackbox.SHIPPED)
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


def find_all(tracks: list[Track], kinds: tuple[str, ...], model: Path | None, folder: Path) -> None:
    """Find references and write them into a folder."""
    parameters, name = (nominal(), NOMINAL) if model is None else (load_model(model), model.stem)
    for track in tracks:
        for kind in kinds:
            found = optimise(track, kind, parameters, name)
            save_reference(folder / f"{track.name}_{name}_{kind}.npz", found)
            print(f"{track.name} {kind}: {found.time_s:.4f} s, {found.found['cpu_s']} CPU s", flush=True)


def main(
    tracks: tuple[str, ...] = tuple(available_tracks()),
    kinds: tuple[Literal["flying", "standing"], ...] = ("flying", "standing"),
    model: Path | None = None,
    verify: bool = False,
    out: Path = FOLDER,
    page: Path | None = None,
) -> None:
    """Find references, replay all and write the page; exit 1 if a replay is not as it should be.

    tracks: names or files. model: file; by default the simulator's nominal model. verify: only replay
    existing references. out: their folder. page: to write, with pictures beside it.
    """
    try:
        known = list(map(load_track, tracks))
        if not verify:
            find_all(known, kinds, model, out)
        replays, is_good = verified(out, known)
        write_page(page, replays)
        if page is not None:
            write_pictures(page, [reference for reference, _, _ in replays], known)
    except ImportError as error:
        sys.exit(f"error: {error}; pip install .[optimal]")
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    raise SystemExit(0 if is_good else 1)


if __name__ == "__main__":
    report.command(main)
