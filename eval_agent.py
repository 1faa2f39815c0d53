"""Fly a checkpoint: ``python eval_agent.py --checkpoint PATH --steps N [--episodes E] [--plants K]``.

A black box moves the drone; the environment's own gate logic decides what was passed, when, and why a flight
ended. With ``--plants``, drawn simulated plants move it instead. The first flight's rollout is written as a
plain numeric array (T, 25) = [x 21 | u 4]. docs/baseline.md describes what is printed and stored.
"""

import sys

import tyro

from baselines.purejaxrl_ppo.evaluate import EvaluationSettings, evaluate


def main() -> None:
    """Fly as the command line says, print the report, write the files."""
    config = (tyro.conf.FlagCreatePairsOff,)
    settings = tyro.cli(EvaluationSettings, prog="eval_agent.py", description=__doc__, config=config)
    try:
        report = evaluate(settings)
        print(report.text, end="")
        print("\n".join(report.write()))
    except (ImportError, ValueError, OSError) as error:
        print(f"eval_agent.py: error: {error}", file=sys.stderr)
        raise SystemExit(2) from error


if __name__ == "__main__":
    main()
