"""Close the loop on a black box: ``python -m flytrack_loop --black-box acro_step.bin [--out FOLDER]``.

Collects, fits the minimal model, trains, flies; diagnoses the log of that flight, extends the model, trains
again and flies again. Prints before and after; writes logs, models, diagnosis, policies, flights and
``loop.json``.
"""

import argparse
from pathlib import Path

from baselines.purejaxrl_ppo import Config
from flytrack_env import blackbox
from flytrack_env.files import fresh_folder
from flytrack_loop.loop import Settings, close_loop
from flytrack_loop.report import describe, write_flights


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, close the loop, print before and after."""
    parser = argparse.ArgumentParser(prog="python -m flytrack_loop", description=__doc__)
    parser.add_argument("--black-box", type=Path, required=True)
    parser.add_argument("--out", type=Path, help="folder (default: runs/loop_NAME, or the next free one)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--total-timesteps", type=float, default=Config.total_timesteps, help="of each training"
    )
    defaults = Settings()
    parser.add_argument("--minutes", type=float, default=defaults.minutes, help="of excitation")
    parser.add_argument(
        "--log-seconds", type=float, default=defaults.log_seconds, help="of the policy's flights in the log"
    )
    parser.add_argument(
        "--noise",
        type=float,
        default=defaults.noise,
        help="of the sensors in all logs: 0 none, 1 common ones",
    )
    given = parser.parse_args(arguments)
    settings = Settings(given.minutes, given.log_seconds, given.noise)
    try:
        plant = blackbox.load(given.black_box)
        out = given.out or fresh_folder(Path("runs") / f"loop_{given.black_box.stem}")
        config = Config(total_timesteps=int(given.total_timesteps))
        loop = close_loop(plant, out, config, given.seed, settings)
        files = write_flights(out, loop, plant, given.seed)
    except (ValueError, OverflowError, OSError) as error:
        parser.error(str(error))
    print(describe(loop))
    print(f"written: {out}/ with loop.json, diagnosis/report.html, {', '.join(one.name for one in files)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
