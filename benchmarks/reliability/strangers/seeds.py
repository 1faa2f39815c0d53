"""Small files of every kind that are well, written by the package itself, to be damaged."""

import gzip
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo import Config, make_network
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from benchmarks.reliability.strangers.flight_logs import write_blackbox, write_ulog
from flytrack_env import load_track, nominal_parameters, random_track, save_model, save_track
from flytrack_env.effects import BY_NAME
from flytrack_env.references import Reference, save_reference, track_digest
from flytrack_env.rollout import save_rollout
from flytrack_env.state import ACTION_SIZE, QUATERNION, STATE_SIZE
from flytrack_sysid import FlightLog, Script, save_log, save_script
from flytrack_sysid.log import CHANNELS
from flytrack_sysid.manoeuvres import MANOEUVRES

NUM_ROWS = 12
MAPPING = """[time]
column = "ms"
unit = "ms"
[rows]
first = 1
every = 2
[command]
columns = ["ail", "ele", "rud", "thr"]
low = [1000, 2000, 2000, 1000]
high = [2000, 1000, 1000, 2000]
[rates]
columns = ["p", "q", "r"]
unit = "deg/s"
frame = "frd"
[attitude]
euler = ["roll", "pitch", "yaw"]
unit = "deg"
body = "frd"
world = "ned"
[battery]
column = "mv"
scale = 0.001
[craft]
max_rate_deg_s = [500, 500, 500]
mass_kg = 0.6
voltage_v = [14.0, 16.8]
"""
SHORT_MAPPING = """[time]
step_s = 0.01
[command]
columns = ["ail", "ele", "rud", "thr"]
clip = true
[rows.manifest]
file = "manifest.csv"
key = "file"
count = "rows"
"""
MANIFEST = "file,rows\nfile.csv,5\nother.csv,7\n"


def _states() -> np.ndarray:
    states = np.random.default_rng(0).normal(size=(NUM_ROWS, STATE_SIZE))
    states[:, 2] = 5.0
    states[:, QUATERNION] = [1.0, 0.0, 0.0, 0.0]
    states[:, 16:20] = 0.1
    states[:, 20] = 23.0
    return states


def _commands(num_rows: int = NUM_ROWS) -> np.ndarray:
    return np.random.default_rng(1).uniform(-1.0, 1.0, (num_rows, ACTION_SIZE))


def write_tracks(folder: Path) -> None:
    """Write a shipped track, and a drawn one."""
    save_track(folder / "a.toml", load_track("flytrack"))
    save_track(folder / "b.toml", random_track(0))


def write_models(folder: Path) -> None:
    """Write a bare model, and one with effects and a provenance."""
    model = nominal_parameters()
    save_model(folder / "a.json", model, {})
    effects = [BY_NAME[name].parameters() for name in ("quadratic_drag", "voltage_sag", "wind")]
    save_model(folder / "b.json", model.with_effects(*effects), {"data": {"file": "log.npz"}, "rows": 12})


def write_rollouts(folder: Path) -> None:
    """Write a rollout, and one of short rows."""
    save_rollout(folder / "a.npy", _states(), _commands())
    np.save(folder / "b.npy", np.concatenate([_states()[:, :18], _commands()], axis=1))


def _log() -> FlightLog:
    rng = np.random.default_rng(2)
    channels = {name: rng.normal(size=(NUM_ROWS, len(columns))) for name, columns in CHANNELS.items()}
    channels["u"] = channels["uprev"] = _commands()
    channels["q"] = np.tile([1.0, 0.0, 0.0, 0.0], (NUM_ROWS, 1))
    segment = np.repeat([0, 1], NUM_ROWS // 2)
    return FlightLog(0.01 * np.arange(NUM_ROWS), channels, segment)


def write_logs(suffix: str) -> Callable[[Path], None]:
    """Return what writes a log of all channels, and one of few."""

    def write(folder: Path) -> None:
        log = _log()
        save_log(folder / f"a{suffix}", log)
        save_log(folder / f"b{suffix}", log.without(*(set(CHANNELS) - {"u", "w", "q"})))

    return write


def write_scripts(folder: Path) -> None:
    """Write a script of two flights."""
    starts = _states()[:2]
    starts[:, 3:6] = 0.0
    kinds = tuple(list(MANOEUVRES)[:2])
    save_script(folder / "a.npz", Script(kinds, starts, _commands(10).reshape(2, 5, ACTION_SIZE)))


def write_references(folder: Path) -> None:
    """Write a reference with a bare model, and one with effects."""
    track, states = load_track("flytrack"), _states()
    drag = BY_NAME["quadratic_drag"].parameters()
    for name, model in (("a", nominal_parameters()), ("b", nominal_parameters().with_effects(drag))):
        reference = Reference(
            track=track.name,
            track_sha256=track_digest(track),
            kind="flying" if name == "a" else "standing",
            model_name="nominal",
            model=model,
            dt_s=0.01,
            time_s=0.01 * (NUM_ROWS - 1),
            states=states,
            commands=_commands(NUM_ROWS - 1),
            gate_times_s=np.linspace(0.01, 0.1, len(track.gates)),
            found={"solver": "none"},
        )
        save_reference(folder / f"{name}.npz", reference)


def write_mappings(folder: Path) -> None:
    """Write two mapping files."""
    (folder / "a.toml").write_text(MAPPING)
    (folder / "b.toml").write_text(SHORT_MAPPING)


def foreign_csv() -> str:
    """Return a log as others write it, which both mappings fit."""
    rng = np.random.default_rng(3)
    names = ["ms", "ail", "ele", "rud", "thr", "p", "q", "r", "roll", "pitch", "yaw", "mv"]
    rows = rng.normal(size=(NUM_ROWS, len(names)))
    rows[:, 0], rows[:, 1:5], rows[:, -1] = 10.0 * np.arange(NUM_ROWS), 1500.0, 16_000.0
    lines = [",".join(names), *(",".join(f"{value:.6g}" for value in row) for row in rows)]
    return "\n".join(lines) + "\n"


def write_foreign_csv(folder: Path) -> None:
    """Write a CSV log of others."""
    (folder / "a.csv").write_text(foreign_csv())


def write_packed_csv(folder: Path) -> None:
    """Write a compressed CSV log of others."""
    (folder / "a.csv.gz").write_bytes(gzip.compress(foreign_csv().encode(), mtime=0))


def write_ulogs(folder: Path) -> None:
    """Write PX4 logs: of all topics, and of those that must be there."""
    write_ulog(folder / "a.ulg")
    write_ulog(folder / "b.ulg", ("vehicle_angular_velocity", "vehicle_attitude", "vehicle_rates_setpoint"))


def write_blackboxes(folder: Path) -> None:
    """Write Betaflight logs: one, and two in a file."""
    write_blackbox(folder / "a.bbl")
    write_blackbox(folder / "b.bbl", 2, blackbox_high_resolution="1")


def write_settings(folder: Path) -> None:
    """Write settings of a training."""
    lines = [
        "total_timesteps = 2e6",
        "hidden_sizes = [64, 64]",
        "learning_rate = 3e-4",
        "affine_shuffle = true",
    ]
    (folder / "a.toml").write_text("\n".join([*lines, "initial_action = [0.0, 0.0, 0.0, -0.2]"]) + "\n")


def write_policies(folder: Path) -> None:
    """Write a policy, and one of the format without checksum and training."""
    config, size = Config(hidden_sizes=(3,)), 5
    params = make_network(config).init(jax.random.key(0), jnp.zeros((1, size)))
    description = {"env_id": "FlyTrack-v0", "track": "flytrack", "missed_gate": "terminate"}
    description |= {"observation_size": size, "model": {"parameters": [1.0, 2.0]}, "seed": 3}
    save_checkpoint(folder / "a.msgpack", params, config, description)
    training = {"step": np.zeros(3, np.int32), "key": np.zeros(2, np.uint32)}
    save_checkpoint(folder / "b.msgpack", params, config, description, training)
