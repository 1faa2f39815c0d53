"""What a step from motors costs over one from sticks: ``python -m benchmarks.motor_cost``."""

from benchmarks import report
from benchmarks.env_speed import PLAIN, jax_contestant, measure, ratios


def main(repeats: int = 7) -> None:
    """Time ``vmap(step)`` of 1,024 environments in turns, CPU time, and print the ratios."""
    core = report.pin_to_one_core()
    from flytrack_env import Motion, nominal_parameters

    continuous = nominal_parameters()._replace(motion=Motion.CONTINUOUS)
    entries = [
        jax_contestant(PLAIN, "FlyTrack-v0"),
        jax_contestant("continuous", "FlyTrack-v0", model=continuous),
        jax_contestant("motors", "FlyTrackMotors-v0"),
    ]
    rates = measure(entries, repeats, warm_up=1)
    for name in (PLAIN, "continuous"):
        costs = ratios(rates, name, "motors")
        print(f"motors over {name}: {report.median_and_spread(costs, '.2f')}")
    print(f"{repeats} rounds, {core}. {report.provenance_line(report.provenance())}")


if __name__ == "__main__":
    report.command(main)
