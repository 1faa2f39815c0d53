"""The shipped plant, its artifact, and the loading of anyone's artifact."""

import ast
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import flytrack_env
from blackbox import acro_step_runtime, plant
from blackbox.build import build, main
from blackbox.plant import PlantParameters
from flytrack_env import blackbox, nominal_parameters
from flytrack_env.blackbox import BlackBox, BlackBoxError, load
from flytrack_env.dynamics import ModelParameters
from flytrack_env.dynamics import step as model_step
from flytrack_env.state import (
    ACCELERATION,
    APPLIED_ACTION,
    BATTERY,
    POSITION,
    QUATERNION,
    RATES,
    VELOCITY,
    Action,
    unpack,
    unpack_action,
)

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "blackbox" / "acro_step.bin"
GRAVITY = 9.80665
# Put together, so that this file passes its own search for the word.
FORBIDDEN = "_".join(("hidden", "parameters"))

# A drone in empty space: the minimal model, with numbers of the test's own.
AIRLESS = PlantParameters(
    mass=1.2,
    gravity=GRAVITY,
    battery_drain=1.0,
    lag=(0.02, 0.03, 0.05, 0.04),
    max_rate=(600.0, 500.0, 100.0),
    thrust=(-9.0, -6.0, 3.0, -0.3, 0.98, 0.98),
    body_drag=(0.0, 0.0, 0.0),
    rotor_drag=0.0,
    translational_lift=0.0,
    translational_speed=5.0,
    ground_radius=0.0,
)


@pytest.fixture(scope="module")
def shipped() -> BlackBox:
    return load(SHIPPED)


@pytest.fixture(scope="module")
def fly(shipped: BlackBox) -> Callable[..., np.ndarray]:
    """One step of the shipped plant, compiled once for the module."""
    step = jax.jit(shipped.step_vector)
    return lambda x, u: np.asarray(step(x, u))


def start(**parts: Any) -> np.ndarray:
    """The handout's start state, 3 m up, with some components set."""
    x = np.array(blackbox.start_vector())
    x[2] = 3.0
    slices = {"vel": VELOCITY, "quat": QUATERNION, "applied": APPLIED_ACTION, "volt": BATTERY}
    for name, value in parts.items():
        x[slices[name]] = value
    return x


def random_inputs(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """States (count, 21) all over the flight envelope and actions (count, 4)."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 21)) * np.array([*[5.0] * 3, *[8.0] * 3, *[1.0] * 15])
    x[:, 2] = rng.uniform(0.0, 8.0, count)
    x[:, QUATERNION] /= np.linalg.norm(x[:, QUATERNION], axis=1, keepdims=True)
    x[:, APPLIED_ACTION] = rng.uniform(-1.0, 1.0, (count, 4))
    x[:, BATTERY] = rng.uniform(22.0, 24.0, count)
    return x.astype(np.float32), rng.uniform(-1.0, 1.0, (count, 4)).astype(np.float32)


def write_artifact(
    path: Path, function: Callable[..., Any], shapes: Any = ((21,), (4,)), **options: Any
) -> Path:
    """Export any function as an artifact, float32 unless ``dtype`` says otherwise."""
    dtype = options.pop("dtype", jnp.float32)
    arguments = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    options.setdefault("platforms", ["cpu"])
    exported = export.export(jax.jit(function), **options)(*arguments)
    path.write_bytes(exported.serialize())
    return path


# The plant's own physics


def test_free_fall_without_thrust(fly):
    after = fly(start(), [0.0, 0.0, 0.0, -1.0])
    np.testing.assert_allclose(after[ACCELERATION], [0.0, 0.0, -GRAVITY], atol=0.1)
    np.testing.assert_allclose(after[VELOCITY], after[ACCELERATION] * 0.01, rtol=1e-5)


@pytest.mark.parametrize(("volt", "ratio"), [(24.0, 3.5), (22.0, 3.1)])
def test_thrust_to_weight(fly, volt, ratio):
    x = start(applied=[0.0, 0.0, 0.0, 1.0], volt=volt)
    acceleration = fly(x, [0.0, 0.0, 0.0, 1.0])[ACCELERATION]
    assert acceleration[2] / GRAVITY + 1.0 == pytest.approx(ratio, abs=0.08)


def test_thrust_grows_with_the_command(fly):
    thrust = [
        fly(start(applied=[0.0, 0.0, 0.0, u], volt=22.0), [0.0, 0.0, 0.0, u])[8]
        for u in np.linspace(-1.0, 1.0, 21)
    ]
    assert (np.diff(thrust) > 0.0).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_drag_takes_energy(fly, axis, sign):
    velocity = np.zeros(3)
    velocity[axis] = sign * 15.0
    x = start(vel=velocity)

    def energy(state: np.ndarray) -> float:
        state = state.astype(np.float64)
        return float(0.5 * state[VELOCITY] @ state[VELOCITY] + GRAVITY * state[2])

    after = fly(x, [0.0, 0.0, 0.0, -1.0])
    airless = np.asarray(plant.step(x, jnp.array([0.0, 0.0, 0.0, -1.0]), AIRLESS))
    lost_w_per_kg = (energy(x) - energy(after)) / 0.01
    assert abs((energy(x) - energy(airless)) / 0.01) < 5.0
    assert 8.0 < lost_w_per_kg < 60.0


@pytest.mark.parametrize("axis", [0, 1])
def test_drag_in_fast_level_flight(fly, axis):
    x = start(applied=[0.0, 0.0, 0.0, -0.3])
    x[3 + axis] = 15.0
    acceleration = fly(x, [0.0, 0.0, 0.0, -0.3])[ACCELERATION]
    assert 1.5 < -acceleration[axis] < 3.0


def test_ground_and_airspeed_add_some_thrust(fly):
    u = [0.0, 0.0, 0.0, 0.0]
    still = start(applied=[0.0, 0.0, 0.0, 0.0])
    low, fast = still.copy(), still.copy()
    low[2], fast[3] = 0.1, 10.0
    thrust = fly(still, u)[8] + GRAVITY
    assert 1.01 < (fly(low, u)[8] + GRAVITY) / thrust < 1.1
    assert 1.01 < (fly(fast, u)[8] + GRAVITY) / thrust < 1.1


def test_airless_plant_is_the_minimal_model():
    model = ModelParameters(
        tau=np.array(AIRLESS.lag, np.float32),
        thrust_coeffs=np.array(AIRLESS.thrust, np.float32),
        max_rate=np.array(AIRLESS.max_rate, np.float32),
        m=AIRLESS.mass,
        g=AIRLESS.gravity,
    )
    states, actions = random_inputs(64)
    found = jax.vmap(lambda x, u: plant.step(x, u, AIRLESS))(states, actions)
    expected = jax.vmap(lambda x, u: model_step(x, u, 0.01, model))(states, actions)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5)


def test_shipped_plant_feels_the_air(fly):
    x = start(vel=[10.0, 0.0, 0.0], applied=[0.0, 0.0, 0.0, 0.0])
    assert abs(fly(x, np.zeros(4))[6]) > 0.5


def test_attitude_battery_and_clipping(fly):
    states, actions = random_inputs(32, seed=1)
    for x, u in zip(states, actions, strict=True):
        after = fly(x, u)
        assert np.linalg.norm(after[QUATERNION]) == pytest.approx(1.0, abs=1e-6)
        # 60 s * 100 Hz steps per volt, within float32 near 24 V.
        assert (x[BATTERY] - after[BATTERY]) * 6000.0 == pytest.approx(1.0, rel=0.02)
        np.testing.assert_array_equal(after, fly(x, np.clip(u, -1.0, 1.0)))
    np.testing.assert_array_equal(fly(states[0], [9.0, -9.0, 9.0, -9.0]), fly(states[0], [1, -1, 1, -1]))


def test_lags_and_full_stick_rates(fly):
    x = start()
    for _ in range(100):
        x = fly(x, [1.0, -1.0, 1.0, 0.0])
    np.testing.assert_allclose(np.rad2deg(x[RATES]), [618.0, -618.0, 120.0], rtol=1e-4)
    first = fly(start(applied=np.zeros(4)), np.ones(4))[APPLIED_ACTION]
    lags = -0.01 / np.log1p(-first)
    assert (lags > 0.019).all() and (lags < 0.061).all()
    assert len(np.unique(lags.round(3))) == 4


# The artifact and its runtime


def test_rebuilt_artifact_is_the_committed_one(tmp_path, capsys):
    main(["--out", str(tmp_path / "deep" / "acro_step.bin")])
    assert "acro_step.bin" in capsys.readouterr().out
    assert os.listdir(tmp_path / "deep") == ["acro_step.bin"]
    rebuilt = load(tmp_path / "deep" / "acro_step.bin")
    states, actions = random_inputs(512)
    outputs = [
        np.asarray(jax.jit(jax.vmap(box.step_vector))(states, actions)) for box in (load(SHIPPED), rebuilt)
    ]
    assert np.isfinite(outputs[0]).all()
    np.testing.assert_array_equal(outputs[0], outputs[1])


def test_artifact_tells_nothing_about_its_source():
    content = SHIPPED.read_bytes()
    for word in (b".py", b"lift", b"drag", b"ground", b"jit("):
        assert word not in content


def test_other_parameters_give_another_plant(tmp_path):
    path = build(AIRLESS, tmp_path / "airless.bin")
    x, u = (rows[0] for rows in random_inputs(1))
    expected = plant.step(x, jnp.asarray(u), AIRLESS)
    np.testing.assert_allclose(load(path).step_vector(x, u), expected, rtol=1e-5, atol=1e-5)
    assert not np.allclose(load(SHIPPED).step_vector(x, u), expected, rtol=1e-3, atol=1e-3)


def test_runtime_interface(tmp_path, fly):
    x, u = (rows[0] for rows in random_inputs(1))
    np.testing.assert_allclose(acro_step_runtime.step(x, u), fly(x, u), rtol=1e-6, atol=1e-6)
    path = build(AIRLESS, tmp_path / "airless.bin")
    elsewhere = acro_step_runtime.step(x, u, bin_path=str(path))
    expected = plant.step(x, jnp.asarray(u), AIRLESS)
    np.testing.assert_allclose(elsewhere, expected, rtol=1e-5, atol=1e-5)
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


def imported_modules(tree: ast.AST) -> Iterator[str]:
    """Every absolute module that a source imports, with the names it takes from it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def mentions_numbers(tree: ast.AST) -> bool:
    """Whether a source imports, names or spells out the file of numbers."""
    words: list[str] = list(imported_modules(tree))
    for node in ast.walk(tree):
        match node:
            case ast.ImportFrom(names=names):
                words += [f"{node.module}.{alias.name}" for alias in names]
            case ast.Constant(value=str(text)) | ast.Name(id=text) | ast.Attribute(attr=text):
                words.append(text)
    return any(FORBIDDEN in word for word in words)


def sources() -> list[Path]:
    found = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "*.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if found.returncode == 0:
        paths = [ROOT / name for name in found.stdout.split("\0") if name]
    else:
        paths = list(ROOT.rglob("*.py"))
    return [path for path in paths if path.is_file()]


@pytest.mark.parametrize(
    "source",
    [
        f"import blackbox.{FORBIDDEN}",
        f"from blackbox import {FORBIDDEN} as numbers",
        f"from blackbox.{FORBIDDEN} import PARAMETERS",
        f"from .{FORBIDDEN} import PARAMETERS",
        f"open('blackbox/{FORBIDDEN}.py').read()",
        f"import blackbox\nblackbox.{FORBIDDEN}.PARAMETERS",
    ],
)
def test_search_finds_peeking(source):
    assert mentions_numbers(ast.parse(source))


def test_nothing_peeks_at_the_numbers():
    allowed = {ROOT / "blackbox" / name for name in ("build.py", "plant.py", f"{FORBIDDEN}.py")}
    paths = sources()
    assert allowed < set(paths)
    for path in set(paths) - allowed:
        assert not mentions_numbers(ast.parse(path.read_text(encoding="utf-8"))), path


def test_product_code_reaches_the_plant_through_its_artifact_only():
    for path in sources():
        top = path.relative_to(ROOT).parts[0]
        modules = set(imported_modules(ast.parse(path.read_text(encoding="utf-8"))))
        if top == "blackbox":
            assert not any(name.startswith("flytrack") for name in modules), path
        elif top != "tests":
            assert not any(name.split(".")[0] == "blackbox" for name in modules), path


# Loading


def test_missing_directory_and_empty(tmp_path):
    (tmp_path / "empty.bin").write_bytes(b"")
    cases = {"missing.bin": "found nothing", ".": "found a directory", "empty.bin": "found 0 bytes"}
    for name, found in cases.items():
        with pytest.raises(BlackBoxError, match=found) as caught:
            load(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)


def test_huge_file(tmp_path):
    path = tmp_path / "huge.bin"
    with path.open("wb") as file:
        file.truncate(2**40)  # sparse: takes no room
    with pytest.raises(BlackBoxError, match=f"found {2**40} bytes, expected 1 to"):
        load(path)


def test_truncated(tmp_path):
    content = SHIPPED.read_bytes()
    path = tmp_path / "truncated.bin"
    # The last dozen bytes are padding that the format does not need.
    lengths = [1, 3, 4, 8, 20, 64, *range(100, len(content) - 12, 97), len(content) - 13]
    for length in lengths:
        path.write_bytes(content[:length])
        with pytest.raises(BlackBoxError, match=f"found {length} bytes that cannot be deserialised"):
            load(path)


def test_random_bytes_and_foreign_formats(tmp_path):
    path = tmp_path / "noise.bin"
    rng = np.random.default_rng(0)
    contents = [rng.bytes(size) for size in (16, 300, 5000, 100_000)]
    contents += [b"\0" * 4096, b"\xff" * 4096, b"{}", b"\x80\x04K\x01.", b"PK\x03\x04" * 100]
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(BlackBoxError, match=r"noise\.bin: .*expected"):
            load(path)


@pytest.mark.parametrize(
    ("function", "shapes", "dtype", "found"),
    [
        (lambda x, u: x, ((20,), (4,)), jnp.float32, r"float32\[20\], float32\[4\]"),
        (lambda x, u: x, ((21,), (3,)), jnp.float32, r"float32\[21\], float32\[3\]"),
        (lambda x, u: x[:18], ((21,), (4,)), jnp.float32, r"-> \(float32\[18\]\)"),
        (lambda x, u: (x, u), ((21,), (4,)), jnp.float32, r"-> \(float32\[21\], float32\[4\]\)"),
        (lambda x: x, ((21,),), jnp.float32, r"\(float32\[21\]\) ->"),
        (lambda x, u, dt: x, ((21,), (4,), ()), jnp.float32, r"float32\[\]"),
        (lambda x, u: x, ((21,), (4,)), jnp.float16, r"float16\[21\]"),
        (lambda x, u: x, ((21,), (4,)), jnp.int32, r"int32\[21\]"),
    ],
)
def test_wrong_signature(tmp_path, function, shapes, dtype, found):
    path = write_artifact(tmp_path / "other.bin", function, shapes, dtype=dtype)
    with pytest.raises(BlackBoxError, match=f"signature: found .*{found}.*expected") as caught:
        load(path)
    assert "other.bin" in str(caught.value)


def test_wrong_platform(tmp_path):
    path = write_artifact(tmp_path / "gpu.bin", lambda x, u: x, platforms=["cuda"])
    with pytest.raises(BlackBoxError, match=r"gpu\.bin: platforms: found \('cuda',\)"):
        load(path)


def test_not_finite(tmp_path):
    path = write_artifact(tmp_path / "nan.bin", lambda x, u: x.at[8].set(x[8] / x[0]))
    with pytest.raises(BlackBoxError, match=r"nan\.bin: components \[8\] .*expected finite numbers"):
        load(path)


def test_calls_into_python_are_refused(tmp_path):
    def step(x: jax.Array, u: jax.Array) -> jax.Array:
        return jax.ffi.ffi_call(target, jax.ShapeDtypeStruct(x.shape, x.dtype))(x)

    target = "xla_ffi_python_cpu_callback"
    checks = [export.DisabledSafetyCheck.custom_call(target)]
    path = write_artifact(tmp_path / "callback.bin", step, disabled_checks=checks)
    with pytest.raises(BlackBoxError, match=rf"callback\.bin: found .*{target}"):
        load(path)


# Flying


def test_vmap_nested_vmap_and_scan_agree_with_a_loop(shipped, fly):
    states, actions = random_inputs(12)
    one_by_one = np.stack([fly(x, u) for x, u in zip(states, actions, strict=True)])
    close = {"rtol": 1e-5, "atol": 1e-5}
    batched = jax.jit(jax.vmap(shipped.step_vector))(states, actions)
    np.testing.assert_allclose(batched, one_by_one, **close)
    grid = (states.reshape(3, 4, 21), actions.reshape(3, 4, 4))
    nested = jax.jit(jax.vmap(jax.vmap(shipped.step_vector)))(*grid)
    np.testing.assert_allclose(nested.reshape(12, 21), one_by_one, **close)
    one_state = jax.vmap(shipped.step_vector, in_axes=(None, 0))(states[0], actions)
    expected = np.stack([fly(states[0], u) for u in actions])
    np.testing.assert_allclose(one_state, expected, **close)

    def body(x, u):
        x = jax.vmap(shipped.step_vector, in_axes=(0, None))(x, u)
        return x, x

    _, path = jax.jit(lambda x: jax.lax.scan(body, x, actions))(states[:2])
    x = states[1]
    for u, row in zip(actions, path[:, 1], strict=True):
        x = fly(x, u)
        np.testing.assert_allclose(row, x, rtol=1e-4, atol=1e-4)


def test_many_drones_fly_in_one_loop(shipped):
    text = jax.jit(jax.vmap(jax.vmap(shipped.step_vector))).lower(
        jnp.zeros((16, 16, 21)), jnp.zeros((16, 16, 4))
    )
    assert text.as_text().count("stablehlo.while") == 1


def test_plant_protocol(shipped, fly):
    x, u = (rows[0] for rows in random_inputs(1))
    command = unpack_action(jnp.asarray(u))
    state = shipped.reset(unpack(jnp.asarray(x)), nominal_parameters())
    after = shipped.drone(shipped.step(state, command, blackbox.DT, None))
    np.testing.assert_allclose(jnp.stack(jax.tree.leaves(after)), fly(x, u), rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match=r"dt: found 0\.02 s, expected 0\.01 s"):
        shipped.step(state, command, 0.02, None)


def test_another_backend_is_a_clear_error(shipped):
    traced = jax.jit(shipped.step_vector).trace(jnp.zeros(21), jnp.zeros(4))
    with pytest.raises(ValueError, match="exported for platforms"):
        traced.lower(lowering_platforms=("cuda",))


def test_artifact_of_18_components(tmp_path):
    def reduced_step(x: jax.Array, u: jax.Array) -> jax.Array:
        # Position, velocity, acceleration and quaternion stay; the rest is made recognisable.
        rates = jnp.deg2rad(jnp.array([618.0, 618.0, 120.0])) * u[:3]
        return jnp.concatenate([x[:13], rates, u[3:] * x[16], x[17:] - 1.0])

    path = write_artifact(tmp_path / "reduced.bin", reduced_step, ((18,), (4,)))
    box = load(path)
    assert box.state_size == 18
    states, actions = random_inputs(5)
    after = np.asarray(jax.jit(jax.vmap(box.step_vector))(states, actions))
    np.testing.assert_array_equal(after[:, POSITION], states[:, POSITION])
    np.testing.assert_array_equal(after[:, :13], states[:, :13])
    np.testing.assert_allclose(after[:, 16:19], actions[:, :3], rtol=1e-5)
    np.testing.assert_allclose(after[:, 19], actions[:, 3] * states[:, 19], rtol=1e-6)
    np.testing.assert_allclose(after[:, BATTERY], states[:, BATTERY] - 1.0, rtol=1e-6)
    slower = load(path, max_rate=(309.0, 618.0, 120.0)).step_vector(states[0], actions[0])
    np.testing.assert_allclose(slower[16], 2.0 * actions[0, 0], rtol=1e-5)


def test_environment_flies_the_black_box(shipped, fly):
    env, params = gymnax.make("FlyTrack-v0", plant=shipped)
    assert isinstance(env, flytrack_env.FlyTrack)
    keys = jax.random.split(jax.random.key(0), 3)
    actions = jnp.array([[0.1, 0.2, -0.3, 0.4], [0.0, 0.1, 0.0, 0.2], [0.3, 0.0, 0.1, -0.5]])

    @jax.jit
    def rollout(params):
        _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)

        def body(states, _):
            _, states, reward, *_ = env.step_batch(keys[0], states, actions, params)
            return states, (jax.vmap(env.drone)(states), reward)

        first = jax.vmap(env.drone)(states)
        return first, jax.lax.scan(body, states, None, length=3)[1]

    first, (drones, rewards) = rollout(params)
    assert np.isfinite(rewards).all()
    path = np.stack(jax.tree.leaves(drones), axis=-1)
    for index in range(3):
        x = np.stack(jax.tree.leaves(first), axis=-1)[index]
        for step in range(3):
            x = fly(x, actions[index])
            np.testing.assert_allclose(path[step, index], x, rtol=1e-5, atol=1e-4)


def test_command_leaves_may_be_python_numbers(shipped):
    state = shipped.reset(unpack(blackbox.start_vector()), nominal_parameters())
    after = shipped.step(state, Action(0, 0, 0, -1), 0.01, None)
    assert after.pos_w.z.dtype == jnp.float32
