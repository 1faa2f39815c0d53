"""Decoders of other programs' logs: pyulog and orangebox, run by ``flytrack_env.sandbox``.

A small file can make either of them run forever or exhaust the memory (an interval of 0; arrays of arrays).
This file is imported alone there, so it imports nothing of this package. A decoder takes its arguments, the
path first, and returns an ``.npz`` of notes (JSON) and arrays.
"""

import io
import json
import logging
import math
from array import array
from typing import Any

import numpy as np

MAIN_FRAME = "I"  # of Betaflight: the frame type whose fields the others repeat


def _pack(notes: Any, arrays: list[np.ndarray]) -> bytes:
    content = io.BytesIO()
    np.savez(content, np.frombuffer(json.dumps(notes).encode(), np.uint8), *arrays, allow_pickle=False)
    return content.getvalue()


def decode_ulog(arguments: Any, _: bytes) -> bytes:
    """Return fields of the first instances of a PX4 log's topics.

    arguments: path, and the wanted fields by topic. The arrays are float64, (num_rows,). The notes have their
    topics and fields (``fields``), ``parameters`` (finite numbers) and ``is_damaged``.
    """
    import pyulog

    path, wanted = arguments
    with open(path, "rb") as file:
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
    return _pack(notes, list(found.values()))


def decode_betaflight(arguments: Any, _: bytes) -> bytes:
    """Return the main frames of a blackbox file's logs, (num_frames, num_fields) float64 each.

    arguments: path, number of logs. The notes have each log's ``headers`` and the fields' ``names``.
    """
    import orangebox

    path, num_logs = arguments
    logging.getLogger("orangebox").setLevel(logging.CRITICAL)  # it warns of events that it does not know
    notes, arrays = [], []
    for number in range(1, num_logs + 1):
        parser = orangebox.Parser.load(path, number)
        main = next(fields for kind, fields in parser.reader.field_defs.items() if kind.value == MAIN_FRAME)
        names = [str(field.name) for field in main]
        values = array("d")
        for frame in parser.frames():
            if len(frame.data) < len(names):
                raise ValueError(f"found a frame of {len(frame.data)} fields, expected {len(names)}")
            values.extend(frame.data[: len(names)])
        notes.append({"headers": parser.headers, "names": names})
        arrays.append(np.array(values, float).reshape(-1, len(names)))
    return _pack(notes, arrays)
