"""Black boxes are loaded or refused, and flown; the shipped one keeps its physics to itself."""

import os
import subprocess
import sys

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from blackbox import acro_step_runtime, plant
from blackbox.build import build, main
from flytrack_env.blackbox import BlackBoxError, load
from flytrack_env.state import RATES, pack
from tests.support.black_boxes import (
    AIRLESS,
    FORBIDDEN,
    ROOT,
    SHIPPED,
    random_inputs,
    write_artifact,
)
from tests.support.coasting import drone_at

REFUSALS = [
    (
        r"signature: found .*float32\[20\], float32\[4\].*expected",
        lambda x, u: x,
        {"shapes": ((20,), (4,))},
    ),
    (r"signature: found .*-> \(float32\[21\], float32\[4\]\).*expected", lambda x, u: (x, u), {}),
    (r"signature: found .*\(float32\[21\]\) ->.*expected", lambda x: x, {"shapes": ((21,),)}),
    (r"signature: found .*float16\[21\].*expected", lambda x, u: x, {"dtype": jnp.float16}),
    (r".* does not run on the CPU .*platforms", lambda x, u: x, {"platforms": ["cuda"]}),
    (r"components \[8\] .*expected finite numbers", lambda x, u: x.at[8].set(x[8] / x[0]), {}),
]


@pytest.mark.parametrize(("reason", "function", "options"), REFUSALS)
def test_what_cannot_be_flown_is_refused(tmp_path, reason, function, options):
    path = write_artifact(tmp_path / "other.bin", function, **options)
    with pytest.raises(BlackBoxError, match=rf"other\.bin: {reason}"):
        load(path, limits=None)  # in this process; tests/integration/test_sandbox.py has the other


# Flying


def test_nested_vmap_agrees_with_a_loop(black_box, fly_black_box):
    states, actions = random_inputs(12)
    one_by_one = [fly_black_box(x, u) for x, u in zip(states, actions, strict=True)]
    grid = (states.reshape(3, 4, 21), actions.reshape(3, 4, 4))
    nested = jax.jit(jax.vmap(jax.vmap(black_box.step_vector)))(*grid)
    assert_allclose(nested.reshape(12, 21), one_by_one, rtol=1e-5, atol=1e-5)


def test_many_drones_fly_in_one_loop(black_box):
    batch = jnp.zeros((16, 21)), jnp.zeros((16, 4))
    text = jax.jit(jax.vmap(black_box.step_vector)).lower(*batch)
    assert text.as_text().count("stablehlo.while") == 1


def test_another_backend_is_a_clear_error(black_box):
    traced = jax.jit(black_box.step_vector).trace(jnp.zeros(21), jnp.zeros(4))
    with pytest.raises(ValueError, match="exported for platforms"):
        traced.lower(lowering_platforms=("cuda",))


def test_artifact_of_18_components(tmp_path):
    def reduced_step(x, u):
        # Position, velocity, acceleration and quaternion stay; the rest is made recognisable.
        rates = jnp.deg2rad(jnp.array([618.0, 618.0, 120.0])) * u[:3]
        return jnp.concatenate([x[:13], rates, u[3:] * x[16], x[17:] - 1.0])

    path = write_artifact(tmp_path / "reduced.bin", reduced_step, ((18,), (4,)))
    box, (states, actions) = load(path, limits=None), random_inputs(5)
    after = jax.jit(jax.vmap(box.step_vector))(states, actions)
    thrust, battery = actions[:, 3:] * states[:, 19:20], states[:, 20:] - 1.0
    expected = np.hstack([states[:, :13], after[:, RATES], actions[:, :3], thrust, battery])
    assert box.state_size == 18
    assert_allclose(after, expected, rtol=1e-5)
    slow = load(path, (309.0, 618.0, 120.0), limits=None)
    slower = slow.step_vector(states[0], actions[0])
    assert_allclose(slower[16], 2.0 * actions[0, 0], rtol=1e-5)


def test_environment_flies_the_black_box(black_box, fly_black_box):
    env, params = gymnax.make("FlyTrack-v0", plant=black_box)
    state = env.begin(drone_at((15.0, 2.0, 1.35), (-4.0, 0.0, 1.0)), 0, params)
    step = jax.jit(env.step_env)
    for action in jnp.array([[0.1, 0.2, -0.3, 0.4], [0.0, 0.1, 0.0, 0.2], [0.3, 0.0, 0.1, -0.5]]):
        before = pack(env.drone(state))
        _, state, *_ = step(None, state, action, params)
        expected = fly_black_box(before, action)
        assert_allclose(pack(env.drone(state)), expected, rtol=1e-5, atol=1e-4)
    with pytest.raises(ValueError, match=r"dt: found 0\.02 s, expected 0\.01 s"):
        black_box.step(None, None, 0.02, None)


# The artifact and its runtime


def test_rebuilt_artifact_is_the_committed_one_that_tells_nothing_about_its_source(
    tmp_path, capsys
):
    main(["--out", str(tmp_path / "deep" / "acro_step.bin")])
    assert "acro_step.bin" in capsys.readouterr().out
    assert os.listdir(tmp_path / "deep") == ["acro_step.bin"]
    rebuilt = load(tmp_path / "deep" / "acro_step.bin", limits=None)
    states, actions = random_inputs(512)
    shipped, again = (
        jax.jit(jax.vmap(box.step_vector))(states, actions) for box in (load(SHIPPED), rebuilt)
    )
    assert np.isfinite(shipped).all()
    assert_array_equal(shipped, again)
    for word in (b".py", b"lift", b"drag", b"ground", b"jit("):
        assert word not in SHIPPED.read_bytes()


def test_runtime_interface(tmp_path, fly_black_box):
    x, u = (rows[0] for rows in random_inputs(1))
    assert_allclose(acro_step_runtime.step(x, u), fly_black_box(x, u), rtol=1e-6, atol=1e-6)
    path = build(AIRLESS, tmp_path / "airless.bin")
    elsewhere = acro_step_runtime.step(x, u, bin_path=str(path))
    expected = jax.jit(lambda x, u: plant.step(x, u, AIRLESS))(x, u)
    assert_allclose(elsewhere, expected, rtol=1e-5, atol=1e-5)
    assert not np.allclose(fly_black_box(x, u), expected, rtol=1e-3, atol=1e-3)
    with pytest.raises(OSError):
        acro_step_runtime.step(x, u, bin_path=tmp_path / "missing.bin")


def test_runtime_stands_alone():
    code = (
        "from acro_step_runtime import step; import sys; "
        "x = step([0.0] * 9 + [1.0] + [0.0] * 9 + [-1.0, 24.0], [0.0, 0.0, 0.0, -1.0]); "
        "assert x.shape == (21,) and -10.0 < float(x[8]) < -9.5, x; "
        "assert not any(name.split('.')[0] == 'flytrack_env' for name in sys.modules)"
    )
    command = [sys.executable, "-B", "-c", code]
    done = subprocess.run(command, cwd=SHIPPED.parent, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


# Nobody peeks


def test_nothing_mentions_the_numbers():
    command = ["git", "grep", "--untracked", "-l", FORBIDDEN, "--", "*.py"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.split()
    allowed = {f"blackbox/{name}.py" for name in ("build", "plant", FORBIDDEN)}
    assert "blackbox/build.py" in listed and set(listed) <= allowed
