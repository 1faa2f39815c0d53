"""``flytrack race``: checkpoints against each other on a black box, from every slot of the start grid."""

import dataclasses
from pathlib import Path

import numpy as np
import tyro

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.config import OptionalFloat, OptionalPath
from baselines.purejaxrl_ppo.duels import Races, fly_races, score, start_pose_params
from baselines.purejaxrl_ppo.flights import CANNOT_RECORD, can_record
from flytrack_env import blackbox
from flytrack_env.files import fresh_folder
from flytrack_env.multi_drone import MultiDroneRace, RaceParams
from flytrack_env.multi_drone.rules import MOST_DRONES
from flytrack_env.params import DT_S, EnvParams
from flytrack_env.progress import ProgressBar

DEFAULT_OUT = Path("runs/race")
RECORDING = "race.rrd"
SLOWEST_M_S = 5.0  # along straight lines between gates: whoever is slower is out of time
MOST_ROWS = 10_000_000  # of all drones' states, which are kept: about 2 GB


@dataclasses.dataclass(frozen=True)
class RaceSettings:
    """Who races; the fields are the flags of ``flytrack race``."""

    checkpoints: tyro.conf.Positional[tuple[Path, ...]]
    """Two to eight checkpoints, of policies for one drone or for races."""
    races: int = 64
    """Races from each slot of the first checkpoint on the start grid."""
    laps: int = 3
    """Laps to complete."""
    black_box: OptionalPath = None
    """File of the black box that all fly; by default the shipped one."""
    downwash: OptionalFloat = None
    """Scale of the push of wakes on whoever flies into them, 1 for all of it; by default there are none."""
    seed: int = 0
    """Seed of the noisy start poses."""
    out: OptionalPath = None
    """New folder for the rollouts of one race and its recording; by default runs/race, or the next free
    one."""

    def check(self) -> None:
        """Raise ValueError, naming the flag, for settings that cannot be used."""
        if not 2 <= len(self.checkpoints) <= MOST_DRONES:
            raise ValueError(f"checkpoints: found {len(self.checkpoints)}, expected 2 to {MOST_DRONES}")
        for name in ("races", "laps"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name}: found {getattr(self, name)}, expected at least 1")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"--seed: found {self.seed}, expected 0 to {2**31 - 1}")

    @property
    def names(self) -> list[str]:
        """Names of the drones: those of their files, with folder and place where they repeat."""
        names = [path.stem for path in self.checkpoints]
        if len(set(names)) < len(names):
            names = [f"{path.resolve().parent.name}_{path.stem}" for path in self.checkpoints]
        if len(set(names)) < len(names):
            names = [f"{name}_{place}" for place, name in enumerate(names, start=1)]
        return names


def load_race(settings: RaceSettings) -> tuple[MultiDroneRace, list[Checkpoint]]:
    """Return the race and its policies.

    Raises:
        CheckpointError: a policy that remembers, or one for another observation or track.
    """
    checkpoints = [load_checkpoint(path) for path in settings.checkpoints]
    plant = blackbox.load(settings.black_box or blackbox.SHIPPED)
    env = flytrack_env.make("FlyTrack-v0", track=checkpoints[0].track, plant=plant)
    races = [MultiDroneRace(env, number) for number in range(1, len(checkpoints) + 1)]
    by_size = {race.observation_space().shape[0]: race for race in reversed(races)}
    first = checkpoints[0]
    for path, one in zip(settings.checkpoints, checkpoints, strict=True):
        if one.config.memory_size:
            raise CheckpointError(f"{path}: found a policy that remembers, expected one that does not")
        if one.meta.get("track_data", one.track) != first.meta.get("track_data", first.track):
            expected = f"{first.track}, as {settings.checkpoints[0]}"
            raise CheckpointError(f"{path}: found track {one.track}, expected {expected}")
        if one.observation_size not in by_size:
            expected = f"one of {sorted(by_size)}"
            raise CheckpointError(
                f"{path}: found observations of {one.observation_size}, expected {expected}"
            )
        one.check_fits(by_size[one.observation_size])
    return races[-1], checkpoints


def steps_of(params: EnvParams, settings: RaceSettings) -> int:
    """Return after how many steps a race is over.

    Raises:
        ValueError: more races than fit into memory.
    """
    centres_w = np.stack([np.asarray(axis) for axis in params.course.gates.centre], axis=-1)
    lap_m = np.linalg.norm(centres_w - np.roll(centres_w, 1, axis=0), axis=-1).sum()
    num_steps = int(settings.laps * lap_m / SLOWEST_M_S / DT_S)
    most = MOST_ROWS // (num_steps * len(settings.checkpoints))
    if settings.races > most:
        raise ValueError(f"--races: found {settings.races}, expected at most {most}, with so many laps")
    return num_steps


def describe(races: Races, settings: RaceSettings, slot: int) -> str:
    """Return the results of the races from one slot, a line for each drone."""
    finish_s = races.finish_s(settings.laps)
    collisions = score(races, settings.laps).collisions
    lines = [f"races: {settings.races}, with collisions: {collisions:.1%}"]
    for place, name in enumerate(settings.names):
        own_s = finish_s[:, place]
        others_s = np.delete(finish_s, place, axis=1).min(axis=1)
        has_finished, is_out = np.isfinite(own_s), races.is_out[:, -1, place]
        mean = f" after {own_s[has_finished].mean():.3f} s on average" if has_finished.any() else ""
        own_slot = (slot + place) % len(settings.names)
        lines.append(
            f"  slot {own_slot}  {name}: finishes {has_finished.mean():.1%}{mean}, "
            f"wins {(own_s < others_s).mean():.1%}, out of time {(~has_finished & ~is_out).mean():.1%}"
        )
    return "\n".join(lines)


def write_race(races: Races, settings: RaceSettings, race: MultiDroneRace, folder: Path) -> list[str]:
    """Write one race, won by the first policy if it won any; return a line about each file.

    Raises:
        OSError: a file that cannot be written.
    """
    finish_s = races.finish_s(settings.laps)
    chosen = int(np.argmax(finish_s[:, 0] < finish_s[:, 1:].min(axis=1)))
    paths = races.save(chosen, folder, settings.names)
    lines = [f"rollout: {path}" for path in paths]
    if not can_record():
        return [*lines, f"no recording: {CANNOT_RECORD}"]
    from flytrack_env.viz_rerun import Trajectory, write_recording

    lengths = (~races.is_out[chosen]).sum(axis=0) + 1
    flights = [
        Trajectory(name, races.states[chosen, :rows, place], races.actions[chosen, :rows, place])
        for place, (name, rows) in enumerate(zip(settings.names, lengths, strict=True))
    ]
    write_recording(folder / RECORDING, flights, race.env.track)
    return [*lines, f"recording: {folder / RECORDING}"]


def run_race(settings: RaceSettings) -> None:
    """Do what ``flytrack race`` does: race, print who wins, write one race.

    Raises:
        OSError, ValueError: files or settings that cannot be used, before anything is flown.
    """
    settings.check()
    race, checkpoints = load_race(settings)
    flight, rules = race.default_params
    params = RaceParams(flight, rules._replace(downwash=settings.downwash))
    race.check_params(params)
    num_steps, policies = steps_of(flight, settings), tuple(one.policy for one in checkpoints)
    folder = fresh_folder(DEFAULT_OUT) if settings.out is None else settings.out
    folder.mkdir(parents=True, exist_ok=settings.out is None)
    print(f"track: {race.env.track.name}, laps: {settings.laps}, at most {num_steps * DT_S:g} s")
    bar = ProgressBar("slots")
    for slot in range(len(checkpoints)):
        first = start_pose_params(params, slot, num_steps)
        races = fly_races(race, policies, first, settings.seed, settings.races, num_steps)
        race.env.plant.check_alive()
        bar(slot + 1, len(checkpoints))
        print(describe(races, settings, slot))
    print("\n".join(write_race(races, settings, race, folder)))  # from the last slot, behind all others
