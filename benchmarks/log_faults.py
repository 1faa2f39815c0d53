"""A table of the outcomes of the tests of faulty logs, for ``benchmarks.any_drone``."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from xml.etree import ElementTree

from benchmarks import report

CLOCKS, CUT_OFF, GROUND = (
    f"tests/unit/test_{name}.py" for name in ("timestamps", "cut_off_logs", "ground")
)
ULOG, DATAFLASH = "tests/unit/test_import_ulog.py", "tests/unit/test_import_dataflash.py"


class Format(NamedTuple):
    """A kind of log: its name in the tests of clocks, its format, and its test of two batteries."""

    name: str
    form: str
    batteries: str = ""


FORMATS = (
    Format("ULog", "ulog", "test_the_battery_that_is_measured_is_used"),
    Format("blackbox", "betaflight"),
    Format("DataFlash", "dataflash", "test_a_made_flight_comes_back"),
    Format("uSD", "usd"),
    Format("bag", "bag"),
    Format("CSV", "csv"),
    Format("CSV files", ""),
)


def clock(fault: str) -> Callable[[Format], list[tuple[str, str]]]:
    """Return the tests of a clock fault: beginnings of their names, and what each shows."""
    return lambda one: [(f"test_every_format_reads_every_clock[{one.name}-{fault}]", "right")]


COLUMNS: dict[str, Callable[[Format], list[tuple[str, str]]]] = {
    "stray stamp": clock("a stray stamp an hour later"),
    "repeated stamp": clock("a repeated stamp"),
    "clock set back": clock("set back by 1.5 s"),
    "re-boot": clock("a re-boot"),
    "pause": clock("a pause of 30 s"),
    "roll-over": clock("a roll-over of us"),
    "cut off": lambda one: [
        (f"test_the_whole_rows_of_a_cut_off_log_are_used[{one.name}]", "right"),
        (f"test_a_cut_off_log_that_cannot_be_used_is_refused[{one.name}]", "refused, reason"),
    ],
    "on the ground": lambda one: [
        (f"test_ground_is_dropped_and_counted_in_every_format[{one.form}]", "right")
    ],
    "two batteries": lambda one: [(one.batteries, "right")] if one.batteries else [],
}


def outcomes() -> dict[str, bool | None]:
    """Run the tests; return which passed, by name; None of those that were skipped."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "outcomes.xml"
        words = (
            "-q",
            "-p",
            "no:cacheprovider",
            f"--junitxml={path}",
            CLOCKS,
            CUT_OFF,
            GROUND,
            ULOG,
            DATAFLASH,
        )
        subprocess.run([sys.executable, "-m", "pytest", *words], cwd=report.ROOT, check=False)
        found: dict[str, bool | None] = {}
        for case in ElementTree.parse(path).iter("testcase"):
            kinds = {child.tag for child in case}
            is_skipped = "skipped" in kinds
            found[case.get("name", "")] = None if is_skipped else not kinds & {"failure", "error"}
        return found


def cell(found: dict[str, bool | None], tests: list[tuple[str, str]]) -> str:
    """Return what the tests of a format and a fault show; - where there is none."""
    for start, shown in tests:
        passed = [outcome for name, outcome in found.items() if name.startswith(start)]
        if any(outcome is False for outcome in passed):
            return "**wrong**"
        if any(passed):
            return shown
    return "-"


def fault_table() -> str:
    """Return the table of formats and faults."""
    found = outcomes()
    rows = [
        [one.name, *(cell(found, tests_of(one)) for tests_of in COLUMNS.values())]
        for one in FORMATS
    ]
    return report.table(" | ".join(["log", *COLUMNS]), rows)
