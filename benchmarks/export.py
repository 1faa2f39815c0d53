"""Exported policies against the evaluator: ``python -m benchmarks.export [--inputs 1000000]``.

The compiled header of each champion flies the black box and counts the gates itself; then header, ONNX files
and evaluator act on the states of those flights and on states whose observations fill the box.
"""

import ctypes
import os
import statistics
import subprocess
import tempfile
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.export import ExportedPolicy, ExportSettings, export, policy_of
from baselines.purejaxrl_ppo.flights import race_many, start_keys, start_pose_params
from baselines.purejaxrl_ppo.race_env import plant_env
from benchmarks import report
from benchmarks.champion import FOLDER, LAPS, STEPS
from flytrack_env import blackbox
from flytrack_env.observations import observe_race
from flytrack_env.state import ACTION_SIZE, BATTERY, POSITION, QUATERNION, STATE_SIZE, VELOCITY, pack, unpack

DRIVER = report.ROOT / "benchmarks" / "export_driver.c"
FLAGS = "-std=c99 -pedantic -Wall -Wextra -Werror -Wconversion -O2 -shared -fPIC"
SEED, FLIGHTS, BEYOND, REPEATS, SINGLE = 100, 256, 1.2, 5, 20_000
HEADER = (
    "file | bytes | in flight, from the evaluator | from float64 | "
    "in the box, from the evaluator | from float64 | µs a step"
)
Act = Callable[[np.ndarray, np.ndarray], np.ndarray]


class CompiledPolicy:
    """A header of ``export``, compiled; it is called policy.h."""

    def __init__(self, header: Path):
        library = header.with_name("policy.so")
        command = ["gcc", *FLAGS.split(), f"-I{header.parent}", str(DRIVER), "-o", str(library), "-lm"]
        subprocess.run(command, check=True)
        self.functions = ctypes.CDLL(str(library))

    def act(self, states: Any, gates: Any, past: Any = ()) -> np.ndarray:
        """Return actions (N, 4) of states (N, 21), gates (N,) and, if it reads them, past actions (N, P)."""
        actions = np.empty((len(states), ACTION_SIZE), np.float32)
        self._call("act", len(states), np.float32(states), np.int32(gates), np.float32(past), actions)
        return actions

    def next_gates(self, before: Any, after: Any, gates: Any) -> np.ndarray:
        """Return the gates to fly, (N,), after steps from states to states, (N, 21)."""
        gates = np.array(gates, np.int32)
        self._call("advance", len(gates), np.float32(before), np.float32(after), gates)
        return gates

    def lag(self, action: Any, applied: Any) -> np.ndarray:
        """Return the applied action, (4,), after a step."""
        applied = np.array(applied, np.float32)
        self._call("lag", np.float32(action), applied)
        return applied

    def _call(self, name: str, *arguments: Any) -> None:
        kept = [np.ascontiguousarray(one) if np.ndim(one) else int(one) for one in arguments]
        given = [one if isinstance(one, int) else ctypes.c_void_p(one.ctypes.data) for one in kept]
        getattr(self.functions, name)(*given)


class Race(NamedTuple):
    """Flights of a compiled policy: (FLIGHTS,) finished and steps flown; every state and its gate."""

    finished: np.ndarray
    steps: np.ndarray
    states: np.ndarray
    gates: np.ndarray


def race(policy: CompiledPolicy, env: Any) -> Race:
    """Return noisy starts flown by a compiled policy, which counts the gates itself."""
    params = start_pose_params(env.default_params, STEPS)
    advance = jax.jit(jax.vmap(lambda state, action: env.step_env(None, state, action, params)[1:]))
    look = jax.jit(jax.vmap(lambda state: pack(env.drone(state))))
    state = jax.vmap(env.reset, (0, None))(start_keys(SEED, FLIGHTS), params)[1]
    gates, is_flying = np.zeros(FLIGHTS, np.int32), np.ones(FLIGHTS, bool)
    finished, steps, rows = np.zeros(FLIGHTS, bool), np.zeros(FLIGHTS, int), []
    drones = np.asarray(look(state))
    for _ in report.progress(range(STEPS), "steps"):
        rows.append((drones[is_flying], gates[is_flying]))
        state, _, terminated, info = advance(state, policy.act(drones, gates))
        before, drones = drones, np.asarray(look(state))
        gates, steps = policy.next_gates(before, drones, gates), steps + is_flying
        finished |= is_flying & (np.asarray(info["laps"]) >= LAPS)
        is_flying = is_flying & ~finished & ~np.asarray(terminated)
        if not is_flying.any():
            break
    return Race(finished, steps, *map(np.concatenate, zip(*rows, strict=True)))


def states_in_box(policy: ExportedPolicy, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states (count, 21) and gates whose observations fill the box, and leave it by a fifth."""
    rng = np.random.default_rng(SEED)
    gates = rng.integers(0, len(policy.centres), count)
    reach = BEYOND * policy.limits / policy.factors
    rows = rng.uniform(-reach, reach, (count, reach.size)) + policy.offsets
    states = np.zeros((count, STATE_SIZE))
    states[:, POSITION] = policy.centres[gates] + np.einsum("nij,ni->nj", policy.frames[gates], rows[:, :3])
    states[:, VELOCITY] = np.einsum("nij,ni->nj", policy.frames[gates], rows[:, 3:6])
    attitudes = rng.normal(size=(count, 4))
    states[:, QUATERNION] = attitudes / np.linalg.norm(attitudes, axis=1, keepdims=True)
    states[:, QUATERNION.stop : BATTERY + 1] = rows[:, 15:]
    return states.astype(np.float32), gates


def evaluator(checkpoint: Checkpoint, env: Any, is_float64: bool = False, batch: int = 1000) -> Act:
    """Return what the evaluator does with states (N, 21) and gates (N,), ``batch`` of them at a time."""

    def act(states: np.ndarray, gates: np.ndarray) -> np.ndarray:
        with jax.enable_x64(is_float64):
            real = jnp.float64 if is_float64 else jnp.float32
            arrays = checkpoint.params, env.default_params.course
            params, course = jax.tree.map(lambda leaf: jnp.asarray(leaf, real), arrays)
            battery = env.default_params.model.battery

            def one(state: jax.Array, gate: jax.Array) -> jax.Array:
                pair = course.gate(gate), course.gate(course.next_index(gate))
                observation = jnp.stack(observe_race(unpack(state.astype(real)), *pair, battery))
                mean: Any = checkpoint.network.apply(params, observation, method="policy")
                return jnp.clip(mean.mode(), -1.0, 1.0)

            return np.asarray(jax.lax.map(lambda pair: one(*pair), (states, gates), batch_size=batch))

    return act


def onnx_policy(path: Path) -> Act:
    """Return what ONNX Runtime does with states (N, 21) and gates (N,), on one core."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options)
    return lambda states, gates: session.run(None, {"state": states, "gate": np.int64(gates)})[0]


def microseconds(act: Act, states: np.ndarray, gates: np.ndarray, together: int) -> str:
    """Return the median time of a step, µs; together: steps in a call."""
    calls = [slice(first, first + together) for first in range(0, SINGLE, together)]
    times = timeit.repeat(lambda: [act(states[own], gates[own]) for own in calls], number=1, repeat=REPEATS)
    return f"{1e6 * statistics.median(times) / SINGLE:.1f}"


def section_of(name: str, num_inputs: int, folder: Path) -> str:
    """Export a champion, fly it, compare it; return its part of the page."""
    path, header, single, double = (
        FOLDER / f"{name}.safetensors",
        *(folder / name / file for file in ("policy.h", "policy.onnx", "float64.onnx")),
    )
    export(ExportSettings(path, single, header))
    export(ExportSettings(path, double, float64=True))
    checkpoint, compiled = load_checkpoint(path), CompiledPolicy(header)
    env = plant_env(checkpoint, blackbox.load(blackbox.SHIPPED))
    flown = race(compiled, env)
    python = race_many(env, checkpoint.policy, start_keys(SEED, FLIGHTS), STEPS, LAPS)
    same = int(np.sum(flown.finished == python.is_complete()))
    box = states_in_box(policy_of(checkpoint, path.name), num_inputs - len(flown.states))
    usual, exact = evaluator(checkpoint, env), evaluator(checkpoint, env, is_float64=True)
    files: dict[str, tuple[Act, Path | None, int]] = {
        "C header": (compiled.act, header, SINGLE),
        "ONNX": (onnx_policy(single), single, 1),
        "ONNX, `--float64`": (onnx_policy(double), double, 1),
        "evaluator": (usual, None, 0),
        "evaluator, a state at a time": (evaluator(checkpoint, env, batch=1), None, 0),
    }
    wanted = [(pair, act(*pair)) for pair in ((flown.states, flown.gates), box) for act in (usual, exact)]
    rows = []
    for label, (act, file, together) in files.items():
        apart = [f"{np.abs(act(*pair) - actions).max():.1e}" for pair, actions in wanted]
        timed = microseconds(act, flown.states, flown.gates, together) if together else "-"
        rows.append([label, f"{file.stat().st_size:,}" if file else "-", *apart, timed])
    return "\n\n".join(
        [
            f"## {name}",
            f"Black box, {FLIGHTS} noisy starts, {LAPS} laps: {python.is_complete().sum()} finish with the "
            f"evaluator's policy, {flown.finished.sum()} with the compiled one, which counts the gates "
            f"itself; {same} end alike. Mean flight: {python.steps.mean():.2f} and "
            f"{flown.steps.mean():.2f} steps.",
            f"Largest difference of an action over {len(flown.states):,} states of these flights and "
            f"{len(box[1]):,} of the box:",
            report.table(HEADER, rows),
        ]
    )


def main(inputs: int = 1_000_000) -> None:
    """Export, fly, compare ``inputs`` states and write the page."""
    load, core = os.getloadavg()[0], report.pin_to_one_core()
    with tempfile.TemporaryDirectory() as folder:
        sections = [section_of(name, inputs, Path(folder)) for name in ("flytrack", "robust")]
    values = {"core": core, "load": f"{load:.1f}", "cores": os.cpu_count(), "flags": FLAGS}
    path, packages = report.RESULTS / "export.md", ("onnx", "onnxruntime")
    report.fill_page(path, "export", packages=packages, sections="\n\n".join(sections), **values)


if __name__ == "__main__":
    report.command(main)
