"""What a file probably is, by its first bytes, and the format that reads it."""

from pathlib import Path
from typing import NamedTuple

from flytrack_env.files import open_file
from flytrack_sysid.log import LogError

NUM_BYTES = 512  # read from the beginning of a file; the last mark is that of a TAR archive, at 257
TAR, TAR_START = b"ustar", 257
TELEMETRY, TELEMETRY_START = (0xFD, 0xFE), 8  # MAVLink's packets, after a time stamp of 8 bytes


class FileKind(NamedTuple):
    """A kind of file in words, and the format of ``import`` that reads it ("" if none does)."""

    name: str
    format: str = ""

    def __str__(self) -> str:
        return f"{self.name} (--format {self.format} reads it)" if self.format else self.name


EMPTY, UNKNOWN = FileKind("an empty file"), FileKind("binary data of no known kind")
TEXT, GZIP = FileKind("text", "csv"), FileKind("a file compressed by gzip")
ZSTD = FileKind("a file compressed by zstd")
KINDS: dict[bytes, FileKind] = {
    b"ULog\x01\x12\x35": FileKind("a PX4 log (ULog)", "ulog"),
    b"H Product:Blackbox": FileKind("a blackbox log", "betaflight"),
    b"\xa3\x95": FileKind("an ArduPilot log (DataFlash)", "dataflash"),
    b"\xbc\x01\x00": FileKind("a Crazyflie uSD log", "usd"),
    b"\xbc\x02\x00": FileKind("a Crazyflie uSD log", "usd"),
    b"\x89MCAP": FileKind("an MCAP file", "bag"),
    b"#ROSBAG": FileKind("a ROS 1 bag", "bag"),
    b"SQLite format 3": FileKind("an SQLite file, as in the folder of a ROS 2 bag", "bag"),
    b"FMT, 128": FileKind("an ArduPilot log as text, made of a .bin file"),
    b"\x1f\x8b": GZIP,
    b"\x28\xb5\x2f\xfd": ZSTD,
    b"BZh": FileKind("a file compressed by bzip2"),
    b"\xfd7zXZ": FileKind("a file compressed by xz"),
    b"7z\xbc\xaf": FileKind("a 7-Zip archive"),
    b"PK\x03\x04": FileKind("a ZIP archive; .npz files are such, too"),
    b"\x93NUMPY": FileKind("a NumPy array (.npy)"),
    b"\x89HDF": FileKind("an HDF5 file"),
    b"MATLAB 5.0": FileKind("a MATLAB file"),
    b"PAR1": FileKind("a Parquet file"),
    b"\x89PNG": FileKind("a PNG picture"),
    b"\xff\xd8\xff": FileKind("a JPEG picture"),
    b"%PDF": FileKind("a PDF document"),
    b"\x80\x04": FileKind("a Python pickle"),
    b"\x80\x05": FileKind("a Python pickle"),
    b"\x7fELF": FileKind("a program"),
}


def identify(content: bytes) -> FileKind:
    """Return what a file probably is.

    Args:
        content: its first ``NUM_BYTES`` bytes, or all if it has fewer.
    """
    if not content:
        return EMPTY
    for first, kind in KINDS.items():
        if content.startswith(first):
            return kind
    if content[TAR_START:].startswith(TAR):
        return FileKind("a TAR archive")
    try:
        text = content.decode("utf-8-sig", errors="strict")
    except UnicodeDecodeError as error:
        is_cut_letter = error.start > len(content) - 4
        text = content[: error.start].decode() if is_cut_letter else "\0"
    if all(letter.isprintable() or letter.isspace() for letter in text):
        return TEXT
    if len(content) > TELEMETRY_START and content[TELEMETRY_START] in TELEMETRY:
        return FileKind("MAVLink telemetry (.tlog); the log on the vehicle has faster rates")
    return UNKNOWN


def check_kind(path: Path, format: str, expected: str, allowed: tuple[FileKind, ...]) -> None:
    """Raise LogError for a file of another kind than a format reads.

    Args:
        path: of the file; one that cannot be opened is accepted here, and its reader reports it.
        format: of ``import``.
        expected: kinds of files in words.
        allowed: other kinds that the format reads, or refuses with a better reason.
    """
    try:
        with open_file(path, path.stat().st_size) as file:
            kind = identify(file.read(NUM_BYTES))
    except OSError:
        return
    if kind.format != format and kind not in allowed:
        raise LogError(f"{path}: found {kind}, expected {expected}")
