"""CSV logs of any source, read by a mapping file; gzip-compressed ones too."""

import contextlib
import csv
import gzip
import io
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from flytrack_env.files import open_file
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_sysid.importing.flight import ImportedFlight
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.log import CHANNELS, LogError
from flytrack_sysid.log_file import LARGEST_BYTES
from flytrack_sysid.log_table import CsvRows, Rows, Table, log_of_table

PACKED_BYTES, LARGEST_RATIO = 2**24, 32  # characters in a compressed file: that, or as many times its bytes
LONGEST_LIST = 1000  # characters of a header in a message


def read_csv(path: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a CSV file with a header, by a mapping; SI units and our frames.

    Raises:
        LogError: a mapping without columns; a file that cannot be read; a missing column; a cell that is no
            number, or a value that no log can have. The message names file, row, line and column.
    """
    if not mapping.channels:
        raise LogError(f"{path}: {mapping.source} names no columns; a CSV file needs [time] and [command]")
    with _open_rows(path, mapping.delimiter) as rows:
        table = _read_table(path, rows, mapping)
    values: dict[str, np.ndarray] = {}
    for channel in mapping.channels:
        names = CHANNELS.get(channel.name, (channel.name,))
        values |= dict(zip(names, channel.convert(table).T, strict=True))
    return ImportedFlight(log_of_table(table._replace(columns=values)), mapping.craft)


@contextlib.contextmanager
def _open_rows(path: Path, delimiter: str) -> Iterator[CsvRows]:
    """Yield the rows of a file, unpacked if its name ends in .gz; errors while reading become LogErrors."""
    try:
        with open_file(path, LARGEST_BYTES) as file:
            stream, most_characters = file, LARGEST_BYTES
            if path.suffix == ".gz":
                most_characters = min(LARGEST_BYTES, max(PACKED_BYTES, LARGEST_RATIO * path.stat().st_size))
                stream = cast(BinaryIO, gzip.GzipFile(fileobj=file))
            rows = CsvRows(
                io.TextIOWrapper(stream, encoding="utf-8-sig", newline=""), delimiter, most_characters
            )
            try:
                yield rows
            except csv.Error as error:
                found = f"near line {rows.line_num + 1}: not a CSV file: {error_text(error)}"
                raise LogError(f"{path}: {found}") from error
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise LogError(f"{path}: cannot be read as text: {error_text(error)}") from error


def _read_table(path: Path, lines: CsvRows, mapping: Mapping) -> Table:
    """Return the columns that the mapping names, in the units of the file."""
    header = [name.strip() for name in next(lines, [])]
    wanted = {column: channel.table for channel in mapping.channels for column in channel.columns}
    for name, table in wanted.items():
        count = header.count(name)
        if count != 1:
            found = f"found {count} times among {', '.join(map(quote_name, header))[:LONGEST_LIST]}"
            expected = f"expected once by {mapping.source}: {table}"
            raise LogError(f"{path}: column {quote_name(name)}: {found}; {expected}")
    places = [header.index(name) for name in wanted]
    rows = Rows(str(path), list(wanted))
    for cells in filter(None, lines):  # blank lines have no cells
        where = f"{path}: row {len(rows)} (line {lines.line_num})"
        if len(cells) != len(header):
            raise LogError(f"{where}: found {len(cells)} cells, expected {len(header)} as in the header")
        rows.add([_number(where, header[place], cells[place]) for place in places], lines.line_num)
    if not len(rows):
        raise LogError(f"{path}: found no rows, expected at least one")
    return rows.table()


def _number(where: str, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        found = quote_value(cell) if cell.strip() else "an empty cell"
        raise LogError(f"{where}, column {quote_name(column)}: found {found}, expected a finite number")
    return value
