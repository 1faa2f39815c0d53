"""Exported policies act as observation and network do, and what cannot be exported is told."""

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from baselines.purejaxrl_ppo import export, load_checkpoint
from baselines.purejaxrl_ppo.export import policy_of
from flytrack_env import make
from flytrack_env.dynamics import lag
from flytrack_env.state import POSITION, Action, unpack, unpack_action
from flytrack_env.wrappers import NoiseParams, ObservationNoise
from tests.support.compiled_policy import CompiledPolicy, states_in_box
from tests.support.evaluated import write_checkpoint
from tests.support.refusals import refused, run

SEED, COUNT = 5, 200
MAX_ERROR, MAX_LAG_ERROR, MAX_FLOAT64_ERROR = 1e-5, 1e-6, 1e-7
# Environment id, track, hidden layers, and flags of the ONNX file.
CASES = {
    "float64": ("FlyTrack-v0", "flytrack", (8, 5), ["--float64"]),
    "noise and earlier actions": ("FlyTrackRobust-v0", "figure_eight", (8,), []),
}


def act_in_python(env, checkpoint, dtype):
    """Return states, gates, past actions, and the policy's actions given the observations."""
    params = env.default_params
    if ObservationNoise.key in params.wrappers:
        none = NoiseParams(0.0, 0.0, 0.0, 0.0)
        params = params.replace(wrappers={**params.wrappers, ObservationNoise.key: none})
    params, weights = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, dtype), (params, checkpoint.params)
    )
    policy = policy_of(checkpoint, "a.safetensors")
    states, gates = states_in_box(policy, COUNT, SEED)
    rng = np.random.default_rng(SEED)
    past = rng.uniform(-1.0, 1.0, (COUNT, len(policy.past), 4)).astype(np.float32)

    @jax.jit
    @jax.vmap
    def act(state, gate, past):
        begun = env.begin(unpack(state), gate, params)
        if policy.past:
            begun = begun._replace(actions=tuple(map(unpack_action, past)))
        observation = env.observe(None, begun, None, params)
        return jnp.clip(checkpoint.network.apply(weights, observation)[0].mode(), -1.0, 1.0)

    actions = np.asarray(act(states.astype(dtype), gates, past))
    return {"state": states, "gate": gates, "past": past.reshape(COUNT, -1)}, actions


@pytest.mark.parametrize("case", CASES)
def test_exported_policies_act_as_the_python_one(case, tmp_path, capsys):
    env_id, track, hidden_sizes, flags = CASES[case]
    path, header = tmp_path / "a.safetensors", tmp_path / "policy.h"
    checkpoint = load_checkpoint(write_checkpoint(path, env_id, track, hidden_sizes))
    env = make(env_id, track=track)
    with jax.enable_x64("--float64" in flags):
        inputs, actions = act_in_python(env, checkpoint, np.float64 if flags else np.float32)
    assert np.ptp(actions, axis=0).min() > 0.01, "actions that differ"

    header.write_text("old")
    run("export", path, "--c", header)
    assert f"{header}: {header.stat().st_size} bytes" in capsys.readouterr().out
    if shutil.which("gcc") is not None:
        states, *others = inputs.values()
        compiled = CompiledPolicy(header)
        assert_allclose(compiled.act(states, *others), actions, rtol=0.0, atol=MAX_ERROR)
        assert np.isnan(compiled.act(states * np.nan, *others)).all()
    max_error = MAX_FLOAT64_ERROR if flags else MAX_ERROR
    assert_allclose(act_by_onnx(path, flags, inputs), actions, rtol=0.0, atol=max_error)


def act_by_onnx(checkpoint, flags, inputs):
    """Export a checkpoint as ONNX, and return the actions that ONNX Runtime computes."""
    pytest.importorskip("onnx", reason="onnx is not installed (extra flytrack[export])")
    onnxruntime = pytest.importorskip(
        "onnxruntime", reason="onnxruntime is not installed (flytrack[dev])"
    )
    path = str(checkpoint.with_name("policy.onnx"))
    run("export", checkpoint, "--onnx", path, *flags)
    session = onnxruntime.InferenceSession(path)
    return session.run(None, {given.name: inputs[given.name] for given in session.get_inputs()})[0]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
def test_a_header_counts_gates_and_lags_as_the_environment_does(tmp_path):
    write_checkpoint(tmp_path / "a.safetensors", "FlyTrack-v0", "split_s", (4,))
    run("export", tmp_path / "a.safetensors", "--c", tmp_path / "policy.h")
    compiled = CompiledPolicy(tmp_path / "policy.h")
    params = make("FlyTrack-v0", track="split_s").default_params
    gates, count = params.course.gates, np.arange(params.course.num_gates)
    centres, forward, up = (
        np.stack(axis, axis=-1) for axis in (gates.centre, gates.forward, gates.up)
    )
    cases = ((1.0, 0.0, True), (1.0, 0.5, True), (1.0, 0.7, False), (-1.0, 0.0, False))
    for ahead, aside, is_pass in cases:
        before, after = np.zeros((2, len(count), 21))
        before[:, POSITION] = centres - ahead * forward + aside * up
        after[:, POSITION] = centres + ahead * forward + aside * up
        expected = (count + is_pass) % len(count)
        assert_array_equal(compiled.next_gates(before, after, count), expected)
    action, applied = np.array([1.0, -1.0, 0.5, 0.2]), np.array([0.0, 0.3, -0.5, 1.0])
    expected = lag(unpack_action(applied), Action(*action), 0.01, params.model.tau)
    assert_allclose(compiled.lag(action, applied), expected, atol=MAX_LAG_ERROR)


def test_observations_that_cannot_be_exported_are_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(export, "KINDS_OF_PAST", ("applied",))
    write_checkpoint(tmp_path / "a.safetensors", "FlyTrackActionHistory-v0", "flytrack", (4,))
    said = refused(capsys, "export", "a.safetensors", "--c", "policy.h")
    assert (
        "a.safetensors: observation: found commanded_0, " in said and not Path("policy.h").exists()
    )
