"""What the clients reach: ``python -m clients.measure``.

Runs the training of ``make test-clients`` for several seeds, prints each, and writes a table.
"""

import time
from statistics import fmean

from benchmarks import report
from clients import (
    cleanrl_loop,
    evosax_es,
    purejaxrl_loop,
    rejax_ppo,
    sb3_contrib_trpo,
    sb3_ppo,
    sbx_ppo,
    skrl_ppo,
    torchrl_ppo,
)

CLIENTS = {
    "rejax": rejax_ppo,
    "stable-baselines3": sb3_ppo,
    "sbx-rl": sbx_ppo,
    "sb3-contrib": sb3_contrib_trpo,
    "skrl": skrl_ppo,
    "torchrl": torchrl_ppo,
    "evosax": evosax_es,
    "gymnasium": cleanrl_loop,  # a loop of one's own, with Gymnasium's wrappers
    "gymnax": purejaxrl_loop,  # a compiled loop, with gymnax's wrapper
}
HEADER = "client | return before | return after | gates before | gates after | CPU (s)"


def summarize(rows: list[tuple[float, ...]]) -> list[str]:
    """Return the mean of each number of a client over its seeds, with lowest and highest.

    Args:
        rows: returns and gates before and after, and CPU seconds, of each seed.
    """
    cells = []
    for number, digits in enumerate((".2f", ".2f", ".2f", ".2f", ".0f")):
        values = [row[number] for row in rows]
        cells.append(f"{fmean(values):{digits}} ({report.spread(values, digits)})")
    return cells


def main(seeds: int = 5) -> None:
    """Measure every client with ``seeds`` seeds; print and write the table.

    Exits with status 1 if a client misses a margin.
    """
    reached = dict.fromkeys(CLIENTS, 0)
    rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in CLIENTS}
    for name, client in CLIENTS.items():
        for seed in range(seeds):
            start_s = time.process_time()
            outcome = client.measure(seed)
            seconds = time.process_time() - start_s
            reached[name] += outcome.has_gained(client.RETURN_MARGIN, client.GATE_MARGIN)
            rows[name].append((*outcome, seconds))
            numbers = [f"{value:.2f}" for value in rows[name][-1]]
            print(name, seed, *numbers, sep=", ", flush=True)
    figures = [
        report.Figure(
            f"{name}: seeds that gain {client.RETURN_MARGIN:g} in return "
            f"and {client.GATE_MARGIN:g} in gates",
            "100 %",
            f"{reached[name] / seeds:.0%}",
            seeds,
        )
        for name, client in CLIENTS.items()
    ]
    report.fill_page(
        report.RESULTS / "clients.md",
        "clients",
        packages=[*CLIENTS, "torch"],
        figures=report.figures_table(figures),
        table=report.table(HEADER, [[name, *summarize(of)] for name, of in rows.items()]),
    )
    if min(reached.values()) < seeds:
        raise SystemExit(1)


if __name__ == "__main__":
    report.command(main)
