"""What the clients reach, seed by seed: ``python -m clients.measure``.

Runs the training of ``make test-clients`` for several seeds and writes a table of all of them.
"""

import argparse
import platform
import time
from importlib.metadata import version
from pathlib import Path

import jax

from clients import evosax_es, rejax_ppo, sb3_ppo
from flytrack_env.files import write_atomically

CLIENTS = {"rejax": rejax_ppo, "stable-baselines3": sb3_ppo, "evosax": evosax_es}
PACKAGES = (*CLIENTS, "torch", "gymnasium", "gymnax")
HEADER = (
    "| client | seed | return before | return after | gates before | gates after | wall (s) | CPU (s) |\n"
    "|---|---|---|---|---|---|---|---|\n"
)


def measure_seed(name: str, seed: int) -> tuple[bool, str]:
    """Return whether a client's training gains its margins with a seed, and its row of the table."""
    client = CLIENTS[name]
    wall_start, cpu_start = time.perf_counter(), time.process_time()
    outcome = client.measure(seed)
    wall_s, cpu_s = time.perf_counter() - wall_start, time.process_time() - cpu_start
    is_reached = outcome.return_gain >= client.RETURN_MARGIN and outcome.gate_gain >= client.GATE_MARGIN
    row = (
        f"| {name} | {seed} | {outcome.return_before:.2f} | {outcome.return_after:.2f} | "
        f"{outcome.gates_before:.2f} | {outcome.gates_after:.2f} | {wall_s:.0f} | {cpu_s:.0f} |\n"
    )
    return is_reached, row


def main() -> None:
    """Measure every client with every seed, print and write the table; exit 1 if one misses a margin."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--table", type=Path, default=Path("docs/results/clients.md"))
    arguments = parser.parse_args()
    reached, rows = {name: 0 for name in CLIENTS}, []
    for name in CLIENTS:
        for seed in range(arguments.seeds):
            is_reached, row = measure_seed(name, seed)
            reached[name] += is_reached
            rows.append(row)
            print(row, end="", flush=True)
    margins = "".join(
        f"- {name}: margins {client.RETURN_MARGIN:g} in return and {client.GATE_MARGIN:g} in gates, "
        f"gained by **{reached[name]} of {arguments.seeds}** seeds\n"
        for name, client in CLIENTS.items()
    )
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    text = (
        "# Clients: training by code of others\n\n"
        f"`python -m clients.measure --seeds {arguments.seeds}` on {platform.machine()}, "
        f"{jax.device_count()} {jax.default_backend()} device, jax {jax.__version__}, {versions}. "
        "Means over the episodes of an evaluation before training and one after it "
        "([what is trained](../clients.md)); times include compilation.\n\n"
        f"{margins}\n{HEADER}{''.join(rows)}"
    )
    write_atomically(arguments.table, text.encode())
    if min(reached.values()) < arguments.seeds:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
