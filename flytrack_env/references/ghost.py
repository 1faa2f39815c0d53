"""The time-optimal flights of a track together, and as one flight to see beside another: the ghost."""

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.references.reference import (
    KINDS,
    Reference,
    ReferenceFileError,
    is_shipped,
    model_digest,
    shipped_reference,
    track_digest,
)
from flytrack_env.tracks import Track

References = dict[str, Reference]


def shipped_references(track: Track, model_names: tuple[str, ...]) -> References:
    """Return the references of a track by kind, with the first of these models that it has them for.

    Raises:
        ReferenceFileError: none for this track; the message lists those that are there.
    """
    names = [name for name in model_names if all(is_shipped(track.name, kind, name) for kind in KINDS)]
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
    if not is_shipped(track, "flying", model_name):
        return False
    return model_digest(model) == model_digest(shipped_reference(track, "flying", model_name).model)


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
