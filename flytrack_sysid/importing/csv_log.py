"""CSV logs of any source, read by a mapping file."""

from pathlib import Path

import numpy as np

from flytrack_env.messages import quote_name
from flytrack_sysid.csv_file import open_csv, read_columns
from flytrack_sysid.importing.flight import ImportedFlight
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.log import CHANNELS, LogError
from flytrack_sysid.log_table import log_of_table

LONGEST_LIST = 1000  # characters of a header in a message


def read_csv(path: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a CSV file with a header, by a mapping; SI units and our frames.

    Raises LogError, whose message names file, row, line and column.
    """
    if not mapping.channels:
        raise LogError(f"{path}: {mapping.source} names no columns; a CSV file needs [time] and [command]")
    wanted = {column: channel.table for channel in mapping.channels for column in channel.columns}
    with open_csv(path, mapping.delimiter) as rows:
        header = [name.strip() for name in next(rows, [])]
        for name, table_name in wanted.items():
            if header.count(name) != 1:
                listed = ", ".join(map(quote_name, header))[:LONGEST_LIST]
                found = f"found {header.count(name)} times among {listed}"
                expected = f"expected once by {mapping.source}: {table_name}"
                raise LogError(f"{path}: column {quote_name(name)}: {found}; {expected}")
        table = read_columns(path, rows, header, wanted)
    if table.lines is None or not len(table.lines):
        raise LogError(f"{path}: found no rows, expected at least one")
    values: dict[str, np.ndarray] = {}
    for channel in mapping.channels:
        names = CHANNELS.get(channel.name, (channel.name,))
        values |= dict(zip(names, channel.convert(table).T, strict=True))
    return ImportedFlight(log_of_table(table._replace(columns=values)), mapping.craft)
