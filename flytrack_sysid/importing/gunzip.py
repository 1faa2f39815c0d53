"""Unpacking gzip files of others in steps of blocks: Python's ``gzip`` takes some of them byte by byte."""

import zlib
from typing import BinaryIO

BLOCK_BYTES = 2**16
MOST_MEMBERS = 20_000  # one after the other in a file: packers that work side by side write one per block
AS_GZIP = 16 + zlib.MAX_WBITS


class Gunzip:
    """What a compressed file unpacks to; what is damaged raises zlib.error, what is cut off EOFError."""

    def __init__(self, file: BinaryIO):
        self._file, self._rest = file, b""
        self._member = zlib.decompressobj(AS_GZIP)
        self._num_members = 1

    def read(self, size: int) -> bytes:
        """Return the next bytes, at most ``size`` (above 0); none at the end."""
        while True:
            part = self._member.decompress(self._rest, size)
            self._rest = self._member.unconsumed_tail
            if part:
                return part
            if self._member.eof:
                if not self._begin_member():
                    return b""
            elif not self._rest and not self._more():
                raise EOFError("found no end of what is compressed: the file is cut off")

    def _more(self) -> bool:
        self._rest = self._file.read(BLOCK_BYTES)
        return bool(self._rest)

    def _begin_member(self) -> bool:
        """Begin what stands behind the last member, after zeros that fill up; return whether there is any."""
        self._rest = self._member.unused_data.lstrip(b"\0")
        while not self._rest:
            if not self._more():
                return False
            self._rest = self._rest.lstrip(b"\0")
        self._num_members += 1
        if self._num_members > MOST_MEMBERS:
            raise zlib.error(f"found more than {MOST_MEMBERS} members, expected at most that")
        self._member = zlib.decompressobj(AS_GZIP)
        return True
