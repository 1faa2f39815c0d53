"""Clocks with faults: which stamps are kept, and where segments begin."""

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest

from flytrack_sysid import LogError, import_log
from flytrack_sysid.timestamps import put_on_one_line, read_clock
from tests.support.foreign_logs import WRITERS, flying
from tests.support.tables import table

STEP_S, NUM_ROWS, ROW = 0.004, 1000, 400  # of the written logs; the row at which the clock fails
STAMPS_S = 100.0 + STEP_S * np.arange(NUM_ROWS)
LARGEST_32_BIT_S = 2**32 * 1e-6


class Fault(NamedTuple):
    """A fault of a clock, as the table of them has it."""

    rows: tuple[int, int] = (0, NUM_ROWS)
    shift_s: float = 0.0
    values: Sequence[float] = ()
    period_s: float = 0.0
    num_lost: int = 0
    is_split: bool = False
    notes: Sequence[str] = ()
    error_s: float = 2e-6

    def stamps(self):
        """Return what is written in place of the right stamps, s."""
        stamps = STAMPS_S.copy()
        if self.period_s:  # starts again at 0 two rows after the one at which the others fail
            stamps = (stamps + self.period_s - STAMPS_S[ROW + 2] + 0.5 * STEP_S) % self.period_s
        first, end = self.rows
        stamps[first:end] += self.shift_s
        stamps[first : first + len(self.values)] = self.values
        return stamps

    def segments(self):
        """Return how many rows each segment has."""
        return (ROW, NUM_ROWS - ROW) if self.is_split else (NUM_ROWS - self.num_lost,)


FAULTS = {name: Fault(**fields) for name, fields in table("clock_faults").items()}


# Each has another outcome; all formats read their clocks by one function.
OUTCOMES = ("a stray stamp an hour later", "set back by 1.5 s", "a roll-over of us")
CASES = [
    (kind, fault) for kind, fault in product(WRITERS, FAULTS) if kind == "CSV" or fault in OUTCOMES
]


@pytest.mark.parametrize(("kind", "fault"), CASES)
def test_what_fits_is_kept_and_the_rest_is_counted_in_every_format(kind, fault, tmp_path):
    form, write = WRITERS[kind]
    expected = FAULTS[fault]
    stamps = expected.stamps()
    if kind == "blackbox" and stamps.max() >= LARGEST_32_BIT_S:
        pytest.skip("this format's stamps have 32 bits")
    log = flying(NUM_ROWS)
    log["w"][:] = np.outer(np.deg2rad(np.arange(NUM_ROWS)), [0.0, 0.0, 1.0])  # tells rows apart
    path, mapping = write(tmp_path, replace(log, time=stamps))
    imported = import_log(path, form, mapping, align=False)
    rows = np.round(np.rad2deg(imported.log["w"][:, 2])).astype(int)
    assert len(rows) == NUM_ROWS - expected.num_lost and np.all(np.diff(rows) >= -1)
    assert tuple(np.bincount(imported.log.segment)) == expected.segments()
    is_inside = np.diff(imported.log.segment) == 0
    spans_s = np.diff(imported.log.time)[is_inside]
    np.testing.assert_allclose(spans_s, STEP_S * np.diff(rows)[is_inside], atol=expected.error_s)
    notes = " ".join(imported.notes)
    assert all(part in notes for part in expected.notes)
    faults = re.search(r"\d rows of .* left out|new segment|rolled over", notes)
    assert bool(faults) == (fault != "none")


def test_what_is_no_clock_is_refused():
    random_s = np.random.default_rng(0).uniform(0.0, 1e3, 500)
    with pytest.raises(
        LogError, match=r"a\.log: time of w: found \d+ jumps in 500 stamps, expected steps of"
    ):
        read_clock("a.log", "w", random_s)
    with pytest.raises(LogError, match=r"a\.log: time of w: found no finite stamp in 3 rows"):
        read_clock("a.log", "w", np.full(3, np.nan))


def test_a_stream_that_alone_is_set_back_is_refused():
    set_back = Fault((ROW, NUM_ROWS), -1.5).stamps()
    clocks = {"w": read_clock("a.log", "w", STAMPS_S), "q": read_clock("a.log", "q", set_back)}
    message = "clock of q: set back 1 times, that of w 0 times; which rows belong"
    with pytest.raises(LogError, match=message):
        put_on_one_line("a.log", clocks, "w")


def test_streams_of_other_rates_are_set_back_together():
    """A slow stream has no row near the jump; later rows of both stay together."""
    set_back = Fault((ROW, NUM_ROWS), -1.5).stamps()
    clocks = {
        "w": read_clock("a.log", "w", set_back),
        "q": read_clock("a.log", "q", set_back[::25]),
    }
    times = put_on_one_line("a.log", clocks, "w")
    np.testing.assert_allclose(times["q"], times["w"][::25])
    assert np.all(np.diff(times["w"]) > 0.0)
