"""A policy's flights beside the time-optimal one: percent above it, where time is lost, the ghost to see."""

from typing import Any

import numpy as np

from baselines.purejaxrl_ppo.flights import Outcomes
from benchmarks.optimal.reference import (
    KINDS,
    Reference,
    ReferenceFileError,
    model_digest,
    shipped_path,
    shipped_reference,
    track_digest,
)
from flytrack_env import ModelParameters
from flytrack_env.tracks import Track

References = dict[str, Reference]
LAPS = {"first_lap_s": "standing", "flying_lap_s": "flying"}  # what each reference is the optimum of


def shipped_references(track: Track, model_names: tuple[str, ...]) -> References:
    """Return the references of a track by kind, with the first of these models that it has them for.

    Raises:
        ReferenceFileError: none for this track; the message lists those that are there.
    """
    names = [name for name in model_names if all(shipped_path(track.name, k, name).is_file() for k in KINDS)]
    name = names[0] if names else model_names[-1]
    references = {kind: shipped_reference(track.name, kind, name) for kind in KINDS}
    for reference in references.values():
        if reference.track_sha256 != track_digest(track):
            raise ReferenceFileError(
                f"reference: {track.name}: found one of another track of that name, expected this track's"
            )
    return references


def is_model_of(track: str, model_name: str, model: ModelParameters) -> bool:
    """Return whether a track has a reference of that name that was found with just this model."""
    if not shipped_path(track, "flying", model_name).is_file():
        return False
    return model_digest(model) == model_digest(shipped_reference(track, "flying", model_name).model)


def compare(summary: dict[str, Any], references: References) -> dict[str, Any]:
    """Return how far lap times are above the optimum, as JSON values.

    summary: as ``summary.summarise`` returns it. For each kind of lap: ``time_s`` of the optimum,
    ``mean_percent_above`` and ``min_percent_above`` of the laps flown, None where there were none.
    """
    compared: dict[str, Any] = {"model": references["flying"].model_name}
    for lap, kind in LAPS.items():
        percent = {
            f"{name}_percent_above": None
            if summary[lap][name] is None
            else references[kind].percent_above(summary[lap][name])
            for name in ("mean", "min")
        }
        compared[lap] = {"time_s": references[kind].time_s, **percent}
    return compared


def time_lost(outcomes: Outcomes, references: References) -> list[dict[str, Any]]:
    """Return the mean time lost on the way to each gate, s, as JSON values: one row per gate.

    Of complete laps, so that the rows add up to the mean lap less the optimum; None where there was none.
    """
    num_gates = len(references["flying"].gate_times_s)
    num_laps = outcomes.lap_times_s.shape[-1]
    times_s = outcomes.gate_times_s.astype(float).reshape(-1, num_laps, num_gates)
    starts_s = np.concatenate([np.zeros((len(times_s), 1)), times_s[:, :-1, -1]], axis=1)
    within_s = times_s - starts_s[..., None]
    laps = {"first_lap_s": within_s[:, 0], "flying_lap_s": within_s[:, 1:].reshape(-1, num_gates)}
    lost: dict[str, Any] = {}
    for name, gates_s in laps.items():
        complete = gates_s[np.isfinite(gates_s).all(axis=1)]
        own = np.diff(complete, axis=1, prepend=0.0)
        optimal = np.diff(references[LAPS[name]].gate_times_s, prepend=0.0)
        lost[name] = (own.mean(axis=0) - optimal).tolist() if len(own) else [None] * num_gates
    columns = zip(*lost.values(), strict=True)
    return [{"gate": gate + 1, **dict(zip(LAPS, values, strict=True))} for gate, values in enumerate(columns)]


def ghost_rollout(references: References, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states (num_steps, 21) and commands (num_steps, 4) of the optimum: start, then flying laps.

    Row t is the sample that is nearest in time, at most half a step off: laps are no whole number of steps.
    Where the start's last gate is passed, the ghost jumps: a start is free to pass it as it likes.
    """
    standing, flying = references["standing"], references["flying"]
    times_s = standing.dt_s * np.arange(num_steps)
    is_start = times_s < standing.time_s
    within_s = np.where(is_start, times_s, (times_s - standing.time_s) % flying.time_s)
    rows = np.rint(within_s / standing.dt_s).astype(int)

    def pick(name: str) -> np.ndarray:
        first, later = (getattr(reference, name) for reference in (standing, flying))
        picked = [source[np.minimum(rows, len(source) - 1)] for source in (first, later)]
        return np.where(is_start[:, None], *picked)

    return pick("states"), pick("commands")
