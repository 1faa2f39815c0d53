"""Training speed on one core, and what it costs to watch: ``python -m benchmarks.training_speed``.

Trains the default recipe for a number of steps, alone and with all that the command does by default
(checkpoints, evaluations with their charts, MLflow with a local store), in turns, and counts
process CPU time. Compilation and imports happen before: a first run, which is not counted, does
them.
"""

import statistics
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
from msgspec.structs import replace

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.tracking import local_uri
from baselines.purejaxrl_ppo.training import DEFAULT_OPTIONS, Options, Trainer
from benchmarks import report

TARGET_STEPS_PER_S, TARGET_COST, LIMIT_REPEATS = 800_000, 0.1, 5
ALL_ON = "steps per CPU second with everything on"
COST = "cost of checkpoints, evaluations, charts and MLflow, a new store included"
BOUND = (
    "steps per CPU second if products of matrices, at the best rate of this core, were all there is"
)


def matrix_limit(trainer: Trainer) -> float:
    """Return the steps per CPU second if only matrix products at the best rate took time.

    The best rate: a chain of products of a minibatch and a layer, which stay in the cache. A step
    takes a product with every weight to act, one to learn, one for the gradient of the weights, and
    one for that of the inputs except in the first layer.
    """
    width, chain = trainer.config.hidden_sizes[0], 200
    rows = trainer.config.batch_size // trainer.config.num_minibatches

    @jax.jit
    def multiply(values: jax.Array, weights: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, chain, lambda _, values: values @ weights, values)

    values, weights = jnp.ones((rows, width)), jnp.eye(width)
    jax.block_until_ready(multiply(values, weights))
    started_s = time.process_time()
    jax.block_until_ready(multiply(values, weights))
    products_per_s = chain * rows * width * width / (time.process_time() - started_s)
    leaves = jax.tree.leaves(trainer.start(jax.random.key(0)).train_state.params)
    sizes = [leaf.shape for leaf in leaves if leaf.ndim == 2]
    all_weights = sum(rows * columns for rows, columns in sizes)
    first = sum(
        rows * columns
        for rows, columns in sizes
        if rows == trainer.env.observation_space().shape[0]
    )
    return products_per_s / (4 * all_weights - first)


def measure(trainer: Trainer, options: Options, is_tracked: bool) -> float:
    """Return the environment steps per CPU second of one run."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        uri = local_uri(out) if is_tracked else ""
        started_s = time.process_time()
        checkpoint, _ = trainer.train(out, 0, replace(options, tracking_uri=uri))
        return checkpoint.meta["steps"] / (time.process_time() - started_s)


def main(total_timesteps: float = Config.total_timesteps, repeats: int = 1) -> None:
    """Measure in turns, print and write the table; exit 1 if a target is missed."""
    pinned = report.pin_to_one_core()
    trainer = Trainer(Config(total_timesteps=int(total_timesteps)))
    modes = {"alone": Options(), "with everything that is on by default": DEFAULT_OPTIONS}
    rates: dict[str, list[float]] = {name: [] for name in modes}
    measure(trainer, DEFAULT_OPTIONS, is_tracked=True)  # compiles and imports all that is used
    for _ in range(repeats):
        for name, options in modes.items():
            rates[name].append(measure(trainer, options, is_tracked=options is DEFAULT_OPTIONS))
            print(f"{name}: {rates[name][-1]:,.0f} steps per CPU s", flush=True)
    rows = [
        [name, f"{statistics.median(values):,.0f}", report.spread(values)]
        for name, values in rates.items()
    ]
    alone, watched = map(statistics.median, rates.values())
    cost = 1.0 - watched / alone
    limit = statistics.median(matrix_limit(trainer) for _ in range(LIMIT_REPEATS))
    figures = [
        report.Figure(ALL_ON, f"at least {TARGET_STEPS_PER_S:,}", f"{watched:,.0f}", repeats),
        report.Figure(COST, f"at most {TARGET_COST:.0%}", f"{cost:.1%}", repeats),
        report.Figure(BOUND, "", f"{limit:,.0f}", LIMIT_REPEATS),
    ]
    report.fill_page(
        report.RESULTS / "training_speed.md",
        "training_speed",
        table=report.table("training | median | lowest to highest", rows),
        figures=report.figures_table(figures),
        steps=total_timesteps,
        repeats=repeats,
        pinned=pinned.capitalize(),
    )
    if watched < TARGET_STEPS_PER_S or cost > TARGET_COST:
        raise SystemExit(1)


if __name__ == "__main__":
    report.command(main)
