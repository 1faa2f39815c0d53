"""How plainly flights show each hidden effect.

``python -m benchmarks.hidden [--plants 8] [--seed 0]`` prints, for every effect of the list, how plainly
scripted flights of a minute show its smallest and its largest size, in standard deviations
(``benchmarks.hidden.visibility``), with the base parameters known and not.
"""

import argparse
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from benchmarks.hidden.draws import EFFECTS, draw_base, draw_effect
from benchmarks.hidden.flights import fly
from benchmarks.hidden.visibility import signal_to_noise

FLIGHT_S = 60.0


def plainness(name: str, size: float, num_plants: int, seed: int) -> tuple[float, float]:
    """Return medians over plants of how plain an effect of a size is, the base parameters known or not."""
    values = []
    for number in range(num_plants):
        rng = np.random.default_rng([seed, number])
        truth = draw_base(rng)
        truth = replace(truth, effects={name: draw_effect(name, rng, size)})
        log = fly(truth, "scripted", FLIGHT_S, rng)
        values.append([signal_to_noise(truth, log, is_known) for is_known in (True, False)])
    return tuple(np.median(values, axis=0).tolist())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plants", type=int, default=8, help="flights of each effect and size")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| effect | size is in | smallest | plain, base known | not known | largest | plain | not known |")
    print("|---|---|---|---|---|---|---|---|")
    for name, drawn in tqdm(EFFECTS.items(), disable=None):
        cells = [name, drawn.unit.replace("|", "")]
        for size in (drawn.low, drawn.high):
            known, free = plainness(name, size, options.plants, options.seed)
            cells += [f"{size:g}", f"{known:.1f}", f"{free:.1f}"]
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
