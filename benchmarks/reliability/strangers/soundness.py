"""What must be true of anything that was loaded, whatever was done to its file."""

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from baselines.purejaxrl_ppo.config import Config
from flytrack_env.blackbox import BlackBox
from flytrack_env.model_file import SIZES
from flytrack_env.references import ghost_rollout
from flytrack_env.state import ACTION_SIZE, STATE_SIZE
from flytrack_env.tracks import build_course
from flytrack_sysid.log import CHANNELS
from flytrack_sysid.log_file import describe
from flytrack_sysid.script_file import check_script


def _all_finite(tree: Any) -> bool:
    return all(np.isfinite(np.asarray(leaf, float)).all() for leaf in jax.tree.leaves(tree))


def track(found: Any) -> None:
    """A track has a course of finite numbers, and a table of its gates."""
    course = build_course(found)
    assert course.num_gates == len(found.gates) >= 2 and _all_finite(course._asdict())
    assert found.rows().shape == (len(found.gates), 8) and found.rows().dtype == np.float64


def model(found: Any) -> None:
    """A model has finite numbers of the right shapes, and a provenance."""
    parameters, provenance = found
    assert isinstance(provenance, dict) and _all_finite(parameters)
    for name, size in SIZES.items():
        assert np.shape(getattr(parameters, name)) == ((size,) if size else ())


def rollout(found: Any) -> None:
    """A rollout has rows of float32; only the applied roll, pitch and yaw may be unknown."""
    states, actions = found
    assert states.shape == (len(states), STATE_SIZE) and actions.shape == (len(states), ACTION_SIZE)
    assert len(states) >= 1 and states.dtype == actions.dtype == np.float32
    assert np.isfinite(actions).all() and np.isfinite(np.delete(states, [16, 17, 18], axis=1)).all()


def log(found: Any) -> None:
    """A log has finite columns of one length, commands within [-1, 1], unit quaternions."""
    assert len(found) >= 1 and np.isfinite(found.time).all() and found.segment.dtype == np.int64
    for name, values in found.channels.items():
        assert values.shape == (len(found), len(CHANNELS[name])) and np.isfinite(values).all()
    assert np.abs(found["u"]).max() <= 1.0 + 1e-6
    if "q" in found:
        assert np.allclose(np.linalg.norm(found["q"], axis=1), 1.0, atol=1e-9)
    with np.errstate(all="ignore"):  # speeds of 1e300 m/s are no speeds, and no error of the reader
        assert describe(found)


def imported(found: Any) -> None:
    """An import has a sound log, and says what it found."""
    log(found.log)
    assert len(found.sources) == len(np.unique(found.log.segment)) and found.describe()
    values = [value for value in found.craft if value is not None]
    assert all(math.isfinite(one) and one > 0.0 for value in values for one in np.atleast_1d(value))


def script(found: Any) -> None:
    """A script can be flown."""
    check_script(found)
    assert found.starts.dtype == found.commands.dtype == np.float64


def reference(found: Any) -> None:
    """A reference has finite states, times above 0 and a model, and can be seen as a ghost."""
    assert _all_finite((found.states, found.commands, found.gate_times_s, found.model))
    assert found.dt_s > 0.0 and found.time_s > 0.0 and isinstance(found.track, str)
    states, _ = ghost_rollout({"standing": found, "flying": found}, 5)
    assert states.shape == (5, STATE_SIZE)


def settings(found: Any) -> None:
    """Settings are those of a configuration, each of its type."""
    config = Config(**found)
    for field in dataclasses.fields(Config):
        value, usual = getattr(config, field.name), field.default
        assert type(value) is type(usual), field.name


def checkpoint(found: Any) -> None:
    """A checkpoint has finite parameters of its network, settings to train with, and names."""
    found.config.check()
    assert _all_finite(found.params) and isinstance(found.meta, dict)
    assert all(isinstance(name, str) for name in (found.env_id, found.track, found.meta["missed_gate"]))
    assert found.network.hidden_sizes == found.config.hidden_sizes and found.observation_size >= 1
    training = {} if found.training is None else found.training
    assert all(isinstance(array, np.ndarray) for array in training.values())


def runner(found: Any) -> None:
    """A training's state that was restored has the steps to go on from, and finite parameters."""
    state, steps = found
    assert steps >= 0 and _all_finite(state.train_state.params)


def black_box(found: Any) -> None:
    """A black box is a plant of one of both sizes."""
    assert isinstance(found, BlackBox) and found.state_size in (18, 21)
