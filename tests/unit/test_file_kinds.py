"""Files of other kinds are named, with the format that reads them."""

import gzip
import io
import pickle
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing.file_kinds import identify
from flytrack_sysid.importing.importer import FORMATS
from tests.support import foreign_logs
from tests.support.written_logs import read_mapping


def packed(write) -> bytes:
    content = io.BytesIO()
    write(content)
    return content.getvalue()


def tar(content: io.BytesIO) -> None:
    with tarfile.open(fileobj=content, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("a"), io.BytesIO())


LOGS = {
    "ulog": foreign_logs.ulog(),
    "betaflight": foreign_logs.betaflight(),
    "dataflash": foreign_logs.small_dataflash(np.arange(30.0)),
    "usd": foreign_logs.usd(),
    "bag": b"\x89MCAP0\r\n",
    "csv": foreign_logs.foreign_csv(),
}
OTHERS = {
    "gzip": gzip.compress(b"a,b"),
    "ZIP": packed(lambda content: zipfile.ZipFile(content, "w").writestr("a", "b")),
    "NumPy": packed(lambda content: np.save(content, np.zeros(3))),
    "TAR": packed(tar),
    "pickle": pickle.dumps([1.0]),
    "PDF": b"%PDF-1.7\n%\xe2\xe3",
    "PNG": b"\x89PNG\r\n\x1a\n",
    "HDF5": b"\x89HDF\r\n\x1a\n",
    "empty": b"",
    "MAVLink": bytes(8) + b"\xfd\x09\x00\x00",
    "no known kind": b"\x00\xff\x10\x80" * 9,
    "text": "Größe, Maße\n".encode() * 60,
}


def test_every_format_is_recognised() -> None:
    assert {format: identify(content).format for format, content in LOGS.items()} == {
        name: name for name in FORMATS
    }


@pytest.mark.parametrize("kind", OTHERS)
def test_other_kinds_are_named(kind: str) -> None:
    assert kind in str(identify(OTHERS[kind][:512]))


@pytest.mark.parametrize("format", FORMATS)
def test_logs_of_other_formats_are_refused_with_the_format_that_reads_them(
    format: str, tmp_path: Path
) -> None:
    (tmp_path / "map.toml").write_text(read_mapping("bag" if format == "bag" else "csv"))
    path = tmp_path / "flight"
    for other in set(LOGS) - {format}:
        path.write_bytes(LOGS[other])
        with pytest.raises(
            LogError, match=rf"flight: found .* \(--format {other} reads it\), expected "
        ):
            import_log(path, format, tmp_path / "map.toml")
