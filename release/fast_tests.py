"""The fast tests: what each release of a dependency must pass. Minutes of one core, most of it compiling."""

# Of every part of the package that meets a dependency: whole files, and the telling tests of dear ones.
FAST_TESTS = (
    # The environment, its ids, and what models are made of.
    "tests/contract/test_registration.py",
    "tests/unit/test_params.py",
    "tests/unit/test_dynamics.py",
    "tests/unit/test_model_file.py",
    "tests/unit/test_env.py::test_flight_ends_in_many_ways_and_stays_finite",
    "tests/unit/test_env.py::test_auto_reset_leaves_nothing_behind_in_a_flight",
    "tests/unit/test_episode_ends.py::test_final_observation_is_the_one_before_the_reset",
    "tests/unit/test_env.py::test_wrong_arguments_say_what_was_expected",
    # Wrappers, ours and gymnax's.
    "tests/unit/test_wrappers.py::test_orders_that_make_sense_have_the_same_spaces_and_parameters",
    "tests/unit/test_wrappers.py::test_after_every_kind_of_end_an_episode_begins_as_if_nothing_had_been",
    "tests/unit/test_wrappers.py::test_legacy_step_goes_around_all_of_them_and_can_be_copied",
    "tests/unit/test_wrappers.py::test_gymnax_wrappers_go_around_ours",
    # Gymnasium.
    "tests/contract/test_gymnasium.py::test_checker_of_gymnasium_gives_no_warning",
    "tests/contract/test_gymnasium.py::test_both_environments_agree_with_gymnax",
    "tests/contract/test_gymnasium.py::test_vector_environment_returns_what_gymnasiums_own_does",
    "tests/contract/test_gymnasium.py::test_constructors_survive_cloudpickle",
    # A black box: jax.export, out and in.
    "tests/unit/test_blackbox_plant.py::test_rebuilt_artifact_is_the_committed_one",
    "tests/unit/test_blackbox.py::test_environment_flies_the_black_box",
    # PPO, checkpoints, MLflow.
    "tests/unit/test_ppo.py",
    "tests/unit/test_checkpoint.py",
    "tests/integration/test_ppo_tracking.py::test_mlflow_is_told_everything_once_though_the_run_was_cut_off",
    # Identification.
    "tests/unit/test_collect.py::test_log_is_what_the_plant_did",
    "tests/unit/test_fit.py::test_truth_is_found_without_noise",
)
