"""Is it PureJaxRL's PPO? CartPole-v1 with its configuration: ``python -m benchmarks.cartpole``.

Single updates scatter by 100; the mean over all updates of the mean last return does not, so that
is what is compared. The target is what PureJaxRL's own ``ppo.py`` reaches, unmodified, over five
seeds. Our differences from it are switched off here.
"""

import gymnax
import jax
import numpy as np

from baselines.purejaxrl_ppo import Config, make_train
from benchmarks import report

TARGET, TOLERANCE = 413.0, 8.0
CONFIG = Config(
    total_timesteps=500_000,
    num_envs=4,
    num_steps=128,
    update_epochs=4,
    num_minibatches=4,
    learning_rate=2.5e-4,
    final_learning_rate_fraction=0.0,
    entropy_coef=0.01,
    max_grad_norm=0.5,
    hidden_sizes=(64, 64),
    bootstrap_at_truncation=False,
    batched_step=False,
    affine_shuffle=False,
    anneal_every_gradient=False,
)


def main(seeds: int = 5) -> None:
    """Train every seed, print and write the table; exit 1 if the mean misses the target."""
    env, params = gymnax.make("CartPole-v1")
    train = jax.jit(make_train(env, params, CONFIG))
    areas = []
    for seed in range(seeds):
        _, metrics = train(jax.random.key(seed))
        areas.append(float(np.mean(metrics["last_return"])))
        print(f"seed {seed}: {areas[-1]:.1f}", flush=True)
    mean = float(np.mean(areas))
    figure = report.Figure(
        "mean last return, mean of seeds", f"{TARGET:g} +- {TOLERANCE:g}", f"{mean:.1f}", seeds
    )
    report.fill_page(
        report.RESULTS / "cartpole.md",
        "cartpole",
        figures=report.figures_table([figure]),
        table=report.table(
            "seed | mean last return", [[n, f"{area:.1f}"] for n, area in enumerate(areas)]
        ),
    )
    if abs(mean - TARGET) > TOLERANCE:
        raise SystemExit(1)


if __name__ == "__main__":
    report.command(main)
