"""Decoding other people's logs by other people's packages: pyulog, orangebox.

A small file can make either of them run for ever or eat all memory (an interval of 0; arrays of arrays), so
they work in a process of their own (``decoding.py``). This file is read there alone: it imports nothing of
this package, and of the two what is installed.
"""

import contextlib
import io
import json
import logging
import math
from array import array
from pathlib import Path
from typing import Any

import numpy as np

with contextlib.suppress(ImportError):
    import orangebox
with contextlib.suppress(ImportError):
    import pyulog

MAIN_FRAME = "I"  # of Betaflight: frame type whose fields the others repeat


def decode(argument: Any, _: bytes) -> bytes:
    """Return what a file holds, packed; argument: format, path, and what the format's function takes."""
    format_name, path, *rest = argument
    found: bytes = globals()[f"decode_{format_name}"](Path(path), *rest)
    return found


def pack(notes: Any, arrays: list[np.ndarray]) -> bytes:
    """Return JSON values and arrays as the bytes of an ``.npz``."""
    content = io.BytesIO()
    np.savez(content, np.frombuffer(json.dumps(notes).encode(), np.uint8), *arrays, allow_pickle=False)
    return content.getvalue()


def decode_ulog(path: Path, wanted: dict[str, list[str]]) -> bytes:
    """Return fields of a PX4 log's topics, their first instances.

    wanted: fields by topic. The arrays are float64, (num_rows,); their topics and fields are in the notes
    (``fields``), with ``parameters`` (finite numbers) and ``is_damaged``.
    """
    with path.open("rb") as file:
        ulog = pyulog.ULog(file, list(wanted))
    found = {
        (data.name, field): data.data[field].astype(float)
        for data in ulog.data_list
        if data.multi_id == 0
        for field in wanted.get(data.name, ())
        if field in data.data
    }
    parameters = {
        name: value
        for name, value in ulog.initial_parameters.items()
        if isinstance(value, (int, float)) and math.isfinite(value)
    }
    notes = {"fields": list(found), "parameters": parameters, "is_damaged": bool(ulog.file_corruption)}
    return pack(notes, list(found.values()))


def decode_betaflight(path: Path, num_logs: int) -> bytes:
    """Return the main frames of a blackbox file's logs, (num_frames, num_fields) float64 each.

    The notes have, for each, ``headers`` and ``names``: of the fields.
    """
    logging.getLogger("orangebox").setLevel(logging.CRITICAL)  # it warns of events that it does not know
    notes, arrays = [], []
    for number in range(1, num_logs + 1):
        parser = orangebox.Parser.load(str(path), number)
        fields = parser.reader.field_defs
        names = [
            str(field.name) for field in next(fields[kind] for kind in fields if kind.value == MAIN_FRAME)
        ]
        values = array("d")
        for frame in parser.frames():
            if len(frame.data) < len(names):
                raise ValueError(f"found a frame of {len(frame.data)} fields, expected {len(names)}")
            values.extend(frame.data[: len(names)])
        notes.append({"headers": parser.headers, "names": names})
        arrays.append(np.array(values, float).reshape(-1, len(names)))
    return pack(notes, arrays)
