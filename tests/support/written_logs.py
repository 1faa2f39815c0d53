"""Random logs, and their columns in files, right or wrong."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from flytrack_sysid import load_log, save_log
from flytrack_sysid.log import CHANNELS, FlightLog

MAPPINGS = Path(__file__).with_name("mappings")
SUFFIXES = (".npz", ".csv")
NUM_ROWS = 6


def read_mapping(name):
    """Return the text of a mapping of a file that a test writes."""
    return (MAPPINGS / f"{name}.toml").read_text(encoding="utf-8")


def make_log(seed=0, num_rows=NUM_ROWS, names=tuple(CHANNELS)):
    """Return a log of random numbers in two segments that every check of a file passes."""
    rng = np.random.default_rng(seed)
    channels = {name: rng.standard_normal((num_rows, len(CHANNELS[name]))) for name in names}
    for name in ("u", "sticks") if "sticks" in names else ("u",):
        channels[name] = rng.uniform(-1.0, 1.0, (num_rows, 4))
    if "q" in channels:
        channels["q"] /= np.linalg.norm(channels["q"], axis=1, keepdims=True)
    segment = np.where(np.arange(num_rows) < num_rows // 2, 7, -2)
    return FlightLog(np.cumsum(rng.uniform(1e-3, 0.1, num_rows)), channels, segment)


def with_channels(log, **channels):
    """Return a log with some channels replaced."""
    return replace(log, channels={**log.channels, **channels})


def held_still(log, names):
    """Return a log of which some channels stay as they are in its first row."""
    return with_channels(
        log, **{name: np.repeat(log[name][:1], len(log), axis=0) for name in names}
    )


def columns_of(log):
    """Return the columns of a log's file, by name."""
    columns = {"t": log.time.copy(), "segment": log.segment.copy()}
    for name, values in log.channels.items():
        columns |= {column: values[:, i].copy() for i, column in enumerate(CHANNELS[name])}
    return columns


def write(path, columns):
    """Write columns as they are, right or wrong."""
    if path.suffix == ".npz":
        np.savez(path, **columns)
        return
    rows = zip(*(np.asarray(values).tolist() for values in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def npy_bytes(array):
    """Return one array as a file."""
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def npz_bytes(arrays):
    """Return arrays as a compressed archive."""
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def through_file(log, path):
    """Return a log as its file has it."""
    save_log(path, log)
    return load_log(path)


def assert_same_log(found, expected):
    np.testing.assert_array_equal(found.time, expected.time)
    np.testing.assert_array_equal(found.segment, expected.segment)
    assert set(found.channels) == set(expected.channels)
    for name, values in expected.channels.items():
        assert found[name].dtype == np.float64
        if name == "q":
            np.testing.assert_allclose(found[name], values, atol=1e-15, rtol=0)
        else:
            np.testing.assert_array_equal(found[name], values, err_msg=name)
