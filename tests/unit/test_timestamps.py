"""Clocks with faults: which stamps are kept, and where segments begin."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from flytrack_sysid import LogError, import_log
from flytrack_sysid.timestamps import ROLL_OVERS_S, number_segments, put_on_one_line, read_clock
from tests.support.foreign_logs import WRITERS, flying
from tests.support.slow import slow_but

STEP_S, NUM_ROWS, ROW = 0.004, 1000, 400  # of the written logs; the row at which the clock fails
START_S = 100.0
PERIOD_US_S, PERIOD_MS_S = ROLL_OVERS_S


def shift(rows: slice, by_s: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return the fault of some stamps that are off by a number of seconds."""
    is_shifted = np.isin(np.arange(NUM_ROWS), np.arange(NUM_ROWS)[rows])
    return lambda stamps: stamps + by_s * is_shifted


def replace_stamps(values: list[float], first: int = ROW) -> Callable[[np.ndarray], np.ndarray]:
    """Return the fault of stamps that have other values."""

    def fault(stamps: np.ndarray) -> np.ndarray:
        stamps = stamps.copy()
        stamps[first : first + len(values)] = values
        return stamps

    return fault


def roll_over(period_s: float, before_s: float = 1.602) -> Callable[[np.ndarray], np.ndarray]:
    """Return the fault of a counter that starts again at 0 after so many seconds."""
    return lambda stamps: (stamps + period_s - START_S - before_s) % period_s


class Fault(NamedTuple):
    """A fault of a clock.

    apply: from right stamps to those that are written, s. num_lost: rows that cannot be used.
    segments: rows of each segment. said: parts of a note. error_s: of the times that are read.
    """

    apply: Callable[[np.ndarray], np.ndarray]
    num_lost: int = 0
    segments: tuple[int, ...] = (NUM_ROWS,)
    said: str = ""
    error_s: float = 2e-6


def lost(num_rows: int, reason: str = "with a stamp far from their neighbours'") -> dict[str, Any]:
    """Return what is expected where a number of rows is left out."""
    said = f"{num_rows} of {NUM_ROWS} rows"
    return {
        "num_lost": num_rows,
        "segments": (NUM_ROWS - num_rows,),
        "said": f"{said}|{num_rows} {reason}",
    }


HALVES = (ROW, NUM_ROWS - ROW)
FAULTS = {
    "none": Fault(lambda stamps: stamps),
    "a stray stamp an hour later": Fault(shift(slice(ROW, ROW + 1), 3600.0), **lost(1)),
    "a stray stamp half a second later": Fault(shift(slice(ROW, ROW + 1), 0.5), **lost(1)),
    "a stray stamp half a second earlier": Fault(shift(slice(ROW, ROW + 1), -0.5), **lost(1)),
    "a stray stamp in the first row": Fault(shift(slice(1), 3600.0), **lost(1)),
    "a stray stamp in the last row": Fault(shift(slice(-1, None), 3600.0), **lost(1)),
    "five different stray stamps in a row": Fault(
        replace_stamps([9.0, 3e3, 77.0, 4e3, 2.0]), **lost(5)
    ),
    "twenty stamps in a row an hour later": Fault(shift(slice(ROW, ROW + 20), 3600.0), **lost(20)),
    "0 in the first five rows": Fault(replace_stamps([0.0] * 5, 0), **lost(5, "")),
    "a repeated stamp": Fault(
        lambda stamps: np.where(np.arange(NUM_ROWS) == ROW, stamps[ROW - 1], stamps),
        **lost(1, "with a repeated stamp"),
    ),
    "two swapped stamps": Fault(
        lambda stamps: stamps[np.r_[:ROW, ROW + 1, ROW, ROW + 2 : NUM_ROWS]],
        **lost(1),
        error_s=STEP_S + 2e-6,
    ),
    "set back by 1.5 s": Fault(shift(slice(ROW, None), -1.5), 0, HALVES, "set back 1 times"),
    "set back by 50 ms": Fault(shift(slice(ROW, None), -0.05), 0, HALVES, "set back 1 times"),
    "a re-boot": Fault(shift(slice(ROW, None), -START_S), 0, HALVES, "set back 1 times"),
    "a pause of 30 s": Fault(shift(slice(ROW, None), 30.0), 0, HALVES, "1 gaps above 1 s"),
    "set to the time of day": Fault(shift(slice(ROW, None), 1.7e6), 0, HALVES, "1 gaps above 1 s"),
    "a roll-over of us": Fault(roll_over(PERIOD_US_S), said="rolled over 1"),
    "a roll-over of ms": Fault(roll_over(PERIOD_MS_S), said="rolled over 1"),
    "a roll-over with a stray stamp before it": Fault(
        lambda stamps: replace_stamps([77.0])(roll_over(PERIOD_US_S, 1.606)(stamps)),
        1,
        (NUM_ROWS - 1,),
        "rolled over 1",
    ),
}
STAMPS_S = START_S + STEP_S * np.arange(NUM_ROWS)


@pytest.mark.parametrize("name", FAULTS)
def test_what_fits_is_kept_and_the_rest_is_counted(name: str) -> None:
    fault = FAULTS[name]
    clock = read_clock("a.log", "the gyro", fault.apply(STAMPS_S))
    times = put_on_one_line("a.log", {"w": clock}, "w")["w"]
    segments = number_segments(times, clock.max_gap_s)
    assert NUM_ROWS - clock.is_used.sum() == fault.num_lost
    assert tuple(np.bincount(segments)) == fault.segments
    rows = np.flatnonzero(clock.is_used)
    is_inside = np.diff(segments) == 0
    np.testing.assert_allclose(
        np.diff(times)[is_inside], STEP_S * np.diff(rows)[is_inside], atol=fault.error_s
    )
    said = " ".join(clock.describe("the gyro"))
    assert all(part in said for part in fault.said.split("|")) and bool(said) == (name != "none")


# Each has another outcome; formats read their clocks by the function above.
FAST = ("a stray stamp an hour later", "set back by 1.5 s", "a roll-over of us")


@pytest.mark.parametrize("fault", slow_but(FAST, FAULTS))
@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_reads_its_clock(kind: str, fault: str, tmp_path: Path) -> None:
    form, write = WRITERS[kind]
    expected = FAULTS[fault]
    stamps = expected.apply(STAMPS_S)
    if kind == "blackbox" and stamps.max() >= PERIOD_US_S:
        pytest.skip("this format's stamps have 32 bits")
    log = flying(NUM_ROWS)
    log["w"][:] = np.outer(np.deg2rad(np.arange(NUM_ROWS)), [0.0, 0.0, 1.0])  # tells rows apart
    path, mapping = write(tmp_path, replace(log, time=stamps))
    imported = import_log(path, form, mapping, align=False)
    rows = np.round(np.rad2deg(imported.log["w"][:, 2])).astype(int)
    assert len(rows) == NUM_ROWS - expected.num_lost and np.all(np.diff(rows) >= -1)
    assert tuple(np.bincount(imported.log.segment)) == expected.segments
    is_inside = np.diff(imported.log.segment) == 0
    spans_s = np.diff(imported.log.time)[is_inside]
    np.testing.assert_allclose(spans_s, STEP_S * np.diff(rows)[is_inside], atol=expected.error_s)
    notes = " ".join(imported.notes)
    assert all(part in notes for part in expected.said.split("|"))


def test_what_is_no_clock_is_refused() -> None:
    random_s = np.random.default_rng(0).uniform(0.0, 1e3, 500)
    with pytest.raises(
        LogError, match=r"a\.log: time of w: found \d+ jumps in 500 stamps, expected steps of"
    ):
        read_clock("a.log", "w", random_s)
    with pytest.raises(LogError, match=r"a\.log: time of w: found no finite stamp in 3 rows"):
        read_clock("a.log", "w", np.full(3, np.nan))


@pytest.mark.parametrize(
    ("apply", "message"),
    [
        (
            shift(slice(None), 1.7e9),
            r"clock of q: found 17\d+\.\d+ to .*, that of w 100\.0+ to .* in common",
        ),
        (
            shift(slice(ROW, None), -1.5),
            "clock of q: set back 1 times, that of w 0 times; which rows belong",
        ),
    ],
)
def test_streams_that_share_no_time_are_refused(apply: Any, message: str) -> None:
    clocks = {
        name: read_clock("a.log", name, stamps)
        for name, stamps in (("w", STAMPS_S), ("q", apply(STAMPS_S)))
    }
    with pytest.raises(LogError, match=message):
        put_on_one_line("a.log", clocks, "w")


def test_streams_of_other_rates_are_set_back_together() -> None:
    """A slow stream has no row near the jump; later rows of both stay together."""
    set_back = shift(slice(ROW, None), -1.5)(STAMPS_S)
    clocks = {
        "w": read_clock("a.log", "w", set_back),
        "q": read_clock("a.log", "q", set_back[::25]),
    }
    times = put_on_one_line("a.log", clocks, "w")
    np.testing.assert_allclose(times["q"], times["w"][::25])
    assert np.all(np.diff(times["w"]) > 0.0)
