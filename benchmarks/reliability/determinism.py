"""Determinism: the same training again and again, in fresh processes, under what may differ between them.

Every run is a process of its own, ``python -m benchmarks.reliability.determinism FOLDER SETTINGS``, which
trains one seed; what is compared is every array of its final checkpoint, byte by byte: parameters, optimiser,
environments, random keys. Where the same bytes are promised, another byte is a failure.
"""

import dataclasses
import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.config import config_from_json
from baselines.purejaxrl_ppo.named_arrays import as_named_arrays
from baselines.purejaxrl_ppo.options import Options
from baselines.purejaxrl_ppo.run_folder import FINAL
from baselines.purejaxrl_ppo.tracking import local_uri
from baselines.purejaxrl_ppo.training import Trainer, train_policy
from benchmarks.flown import ROOT
from benchmarks.reliability.section import Section

NUM_UPDATES = 8
ENV_ID = "FlyTrackRobust-v0"  # with the most state, and the most random draws
TIMEOUT_S = 900
LONGEST_ERROR = 2000  # characters
TWO_DEVICES = "--xla_force_host_platform_device_count=2"
REFERENCE, WATCHED, ONE_CORE = "the run that others are compared with", "watched", "one core"


class Condition(NamedTuple):
    """A run, and what differs between it and the run that it is compared with.

    is_promised: whether the same bytes are. against: the other run. variables: of the process. xla_flag:
    beside those that are set. cores: that it may use; None: all. how: "alone", "watched" with all that the
    command does beside training, "resumed" from the middle of the watched run, or "beside" another seed.
    """

    name: str
    is_promised: bool
    against: str = REFERENCE
    variables: tuple[tuple[str, str], ...] = ()
    xla_flag: str = ""
    cores: int | None = None
    how: str = "alone"


CONDITIONS = (
    Condition(REFERENCE, True),
    Condition("the same again, Python's hash seed another", True, variables=(("PYTHONHASHSEED", "1"),)),
    Condition(WATCHED, True, how="watched"),
    Condition("cut off in the middle and gone on with, in another process", True, how="resumed"),
    Condition(ONE_CORE, False, cores=1),
    Condition("one core, the same again", True, against=ONE_CORE, cores=1),
    Condition("beside another seed, in one program", False, how="beside"),
    Condition("two devices on the host, one used", False, xla_flag=TWO_DEVICES),
    Condition("instructions up to AVX2", False, xla_flag="--xla_cpu_max_isa=AVX2"),
    Condition("instructions up to SSE4.2", False, xla_flag="--xla_cpu_max_isa=SSE4_2"),
)


# --- In the process of a run ------------------------------------------------------------------------


def options_of(how: str, config: Config, folder: Path) -> Options:
    """Return what a run does beside training."""
    middle = config.num_updates // 2 * config.batch_size
    if how == "resumed":
        return Options(resume=next(folder.glob("resumed_*.msgpack")))
    if how != "watched":
        return Options()
    return Options(checkpoint_every=middle, evaluate_every=middle, tracking_uri=local_uri(folder))


def train(folder: Path, config: Config, seed: int, how: str) -> None:
    """Train into folder/run, as a process of its own does."""
    out = folder / "run"
    if how == "beside":
        trainer = Trainer(config, ENV_ID)
        trainer.train_all([(out, seed, Options()), (folder / "other", seed + 1, Options())])
    else:
        train_policy(out, config, seed, ENV_ID, options_of(how, config, folder))


# --- Around it --------------------------------------------------------------------------------------


Arrays = dict[str, np.ndarray]


def run(condition: Condition, config: Config, seed: int, folder: Path, watched: Path) -> Arrays:
    """Train in a fresh process and return every array of the final checkpoint by its name.

    folder: of this run. watched: of the run that is gone on with where this one is resumed.

    Raises:
        RuntimeError: a process that failed; with the end of what it said.
    """
    folder.mkdir()
    if condition.how == "resumed":
        step = config.num_updates // 2 * config.batch_size
        shutil.copy(watched / "run" / f"step_{step}.msgpack", folder / "resumed_from.msgpack")
    flags = f"{os.environ.get('XLA_FLAGS', '')} {condition.xla_flag}".strip()
    variables = {**os.environ, "PYTHONHASHSEED": "0", "XLA_FLAGS": flags, **dict(condition.variables)}
    settings = json.dumps({"config": dataclasses.asdict(config), "seed": seed, "how": condition.how})
    command = [sys.executable, "-m", __spec__.name, str(folder), settings]
    cores = os.sched_getaffinity(0)
    # A process inherits the cores of the thread that starts it.
    os.sched_setaffinity(0, sorted(cores)[: condition.cores])
    try:
        done = subprocess.run(
            command, env=variables, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    finally:
        os.sched_setaffinity(0, cores)
    if done.returncode:
        end = f"the process ended with {done.returncode}: {done.stderr[-LONGEST_ERROR:]}"
        raise RuntimeError(f"{condition.name}: {end}")
    checkpoint = load_checkpoint(folder / "run" / FINAL)
    params = {f"params.{name}": array for name, array in as_named_arrays(checkpoint.params).items()}
    return {**params, **(checkpoint.training or {})}


def compare(found: Arrays, expected: Arrays) -> dict[str, Any]:
    """Return how many arrays there are, how many differ in any byte, and by how much a parameter at most.

    Raises:
        RuntimeError: arrays of other names, forms or types, which no condition can bring about.
    """
    for name in {**found, **expected}:
        pair = [arrays.get(name) for arrays in (found, expected)]
        forms = [None if array is None else (array.shape, array.dtype) for array in pair]
        if forms[0] != forms[1]:
            raise RuntimeError(f"{name}: found {forms[0]}, expected {forms[1]}")
    differing = [name for name in found if found[name].tobytes() != expected[name].tobytes()]
    params = [name for name in found if name.startswith("params.")]
    farthest = max(float(np.abs(found[name] - expected[name]).max()) for name in params)
    return {"arrays": len(found), "differing": len(differing), "farthest_param": farthest}


def measure_conditions(
    conditions: tuple[Condition, ...], config: Config, seed: int, folder: Path
) -> dict[str, Any]:
    """Train under every condition, the first being the reference; return how the checkpoints compare."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    runs: dict[str, Arrays] = {}
    rows: list[dict[str, Any]] = []
    num_cores = len(os.sched_getaffinity(0))
    folders = {condition.how: folder / f"{i}" for i, condition in reversed([*enumerate(conditions)])}
    for index, condition in enumerate(tqdm(conditions, unit="training")):
        if condition.cores is not None and condition.cores >= num_cores:
            rows.append(condition._asdict())
            continue
        watched = folders.get("watched", folder)
        runs[condition.name] = run(condition, config, seed, folder / f"{index}", watched)
        if condition.name != REFERENCE:
            found = compare(runs[condition.name], runs[condition.against])
            rows.append({**condition._asdict(), **found})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "rows": rows,
        "cores": num_cores,
        "steps": config.num_updates * config.batch_size,
        "cpu_minutes": round(used_s / 60.0, 1),
    }


def measure(seed: int, share: float, folder: Path) -> dict[str, Any]:
    """Train the default recipe under CONDITIONS, NUM_UPDATES updates where the share is 1."""
    updates = max(2, round(share * NUM_UPDATES))
    config = Config(total_timesteps=updates * Config().batch_size)
    return measure_conditions(CONDITIONS, config, seed, folder)


def is_held(result: dict[str, Any]) -> bool:
    """Return whether every checkpoint whose bytes are promised has them."""
    return not any(row["is_promised"] and row.get("differing") for row in result["rows"])


def as_markdown(result: dict[str, Any]) -> str:
    """Return what was promised and what was found."""
    text = (
        f"{ENV_ID}, {result['steps']:,} steps of the default recipe, every run in a fresh process, "
        f"{result['cpu_minutes']:g} minutes of processor time, {result['cores']} cores where it says nothing "
        "else. Compared byte by byte: every array of the final checkpoint, parameters, optimiser, "
        "environments, random keys.\n\n"
        "| what differs | same bytes promised | arrays that differ | farthest parameter |\n"
        "|---|---|---|---|\n"
    )
    for row in result["rows"]:
        promised = "yes" if row["is_promised"] else "no"
        found = "not tried: there are no other cores | "
        if "differing" in row:
            found = f"{row['differing']} of {row['arrays']} | {row['farthest_param']:.2g}"
        text += f"| {row['name']} | {promised} | {found} |\n"
    return text


SECTION = Section("determinism", "Determinism", measure, as_markdown, is_held)

if __name__ == "__main__":
    given = json.loads(sys.argv[2])
    train(Path(sys.argv[1]), config_from_json(given["config"]), given["seed"], given["how"])
