"""Write a policy for the drone itself: ``flytrack export CHECKPOINT --c policy.h``.

The files take the drone's state and the gate to fly, and give the stick commands (docs/export.md),
as the evaluator computes them: observation before the gate, network, mean action, clipped to [-1,
1]. Noise of sensors and drawn models are of the environment, and no part of it.
``policy_template.h`` is the text of a C99 header without dependencies, ``policy_template.onnxtxt``
that of an ONNX graph for any number of drones.
"""

import dataclasses
import textwrap
from itertools import count, takewhile
from pathlib import Path
from string import Template
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import simulated_env
from baselines.purejaxrl_ppo.config import OptionalName, OptionalPath
from flytrack_env.extras import check_installed
from flytrack_env.files import write_atomically
from flytrack_env.observations import OBSERVATION, Entry, observe_race
from flytrack_env.params import EnvParams
from flytrack_env.quaternion import Quaternion
from flytrack_env.state import ACTION_SIZE, STATE_SIZE, unpack
from flytrack_env.thrust import collective_thrust, hover_action
from flytrack_env.tracks import GateFrame

FOLDER = Path(__file__).parent  # of the templates
FLOAT32, FLOAT64 = 1, 11  # ONNX's numbers of types
WIDTH = 110
NAMES = ("centres", "frames", "free", "next_rows", "offsets", "factors", "limits", "blend")
PAST = {  # what a policy that reads earlier actions has besides
    "past_in_words": ", and the earlier actions",
    "past_parameter": " const float past[FLYTRACK_PAST],",
    "past_argument": " past,",
    "past_rows": """
    for (int i = 0; i < FLYTRACK_PAST; i++) {
        observation[FLYTRACK_OF_DRONE + 6 + i] = past[i];
    }""",
}
OF_NEXT_GATE = (
    "next_gate",
    "next_direction",
)  # the last entries of OBSERVATION, which no state changes
OF_DRONE = tuple(entry for entry in OBSERVATION if entry.key not in OF_NEXT_GATE)
KINDS_OF_PAST = ("commanded", "applied")
SENTENCES = {
    "state": (
        "0:3 position, world, m; 3:6 velocity, world, m/s; 6:9 acceleration, not read; "
        "9:13 attitude, quaternion w, x, y, z of norm 1, body to world; "
        "13:16 angular velocity, body, rad/s; "
        "16:20 applied action, that is the command after the drone's lag: roll, pitch, yaw, "
        "thrust; "
        "20 battery, V, from {empty_v} (empty) to {full_v} (full), as the policy was trained. "
        "World: the track's, z up. Body: x forward, y left, z up."
    ),
    "gate": "index of the gate to fly, 0 to {last_gate}, in the order of the track {track}.",
    "past": (
        "the last {num_actions} {kind} actions, the latest first, each roll, pitch, yaw, thrust "
        "in [-1, 1]; at the start of a flight all of them are the applied action."
    ),
    "action": (
        "roll, pitch, yaw, thrust in [-1, 1]. Full stick asks for {full_stick} deg/s about body "
        "x, y, z; thrust is -1 for none and 1 for full. With a full battery of {full_v} V the "
        "thrust map that the policy was trained with gives {full_weights} times the weight at full "
        "thrust, and {hover} hovers: compare both with the craft."
    ),
}


class ExportedPolicy(NamedTuple):
    """A policy as arrays, float64, and what its files say about it.

    Attributes:
        centres: of the gates, world, (num_gates, 3), m.
        frames: of the gates, rows forward, left, up, world, (num_gates, 3, 3).
        free: half of the opening less the drone's radius, (num_gates,), m.
        next_rows: rows of the observation about the gate after the next, (num_gates, 6).
        offsets: of the rows before these, (23,): clip((quantity - offset) * factor, -limit, limit).
        factors: as ``offsets``.
        limits: as ``offsets``.
        past: entries of earlier actions, behind ``next_rows``.
        layers: kernel (num_inputs, num_outputs) and bias; tanh between layers.
        blend: share of the way to the command that the lags of the checkpoint's model go in a step,
            (4,).
        about: sentences about the policy.
        meanings: of inputs and output, by name.
    """

    centres: np.ndarray
    frames: np.ndarray
    free: np.ndarray
    next_rows: np.ndarray
    offsets: np.ndarray
    factors: np.ndarray
    limits: np.ndarray
    past: tuple[Entry, ...]
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    blend: np.ndarray
    about: str
    meanings: dict[str, str]

    @property
    def num_past(self) -> int:
        """How many numbers of earlier actions it reads."""
        return sum(entry.size for entry in self.past)


def policy_of(checkpoint: Checkpoint, name: str, track: str | None = None) -> ExportedPolicy:
    """Return the policy of a checkpoint on a track, by default on its own.

    Args:
        checkpoint: of the policy.
        name: of the checkpoint's file.
        track: name or path of another track.

    Raises:
        CheckpointError: a checkpoint that does not fit its environment, whose policy remembers, or
            whose observation has rows that cannot be exported.
        TrackError: a track that cannot be used.
    """
    if checkpoint.config.memory_size:
        raise CheckpointError(
            f"{name}: memory_size: found {checkpoint.config.memory_size}, expected 0: no "
            "policy that remembers can be exported yet"
        )
    env = simulated_env(checkpoint, track)
    if env.observation_table[: len(OBSERVATION)] != OBSERVATION:
        raise CheckpointError(
            f"{name}: observation: found that of {checkpoint.env_id}, expected one that begins "
            "with FlyTrack-v0's"
        )
    past = env.observation_table[len(OBSERVATION) :]
    unknown = [entry.key for entry in past if entry.key.rpartition("_")[0] not in KINDS_OF_PAST]
    if unknown:
        raise CheckpointError(
            f"{name}: observation: found {', '.join(unknown)}, expected rows of "
            f"{' or '.join(KINDS_OF_PAST)} actions after those of FlyTrack-v0"
        )
    params = env.default_params
    model, battery = params.model, params.model.battery
    coeffs, weight_n = np.asarray(model.thrust_coeffs, float), float(model.m) * float(model.g)
    sizes = [entry.size for entry in OF_DRONE]
    rate = f"{1.0 / params.dt:g} commands a second"
    words = {
        "last_gate": len(env.track.gates) - 1,
        "track": env.track.name,
        "num_actions": len(past),
        "kind": past[0].key.rpartition("_")[0] if past else "",
        "full_stick": ", ".join(f"{value:.0f}" for value in params.model.max_rate),
        "empty_v": f"{battery.empty_v:.4g}",
        "full_v": f"{battery.full_v:.4g}",
        "full_weights": f"{collective_thrust(1.0, battery.full_v, coeffs) / weight_n:.3f}",
        "hover": f"{hover_action(coeffs, weight_n, float(battery.full_v)):.3f}",
    }
    middle_v, half_v = battery.voltage(0.5), 0.5 * (battery.full_v - battery.empty_v)
    return ExportedPolicy(
        **_gates(params),
        offsets=np.repeat(
            [middle_v if entry.key == "battery" else 0.0 for entry in OF_DRONE], sizes
        ),
        factors=np.repeat(
            [1.0 / (half_v if entry.key == "battery" else entry.scale) for entry in OF_DRONE], sizes
        ),
        limits=np.repeat([entry.limit for entry in OF_DRONE], sizes),
        past=past,
        layers=_layers(checkpoint),
        blend=1.0 - np.exp(-params.dt / np.asarray(params.model.tau, float)),
        about=(
            f"FlyTrack {flytrack_env.__version__}: policy of {name}, track {env.track.name}, "
            f"{rate}."
        ),
        meanings={
            key: text.format(**words) for key, text in SENTENCES.items() if past or key != "past"
        },
    )


def _gates(params: EnvParams) -> dict[str, np.ndarray]:
    """Return the fields that depend on the gates."""
    gates = jax.tree.map(lambda leaf: np.asarray(leaf, float), params.course.gates)
    following = jax.tree.map(lambda leaf: np.roll(leaf, -1, axis=0), gates)
    battery = params.model.battery
    with jax.enable_x64(True):
        anywhere = unpack(jnp.zeros(STATE_SIZE))

        def observed(gate: GateFrame, next_gate: GateFrame) -> jax.Array:
            return jnp.stack(observe_race(anywhere, gate, next_gate, battery))

        rows = jax.vmap(observed)(gates, following)
    axes = [np.stack(axis, axis=-1) for axis in (gates.forward, gates.left(), gates.up)]
    return {
        "centres": np.stack(gates.centre, axis=-1),
        "frames": np.stack(axes, axis=1),
        "free": gates.half_opening - params.drone_radius,
        "next_rows": np.asarray(rows)[:, sum(entry.size for entry in OF_DRONE) :],
    }


def _layers(checkpoint: Checkpoint) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return the actor's layers, with the initial action in the last bias."""
    tower = checkpoint.params["params"]["actor_tower"]
    names = takewhile(
        tower.__contains__, (f"layers_{2 * i}" for i in count())
    )  # tanh has the odd numbers
    layers = [
        (np.asarray(tower[name]["kernel"], float), np.asarray(tower[name]["bias"], float))
        for name in names
    ]
    kernel, bias = layers[-1]
    return (*layers[:-1], (kernel, bias + checkpoint.config.initial_action))


def c_of(policy: ExportedPolicy) -> bytes:
    """Return the content of the header."""
    tables, calls = [], []
    for i, (kernel, bias) in enumerate(policy.layers):
        inputs, outputs = kernel.shape
        for name, size, array in (
            ("kernel", f"{outputs} * {inputs}", kernel.T),
            ("bias", outputs, bias),
        ):
            tables.append(
                f"static const float flytrack_{name}_{i}[{size}] = {{\n{_numbers(array)}\n}};"
            )
        arguments = (
            f"flytrack_kernel_{i}, flytrack_bias_{i}, {inputs}, {outputs}, layer_{i}, layer_{i + 1}"
        )
        calls += [f"float layer_{i + 1}[{outputs}];", f"flytrack_layer({arguments});"]
        calls.append(f"flytrack_tanh({outputs}, layer_{i + 1});")
    text = Template((FOLDER / "policy_template.h").read_text(encoding="utf-8")).substitute(
        {name: _numbers(getattr(policy, name)) for name in NAMES},
        **(PAST if policy.past else dict.fromkeys(PAST, "")),
        about=_comment(policy.about).removeprefix(" * "),
        meanings="\n".join(
            " *\n" + _comment(f"{name}: {text}") for name, text in policy.meanings.items()
        ),
        state_size=STATE_SIZE,
        num_gates=len(policy.centres),
        num_past=policy.num_past,
        num_of_drone=policy.limits.size,
        num_observation=policy.layers[0][0].shape[0],
        num_actions=ACTION_SIZE,
        layers="\n".join(tables),
        network="\n".join("    " + call for call in calls[:-1]),  # no tanh behind the last layer
        last=f"layer_{len(policy.layers)}",
    )
    return text.encode()


def _numbers(array: np.ndarray) -> str:
    """Return numbers as lines of C, each the shortest decimal that is the same float32."""
    words = [str(number) + "f," for number in array.astype(np.float32).ravel()]
    return textwrap.fill(" ".join(words), WIDTH, initial_indent="    ", subsequent_indent="    ")


def _comment(text: str) -> str:
    """Return text as lines inside a comment, which nothing in it can end."""
    return textwrap.fill(
        text.replace("*/", "* /"), WIDTH, initial_indent=" * ", subsequent_indent=" * "
    )


def onnx_of(policy: ExportedPolicy, is_float64: bool = False) -> bytes:
    """Return the content of an ONNX file.

    Args:
        is_float64: compute in float64 between the float32 inputs and the float32 action.

    Raises:
        ImportError: onnx is not installed.
    """
    check_installed("export", "ONNX files", "onnx")
    import onnx

    real = FLOAT64 if is_float64 else FLOAT32
    names = ("centres", "frames", "next_rows", "offsets", "factors", "limits")
    arrays = {name: getattr(policy, name) for name in names}
    arrays |= {"rotation_of_products": rotation_of_products(), "identity": np.eye(3).ravel()}
    arrays["highest"] = np.array(1.0)
    lines = [f"real_past = Cast <to = {real}> (past)"] if policy.past else []
    lines += [
        f"layer_0 = Concat <axis = 1> (clipped, next_gate{', real_past' if policy.past else ''})"
    ]
    for i, (kernel, bias) in enumerate(policy.layers):
        arrays |= {f"kernel_{i}": kernel, f"bias_{i}": bias}
        lines.append(f"sum_{i} = Gemm (layer_{i}, kernel_{i}, bias_{i})")
        lines.append(f"layer_{i + 1} = Tanh (sum_{i})")
    text = Template((FOLDER / "policy_template.onnxtxt").read_text(encoding="utf-8")).substitute(
        state_size=STATE_SIZE,
        num_actions=ACTION_SIZE,
        past_input=f", float[drones, {policy.num_past}] past" if policy.past else "",
        network="\n".join("  " + line for line in lines[:-1]),  # no tanh behind the last layer
        last=f"sum_{len(policy.layers) - 1}",
        real=real,
    )
    model = onnx.parser.parse_model(text)
    dtype = np.float64 if is_float64 else np.float32
    tensors = (
        onnx.numpy_helper.from_array(array.astype(dtype), name) for name, array in arrays.items()
    )
    model.graph.initializer.extend(tensors)
    model.producer_name, model.doc_string = "flytrack", policy.about
    for value in (*model.graph.input, *model.graph.output):
        value.doc_string = policy.meanings[value.name]
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def rotation_of_products() -> np.ndarray:
    """Return the matrix (16, 9) from products q_i q_j to a rotation matrix less the identity.

    The entries of the rotation matrix are listed row by row.

    A quadratic form's coefficient of q_i q_j and of q_j q_i is half of Q(e_i + e_j) - Q(e_i) -
    Q(e_j).
    """

    def form(quaternion: np.ndarray) -> np.ndarray:
        return np.array(Quaternion(*quaternion).axes()).T.ravel() - np.eye(3).ravel()

    units = np.eye(4)
    return np.array([0.5 * (form(a + b) - form(a) - form(b)) for a in units for b in units])


@dataclasses.dataclass(frozen=True)
class ExportSettings:
    """Write a policy as an ONNX file, a C header, or both; existing files are replaced."""

    checkpoint: tyro.conf.Positional[Path]
    """Checkpoint of a training: final.safetensors."""
    onnx: OptionalPath = None
    """Write an ONNX file."""
    c: OptionalPath = None
    """Write a C99 header."""
    track: OptionalName = None
    """Name or file of the track whose gates are built in; by default the checkpoint's."""
    float64: bool = False
    """Compute in float64 inside the ONNX file: it rounds less, but not every runtime can."""

    def check(self) -> None:
        """Raise ValueError, naming the flag, for settings that cannot be used."""
        paths = [
            path.resolve() for path in (self.checkpoint, self.onnx, self.c) if path is not None
        ]
        if len(paths) == 1:
            raise ValueError("--onnx, --c: found neither, expected a file to write")
        if len(set(paths)) < len(paths):
            raise ValueError(
                "--onnx, --c: found a file that is read or written twice, expected another"
            )
        if self.float64 and self.onnx is None:
            raise ValueError("--float64: found no --onnx, expected one: a C header is float32")


def export(settings: ExportSettings) -> list[Path]:
    """Write the files that the settings ask for, each as a whole or not at all; return their paths.

    Raises:
        ValueError, ImportError, OSError: settings, packages or files that cannot be used.
    """
    settings.check()
    policy = policy_of(
        load_checkpoint(settings.checkpoint), settings.checkpoint.name, settings.track
    )
    contents = {}  # all of them before any is written
    if settings.onnx is not None:
        contents[settings.onnx] = onnx_of(policy, settings.float64)
    if settings.c is not None:
        contents[settings.c] = c_of(policy)
    for path, content in contents.items():
        write_atomically(path, content)
    return list(contents)


def run_export(settings: ExportSettings) -> None:
    """Export, and print what was written."""
    for path in export(settings):
        print(f"{path}: {path.stat().st_size} bytes")
