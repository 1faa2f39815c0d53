"""What a training survives: kills, full and read-only disks, a dead tracking server, damaged checkpoints."""

import logging
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.resume import newest_intact
from baselines.purejaxrl_ppo.run_folder import FINAL, checkpoints_in
from benchmarks.flown import ROOT
from benchmarks.reliability.section import Section

KILLS, DAMAGES, UPDATES = 50, 2_000, 12_000
BATCH, EVERY = 16 * 24, 20  # steps of an update, updates between checkpoints
LONGEST_LIFE_S = 0.5  # of a process after its first new checkpoint
TIMEOUT_S = 600.0
DEAD_URI = "http://127.0.0.1:9"  # the port at which nothing listens
SMALL = "--num-envs 16 --num-steps 24 --num-minibatches 4 --hidden-sizes 8 --evaluate-every 0 --seed 3"


def command(out: Path, updates: int, *flags: Any) -> list[str]:
    """Return the command of a training of so many updates."""
    asked = flags or ("--env-id", "FlyTrackRobust-v0", *SMALL.split())
    steps = ("--total-timesteps", updates * BATCH, "--checkpoint-every", EVERY * BATCH)
    module = "baselines.purejaxrl_ppo.train_ppo"
    return [sys.executable, "-m", module, "--out", str(out), *map(str, (*asked, *(() if flags else steps)))]


def start(folder: Path, *arguments: Any) -> subprocess.Popen[str]:
    """Start a training; what it compiles is kept in the folder, for the next."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"), "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(
        command(*arguments),
        cwd=ROOT,
        env={**os.environ, **cache},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Return how a process ended, and what it said."""
    said = process.communicate(timeout=TIMEOUT_S)[1]
    return process.returncode, said


def are_equal(one: Path, other: Path) -> bool:
    """Return whether two checkpoints have the same arrays, bit for bit."""
    found, wanted = load_checkpoint(one), load_checkpoint(other)
    both = (found.training or {}, wanted.training or {})
    import jax

    leaves = [jax.tree.leaves(checkpoint.params) for checkpoint in (found, wanted)]
    pairs = [*zip(*leaves, strict=True), *((both[0].get(name), array) for name, array in both[1].items())]
    return both[0].keys() == both[1].keys() and all(a.tobytes() == b.tobytes() for a, b in pairs)


def half_written(out: Path) -> set[Path]:
    """Return the files of a folder that were being written."""
    return set(out.glob(".*.msgpack.*"))


def kill_once(process: subprocess.Popen[str], out: Path, rng: random.Random) -> bool:
    """Kill a training: some as it writes, the others at any time; return whether it lived to be killed."""
    before, is_at_write = set(checkpoints_in(out)), rng.random() < 0.5
    old = half_written(out)
    while process.poll() is None and set(checkpoints_in(out)) == before:
        time.sleep(0.001)
    until = time.monotonic() + rng.uniform(0.0, LONGEST_LIFE_S)
    while process.poll() is None and time.monotonic() < until:
        time.sleep(0.0002)
    while is_at_write and process.poll() is None and half_written(out) <= old:
        pass
    process.send_signal(signal.SIGKILL)
    return ended(process)[0] == -signal.SIGKILL


def kills(folder: Path, number: int, updates: int, rng: random.Random) -> dict[str, Any]:
    """Kill a training again and again; compare its end with that of one that was left alone."""
    code, said = ended(start(folder, folder / "whole", updates))
    if code:
        raise RuntimeError(said)
    found = {"kills": 0, "while writing": 0, "checkpoints lost": 0, "runs": 0, "runs that end otherwise": 0}
    bar = tqdm(total=number, unit="kill")
    while found["kills"] < number:
        out = folder / f"killed{found['runs']}"
        process = start(folder, out, updates)
        while found["kills"] < number:
            known = set(checkpoints_in(out))
            if not kill_once(process, out, rng):
                break
            found["kills"] += 1
            bar.update()
            found["while writing"] += bool(half_written(out))
            found["checkpoints lost"] += len(lost(known | set(checkpoints_in(out)), out))
            process = start(folder, out, updates, "--resume", out)
        code, said = ended(process)
        is_same = code == 0 and are_equal(out / FINAL, folder / "whole" / FINAL)
        found["runs"] += 1
        found["runs that end otherwise"] += not is_same
        if not is_same:
            print(said[-1000:])
    bar.close()
    return found


def lost(known: set[Path], out: Path) -> list[Path]:
    """Return those checkpoints that are not there any more, or cannot be loaded."""
    broken = [path for path in known if not path.exists()]
    for path in checkpoints_in(out)[:2]:  # the others are older than any process that was killed
        try:
            load_checkpoint(path)
        except CheckpointError:
            broken.append(path)
    return broken


def damages(folder: Path, number: int, rng: random.Random) -> dict[str, Any]:
    """Damage the newest checkpoint in many ways; the one before it has to be taken, and a message said."""
    out = folder / "damaged"
    out.mkdir()
    newer, older = checkpoints_in(folder / "whole")[1:3]
    content = newer.read_bytes()
    (out / older.name).write_bytes(older.read_bytes())
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("baselines.purejaxrl_ppo.resume")
    logger.addHandler(handler)
    logger.propagate = False
    wrong = 0
    for _ in tqdm(range(number), unit="damage"):
        said.clear()
        (out / newer.name).write_bytes(damaged(content, rng))
        path, _ = newest_intact(out)
        is_told = any(newer.name in line and "the checkpoint before it is used" in line for line in said)
        wrong += path.name != older.name or not is_told
    logger.removeHandler(handler)
    logger.propagate = True
    return {"damages": number, "not recognised": wrong}


def damaged(content: bytes, rng: random.Random) -> bytes:
    """Return the bytes of a file cut off, or with one bit changed."""
    if rng.random() < 0.5:
        return content[: rng.randrange(len(content))]
    changed = bytearray(content)
    changed[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return bytes(changed)


@contextmanager
def mounted(folder: Path, options: str) -> Iterator[Path]:
    """Mount a file system of its own on a folder; needs the rights to.

    Raises:
        PermissionError: not allowed here.
    """
    folder.mkdir(parents=True)
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True)
    if done.returncode:
        raise PermissionError(done.stderr.decode().strip())
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def full_disk(folder: Path, updates: int) -> str:
    """Train onto a disk that fills up; return what is broken, or nothing."""
    size = sum(path.stat().st_size for path in checkpoints_in(folder / "whole")) // 2
    flags = ("--env-id", "FlyTrackRobust-v0", *SMALL.split(), "--total-timesteps", updates * BATCH)
    flags += ("--checkpoint-every", EVERY * BATCH, "--no-tracking")
    with mounted(folder / "full", f"size={size // 1024}k") as disk:
        code, said = ended(start(folder, disk / "run", updates, *flags))
        if code != 1 or "No space left on device" not in said or "Traceback" in said:
            return f"exit {code}: {said[-300:]}"
        if half_written(disk / "run"):
            return "a half-written file was left"
        newest_intact(disk / "run")
        subprocess.run(["mount", "-o", "remount,size=100m", str(disk)], check=True)
        code, said = ended(start(folder, disk / "run", updates, "--resume", disk / "run"))
        is_same = code == 0 and are_equal(disk / "run" / FINAL, folder / "whole" / FINAL)
        return "" if is_same else f"resumed otherwise: {said[-300:]}"


def read_only_disk(folder: Path, updates: int) -> str:
    """Train into a folder that cannot be written; return what is broken, or nothing."""
    with mounted(folder / "read_only", "ro") as disk:
        code, said = ended(start(folder, disk / "run", updates))
        is_clear = code == 1 and "Read-only file system" in said and str(disk) in said
        return "" if is_clear and "Traceback" not in said else f"exit {code}: {said[-300:]}"


def dead_server(folder: Path, updates: int) -> str:
    """Train with a tracking server that does not answer; return what is broken, or nothing."""
    out = folder / "untold"
    flags = ("--env-id", "FlyTrackRobust-v0", *SMALL.split(), "--total-timesteps", updates * BATCH)
    tracking = ("--checkpoint-every", EVERY * BATCH, "--tracking-uri", DEAD_URI)
    code, said = ended(start(folder, out, updates, *flags, *tracking))
    if code or "Training goes on" not in said:
        return f"exit {code}: {said[-300:]}"
    return "" if are_equal(out / FINAL, folder / "whole" / FINAL) else "another end"


def attempt(what: Any, folder: Path, updates: int) -> str:
    """Return "as promised", what is broken, or why it could not be tried."""
    try:
        return what(folder, updates) or "as promised"
    except PermissionError as error:
        return f"not tried: {error}"


def measure(seed: int, share: float, folder: Path) -> dict[str, Any]:
    """Return what came of kills, damages and faults of disk and server."""
    rng = random.Random(seed)
    updates = max(8 * EVERY, round(UPDATES * share))
    result: dict[str, Any] = {"updates": updates, **kills(folder, max(2, round(KILLS * share)), updates, rng)}
    result |= damages(folder, max(20, round(DAMAGES * share)), rng)
    few = min(updates, 40 * EVERY)
    if few != updates:
        (folder / "whole").rename(folder / "long")
        code, said = ended(start(folder, folder / "whole", few))
        if code:
            raise RuntimeError(said)
    result["full disk"] = attempt(full_disk, folder, few)
    result["read-only folder"] = attempt(read_only_disk, folder, few)
    result["tracking server down"] = attempt(dead_server, folder, few)
    return result


def as_markdown(result: dict[str, Any]) -> str:
    """Return what came of it as a table."""
    rows = [
        (
            "SIGKILL at random moments, resumed each time",
            f"{result['kills']} kills; trainings: {result['runs']}, of {result['updates']:,} updates; "
            f"{result['while writing']} of the kills while a checkpoint was written",
            f"{result['checkpoints lost']} checkpoints lost, {result['runs that end otherwise']} trainings "
            "end in other bits than one left alone",
        ),
        (
            "newest checkpoint cut off, or one bit changed",
            f"{result['damages']} times",
            f"{result['not recognised']} not recognised; else the one before is used, and a message says so",
        ),
        ("disk full", "filled up by checkpoints; made larger, and resumed", result["full disk"]),
        ("read-only folder", "", result["read-only folder"]),
        ("tracking server down", DEAD_URI, result["tracking server down"]),
    ]
    lines = ["| fault | tried | found |", "|---|---|---|", *(f"| {' | '.join(row)} |" for row in rows)]
    return "\n".join(lines) + "\n"


def is_held(result: dict[str, Any]) -> bool:
    """Return whether nothing was lost, and everything was said."""
    broken = ("checkpoints lost", "runs that end otherwise", "not recognised")
    faults = ("full disk", "read-only folder", "tracking server down")
    told = all(result[name] == "as promised" or result[name].startswith("not tried") for name in faults)
    return told and not any(result[name] for name in broken)


SECTION = Section("training", "Training", measure, as_markdown, is_held)
