"""What ``flytrack eval`` does with its flags."""

from baselines.purejaxrl_ppo.evaluate import EvaluationSettings, evaluate


def run_evaluation(settings: EvaluationSettings) -> None:
    """Fly a checkpoint, print the report and write the files."""
    report = evaluate(settings)
    print(report.text, end="")
    print("\n".join(report.write()))
