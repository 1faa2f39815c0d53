"""Beyond one machine: ``python -m benchmarks.scaling --part devices|fleet|...|page``.

``devices`` trains on one device, on several, and in two processes. ``fleet`` flies craft whose
equations share no code with the package (benchmarks.hidden), and lets the fleet's diagnosis say
which cause began when. ``fleet_on_cluster`` and ``sweep_on_cluster`` kill a node of a simulated Ray
cluster. ``overhead`` compares Ray with a plain loop. Each appends its record to
docs/results/scaling.jsonl; ``page`` writes docs/results/scaling.md from the last of each.
"""

import csv
import logging
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import numpy as np
from jax.extend.backend import clear_backends

from baselines.purejaxrl_ppo import Config, devices, load_checkpoint, sweep
from baselines.purejaxrl_ppo.checkpoint import FINAL, as_named_arrays
from baselines.purejaxrl_ppo.config import RECIPES
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks import hidden
from benchmarks.diagnosis import model_of
from benchmarks.report import (
    RESULTS,
    Figure,
    append_line,
    command,
    figures_table,
    filled,
    lines_in,
    progress,
    provenance,
    select,
    spread,
    write_page,
)
from flytrack_bench.hidden.draws import SUDDEN, draw_larger_size
from flytrack_env.jobs import run_jobs
from flytrack_env.model_file import save_model
from flytrack_sysid.fleet import DIAGNOSED, Change, Flight, diagnose_fleet, find_flights
from flytrack_sysid.fleet_page import write_fleet
from flytrack_sysid.log_file import save_log

LINES, RUNS = RESULTS / "scaling.jsonl", Path("runs/scaling")
SEED = 61  # no rule was made on it
BEGINS_IN = 12  # flight
WITH_CAUSE = 3  # craft
LIMIT_S = 900.0
Part = Literal[
    "devices", "rounding", "fleet", "fleet_on_cluster", "sweep_on_cluster", "overhead", "page"
]
JOB_S, JOBS = 10.0, 8
# On paper: docs/results/gpu.md, recipe gpu on an H200; numbers of a row beside the observation; and
# what is assumed, a network card of 400 Gbit/s for each GPU and 50 us for a message between them.
PAPER_STEPS, PAPER_DEVICES, STEPS_PER_S = 1e10, 64, 9.07e6
ROW_NUMBERS, NETWORK_BYTES_PER_S, MESSAGE_S = 8, 50e9, 50e-6
DEVICES, COMPARED = (1, 2, 4), 20  # updates
CHANGES = (1e-7, 2e-7, -1e-7, -2e-7)  # one or two of a float32's last bits
# 160 gradient steps in 20 updates.
FEW = Config(total_timesteps=COMPARED * 64 * 32, num_envs=64, num_steps=32, num_minibatches=8)
CLUSTER_CRAFT = 4
TRIALS, TRIAL_UPDATES = 12, 64  # of a sweep; a core's work of seconds, beside a minute to begin


def draw_craft(rng: np.random.Generator, has_cause: bool) -> tuple[hidden.Truth, hidden.Truth]:
    """Return a plant, and what it is from ``BEGINS_IN`` on: with a cause of the larger sizes."""
    truth = replace(hidden.draw_base(rng), motion="fine")
    name = str(rng.choice(SUDDEN))
    effects = {name: hidden.draw_effect(name, rng, draw_larger_size(name, rng))}
    return truth, replace(truth, effects=effects) if has_cause else truth


def fly_fleet(folder: Path, craft: int, flights: int, seconds: float, seed: int) -> dict[str, Any]:
    """Write the logs of a fleet, a subfolder a craft with its model, and return the true causes."""
    causes = {}
    for number in progress(range(craft), "craft"):
        rng = np.random.default_rng([seed, number])
        before, after = draw_craft(rng, number < WITH_CAUSE)
        home = folder / f"craft{number:02d}"
        home.mkdir(parents=True, exist_ok=True)
        save_model(home / "model.json", model_of(before), {})
        causes[home.name] = sorted(after.effects)
        for flight in range(1, flights + 1):
            path, truth = home / f"flight{flight:02d}.npz", after if flight >= BEGINS_IN else before
            of_flight = np.random.default_rng([seed, number, flight])
            if not path.exists():
                log = hidden.fly(truth, seconds, of_flight)
                save_log(path, hidden.measure(log, "sensors", of_flight))
    return causes


def grade(changes: list[Change], causes: dict[str, list[str]]) -> dict[str, Any]:
    """Return which changes a fleet's diagnosis told, and which of them are so."""
    told = [
        {
            "craft": one.craft,
            "causes": list(one.causes),
            "flight": one.flight,
            "truth": causes[one.craft],
        }
        for one in changes
        if one.causes
    ]
    right = [one for one in told if one["causes"] == one["truth"] and one["flight"] == BEGINS_IN]
    return {
        "told": told,
        "right": len(right),
        "of": sum(map(bool, causes.values())),
        "other": len(told) - len(right),
    }


def grade_single(
    flights: Sequence[Flight], results: dict[str, dict[str, Any]], causes: dict[str, list[str]]
) -> dict[str, Any]:
    """Return how many single diagnoses name what is there, and how many what is not."""
    exact, of, wrong = 0, 0, 0
    for flight in flights:
        is_there = int(Path(flight.path).stem.removeprefix("flight")) >= BEGINS_IN
        truth = set(causes[flight.craft]) if is_there else set()
        diagnosis = results[flight.name].get("diagnosis", {"causes": []})
        named = {cause["effect"] for cause in diagnosis["causes"]}
        of += bool(truth)
        exact += bool(truth) and named == truth
        wrong += bool(named - truth)
    refused = sum(result["state"] != DIAGNOSED for result in results.values())
    single = {"single_exact": exact, "single_of": of, "single_wrong": wrong}
    return {**single, "single_refused": refused}


def print_count(done: int, total: int) -> None:
    """Print how many jobs are done: those of a fleet take hours."""
    print(f"{done} of {total} jobs", file=sys.stderr, flush=True)


def run_fleet(craft: int, flights: int, seconds: float, seed: int, workers: int) -> dict[str, Any]:
    """Return how a simulated fleet was told."""
    # A second call goes on, so that each size has its own folder.
    size = f"{seed}_{craft}_craft_{flights}_flights_{seconds:g}_s"
    folder, out = RUNS / f"fleet{size}", RUNS / f"told{size}"
    causes = fly_fleet(folder, craft, flights, seconds, seed)
    found = find_flights([folder], None)
    started, used = time.perf_counter(), sum(os.times()[:4])
    results, changes = diagnose_fleet(found, out, LIMIT_S, workers, report=print_count)
    write_fleet(out, found, results, changes)
    return {
        "craft": craft,
        "flights": flights,
        "seconds": seconds,
        "seed": seed,
        "wall_s": round(time.perf_counter() - started),
        "cpu_s": round(sum(os.times()[:4]) - used),
        **grade_single(found, results, causes),
        **grade(changes, causes),
    }


def train_on(
    count: int | None, config: Config, seed: int, updates: int, change: float = 0.0
) -> tuple[Any, np.ndarray]:
    """Return the network's arrays after ``COMPARED`` updates, and the mean return after each.

    Args:
        count: of devices; None: without a mesh.
        config: hyperparameters.
        seed: of the training.
        updates: number of them.
        change: relative, of the parameters at the start.
    """
    trainer = Trainer(config, mesh=None if count is None else devices.make_mesh(count))
    runner, returns, arrays = trainer.start(jax.random.key(seed)), [], None
    if change:
        state = runner.train_state
        params = jax.tree.map(lambda leaf: leaf * (1.0 + change), state.params)
        runner = runner._replace(train_state=state.replace(params=params))
    for number in range(1, updates + 1):
        runner, metrics = trainer.update(runner)
        returns.append(float(metrics["last_return"]))
        if number == COMPARED:
            arrays = as_named_arrays(runner.train_state.params)
    return arrays, np.array(returns)


def train_in_processes(config: Config, seed: int, out: Path) -> Any:
    """Return the network's arrays after ``COMPARED`` updates in two processes over loopback."""
    shutil.rmtree(out, ignore_errors=True)
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{one.getsockname()[1]}"
    flags = ["--coordinator", address, "--num-processes", "2", "--out", str(out), "--no-tracking"]
    flags += ["--seed", str(seed), "--total-timesteps", str(config.total_timesteps)]
    flags += ["--checkpoint-every", str(COMPARED * config.batch_size), "--evaluate-every", "0"]
    command = [sys.executable, "-m", "flytrack", "train", *flags, "--process"]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    pair = [subprocess.Popen([*command, str(index)], env=environment) for index in (0, 1)]
    path = out / f"step_{COMPARED * config.batch_size}.safetensors"
    try:
        while not path.exists():
            assert [one.poll() for one in pair] == [None, None], "a process ended"
            time.sleep(0.2)
    finally:
        for process in pair:
            process.kill()
            process.wait()
    return as_named_arrays(load_checkpoint(path).params)


def run_devices(updates: int, seed: int) -> dict[str, Any]:
    """Return how trainings on several devices differ from that on one."""
    clear_backends()
    jax.config.update("jax_num_cpu_devices", max(DEVICES))
    # The length decides the learning rate, so that all trainings have the same.
    config = Config(total_timesteps=updates * Config().batch_size)
    expected, curve = train_on(None, config, seed, updates)
    record: dict[str, Any] = {"updates": updates, "compared": COMPARED, "seed": seed}
    record["largest_parameter"] = max(float(np.abs(one).max()) for one in expected.values())
    for count in DEVICES:
        found, returns = train_on(count, config, seed, updates)
        record[f"{count} devices"] = differences(found, expected)
        # From the worst return on, so that the share of the rise is what is compared.
        rise, rise_of_one = (one.mean() - curve.min() for one in (returns, curve))
        record[f"{count} devices, curve"] = float(rise / rise_of_one)
    found = train_in_processes(config, seed, RUNS / f"pair{seed}")
    record["2 processes"] = differences(found, expected)
    return record


def run_rounding(updates: int, seed: int) -> dict[str, Any]:
    """Return what a change of the last bits becomes on one device, and after few gradient steps.

    A training is chaotic: what sums in another order change, such a change of the start does, too.
    """
    config = Config(total_timesteps=updates * Config().batch_size)
    expected, curve = train_on(None, config, seed, updates)
    changed = [train_on(None, config, seed, updates, change) for change in CHANGES]
    record: dict[str, Any] = {"updates": updates, "compared": COMPARED, "seed": seed}
    record["differences"] = [differences(found, expected) for found, _ in changed]
    record["curves"] = [
        float((returns.mean() - curve.min()) / (curve.mean() - curve.min()))
        for _, returns in changed
    ]
    clear_backends()
    jax.config.update("jax_num_cpu_devices", max(DEVICES))
    expected, _ = train_on(None, FEW, seed, COMPARED)
    for count in DEVICES:
        found, _ = train_on(count, FEW, seed, COMPARED)
        record[f"{count} devices"] = differences(found, expected)
    return record


def differences(found: Any, expected: Any) -> float:
    """Return the largest difference between named arrays."""
    return max(float(np.abs(found[name] - array).max()) for name, array in expected.items())


@contextmanager
def losing_a_node(has_begun: Callable[[], bool]) -> Iterator[list[float]]:
    """Begin a Ray cluster of three nodes of a core each, and kill one once work is under way.

    Yields a list, to which the time of the loss is added (s, of ``time.perf_counter``).
    """
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    victim, _ = (cluster.add_node(num_cpus=1) for _ in range(2))
    lost: list[float] = []
    has_ended = threading.Event()

    def lose() -> None:
        while not has_ended.wait(0.5):
            if has_begun():
                cluster.remove_node(victim, allow_graceful=False)
                lost.append(time.perf_counter())
                return

    thread = threading.Thread(target=lose)
    try:
        ray.init(address=cluster.address, log_to_driver=False, logging_level=logging.ERROR)
        thread.start()
        yield lost
    finally:
        has_ended.set()
        thread.join()
        ray.shutdown()
        cluster.shutdown()


def run_cluster_fleet(flights: int, seconds: float, seed: int) -> dict[str, Any]:
    """Return what became of the logs of a fleet, a node of which was killed."""
    folder, out = RUNS / f"short{seed}", RUNS / f"cluster{seed}"
    shutil.rmtree(out, ignore_errors=True)
    fly_fleet(folder, CLUSTER_CRAFT, flights, seconds, seed)
    found = find_flights([folder], None)
    with losing_a_node(lambda: len(list(out.rglob("*.json"))) >= len(found) // 3) as lost:
        results, _ = diagnose_fleet(found, out, LIMIT_S, 1, "auto")
    states = [result["state"] for result in results.values()]
    return {
        "logs": len(found),
        "seconds": seconds,
        "seed": seed,
        "nodes_lost": len(lost),
        "results": len(results),
        "diagnosed": states.count(DIAGNOSED),
    }


def run_cluster_sweep(seed: int) -> dict[str, Any]:
    """Return what became of the trials of a sweep, a node of which was killed."""
    out = RUNS / f"sweep{seed}"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    settings = out / "settings.toml"
    small = Config(num_envs=16, num_steps=24, num_minibatches=4, hidden_sizes=(8,))
    steps = TRIAL_UPDATES * small.batch_size
    settings.write_text(
        f"total_timesteps = {steps}\nnum_envs = {small.num_envs}\nnum_steps = {small.num_steps}\n"
        f"num_minibatches = {small.num_minibatches}\nhidden_sizes = [{small.hidden_sizes[0]}]\n"
        "[learning_rate]\nloguniform = [1e-3, 1e-2]\n"
    )

    def has_begun() -> bool:
        return len({path.parent for path in out.glob("trial*/step_*")}) >= TRIALS // 3

    flags = sweep.Flags(settings, TRIALS, out, seed=seed, address="auto", tracking_uri="")
    with losing_a_node(has_begun) as lost:
        status = sweep.run_sweep(flags)
    rows = list(csv.DictReader((out / sweep.TABLE).read_text(encoding="utf-8").splitlines()))
    grace = steps // sweep.GRACE
    return {
        "trials": TRIALS,
        "updates": TRIAL_UPDATES,
        "seed": seed,
        "nodes_lost": len(lost),
        "status": status,
        "rows": len(rows),
        "trial_ids": len({row["trial_id"] for row in rows}),
        "folders": len(list(out.glob("trial*"))),
        "ended": sum(float(row["steps"] or 0) >= grace for row in rows),
        "complete": len(list(out.glob(f"trial*/{FINAL}"))),
    }


def pause(seconds: float) -> float:
    """Wait: a job whose own time does not depend on what else the machine does."""
    time.sleep(seconds)
    return seconds


def run_overhead(jobs: int) -> dict[str, Any]:
    """Return how much longer jobs of ten seconds take by Ray, one after the other, than alone."""
    import ray

    started = time.perf_counter()
    ray.init("local", num_cpus=1, log_to_driver=False, logging_level=logging.ERROR)
    ready = time.perf_counter()
    every = {str(number): (JOB_S,) for number in range(jobs)}
    ends = [time.perf_counter() for _ in run_jobs(pause, every, LIMIT_S, "auto")]
    ray.shutdown()
    plain = JOB_S * jobs
    return {
        "jobs": jobs,
        "job_s": JOB_S,
        "start_of_ray_s": round(ready - started, 1),
        "first_job_s": round(ends[0] - ready, 2),
        "overhead": round((ends[-1] - ends[0]) / (plain - JOB_S) - 1.0, 5),
        "overhead_with_first": round((ends[-1] - ready) / plain - 1.0, 4),
    }


def on_paper() -> dict[str, float]:
    """Return what 10^10 steps on 8 nodes of 8 GPUs would take, from the figures of one GPU.

    Each device has the recipe for a GPU, and all experience goes to all devices once an update.
    """
    gpu = RECIPES["gpu"]
    arrays = as_named_arrays(load_checkpoint("champion").params)
    numbers = sum(array.size for array in arrays.values())
    row_bytes = 4 * (load_checkpoint("champion").observation_size + ROW_NUMBERS)
    rows = gpu.batch_size * PAPER_DEVICES
    updates = PAPER_STEPS / rows
    compute_s = gpu.batch_size / STEPS_PER_S
    gathered = rows * row_bytes
    messages = gpu.gradients_per_update + gpu.num_steps
    waiting_s = messages * MESSAGE_S
    update_s = compute_s + gathered / NETWORK_BYTES_PER_S + waiting_s
    return {
        "updates": updates,
        "gathered_mb": gathered / 1e6,
        "gradient_mb": 4e-6 * numbers * gpu.gradients_per_update,
        "compute_ms": 1e3 * compute_s,
        "gather_ms": 1e3 * gathered / NETWORK_BYTES_PER_S,
        "waiting_ms": 1e3 * waiting_s,
        "total_s": updates * update_s,
        "one_gpu_s": PAPER_STEPS / STEPS_PER_S,
    }


def last_of(part: str) -> dict[str, Any] | None:
    """Return the last record of a part; None if there is none."""
    records = select(lines_in(LINES), part=part)
    return records[-1] if records else None


def list_counts() -> str:
    """Return the numbers of devices as text."""
    return ", ".join(map(str, DEVICES))


def figures() -> Iterator[Figure]:
    """Yield the figures of the page; those that were not measured say so."""
    if one := last_of("devices"):
        names = [*(f"{count} devices" for count in DEVICES), "2 processes"]
        title = f"{', '.join(names)}: largest difference of a parameter from one, 1,280 steps"
        yield Figure(title, "1e-5", ", ".join(f"{one[name]:.1e}" for name in names), 1)
        curves = [f"{100.0 * one[f'{count} devices, curve']:.1f}" for count in DEVICES]
        title = f"{list_counts()} devices: rise of the mean return over {one['updates']} updates"
        yield Figure(f"{title}, of that of one", "95 to 105 %", f"{', '.join(curves)} %", 1)
    if one := last_of("rounding"):
        values = ", ".join(f"{one[f'{count} devices']:.1e}" for count in DEVICES)
        title = f"{list_counts()} devices: largest difference of a parameter from one, 160 steps"
        yield Figure(title, "1e-5", values, 1)
        title = "one device, its start changed by 1e-7 or 2e-7, 1,280 steps: the same"
        yield Figure(title, "", spread(one["differences"], ".1e"), len(CHANGES))
        title = f"one device, its start so changed: rise of the mean return over {one['updates']}"
        shares = spread([100.0 * share for share in one["curves"]], ".1f")
        yield Figure(f"{title} updates, of that unchanged", "", f"{shares} %", len(CHANGES))
    if one := last_of("fleet"):
        title = f"fleet of {one['craft']} craft, {one['craft'] * one['flights']} logs: causes"
        text = f"{one['right']} of {one['of']}"
        yield Figure(
            f"{title} that begin in flight {BEGINS_IN}, with it", "2 of 3", text, one["of"]
        )
        yield Figure(f"{title} told that are not there", "0", str(one["other"]), one["craft"])
        text = f"{one['single_exact']} of {one['single_of']}"
        title = "its single diagnoses: exactly the cause, of flights with one"
        yield Figure(title, "", text, one["single_of"])
        title = "its single diagnoses that name what is not there"
        yield Figure(title, "0", str(one["single_wrong"]), one["craft"] * one["flights"])
        title = "its logs that the check refuses, of logs that nothing is wrong with"
        yield Figure(title, "0", str(one["single_refused"]), one["craft"] * one["flights"])
    if one := last_of("fleet_on_cluster"):
        text = f"{one['results']} of {one['logs']}, {one['diagnosed']} diagnosed"
        yield Figure("fleet, a node of three killed: logs present once", "all", text, one["logs"])
    if one := last_of("sweep_on_cluster"):
        text = f"{one['trial_ids']} of {one['trials']}, {one['ended']} ended by ASHA or complete"
        title = "sweep, a node of three killed: trials present once"
        yield Figure(title, "all", text, one["trials"])
    if one := last_of("overhead"):
        title = f"overhead of Ray over a plain loop, jobs of {one['job_s']:g} s"
        text = f"{100.0 * one['overhead']:.2f} %; {100.0 * one['overhead_with_first']:.1f} %"
        yield Figure(f"{title}; with the first job's start", "5 %", text, one["jobs"])


def write_results() -> None:
    """Write the page from the last record of each part."""
    source = last_of("fleet") or last_of("devices") or {}
    told = [
        f"{one['craft']}: {', '.join(one['causes'])} from flight {one['flight']} "
        f"(true: {', '.join(one['truth']) or 'none'})"
        for one in (last_of("fleet") or {"told": []})["told"]
    ]
    commits = ", ".join(
        f"{part} {one['commit']}" for part in get_args(Part) if (one := last_of(part)) is not None
    )
    values = {
        name: f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"
        for name, value in on_paper().items()
    }
    fleet = last_of("fleet") or {}
    text = filled(
        "scaling",
        figures=figures_table(figures()),
        told="; ".join(told) or "nothing",
        commits=commits,
        machine=source.get("machine", ""),
        seed=SEED,
        **{name: fleet.get(name, 0) for name in ("craft", "flights", "seconds")},
        **values,
    )
    write_page(RESULTS / "scaling.md", text)


def main(
    part: Part,
    craft: int = 10,
    flights: int = 20,
    seconds: float = 20.0,
    updates: int = 60,
    workers: int = 1,
    seed: int = SEED,
) -> None:
    """Measure a part.

    Args:
        part: what is measured.
        craft: of the fleet.
        flights: of each.
        seconds: of each flight.
        updates: of each training.
        workers: processes that diagnose.
        seed: of plants, flights and trainings.
    """
    runs: dict[str, Callable[[], dict[str, Any]]] = {
        "devices": lambda: run_devices(updates, seed),
        "rounding": lambda: run_rounding(updates, seed),
        "fleet": lambda: run_fleet(craft, flights, seconds, seed, workers),
        "fleet_on_cluster": lambda: run_cluster_fleet(flights, seconds, seed),
        "sweep_on_cluster": lambda: run_cluster_sweep(seed),
        "overhead": lambda: run_overhead(JOBS),
    }
    if part == "page":
        write_results()
        return
    record = runs[part]()
    append_line(LINES, {"part": part, **record, **provenance()})
    print(record)


if __name__ == "__main__":
    command(main)
