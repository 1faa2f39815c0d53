"""The shipped plant's physics, and that the artifact keeps it to itself."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blackbox import acro_step_runtime, plant
from blackbox.build import build, main
from flytrack_env.blackbox import load
from flytrack_env.dynamics import ModelParameters
from flytrack_env.dynamics import step as model_step
from flytrack_env.state import ACCELERATION, APPLIED_ACTION, BATTERY, QUATERNION, RATES, VELOCITY
from tests.support.black_boxes import AIRLESS, FORBIDDEN, GRAVITY, ROOT, SHIPPED, random_inputs, start

# The plant's own physics


def test_free_fall_without_thrust(fly_black_box):
    after = fly_black_box(start(), [0.0, 0.0, 0.0, -1.0])
    np.testing.assert_allclose(after[ACCELERATION], [0.0, 0.0, -GRAVITY], atol=0.1)
    np.testing.assert_allclose(after[VELOCITY], after[ACCELERATION] * 0.01, rtol=1e-5)


@pytest.mark.parametrize(("volt", "ratio"), [(24.0, 3.5), (22.0, 3.1)])
def test_thrust_to_weight(fly_black_box, volt, ratio):
    x = start(applied=[0.0, 0.0, 0.0, 1.0], volt=volt)
    acceleration = fly_black_box(x, [0.0, 0.0, 0.0, 1.0])[ACCELERATION]
    assert acceleration[2] / GRAVITY + 1.0 == pytest.approx(ratio, abs=0.08)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_drag_takes_energy(fly_black_box, axis, sign):
    x = start(vel=sign * 15.0 * np.eye(3)[axis])

    def energy(state: np.ndarray) -> float:
        state = state.astype(np.float64)
        return float(0.5 * state[VELOCITY] @ state[VELOCITY] + GRAVITY * state[2])

    after = fly_black_box(x, [0.0, 0.0, 0.0, -1.0])
    airless = np.asarray(plant.step(x, jnp.array([0.0, 0.0, 0.0, -1.0]), AIRLESS))
    assert abs((energy(x) - energy(airless)) / 0.01) < 5.0
    assert 8.0 < (energy(x) - energy(after)) / 0.01 < 60.0  # W/kg


def test_ground_and_airspeed_add_some_thrust(fly_black_box):
    u, still = np.zeros(4), start(applied=np.zeros(4))
    low, fast = still.copy(), still.copy()
    low[2], fast[3] = 0.1, 10.0
    thrust = fly_black_box(still, u)[8] + GRAVITY
    assert 1.01 < (fly_black_box(low, u)[8] + GRAVITY) / thrust < 1.1
    assert 1.01 < (fly_black_box(fast, u)[8] + GRAVITY) / thrust < 1.1


def test_airless_plant_is_the_minimal_model():
    lag, thrust, rate = (np.array(one, np.float32) for one in (AIRLESS.lag, AIRLESS.thrust, AIRLESS.max_rate))
    model = ModelParameters(tau=lag, thrust_coeffs=thrust, max_rate=rate, m=AIRLESS.mass, g=AIRLESS.gravity)
    states, actions = random_inputs(64)
    found = jax.vmap(lambda x, u: plant.step(x, u, AIRLESS))(states, actions)
    expected = jax.vmap(lambda x, u: model_step(x, u, 0.01, model))(states, actions)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5)


def test_attitude_battery_and_clipping(fly_black_box):
    states, actions = random_inputs(32, seed=1)
    for x, u in zip(states, actions, strict=True):
        after = fly_black_box(x, u)
        assert np.linalg.norm(after[QUATERNION]) == pytest.approx(1.0, abs=1e-6)
        # 60 s * 100 Hz steps per volt, within float32 near 24 V.
        assert (x[BATTERY] - after[BATTERY]) * 6000.0 == pytest.approx(1.0, rel=0.02)
        np.testing.assert_array_equal(after, fly_black_box(x, np.clip(u, -1.0, 1.0)))
    beyond, full = (fly_black_box(states[0], size * np.array([1.0, -1.0, 1.0, -1.0])) for size in (9.0, 1.0))
    np.testing.assert_array_equal(beyond, full)


def test_lags_and_full_stick_rates(fly_black_box):
    x = start()
    for _ in range(100):
        x = fly_black_box(x, [1.0, -1.0, 1.0, 0.0])
    np.testing.assert_allclose(np.rad2deg(x[RATES]), [618.0, -618.0, 120.0], rtol=1e-4)
    first = fly_black_box(start(applied=np.zeros(4)), np.ones(4))[APPLIED_ACTION]
    lags = -0.01 / np.log1p(-first)
    assert (lags > 0.019).all() and (lags < 0.061).all()
    assert len(np.unique(lags.round(3))) == 4


# The artifact and its runtime


def test_rebuilt_artifact_is_the_committed_one_that_tells_nothing_about_its_source(tmp_path, capsys):
    main(["--out", str(tmp_path / "deep" / "acro_step.bin")])
    assert "acro_step.bin" in capsys.readouterr().out
    assert os.listdir(tmp_path / "deep") == ["acro_step.bin"]
    rebuilt = load(tmp_path / "deep" / "acro_step.bin")
    states, actions = random_inputs(512)
    shipped, again = (jax.jit(jax.vmap(box.step_vector))(states, actions) for box in (load(SHIPPED), rebuilt))
    assert np.isfinite(shipped).all()
    np.testing.assert_array_equal(shipped, again)
    for word in (b".py", b"lift", b"drag", b"ground", b"jit("):
        assert word not in SHIPPED.read_bytes()


def test_runtime_interface(tmp_path, fly_black_box):
    x, u = (rows[0] for rows in random_inputs(1))
    np.testing.assert_allclose(acro_step_runtime.step(x, u), fly_black_box(x, u), rtol=1e-6, atol=1e-6)
    path = build(AIRLESS, tmp_path / "airless.bin")
    elsewhere = acro_step_runtime.step(x, u, bin_path=str(path))
    expected = plant.step(x, jnp.asarray(u), AIRLESS)
    np.testing.assert_allclose(elsewhere, expected, rtol=1e-5, atol=1e-5)
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
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "*.py"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout
    paths = [ROOT / name for name in listed.split("\0") if name] or list(ROOT.rglob("*.py"))
    allowed = {ROOT / "blackbox" / name for name in ("build.py", "plant.py", f"{FORBIDDEN}.py")}
    found = {path for path in paths if path.is_file() and FORBIDDEN in path.read_text(encoding="utf-8")}
    assert found - allowed == set() and ROOT / "blackbox" / "build.py" in found
