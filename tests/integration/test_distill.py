"""A student that sees corners learns to command what a teacher that sees the state would."""

import dataclasses

import pytest

import flytrack_env
from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import CheckpointError, observation_layout
from baselines.purejaxrl_ppo.distill import CONFIG, Settings, check_teacher, distill, main
from baselines.purejaxrl_ppo.evaluate import EvaluationSettings, evaluate
from flytrack_env.model_file import model_from_json

TEACHER = load_checkpoint("robust")
MODEL = model_from_json(TEACHER.meta["model"], "model")


def make_config(num_updates: int) -> Config:
    sizes = {"num_envs": 64, "num_steps": 32, "num_minibatches": 4, "memory_size": 16}
    return dataclasses.replace(CONFIG, **sizes, total_timesteps=num_updates * 64 * 32)


@pytest.mark.slow
def test_a_student_comes_nearer_to_its_teacher_and_to_the_state():
    env = flytrack_env.make("FlyTrackCorners-v0", model=MODEL)
    _, errors = distill(env, check_teacher(TEACHER), make_config(60), seed=0)
    for values in errors:
        assert values.shape == (60,)
        # The teacher flies in the first updates, so that they see easier states than the last.
        assert values[-5:].mean() < 0.6 * values[0]


@pytest.mark.slow
def test_the_checkpoint_of_a_run_flies_by_corners_alone(tmp_path):
    main(Settings(out=tmp_path, total_timesteps=CONFIG.batch_size))
    student = load_checkpoint(tmp_path / "final.safetensors")
    assert student.meta["distilled"] == {"teacher": "robust", "updates": 1}
    assert student.observation_size == 35  # what FlyTrackCorners-v0 observes, and no state
    report = evaluate(EvaluationSettings(student.path, steps=50, out=tmp_path / "rollout.npy"))
    assert report.rollout.outcome.steps > 0


def test_a_teacher_that_cannot_teach_is_refused():
    corners = observation_layout(flytrack_env.make("FlyTrackCorners-v0"))
    blind = TEACHER._replace(
        meta={**TEACHER.meta, "observation": corners}, observation_size=35, env_id="FlyTrackCorners"
    )
    with pytest.raises(CheckpointError, match=r"teacher: expected one that sees the state: .* 35"):
        check_teacher(blind)
    remembers = TEACHER._replace(config=dataclasses.replace(TEACHER.config, memory_size=8))
    with pytest.raises(CheckpointError, match="teacher: memory_size: found 8, expected 0"):
        check_teacher(remembers)
