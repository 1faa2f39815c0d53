"""A policy as an ONNX graph for any number of drones (docs/export.md)."""

import numpy as np

from baselines.purejaxrl_ppo.export_policy import ExportedPolicy
from flytrack_env.extras import check_installed
from flytrack_env.quaternion import Quaternion
from flytrack_env.state import STATE_SIZE

# In the textual form of onnx.parser. Inputs are float32 and so is the action; between, all is {real}.
GRAPH = """
<ir_version: 8, opset_import: ["": 17]>
flytrack_policy (float[drones, {state_size}] state, int64[drones] gate{past_input})
    => (float[drones, {num_actions}] action) {{
  real_state = Cast <to = {real}> (state)
  position, velocity, acceleration, attitude, body = Split <axis = 1> (real_state, parts)
  centre = Gather (centres, gate)
  frame = Gather (frames, gate)
  next_gate = Gather (next_rows, gate)
  relative = Sub (position, centre)
  relative_row = Unsqueeze (relative, axis_1)
  velocity_row = Unsqueeze (velocity, axis_1)
  vectors_w = Concat <axis = 1> (relative_row, velocity_row)
  frame_columns = Transpose <perm = [0, 2, 1]> (frame)
  vectors = MatMul (vectors_w, frame_columns)
  vectors_flat = Flatten (vectors)
  attitude_column = Unsqueeze (attitude, axis_2)
  attitude_row = Unsqueeze (attitude, axis_1)
  products = Mul (attitude_column, attitude_row)
  products_flat = Flatten (products)
  rotation_flat = Gemm (products_flat, rotation_of_products, identity)
  rotation = Reshape (rotation_flat, matrices)
  rotation_gate = MatMul (frame, rotation)
  rotation_gate_flat = Flatten (rotation_gate)
  quantities = Concat <axis = 1> (vectors_flat, rotation_gate_flat, body)
  centred = Sub (quantities, offsets)
  scaled = Mul (centred, factors)
  below = Min (scaled, limits)
  clipped = Max (below, lower_limits)
{layers}
  real_action = Clip ({last}, lowest, highest)
  action = Cast <to = 1> (real_action)
}}
"""
FLOAT32, FLOAT64 = 1, 11  # ONNX's numbers of types


def onnx_of(policy: ExportedPolicy, is_float64: bool = False) -> bytes:
    """Return the content of an ONNX file; is_float64: the arithmetic inside.

    Raises:
        ImportError: onnx is not installed.
    """
    check_installed("export", "ONNX files", "onnx")
    import onnx

    lines = ["  layer_0 = Concat <axis = 1> (clipped, next_gate)"]
    if policy.past:
        lines = [
            "  real_past = Cast <to = {real}> (past)",
            lines[0].replace("next_gate)", "next_gate, real_past)"),
        ]
    for i in range(len(policy.layers)):
        lines.append(f"  sum_{i} = Gemm (layer_{i}, kernel_{i}, bias_{i})")
        lines.append(f"  layer_{i + 1} = Tanh (sum_{i})")
    model = onnx.parser.parse_model(
        GRAPH.replace("{layers}", "\n".join(lines[:-1])).format(
            state_size=STATE_SIZE,
            num_actions=policy.layers[-1][1].size,
            past_input=f", float[drones, {policy.num_past}] past" if policy.past else "",
            last=f"sum_{len(policy.layers) - 1}",
            real=FLOAT64 if is_float64 else FLOAT32,
        )
    )
    arrays = _indices() | {
        name: array.astype(np.float64 if is_float64 else np.float32) for name, array in _reals(policy).items()
    }
    model.graph.initializer.extend(onnx.numpy_helper.from_array(arrays[name], name) for name in arrays)
    model.producer_name, model.doc_string = "flytrack", policy.about
    for value in (*model.graph.input, *model.graph.output):
        value.doc_string = policy.meanings[value.name]
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def _indices() -> dict[str, np.ndarray]:
    return {
        "parts": np.array([3, 3, 3, 4, 8]),
        "axis_1": np.array([1]),
        "axis_2": np.array([2]),
        "matrices": np.array([-1, 3, 3]),
    }


def _reals(policy: ExportedPolicy) -> dict[str, np.ndarray]:
    names = ("centres", "frames", "next_rows", "offsets", "factors", "limits")
    numbered = enumerate(policy.layers)
    layers = {
        f"{name}_{i}": one
        for i, layer in numbered
        for name, one in zip(("kernel", "bias"), layer, strict=True)
    }
    return {
        **{name: getattr(policy, name) for name in names},
        **layers,
        "rotation_of_products": rotation_of_products(),
        "identity": np.eye(3).ravel(),
        "lower_limits": -policy.limits,
        "lowest": np.array(-1.0),
        "highest": np.array(1.0),
    }


def rotation_of_products() -> np.ndarray:
    """Return the matrix (16, 9) from products q_i q_j to a rotation matrix, row by row, less the identity.

    A quadratic form's coefficient of q_i q_j and of q_j q_i is half of Q(e_i + e_j) - Q(e_i) - Q(e_j).
    """

    def form(quaternion: np.ndarray) -> np.ndarray:
        return np.array(Quaternion(*quaternion).axes()).T.ravel() - np.eye(3).ravel()

    units = np.eye(4)
    return np.array([0.5 * (form(a + b) - form(a) - form(b)) for a in units for b in units])
