"""Time-optimal flights of the shipped tracks, as data; ``benchmarks.time_optimal`` found them."""

from flytrack_env.references.reference import (
    FOLDER,
    KINDS,
    Reference,
    ReferenceFileError,
    References,
    ghost_rollout,
    is_model_of,
    load_reference,
    model_digest,
    save_reference,
    shipped_path,
    shipped_reference,
    shipped_references,
    track_digest,
)

__all__ = [
    "FOLDER",
    "KINDS",
    "Reference",
    "ReferenceFileError",
    "References",
    "ghost_rollout",
    "is_model_of",
    "load_reference",
    "model_digest",
    "save_reference",
    "shipped_path",
    "shipped_reference",
    "shipped_references",
    "track_digest",
]
