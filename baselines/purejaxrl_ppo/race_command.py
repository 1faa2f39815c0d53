"""``flytrack race``: checkpoints against each other on a black box, from every slot of the start grid."""

import dataclasses
from pathlib import Path

import numpy as np
import tyro

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.config import OptionalPath
from baselines.purejaxrl_ppo.duels import Races, fly_races, score, start_pose_params
from baselines.purejaxrl_ppo.flights import can_record
from flytrack_env import blackbox
from flytrack_env.files import fresh_folder
from flytrack_env.multi_drone import MultiDroneRace
from flytrack_env.params import DT_S
from flytrack_env.progress import ProgressBar
from flytrack_env.rollout import load_named_rollouts

DEFAULT_OUT = Path("runs/race")
RECORDING = "race.rrd"
SLOWEST_LAP_S = 5.0
MOST_RACES, MOST_LAPS, MOST_POLICIES = 10_000, 20, 8


@dataclasses.dataclass(frozen=True)
class RaceSettings:
    """Who races; the fields are the flags of ``flytrack race``."""

    checkpoints: tyro.conf.Positional[tuple[Path, ...]]
    """Two to eight checkpoints, of policies for one drone or for races of so many."""
    races: int = 64
    """Races from each slot of the first checkpoint on the start grid."""
    laps: int = 3
    """Laps to complete."""
    black_box: OptionalPath = None
    """File of the black box that all fly; by default the shipped one."""
    seed: int = 0
    """Seed of the noisy start poses."""
    out: OptionalPath = None
    """Folder for the rollouts of one race and its recording; by default runs/race, or the next free one."""

    def check(self) -> None:
        """Raise ValueError, naming the flag, for settings that cannot be used."""
        if not 2 <= len(self.checkpoints) <= MOST_POLICIES:
            raise ValueError(f"checkpoints: found {len(self.checkpoints)}, expected 2 to {MOST_POLICIES}")
        for name, most in (("races", MOST_RACES), ("laps", MOST_LAPS)):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"--{name}: found {getattr(self, name)}, expected 1 to {most}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"--seed: found {self.seed}, expected 0 to {2**31 - 1}")
        if self.out is not None and self.out.exists() and not self.out.is_dir():
            raise NotADirectoryError(f"--out {self.out}: found a file, expected a folder or a new path")


def load_policies(settings: RaceSettings) -> tuple[MultiDroneRace, list[Checkpoint]]:
    """Return the race and its policies.

    Raises:
        CheckpointError: a policy that remembers, or one for another observation or track.
    """
    checkpoints = [load_checkpoint(path) for path in settings.checkpoints]
    plant = blackbox.load(settings.black_box or blackbox.SHIPPED)
    env = flytrack_env.make("FlyTrack-v0", track=checkpoints[0].track, plant=plant)
    race = MultiDroneRace(env, len(checkpoints))
    sizes = [one.observation_space().shape[0] for one in (env, race)]
    for path, one in zip(settings.checkpoints, checkpoints, strict=True):
        if one.config.memory_size:
            raise CheckpointError(f"{path}: found a policy that remembers, expected one that does not")
        if one.observation_size not in sizes:
            expected = f"expected {sizes[0]}, or {sizes[1]} for a race of {len(checkpoints)}"
            raise CheckpointError(f"{path}: found observations of {one.observation_size}, {expected}")
        if one.track != checkpoints[0].track:
            raise CheckpointError(f"{path}: found track {one.track}, expected {checkpoints[0].track}")
    return race, checkpoints


def describe(races: Races, settings: RaceSettings, slot: int) -> str:
    """Return what the races from one slot came to, a line for each drone."""
    finish_s, number = races.finish_s(settings.laps), len(settings.checkpoints)
    collisions = score(races, settings.laps).collisions
    lines = [f"{settings.races} races, collisions in {collisions:.1%}:"]
    for place, path in enumerate(settings.checkpoints):
        own_s = finish_s[:, place]
        others_s = np.delete(finish_s, place, axis=1).min(axis=1)
        has_finished = np.isfinite(own_s)
        mean = f", on average after {own_s[has_finished].mean():.3f} s" if has_finished.any() else ""
        lines.append(
            f"  slot {(slot + place) % number}  {path.stem}: finishes {has_finished.mean():.1%}{mean}, "
            f"wins {(own_s < others_s).mean():.1%}"
        )
    return "\n".join(lines)


def write_race(races: Races, settings: RaceSettings) -> list[Path]:
    """Write one race, won by the first policy where it won any; return the files.

    Raises:
        OSError: a file that cannot be written.
    """
    finish_s = races.finish_s(settings.laps)
    chosen = int(np.argmax(finish_s[:, 0] < finish_s[:, 1:].min(axis=1)))
    folder = settings.out or fresh_folder(DEFAULT_OUT)
    paths = races.save(chosen, folder)
    if can_record():
        from flytrack_env.viz_rerun import Trajectory, write_recording

        flights = [
            Trajectory(f"{name} {path.stem}", *rollout)
            for path, (name, rollout) in zip(
                settings.checkpoints, load_named_rollouts(paths).items(), strict=True
            )
        ]
        track = flytrack_env.load_track(load_checkpoint(settings.checkpoints[0]).track)
        write_recording(folder / RECORDING, flights, track)
        paths.append(folder / RECORDING)
    return paths


def run_race(settings: RaceSettings) -> None:
    """Do what ``flytrack race`` does: race, print who wins, write one race.

    Raises:
        OSError, ValueError: files or settings that cannot be used.
    """
    settings.check()
    race, checkpoints = load_policies(settings)
    policies = tuple(one.policy for one in checkpoints)
    num_steps = round(settings.laps * SLOWEST_LAP_S / DT_S)
    bar = ProgressBar("slots")
    for slot in range(len(checkpoints)):
        params = start_pose_params(race.default_params, slot, num_steps)
        races = fly_races(race, policies, params, settings.seed, settings.races, num_steps)
        bar(slot + 1, len(checkpoints))
        print(describe(races, settings, slot))
    for path in write_race(races, settings):  # of the last slot, behind all others
        print(f"{path}: {path.stat().st_size} bytes")
