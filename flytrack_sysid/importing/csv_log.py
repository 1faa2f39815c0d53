"""CSV logs of any source, read by a mapping file."""

from pathlib import Path

from flytrack_sysid.csv_file import open_csv, read_columns
from flytrack_sysid.importing.flight import ImportedFlight
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.importing.table_flight import channels_in, flight_of_table
from flytrack_sysid.log import LogError


def read_csv(path: Path, mapping: Mapping) -> ImportedFlight:
    """Return the flight in a CSV file with a header, by a mapping; SI units and our frames.

    Raises LogError, whose message names file, row, line and column.
    """
    with open_csv(path, mapping.delimiter) as rows:
        header = [name.strip() for name in next(rows, [])]
        channels = channels_in(str(path), [header], mapping)
        wanted = dict.fromkeys(column for channel, _ in channels for column in channel.columns)
        table = read_columns(path, rows, header, wanted)
    if table.lines is None or not len(table.lines):
        raise LogError(f"{path}: found no rows, expected at least one")
    return flight_of_table(table, mapping)
