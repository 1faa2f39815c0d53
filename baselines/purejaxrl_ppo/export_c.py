"""A policy as a C99 header without dependencies (docs/export.md); ``policy_template.h`` is its text."""

import textwrap
from pathlib import Path
from string import Template

import numpy as np

from baselines.purejaxrl_ppo.export_policy import ExportedPolicy
from flytrack_env.state import ACTION_SIZE, STATE_SIZE

TEMPLATE = Path(__file__).with_name("policy_template.h")
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


def c_of(policy: ExportedPolicy) -> bytes:
    """Return the content of the header."""
    tables, calls = [], []
    for i, (kernel, bias) in enumerate(policy.layers):
        inputs, outputs = kernel.shape
        for name, size, array in (("kernel", f"{outputs} * {inputs}", kernel.T), ("bias", outputs, bias)):
            tables.append(f"static const float flytrack_{name}_{i}[{size}] = {{\n{_numbers(array)}\n}};")
        arguments = f"flytrack_kernel_{i}, flytrack_bias_{i}, {inputs}, {outputs}, layer_{i}, layer_{i + 1}"
        calls += [f"float layer_{i + 1}[{outputs}];", f"flytrack_layer({arguments});"]
        calls.append(f"flytrack_tanh({outputs}, layer_{i + 1});")
    text = Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        {name: _numbers(getattr(policy, name)) for name in NAMES},
        **(PAST if policy.past else dict.fromkeys(PAST, "")),
        about=_comment(policy.about).removeprefix(" * "),
        meanings="\n".join(" *\n" + _comment(f"{name}: {text}") for name, text in policy.meanings.items()),
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
    return textwrap.fill(text.replace("*/", "* /"), WIDTH, initial_indent=" * ", subsequent_indent=" * ")
