"""The champion of the FlyTrack course: ``python -m benchmarks.champion [--only-fly]``.

Trains it on the identified and extended model of the shipped black box and flies it on the black box itself,
from noisy starts. Where all flights finish and are fast enough, the policy alone becomes
baselines/purejaxrl_ppo/champion/flytrack.safetensors, and a page compares it with the time-optimal flight.
``--only-fly`` flies the one that is there.
"""

import argparse
import math
from pathlib import Path

from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from baselines.purejaxrl_ppo.evaluate import SHIPPED_BLACK_BOX, EvaluationSettings, evaluate
from baselines.purejaxrl_ppo.run import Options
from baselines.purejaxrl_ppo.training import train_policy
from benchmarks import report
from flytrack_env.files import fresh_folder, write_atomically

CHAMPION = report.ROOT / "baselines" / "purejaxrl_ppo" / "champion" / "flytrack.safetensors"
MODEL = report.ROOT / "benchmarks" / "data" / "time_optimal" / "black_box.json"
# Fast laps use the width of the openings, so that offsets at a pass cost less than in the default reward; and
# a policy that explores less while it learns can fly nearer to the frames. Its model is exact: no margin.
REWARD = {"off_centre": -0.05}
CONFIG = Config(total_timesteps=160_000_000, min_std=0.02, gate_margin=0.0)
SEED = 0
AIM = 1.08  # times the time-optimal flying lap
STEPS, EPISODES, LAPS, FLIGHT_SEED = 2500, 256, 3, 100


def train(out: Path) -> Path:
    """Train the champion; return the file of the policy alone."""
    options = Options(checkpoint_every=CONFIG.total_timesteps // 10)
    checkpoint, _ = train_policy(out, CONFIG, SEED, options=options, model=MODEL, reward=REWARD)
    save_checkpoint(out / CHAMPION.name, checkpoint.params, checkpoint.config, checkpoint.meta)
    return out / CHAMPION.name


def main() -> None:
    """Train, fly, and where the aim is met, ship the policy and write the page; else exit 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only-fly", action="store_true", help="fly the shipped champion, train none")
    arguments = parser.parse_args()
    policy = CHAMPION if arguments.only_fly else train(fresh_folder(Path("runs/champion")))
    settings = EvaluationSettings(
        policy, STEPS, EPISODES, LAPS, black_box=SHIPPED_BLACK_BOX, seed=FLIGHT_SEED, ghost=True
    )
    found = evaluate(settings)
    print(found.text)
    percent = found.numbers["optimal"]["flying_lap_s"]["mean_percent_above"]
    times = math.inf if percent is None else 1.0 + percent / 100.0
    if found.numbers["success"]["share"] < 1.0 or times > AIM:
        raise SystemExit(1)
    write_atomically(CHAMPION, policy.read_bytes())
    meta = load_checkpoint(CHAMPION).meta
    report.fill_page(
        report.RESULTS / "champion.md",
        "champion",
        name=CHAMPION.relative_to(report.ROOT),
        meta=meta,
        millions=meta["steps"] / 1e6,
        model=MODEL.relative_to(report.ROOT),
        reward=", ".join(f"{term} {weight:g}" for term, weight in REWARD.items()),
        config=CONFIG,
        settings=settings,
        text=found.text,
        times=times,
        aim=AIM,
    )


if __name__ == "__main__":
    main()
