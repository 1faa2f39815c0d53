"""Reading columns of numbers from CSV files, gzip-compressed ones too; every refusal names the place."""

import contextlib
import csv
import gzip
import io
import math
import zlib
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.files import open_file
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_sysid.log import LogError
from flytrack_sysid.log_table import Table

LARGEST_BYTES = 512 * 2**20
PACKED_BYTES, LARGEST_RATIO = 2**24, 32  # characters in a compressed file: that, or as many times its bytes
LARGEST_VALUES = 56 * 2**20  # all columns at 1 kHz for half an hour; twice as many float64 are below 1 GiB
LONGEST_ROW = 2**16  # characters: thousands of columns


@contextlib.contextmanager
def open_csv(path: Path, delimiter: str = ",") -> Iterator[Any]:
    """Yield the ``csv.reader`` of a file, unpacked if its name ends in .gz; errors become LogErrors."""
    rows = None
    try:
        with open_file(path, LARGEST_BYTES) as file:
            stream: Any = file
            most_characters = LARGEST_BYTES
            if path.suffix == ".gz":
                most_characters = min(LARGEST_BYTES, max(PACKED_BYTES, LARGEST_RATIO * path.stat().st_size))
                stream = gzip.GzipFile(fileobj=file)
            with io.TextIOWrapper(stream, encoding="utf-8-sig", newline="") as text:
                rows = csv.reader(_lines(text, most_characters), delimiter=delimiter, strict=True)
                yield rows
    except (csv.Error, UnicodeDecodeError) as error:
        where = f"{path}: near line {rows.line_num + 1 if rows else 1}"
        raise LogError(f"{where}: not a CSV file: {error_text(error)}") from error
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"{path}: cannot be read: {error_text(error)}") from error


def _lines(text: io.TextIOWrapper, most_characters: int) -> Iterator[str]:
    """Yield the lines of a file; no row has several, so that ``csv`` never reads much at once."""
    num_characters = 0
    while line := text.readline(LONGEST_ROW):
        num_characters += len(line)
        if len(line) == LONGEST_ROW:
            raise csv.Error(f"found a row of {LONGEST_ROW} characters or more, expected fewer")
        if num_characters > most_characters:
            raise csv.Error(f"found more than {most_characters} characters, expected at most that")
        if line.count('"') % 2:
            raise csv.Error("found a quote that does not end on its line")
        yield line


def read_columns(path: Path, rows: Any, header: list[str], wanted: Iterable[str]) -> Table:
    """Return the wanted columns of the rows after the header, which has each of them, less blank ones.

    Raises:
        LogError: a row of another length, a cell that is no finite number, more than LARGEST_VALUES numbers.
    """
    places = {name: header.index(name) for name in wanted}
    values, lines = array("d"), array("q")
    for cells in filter(None, rows):
        where = f"{path}: row {len(lines)} (line {rows.line_num})"
        if len(cells) != len(header):
            raise LogError(f"{where}: found {len(cells)} cells, expected {len(header)} as in the header")
        values.extend(_number(where, name, cells[place]) for name, place in places.items())
        lines.append(rows.line_num)
        if len(values) > LARGEST_VALUES:
            raise LogError(f"{path}: found more than {LARGEST_VALUES} numbers, expected at most that")
    columns = np.asarray(values).reshape(-1, len(places)).T
    return Table(str(path), dict(zip(places, columns, strict=True)), np.asarray(lines))


def _number(where: str, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in cell:  # Python reads 1_000 as a number, other programs do not
        found = quote_value(cell) if cell.strip() else "an empty cell"
        raise LogError(f"{where}, column {quote_name(column)}: found {found}, expected a finite number")
    return value
