"""Files from strangers, damaged at random and on purpose: they load as they should, or are refused."""

from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.reliability.section import Section
from benchmarks.reliability.strangers.kinds import KINDS
from benchmarks.reliability.strangers.pool import measure_kind

FILES_PER_KIND = 10_000
TITLES = {
    "track": "track (`.toml`)",
    "model": "model file (`.json`)",
    "rollout": "rollout (`.npy`)",
    "log_npz": "flight log (`.npz`)",
    "log_csv": "flight log (`.csv`)",
    "script": "script (`.npz`)",
    "reference": "reference (`.npz`)",
    "mapping": "mapping of an import (`.toml`)",
    "import_csv": "import of a CSV log",
    "import_gz": "import of a compressed CSV log",
    "ulog": "import of a PX4 log (`.ulg`)",
    "betaflight": "import of a Betaflight log (`.bbl`)",
    "settings": "settings of a training (`.toml`)",
    "checkpoint": "checkpoint (`.msgpack`)",
    "resume": "checkpoint that a training is resumed from",
    "black_box": "black box (`acro_step.bin`)",
}
TEXT = """Files of every kind that is read, written by the package itself. Most, up to 1 MiB or so, are
damaged at random: bits, bytes and blocks changed, left out, repeated and mixed; values, types, names,
shapes and sizes inside that are odd, huge, missing or no numbers; pickles. Others are made on purpose to
do harm, up to 50 MB: text without end, or nested very deeply; archives that unpack to gigabytes, that lie
about what is in them or hold it twice, encrypted or elsewhere; gzip files of half a million parts; maps
and lists that take a hundred times their length; arrays of other sizes than they say; logs of headers and
formats that lie, recur or are thousands, of clocks that jump by days, of attitudes that are zero;
descriptions of other trainings; programs that never end, take all memory, call what they may not, or are
of another kind than they say. Each is loaded in a process that may use 5 s of processor time and 1 GiB of
memory more than it had, and whose writing of files, processes, sockets, unpickling and running of code
are watched. Two outcomes are promised: a load that is sound, or the documented error, with a message that
can be read and names the file. What the loaders do for that: [files from strangers](../strangers.md).

"""


def measure(seed: int, share: float, folder: Path) -> dict[str, Any]:
    """Return what came of every kind's files: a share of 10,000 of each."""
    count = max(round(share * FILES_PER_KIND), 1)
    found = {}
    with tqdm(total=count * len(KINDS), unit="file") as bar:
        for kind in KINDS:
            bar.set_description(kind)
            found[kind] = measure_kind(kind, seed, count, folder, bar.update)
    return {"seed": seed, "kinds": found}


def as_markdown(result: dict[str, Any]) -> str:
    """Return a table of all kinds, and examples of what broke the promise."""
    lines = [
        "| kind of file | files | made on purpose | loaded | refused | promise broken | slowest, CPU s |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    broken = []
    for name, found in result["kinds"].items():
        number = sum(found["broken"].values())
        said = f"{number}, then the measurement failed" if found["failure"] else number
        lines.append(
            f"| {TITLES[name]} | {found['files']} | {found['crafted']} | {found['loaded']} | "
            f"{found['refused']} | {said} | {found['slowest_s']:g} |"
        )
        broken += [
            f"- {TITLES[name]}, number {one['number']}: {one['sort']}: `{one['text']}`"
            for one in found["examples"]
        ]
        if found["failure"]:
            broken.append(f"- {TITLES[name]}: the measurement failed: `{' '.join(found['failure'].split())}`")
    if broken:
        lines += ["", f"Broken promises, seed {result['seed']}:", "", *broken]
    return TEXT + "\n".join(lines) + "\n"


def is_held(result: dict[str, Any]) -> bool:
    """Return whether no file broke the promise, and all were judged."""
    return not any(found["broken"] or found["failure"] for found in result["kinds"].values())


SECTION = Section("files", "Files from strangers", measure, as_markdown, is_held)
