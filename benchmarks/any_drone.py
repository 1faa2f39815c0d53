"""Crafts of one to six cells through every command: ``python -m benchmarks.any_drone``.

A nominal model (what ``flytrack import --model-out`` writes) and a fitted one of each craft, with
the thrust that they have by the model, in the environment, in the header of an exported policy and
in a flight of the evaluator; then PPO with its default settings. The logs that are fitted are of a
law that shares nothing with the thrust map: specific force = peak x throttle x V / V_full.
"""

import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import flytrack_env
from baselines.purejaxrl_ppo import Checkpoint, flights, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import simulated_env
from benchmarks import report
from benchmarks.misspec.replay import lagged
from flytrack_env import ModelParameters
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import ACCELERATION, APPLIED_ACTION, BATTERY, QUATERNION, unpack_action
from flytrack_env.thrust import collective_thrust, hover_action

G = 9.80665  # m/s^2
RATE_HZ, LOG_S = 100, 150
FULL_CELL_V, EMPTY_CELL_V = 4.2, 3.5
GYRO_NOISE, ACCELEROMETER_NOISE = 0.02, 0.3  # rad/s, m/s^2
SETTLED_STEPS = 60  # of 10 ms: fifteen time constants of the slowest thrust here
NUM_STARTS, NUM_STEPS, NUM_LAPS = 256, 3000, 3
STICKS = np.linspace(-1.0, 1.0, 401)
MIN_FORCE = 2.0  # N/kg; below, a ratio of forces is noise of float32 and drag
MAPPING = """[time]
column = "t"
unit = "s"
[command]
columns = ["u0", "u1", "u2", "u3"]
[rates]
columns = ["w0", "w1", "w2"]
unit = "rad/s"
frame = "flu"
[specific_force]
columns = ["f0", "f1", "f2"]
unit = "m/s^2"
frame = "flu"
[battery]
column = "v"
unit = "V"
[craft]
max_rate_deg_s = [{rates}]
mass_kg = {mass_kg}
voltage_v = [{empty_v}, {full_v}]
"""


class TrueCraft(NamedTuple):
    """A craft's truth.

    Mass in kg, peak specific force in m/s^2, full stick in deg/s, lags in s.
    """

    name: str
    cells: int
    mass_kg: float
    peak: float
    max_rate_deg_s: tuple[float, float, float]
    lag_s: float
    thrust_lag_s: float

    @property
    def volts(self) -> tuple[float, float]:
        """Empty and full voltage, V."""
        return EMPTY_CELL_V * self.cells, FULL_CELL_V * self.cells


CRAFTS = (
    TrueCraft("1S, 32 g", 1, 0.032, 26.0, (500.0, 500.0, 300.0), 0.025, 0.050),
    TrueCraft("2S, 80 g", 2, 0.08, 32.0, (600.0, 600.0, 400.0), 0.025, 0.045),
    TrueCraft("3S, 350 g", 3, 0.35, 36.0, (618.0, 618.0, 300.0), 0.030, 0.040),
    TrueCraft("4S, 700 g", 4, 0.7, 35.0, (700.0, 700.0, 400.0), 0.030, 0.040),
    TrueCraft("6S, 750 g", 6, 0.75, 45.0, (800.0, 800.0, 500.0), 0.020, 0.030),
)


class Thrust(NamedTuple):
    """Thrust over weight at full stick, and the stick that hovers, both with a full battery."""

    full: float
    hover: float


def write_log(craft: TrueCraft, folder: Path, seed: int) -> tuple[Path, Path]:
    """Write a flight as CSV with its mapping; return both paths."""
    rng = np.random.default_rng(seed)
    time = np.arange(LOG_S * RATE_HZ) / RATE_HZ

    def hold(changes_hz: float, size: float) -> np.ndarray:
        return rng.uniform(-size, size, 1000)[(time * changes_hz).astype(int)]

    turns = [hold(changes_hz, 0.3) for changes_hz in (1.5, 1.3, 1.1)]
    sticks = np.column_stack([*turns, -0.2 + hold(1.7, 0.6)])
    empty_v, full_v = craft.volts
    volts = full_v - 0.9 * (full_v - empty_v) * time / time[-1]
    applied = lagged([craft.lag_s] * 3 + [craft.thrust_lag_s], sticks, 1.0 / RATE_HZ)
    rates = applied[:, :3] * np.deg2rad(craft.max_rate_deg_s)
    throttle = 0.5 * (applied[:, 3] + 1.0)
    force = np.zeros((len(time), 3))
    force[:, 2] = craft.peak * throttle * volts / full_v
    rates += rng.normal(0.0, GYRO_NOISE, rates.shape)
    force += rng.normal(0.0, ACCELEROMETER_NOISE, force.shape)
    table, mapping = folder / "log.csv", folder / "map.toml"
    header = "t,u0,u1,u2,u3,w0,w1,w2,f0,f1,f2,v"
    columns = np.column_stack([time, sticks, rates, force, volts])
    np.savetxt(table, columns, delimiter=",", header=header, comments="", fmt="%.6g")
    text = MAPPING.format(
        rates=", ".join(map(str, craft.max_rate_deg_s)),
        mass_kg=craft.mass_kg,
        empty_v=empty_v,
        full_v=full_v,
    )
    mapping.write_text(text, encoding="utf-8")
    return table, mapping


def run(*words: object) -> None:
    """Run a flytrack command, as a user would."""
    subprocess.run([sys.executable, "-m", "flytrack", *map(str, words)], check=True)


def by_model(model: ModelParameters) -> Thrust:
    """Return what the thrust map says."""
    coeffs, weight_n = np.asarray(model.thrust_coeffs, float), float(model.m) * float(model.g)
    full_v = float(model.battery.full_v)
    full = float(np.asarray(collective_thrust(1.0, full_v, coeffs))) / weight_n
    return Thrust(full, hover_action(coeffs, weight_n, full_v))


def in_environment(path: Path) -> Thrust:
    """Return what a drone in the environment does after a reset with a full battery, upright."""
    env = flytrack_env.make("FlyTrack-v0", model=path)
    params = env.default_params
    params = params.replace(reset=params.reset._replace(start_charge_low=1.0, course_fraction=0.0))

    @jax.jit
    @jax.vmap
    def settled_force(stick: jax.Array) -> jax.Array:
        """Return the specific force along body z once a held thrust stick has settled, m/s^2."""
        drone, gate = env.sample_start(jnp.uint32(0), params)
        drone = drone._replace(quat=Quaternion(*map(jnp.float32, (1.0, 0.0, 0.0, 0.0))))
        command = unpack_action(jnp.array([0.0, 0.0, 0.0, 0.0]).at[3].set(stick))

        def step(state: Any, _: None) -> tuple[Any, Vec3]:
            state = env.advance(state, command, params)[0]
            return state, env.drone(state).acc_w

        _, acc_w = jax.lax.scan(step, env.begin(drone, gate, params), None, SETTLED_STEPS)
        return jnp.asarray(acc_w.z)[-1] + params.model.g

    weights = np.asarray(settled_force(jnp.asarray(STICKS, jnp.float32))) / float(params.model.g)
    hover = float(np.interp(1.0, np.maximum.accumulate(weights), STICKS))
    return Thrust(float(weights[-1]), hover)


def in_header(checkpoint: Path, folder: Path) -> Thrust:
    """Return what the header of the exported C policy states."""
    header = folder / "policy.h"
    run("export", "--c", header, checkpoint)
    words = " ".join(header.read_text(encoding="utf-8").replace("\n *", " ").split())
    pattern = r"gives ([\d.]+) times the weight at full thrust, and (-?[\d.]+) hovers"
    ((full, hover),) = re.findall(pattern, words)
    return Thrust(float(full), float(hover))


def on_evaluator(checkpoint: Checkpoint, model: ModelParameters) -> Thrust:
    """Return the thrust that a flight of the evaluator shows.

    It is that of the thrust map, times the median ratio of the flight's force to the map's.
    """
    env = simulated_env(checkpoint)
    params = flights.start_pose_params(env.default_params, NUM_STEPS)
    flown = flights.fly_episode(
        env, checkpoint.policy, jax.random.key(0), params, NUM_STEPS, NUM_LAPS
    )
    states = flown.flown()[0].astype(float)
    # The handout's step: the force has the attitude before it.
    attitude = Rotation.from_quat(states[:-1, QUATERNION], scalar_first=True)
    body_z = attitude.apply([0.0, 0.0, 1.0])
    force = np.sum((states[1:, ACCELERATION] + [0.0, 0.0, float(model.g)]) * body_z, axis=1)
    coeffs = np.asarray(model.thrust_coeffs, float)
    thrust_action, volts = states[1:, APPLIED_ACTION][:, 3], states[:-1, BATTERY]
    mapped = np.asarray(collective_thrust(thrust_action, volts, coeffs)) / float(model.m)
    is_used = mapped > MIN_FORCE
    ratio = float(np.median(force[is_used] / mapped[is_used]))
    weight_n = float(model.m) * float(model.g) / ratio
    return Thrust(
        by_model(model).full * ratio, hover_action(coeffs, weight_n, float(model.battery.full_v))
    )


class Measured(NamedTuple):
    """What was measured of a model: its race, and four thrusts.

    These are by the model, in the environment, in the C header and in a flight.
    """

    craft: TrueCraft
    kind: str
    battery: str
    thrusts: tuple[Thrust, Thrust, Thrust, Thrust]
    finished: int
    lap_s: float


def race(checkpoint: Checkpoint) -> tuple[int, float]:
    """Return how many noisy starts finish three laps simulated, and the median flying lap, s."""
    env = simulated_env(checkpoint)
    keys = flights.start_keys(0, NUM_STARTS)
    outcomes = flights.race_many(env, checkpoint.policy, keys, NUM_STEPS, NUM_LAPS)
    laps_s = outcomes.flying_laps_s()
    return int(outcomes.is_complete().sum()), float(np.median(laps_s)) if len(laps_s) else np.nan


def measure(craft: TrueCraft, kind: str, path: Path, timesteps: int, folder: Path) -> Measured:
    """Train on a model file, and return what was measured."""
    model, policy = flytrack_env.load_model(path), folder / "trained" / "final.safetensors"
    options = ("--total-timesteps", timesteps, "--evaluate-every", 0, "--no-tracking")
    run("train", "--model", path, *options, "--out", policy.parent)
    checkpoint = load_checkpoint(policy)
    thrusts = (
        by_model(model),
        in_environment(path),
        in_header(policy, folder),
        on_evaluator(checkpoint, model),
    )
    return Measured(craft, kind, model.battery.describe(), thrusts, *race(checkpoint))


def largest_differences(rows: list[Measured]) -> tuple[float, float]:
    """Return the largest differences from the model's full thrust (share) and hover stick."""
    full, hover = np.moveaxis(np.array([row.thrusts for row in rows]), -1, 0)
    return (
        float(np.abs(full[:, 1:] / full[:, :1] - 1.0).max()),
        float(np.abs(hover[:, 1:] - hover[:, :1]).max()),
    )


def table(rows: list[Measured]) -> str:
    """Return the rows as a table: thrust over weight at full stick / hover stick, and the race."""
    lines = []
    for row in rows:
        truth = "-" if row.kind == "nominal" else f"{row.craft.peak / G:.3f}"
        thrust = f"{row.thrusts[0].full:.3f} / {row.thrusts[0].hover:.3f}"
        laps = [f"{row.finished} of {NUM_STARTS}", f"{row.lap_s:.2f} s"]
        lines.append([row.craft.name, row.kind, row.battery, truth, thrust, *laps])
    head = "craft | model | battery | truth | by the model | finished | flying lap"
    return report.table(head, lines)


def main(timesteps: int = 10_000_000, seed: int = 0) -> None:
    """Measure every craft, and write the page."""
    rows = []
    for number, craft in enumerate(CRAFTS):
        with TemporaryDirectory() as name:
            folder = Path(name)
            log, mapping = write_log(craft, folder, seed + number)
            npz, models = folder / "log.npz", {}
            for kind in ("nominal", "fitted"):
                models[kind] = folder / kind / "model.json"
                models[kind].parent.mkdir()
            options = ("--out", npz, "--model-out", models["nominal"])
            run("import", log, "--format", "csv", "--map", mapping, *options)
            run("fit", npz, "--from", models["nominal"], "--out", models["fitted"])
            for kind, path in models.items():
                rows.append(measure(craft, kind, path, timesteps, path.parent))
                print(rows[-1], flush=True)
    full, hover = largest_differences(rows)
    report.fill_page(
        report.RESULTS / "any_drone.md",
        "any_drone",
        table=table(rows),
        timesteps=f"{timesteps / 1e6:g}",
        full=f"{100.0 * full:.2f}",
        hover=f"{hover:.4f}",
    )


if __name__ == "__main__":
    report.command(main)
