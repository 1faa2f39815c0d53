"""How long a new process waits for its first results: ``python -m benchmarks.first_use [--repeats 3]``.

Fresh processes make an environment, reset and step it, alone and as a Gymnasium vector of 256: with an empty
folder for compiled programs, then with what the run before has left there. Wall time, without imports.
"""

import os
import statistics
import subprocess
import sys
import tempfile

from benchmarks import report

CLOCK = """
import time
def tell(name):
    global started
    print(name, time.perf_counter() - started)
    started = time.perf_counter()
"""
ALONE = """
import gymnax, jax, flytrack_env
started = time.perf_counter()
env, params = gymnax.make("FlyTrack-v0")
key = jax.random.key(0)
_, state = jax.block_until_ready(env.reset(key, params))
tell("reset")
jax.block_until_ready(env.step(key, state, jax.numpy.zeros(4), params))
tell("step")
"""
VECTOR = """
import gymnasium, numpy, flytrack_env
started = time.perf_counter()
envs = gymnasium.make_vec("FlyTrack-v0", num_envs=256, autoreset_mode="SameStep")
envs.reset(seed=0)
tell("vector_reset")
envs.step(numpy.zeros((256, 4), numpy.float32))
tell("vector_step")
"""
NAMES = {"reset": 4.0, "step": 4.4, "vector_reset": None, "vector_step": 13.0}  # s, before there were kernels
Times = dict[str, float]


def start(code: str, cache: str) -> Times:
    """Return the seconds of a fresh process that keeps its programs in a folder."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "FLYTRACK_"))}
    command, environment = [sys.executable, "-c", CLOCK + code], kept | {"XDG_CACHE_HOME": cache}
    told = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    return {name: float(seconds) for name, seconds in map(str.split, told.splitlines())}


def main(repeats: int = 3) -> None:
    """Measure, print and write the page."""
    core = report.pin_to_one_core()
    first: list[Times] = []
    second: list[Times] = []
    for _ in report.progress(range(repeats), "round"):
        with tempfile.TemporaryDirectory() as cache:
            for found in (first, second):
                found.append(start(ALONE, cache) | start(VECTOR, cache))
    rows = []
    for name, before in NAMES.items():
        cells = [[times[name] for times in found] for found in (first, second)]
        medians = [f"{statistics.median(cell):.2f} ({report.spread(cell, '.2f')})" for cell in cells]
        rows.append([name.replace("_", " "), before or "-", *medians])
    path = report.RESULTS / "first_use.md"
    table = report.table("first | before kernels (s) | nothing kept (s) | the next process (s)", rows)
    told = f"{report.command_line()}: {repeats} rounds of fresh processes, {core}; the vector has 256 drones."
    record = report.provenance_line(report.provenance("gymnasium"))
    report.write_page(path, report.page("First use", told, table, record))


if __name__ == "__main__":
    report.command(main)
