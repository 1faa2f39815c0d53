"""The fast tests: what each release of a dependency must pass. A few minutes on one core."""

# The environment and its ids, wrappers, the Gymnasium adapter, PPO, identification: each has a file here.
FAST_TESTS = (
    "tests/test_registration.py",
    "tests/test_dynamics.py",
    "tests/test_params.py",
    "tests/test_gates.py",
    "tests/test_laps.py",
    "tests/test_rewards.py",
    "tests/test_resets.py",
    "tests/test_wrappers.py",
    "tests/test_gymnasium.py",
    "tests/test_model_file.py",
    "tests/test_blackbox.py",
    "tests/test_ppo.py",
    "tests/test_checkpoint.py",
    "tests/test_collect.py",
    "tests/test_fit.py",
)
