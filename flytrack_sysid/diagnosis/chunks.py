"""A log cut into chunks of equal length, which are replayed in parallel.

What a step needs of earlier steps (applied action, rates, memories) follows from the commands and
is forgotten within a second. So the judged part of the log is cut into chunks of five seconds, each
with a lead-in of the second before it, and all chunks are replayed at once: many times fewer steps
in sequence.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.log import FlightLog, usual_step
from flytrack_sysid.log_voltage import with_voltage
from flytrack_sysid.record import Record, is_applied_certain, make_record, measured_channels

LEAD_IN_S, CHUNK_S = 1, 5
PIECES = LEAD_IN_S + CHUNK_S  # of a second each, the lead-in first
MIN_ROWS_PER_S = 20
# A rate loop takes 10 to 50 ms. Chosen for cost: what a lower rate hides was not measured.
MAX_RATE_HZ = 250.0
# replayed without lead-ins: all of their slopes are in memory at once, some 50 kB a row
MAX_ROWS = 15_000
CHUNKS_PADDED_TO = 2  # logs of about the same length share one compiled program
# Axes of a residual: rotation x, y, z, force x, y, z (all world), battery. Channels of an axis: a
# direct one, and a level, whose rate of change the direct one measures.
DIRECT, LEVEL = ("w", "f", None), ("q", "v", "v_bat")
SIZES = (3, 3, 1)
AXES = (slice(0, 3), slice(3, 6), slice(6, 7))  # of each side: rotation, force, battery
NUM_AXES = sum(SIZES)


class Chunks(NamedTuple):
    """A log in chunks; (rows, chunks, ...), where row k is followed by row k + 1 after ``step_s``.

    record: as in ``flytrack_sysid.record``. measured: by channel: w rad/s, f m/s^2 (body); others
    are in the record. counts: (rows, chunks, NUM_AXES, 2) bool, what is judged; never the lead-in.
    is_joined: (rows, chunks) bool, the row follows the one before it in flight. is_known: (rows,
    chunks, NUM_AXES) bool, and no lost command still acts there. row: (rows, chunks) int, of the
    record, -1 where there is none. quanta: (2, NUM_AXES), the last digit of each channel.
    """

    record: Record
    measured: dict[str, np.ndarray]
    counts: np.ndarray
    is_joined: np.ndarray
    is_known: np.ndarray
    row: np.ndarray
    quanta: np.ndarray

    def selected(self, places: np.ndarray) -> "Chunks":
        """Return some of the chunks, by their numbers."""
        leaves = {name: value for name, value in self._asdict().items() if name != "quanta"}
        return self._replace(**jax.tree.map(lambda leaf: leaf[:, places], leaves))

    @property
    def num_judged(self) -> int:
        """The number of rows of which anything is to be explained."""
        return int(self.counts.any(axis=(2, 3)).sum())


def lead_in_of(rows: int) -> int:
    """Return how many of a chunk's rows are its lead-in."""
    return rows * LEAD_IN_S // PIECES


def _index(exists: np.ndarray, rate: int) -> np.ndarray:
    """Return the record's row at each place of the chunks, (rows, chunks); -1 where there is none.

    exists: (num_rows,) bool, rows that count; chunks hold all of them. One follows the other, but
    where nothing counts for longer than a lead-in.
    """
    long, lead_in = CHUNK_S * rate, LEAD_IN_S * rate
    starts: list[int] = []
    rows = np.flatnonzero(exists)
    while len(rows):
        after = starts[-1] + long if starts else rows[0]
        starts.append(after if rows[0] - after < lead_in else rows[0])
        rows = rows[np.searchsorted(rows, starts[-1] + long) :]
    starts += [len(exists)] * (-len(starts) % CHUNKS_PADDED_TO or CHUNKS_PADDED_TO * (not starts))
    begin = np.array(starts)
    places = begin + np.arange(-lead_in, long)[:, None]
    return np.where((places >= 0) & (places < len(exists)) & (begin < len(exists)), places, -1)


def _quanta(found: dict[str, np.ndarray]) -> np.ndarray:
    """Return the smallest change of each measured channel, (2, NUM_AXES); 0 for attitude."""

    def smallest(name: str | None) -> float:
        if name is None or name not in found or name == "q":
            return 0.0
        steps = np.diff(np.unique(found[name]))
        return float(steps.min()) if len(steps) else 0.0

    return np.array(
        [np.repeat([smallest(name) for name in names], SIZES) for names in (DIRECT, LEVEL)]
    )


def make_chunks(log: FlightLog, scored_rows: np.ndarray, tau: np.ndarray, gravity: float) -> Chunks:
    """Return the chunks of a log; only ``scored_rows`` rows of it, (num_rows,) bool, count.

    tau: (4,) s, lags that say how long lost commands are remembered.
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
    # A round number of rows a second, so that programs are shared.
    index = _index(exists[:num_rows], max(MIN_ROWS_PER_S, int(float(f"{rate:.2g}"))))
    is_real = (index >= 0) & (np.arange(len(index)) >= lead_in_of(len(index)))[:, None]
    found = measured_channels(log, record, gravity)
    nowhere = np.zeros(len(exists), bool)
    sides = (
        np.stack([allowed[name] if name in found else nowhere for name in names], axis=-1)
        for names in (DIRECT, LEVEL)
    )
    counts = np.repeat(np.stack([side[index] for side in sides], axis=-1), SIZES, axis=-2)
    counts &= is_real[..., None, None]
    sensed: dict[str, np.ndarray] = {
        name: found[name][index] for name in ("w", "f") if name in found
    }
    record = Record(*(leaf[index] for leaf in record))
    begins = record.begins | (np.arange(len(index)) == 0)[:, None] | (index < 0)
    certain = np.stack([turns, lifts, np.ones_like(turns)], axis=-1)
    known = np.repeat(certain[index], SIZES, axis=-1)
    known &= ~begins[..., None]
    record = record._replace(begins=begins)
    return Chunks(record, sensed, counts, ~begins, known, index, _quanta(found))


def cut_chunks(log: FlightLog, scored_rows: np.ndarray, model: ModelParameters) -> Chunks:
    """Return the chunks of a log under a model's lags.

    scored_rows: those that count, (num_rows,) bool.
    """
    return make_chunks(
        with_voltage(log, model), scored_rows, np.asarray(model.tau, float), float(model.g)
    )


def at_usual_rate(log: FlightLog) -> tuple[FlightLog, np.ndarray, list[str]]:
    """Return a log with at most about 250 rows a second, its rows in the log, and a note on that.

    Rows between those that are kept are left out; commands are their means until the next row.
    """
    rate_hz = 1.0 / float(np.median(usual_step(log)))
    every = max(round(rate_hz / MAX_RATE_HZ), 1)
    if every == 1:
        return log, np.ones(len(log), bool), []
    begins = np.flatnonzero(log.is_start())
    since_start = np.arange(len(log)) - begins[np.cumsum(log.is_start()) - 1]
    is_kept = since_start % every == 0
    starts = np.flatnonzero(is_kept)
    number = np.diff(np.append(starts, len(log)))[:, None]
    kept = log.select(is_kept)
    command = np.add.reduceat(log["u"], starts, axis=0) / number
    note = f"of {rate_hz:.4g} rows a second, one in {every} was used, with the mean of the commands"
    return replace(kept, channels={**kept.channels, "u": command}), is_kept, [note]


def voltages_of(chunks: Chunks) -> tuple[float, float] | None:
    """Return the lowest and the highest voltage that was measured, V; None without any."""
    measured = chunks.record.battery_v[chunks.counts[..., -1, 1]]
    return (float(measured.min()), float(measured.max())) if len(measured) else None


def thinned(chunks: Chunks, most: int | None = None) -> Chunks:
    """Return at most ``most`` chunks, evenly spread over a log; by default MAX_ROWS rows."""
    rows, number = chunks.row.shape
    most = (
        most or max(MAX_ROWS // (rows - lead_in_of(rows)) // CHUNKS_PADDED_TO, 1) * CHUNKS_PADDED_TO
    )
    if number <= most:
        return chunks
    return chunks.selected(np.linspace(0, number - 1, most).round().astype(int))
