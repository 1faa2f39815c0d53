"""A policy as an ONNX graph for any number of drones; ``policy_template.onnxtxt`` is its text."""

from pathlib import Path
from string import Template

import numpy as np

from baselines.purejaxrl_ppo.export_policy import ExportedPolicy
from flytrack_env.extras import check_installed
from flytrack_env.quaternion import Quaternion
from flytrack_env.state import ACTION_SIZE, STATE_SIZE

TEMPLATE = Path(__file__).with_name("policy_template.onnxtxt")
FLOAT32, FLOAT64 = 1, 11  # ONNX's numbers of types


def onnx_of(policy: ExportedPolicy, is_float64: bool = False) -> bytes:
    """Return the content of an ONNX file; is_float64: the arithmetic between float32 inputs and action.

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
    lines += [f"layer_0 = Concat <axis = 1> (clipped, next_gate{', real_past' if policy.past else ''})"]
    for i, (kernel, bias) in enumerate(policy.layers):
        arrays |= {f"kernel_{i}": kernel, f"bias_{i}": bias}
        lines.append(f"sum_{i} = Gemm (layer_{i}, kernel_{i}, bias_{i})")
        lines.append(f"layer_{i + 1} = Tanh (sum_{i})")
    text = Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        state_size=STATE_SIZE,
        num_actions=ACTION_SIZE,
        past_input=f", float[drones, {policy.num_past}] past" if policy.past else "",
        network="\n".join("  " + line for line in lines[:-1]),  # no tanh behind the last layer
        last=f"sum_{len(policy.layers) - 1}",
        real=real,
    )
    model = onnx.parser.parse_model(text)
    dtype = np.float64 if is_float64 else np.float32
    tensors = (onnx.numpy_helper.from_array(array.astype(dtype), name) for name, array in arrays.items())
    model.graph.initializer.extend(tensors)
    model.producer_name, model.doc_string = "flytrack", policy.about
    for value in (*model.graph.input, *model.graph.output):
        value.doc_string = policy.meanings[value.name]
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def rotation_of_products() -> np.ndarray:
    """Return the matrix (16, 9) from products q_i q_j to a rotation matrix, row by row, less the identity.

    A quadratic form's coefficient of q_i q_j and of q_j q_i is half of Q(e_i + e_j) - Q(e_i) - Q(e_j).
    """

    def form(quaternion: np.ndarray) -> np.ndarray:
        return np.array(Quaternion(*quaternion).axes()).T.ravel() - np.eye(3).ravel()

    units = np.eye(4)
    return np.array([0.5 * (form(a + b) - form(a) - form(b)) for a in units for b in units])
