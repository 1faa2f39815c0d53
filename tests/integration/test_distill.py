"""A student that sees corners learns to command what a teacher that sees the state would."""

import dataclasses
import hashlib

import pytest

import flytrack_env
from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo import distill as distilling
from baselines.purejaxrl_ppo.checkpoint import CheckpointError, observation_layout
from baselines.purejaxrl_ppo.config import ConfigError
from baselines.purejaxrl_ppo.distill import CONFIG, Settings, check_teacher, distill, main, make_env
from baselines.purejaxrl_ppo.evaluate import EvaluationSettings, evaluate

TEACHER = load_checkpoint("robust")
ENV = make_env(TEACHER, "FlyTrackCorners-v0")


def make_config(num_updates: int) -> Config:
    sizes = {"num_envs": 64, "num_steps": 32, "num_minibatches": 4, "memory_size": 16}
    return dataclasses.replace(CONFIG, **sizes, total_timesteps=num_updates * 64 * 32)


@pytest.mark.slow
def test_a_student_learns_and_its_checkpoint_flies_without_the_state(tmp_path, monkeypatch):
    """It comes nearer to its teacher and to the state."""
    measured = []

    def note(*arguments):
        measured.append(distill(*arguments))
        return measured[0]

    config = make_config(60)
    monkeypatch.setattr(distilling, "CONFIG", config)
    monkeypatch.setattr(distilling, "distill", note)
    settings = Settings(out=tmp_path, total_timesteps=config.total_timesteps)
    main(settings)
    for values in measured[0][1]:
        assert values.shape == (60,)
        # The teacher flies in the first updates, so that they see easier states than the last.
        assert values[-5:].mean() < 0.6 * values[0]
    student = load_checkpoint(tmp_path / "final.safetensors")
    digest = hashlib.sha256(TEACHER.path.read_bytes()).hexdigest()
    assert student.meta["distilled"] == {"teacher": "robust", "teacher_sha256": digest}
    assert student.observation_size == 35  # what FlyTrackCorners-v0 observes, and no state
    report = evaluate(EvaluationSettings(student.path, steps=50, out=tmp_path / "rollout.npy"))
    assert report.rollout.outcome.steps > 0
    with pytest.raises(ValueError, match=r"--out: .* holds the checkpoints of a run"):
        main(settings)


def test_a_teacher_that_cannot_teach_is_refused():
    corners = observation_layout(flytrack_env.make("FlyTrackCorners-v0"))
    blind = TEACHER._replace(
        meta={**TEACHER.meta, "observation": corners}, observation_size=35, env_id="FlyTrackCorners"
    )
    with pytest.raises(CheckpointError, match="teacher: expected one that observes"):
        check_teacher(blind)
    remembers = TEACHER._replace(config=dataclasses.replace(TEACHER.config, memory_size=8))
    with pytest.raises(CheckpointError, match="teacher: memory_size: found 8, expected 0"):
        check_teacher(remembers)
    unknown = {name: value for name, value in TEACHER.meta.items() if name != "model"}
    with pytest.raises(CheckpointError, match="teacher: model: found none"):
        check_teacher(TEACHER._replace(meta=unknown))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"critic_sees_state": False, "state_coef": 0.0}, "critic_sees_state: found False"),
        ({"memory_size": 0, "num_envs": 6, "num_minibatches": 4}, "num_minibatches: found 4"),
    ],
)
def test_a_configuration_without_a_lesson_is_refused(changes, expected):
    config = dataclasses.replace(make_config(2), **changes)
    with pytest.raises(ConfigError, match=expected):
        distill(ENV, check_teacher(TEACHER), config, seed=0)
