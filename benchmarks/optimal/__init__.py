"""Time-optimal laps: the optimum of a track and a model, as data, and how it is found and verified."""

from benchmarks.optimal.reference import (
    KINDS,
    Reference,
    ReferenceFileError,
    load_reference,
    model_digest,
    save_reference,
    shipped_path,
    shipped_reference,
    track_digest,
)

__all__ = [
    "KINDS",
    "Reference",
    "ReferenceFileError",
    "load_reference",
    "model_digest",
    "save_reference",
    "shipped_path",
    "shipped_reference",
    "track_digest",
]
