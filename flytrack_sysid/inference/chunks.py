"""A log cut into chunks of equal length, which are replayed in parallel.

What a step needs of earlier steps (applied action, rates, memories) follows from the commands and
is forgotten within a second. So the scored part of the log is cut into chunks of five seconds, each
with a lead-in of the second before it. All chunks are replayed at once: many times fewer steps in
sequence.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.inference.record import (
    Record,
    is_applied_certain,
    make_record,
    measured_channels,
)
from flytrack_sysid.kinematics import since_first
from flytrack_sysid.log import FlightLog, median_step
from flytrack_sysid.log_voltage import with_voltage

LEAD_IN_S, CHUNK_S = 1, 5  # lags forget within the lead-in; noise is fitted to chunks
PIECES = LEAD_IN_S + CHUNK_S  # of a chunk, of a second each; the lead-in is first
MIN_ROWS_PER_S = 20  # of a log: with fewer, the slowest rate loop is over within a row
# A rate loop takes 10 to 50 ms. Chosen for cost: the effect of a lower rate was not measured.
MAX_RATE_HZ = 250.0
# Rows of all chunks, without lead-ins: all their slopes are in memory at once, some 50 kB a row.
MAX_ROWS = 15_000
CHUNKS_PADDED_TO = 2  # logs of about the same length share one compiled program
# Axes of a residual: rotation x, y, z, force x, y, z (all world), battery. Each axis has two
# channels: a direct one, and a level, whose rate of change the direct one measures.
DIRECT, LEVEL = ("w", "f", None), ("q", "v", "v_bat")
SIZES = (3, 3, 1)  # number of axes of each side
AXES = (slice(0, 3), slice(3, 6), slice(6, 7))  # of each side: rotation, force, battery
NUM_AXES = sum(SIZES)


class Chunks(NamedTuple):
    """A log in chunks; (rows, chunks, ...), where row k is followed by row k + 1 after ``step_s``.

    Attributes:
        record: as in ``flytrack_sysid.inference.record``.
        measured: by channel, w (rad/s) and f (m/s^2, body); others are in the record.
        counts: the scored residuals, never of the lead-in, (rows, chunks, NUM_AXES, 2) bool.
        is_joined: the row follows the one before it in flight, (rows, chunks) bool.
        is_known: the row is joined and no lost command acts on it, (rows, chunks, NUM_AXES) bool.
        row: of the record, -1 where there is none, (rows, chunks) int.
        quanta: the last digit of each channel, (2, NUM_AXES).
    """

    record: Record
    measured: dict[str, np.ndarray]
    counts: np.ndarray
    is_joined: np.ndarray
    is_known: np.ndarray
    row: np.ndarray
    quanta: np.ndarray

    def selected(self, indices: np.ndarray) -> "Chunks":
        """Return some of the chunks, by their indices."""
        leaves = {name: value for name, value in self._asdict().items() if name != "quanta"}
        return self._replace(**jax.tree.map(lambda leaf: leaf[:, indices], leaves))

    @property
    def num_judged(self) -> int:
        """The number of rows with scored residuals."""
        return int(self.counts.any(axis=(2, 3)).sum())


def of_row_before(values: np.ndarray) -> np.ndarray:
    """Return the values, (rows, ...), of the row before each row; of the first, its own."""
    return np.concatenate([values[:1], values[:-1]])


def count_lead_in(rows: int) -> int:
    """Return the number of a chunk's rows that are its lead-in."""
    return rows * LEAD_IN_S // PIECES


def _index(exists: np.ndarray, rate: int) -> np.ndarray:
    """Return the record's row at each row of the chunks, (rows, chunks); -1 where there is none.

    The chunks hold all rows that count. Each chunk directly follows the one before, except where no
    row counts for longer than a lead-in.

    Args:
        exists: rows that count, (num_rows,) bool.
        rate: rows a second.
    """
    chunk_rows, lead_in = CHUNK_S * rate, LEAD_IN_S * rate
    starts: list[int] = []
    rows = np.flatnonzero(exists)
    while len(rows):
        next_start = starts[-1] + chunk_rows if starts else rows[0]
        starts.append(next_start if rows[0] - next_start < lead_in else rows[0])
        rows = rows[np.searchsorted(rows, starts[-1] + chunk_rows) :]
    starts += [len(exists)] * (-len(starts) % CHUNKS_PADDED_TO or CHUNKS_PADDED_TO * (not starts))
    start = np.array(starts)
    indices = start + np.arange(-lead_in, chunk_rows)[:, None]
    return np.where((indices >= 0) & (indices < len(exists)) & (start < len(exists)), indices, -1)


def _quanta(measured: dict[str, np.ndarray]) -> np.ndarray:
    """Return the smallest change of each measured channel, (2, NUM_AXES); 0 for attitude."""

    def smallest(name: str | None) -> float:
        if name is None or name not in measured or name == "q":
            return 0.0
        steps = np.diff(np.unique(measured[name]))
        return float(steps.min()) if len(steps) else 0.0

    return np.array(
        [np.repeat([smallest(name) for name in names], SIZES) for names in (DIRECT, LEVEL)]
    )


def make_chunks(log: FlightLog, scored_rows: np.ndarray, tau: np.ndarray, gravity: float) -> Chunks:
    """Return the chunks of a log.

    Args:
        log: to cut.
        scored_rows: the rows that count, (num_rows,) bool.
        tau: lags, over which lost commands are forgotten, (4,) s.
        gravity: m/s^2.
    """
    record = make_record(log)
    is_certain = is_applied_certain(record, tau)
    exists = (record.source_row >= 0) & scored_rows[record.source_row]
    after = exists & ~record.begins
    turns, lifts = is_certain[:, :3].all(axis=1), is_certain[:, 3]
    allowed = {
        "w": turns & after,
        "q": turns & exists,
        "f": lifts & after,
        "v": lifts & exists,
        "v_bat": exists,
    }
    num_rows = 1 + int(np.flatnonzero(record.source_row >= 0)[-1])
    rate = 1.0 / float(np.median(record.step_s[record.source_row >= 0]))
    # The number of rows a second is rounded, so that logs share programs.
    index = _index(exists[:num_rows], max(MIN_ROWS_PER_S, int(float(f"{rate:.2g}"))))
    is_real = (index >= 0) & (np.arange(len(index)) >= count_lead_in(len(index)))[:, None]
    measured = measured_channels(log, record, gravity)
    no_rows = np.zeros(len(exists), bool)
    sides = (
        np.stack([allowed[name] if name in measured else no_rows for name in names], axis=-1)
        for names in (DIRECT, LEVEL)
    )
    counts = np.repeat(np.stack([side[index] for side in sides], axis=-1), SIZES, axis=-2)
    counts &= is_real[..., None, None]
    sensed: dict[str, np.ndarray] = {
        name: measured[name][index] for name in ("w", "f") if name in measured
    }
    record = Record(*(leaf[index] for leaf in record))
    begins = record.begins | (np.arange(len(index)) == 0)[:, None] | (index < 0)
    certain = np.stack([turns, lifts, np.ones_like(turns)], axis=-1)
    known = np.repeat(certain[index], SIZES, axis=-1)
    known &= ~begins[..., None]
    record = record._replace(begins=begins)
    return Chunks(record, sensed, counts, ~begins, known, index, _quanta(measured))


def cut_chunks(log: FlightLog, scored_rows: np.ndarray, model: ModelParameters) -> Chunks:
    """Return the chunks of a log under a model's lags.

    Args:
        log: to cut.
        scored_rows: the rows that count, (num_rows,) bool.
        model: with the lags, the battery and gravity.
    """
    return make_chunks(
        with_voltage(log, model), scored_rows, np.asarray(model.tau, float), float(model.g)
    )


def at_usual_rate(log: FlightLog) -> tuple[FlightLog, np.ndarray, list[str]]:
    """Return a log with at most about 250 rows a second, a mask of the kept rows, and notes.

    Rows between the kept ones are left out. A command is the mean until the next kept row.
    """
    rate_hz = 1.0 / median_step(log)
    ratio = max(round(rate_hz / MAX_RATE_HZ), 1)
    if ratio == 1:
        return log, np.ones(len(log), bool), []
    is_kept = since_first(np.arange(len(log)), log.is_start()) % ratio == 0
    starts = np.flatnonzero(is_kept)
    counts = np.diff(np.append(starts, len(log)))[:, None]
    kept = log.select(is_kept)
    command = np.add.reduceat(log["u"], starts, axis=0) / counts
    note = f"of {rate_hz:.4g} rows a second, one in {ratio} was used, with the mean of the commands"
    return replace(kept, channels={**kept.channels, "u": command}), is_kept, [note]


def measured_voltage_range(chunks: Chunks) -> tuple[float, float] | None:
    """Return the lowest and the highest measured voltage (V); None without any."""
    measured = chunks.record.battery_v[chunks.counts[..., -1, 1]]
    return (float(measured.min()), float(measured.max())) if len(measured) else None


def spread_chunks(chunks: Chunks, max_chunks: int | None = None) -> np.ndarray:
    """Return the indices of evenly spread chunks.

    Args:
        chunks: of a log.
        max_chunks: the most; if None, as many as have MAX_ROWS rows.
    """
    rows, num_chunks = chunks.row.shape
    max_chunks = (
        max_chunks
        or max(MAX_ROWS // (rows - count_lead_in(rows)) // CHUNKS_PADDED_TO, 1) * CHUNKS_PADDED_TO
    )
    if num_chunks <= max_chunks:
        return np.arange(num_chunks)
    return np.linspace(0, num_chunks - 1, max_chunks).round().astype(int)


def thinned(chunks: Chunks) -> Chunks:
    """Return chunks of at most MAX_ROWS rows, evenly spread over a log."""
    indices = spread_chunks(chunks)
    return chunks if len(indices) == chunks.row.shape[1] else chunks.selected(indices)
