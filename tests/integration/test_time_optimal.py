"""Time-optimal references: the shipped files, their replays, the loader, and the search."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks import time_optimal
from benchmarks.optimal.replay import replay
from flytrack_env import Track, available_tracks, load_track, nominal_parameters
from flytrack_env.dynamics import ModelParameters, step
from flytrack_env.effects import EFFECTS, CommandDelay, GyroBias
from flytrack_env.quaternion import Vec3
from flytrack_env.references import (
    FOLDER,
    KINDS,
    Reference,
    ReferenceFileError,
    load_reference,
    model_digest,
    save_reference,
    shipped_path,
    shipped_reference,
    track_digest,
)
from flytrack_env.state import BATTERY, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from flytrack_env.tracks import build_course

SHIPPED = sorted(FOLDER.glob("*.npz"))
RADIUS_M = 0.15
EXACT = 1e-6  # of the simulator in float64
ROUNDED = 1e-4  # what storing states as float32 leaves of an equation of motion


def in_float64(model: ModelParameters) -> ModelParameters:
    return jax.tree.map(lambda leaf: np.asarray(leaf, float), model)


def with_all_effects(rng: np.random.Generator) -> ModelParameters:
    """Return the nominal model with every effect that has no memory, some way off neutral."""
    model = nominal_parameters()
    for effect in EFFECTS:
        if effect.start is None:
            neutral = effect.parameters()._asdict()
            sizes = {name: neutral[name] + effect.notable.get(name, 0.0) * rng.uniform() for name in neutral}
            model = model.with_effects(effect.parameters(**sizes))
    return model


STEPS = jax.jit(jax.vmap(step, in_axes=(0, 0, 0, None)))
MOST_ROWS = 1000  # all flights are padded to this, so that one program serves them


def step_many(states: Any, commands: Any, durations: Any, model: ModelParameters) -> np.ndarray:
    rows = [np.resize(values, (MOST_ROWS, *values.shape[1:])) for values in (states, commands, durations)]
    return np.array(STEPS(*rows, model))[: len(states)]


def random_state(rng: np.random.Generator) -> np.ndarray:
    x = rng.normal(size=STATE_SIZE) * 3.0
    x[QUATERNION] /= np.linalg.norm(x[QUATERNION])
    x[16:20] = rng.uniform(-1.0, 1.0, 4)
    x[BATTERY] = rng.uniform(22.0, 24.0)
    return x


@pytest.mark.parametrize("has_effects", [False, True])
def test_the_symbolic_step_is_the_simulators(has_effects: bool) -> None:
    symbolic = pytest.importorskip("benchmarks.optimal.symbolic", exc_type=ImportError)
    rng = np.random.default_rng(0)
    model = with_all_effects(rng) if has_effects else nominal_parameters()
    traced = symbolic.step_function(model)
    with jax.enable_x64(True):
        exact = in_float64(model)
        simulated = jax.jit(lambda x, u, dt: step(x, u, dt, exact))
        for _ in range(100):
            x, u, dt = random_state(rng), rng.uniform(-1.0, 1.0, 4), rng.uniform(0.002, 0.04)
            found = traced(x, u, dt).full()[:, 0]
            np.testing.assert_allclose(found, simulated(x, u, dt), rtol=0.0, atol=EXACT)


def test_unsupported_models_are_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    symbolic = pytest.importorskip("benchmarks.optimal.symbolic", exc_type=ImportError)
    with pytest.raises(symbolic.UnsupportedModelError, match=r"command_delay.*memory"):
        symbolic.step_function(nominal_parameters().with_effects(CommandDelay(0.02)))
    assert symbolic.flown_effects(nominal_parameters().with_effects(GyroBias(0.1))) == ()
    monkeypatch.delitem(symbolic.OPERATIONS, "exp")
    with pytest.raises(symbolic.UnsupportedModelError, match="operation exp"):
        symbolic.step_function(nominal_parameters())


def test_every_track_has_its_references() -> None:
    wanted = {shipped_path(track, kind, "nominal") for track in available_tracks() for kind in KINDS}
    assert wanted <= set(SHIPPED)
    nominal = shipped_reference("flytrack", "flying")
    assert model_digest(nominal.model) == model_digest(nominal_parameters())
    assert nominal.percent_above(1.08 * nominal.time_s) == pytest.approx(8.0)
    with pytest.raises(ReferenceFileError, match="flytrack_nominal_flying"):
        shipped_reference("nowhere")


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_flight_obeys_the_simulator_and_the_gates(path: Path) -> None:
    found = load_reference(path)
    assert path.stem == f"{found.track}_{found.model_name}_{found.kind}"
    track, num_steps = load_track(found.track), len(found.commands)
    assert found.track_sha256 == track_digest(track) and found.found["status"] == "Solve_Succeeded"
    assert found.time_s == found.gate_times_s[-1] and len(found.gate_times_s) == len(track.gates)
    with jax.enable_x64(True):
        model, durations = in_float64(found.model), np.full(num_steps, found.dt_s)
        after = step_many(found.states[:-1], found.commands, durations, model)
        durations[-1] = found.time_s - (num_steps - 1) * found.dt_s
        end = step_many(found.states[:-1], found.commands, durations, model)[-1]
    np.testing.assert_allclose(found.states[1:], after, atol=ROUNDED)
    gates = build_course(track).gates
    for index, time_s in enumerate(found.gate_times_s):
        gate = jax.tree.map(lambda leaf, i=index: float(np.asarray(leaf)[i]), gates)
        node = int(time_s / found.dt_s)
        part = time_s / found.dt_s - node
        before, behind = found.states[node, POSITION], found.states[node + 1, POSITION]
        at = gate.to_frame(Vec3(*(before + part * (behind - before))) - gate.centre)
        free = gate.half_opening - RADIUS_M
        assert abs(at.x) < 1e-3 and abs(at.y) < free and abs(at.z) < free
        assert gate.forward.dot(Vec3(*found.states[node + 1, VELOCITY])) > 0.0
    if found.kind == "flying":
        end[QUATERNION] *= np.sign(end[QUATERNION] @ found.states[0, QUATERNION])
        np.testing.assert_allclose(found.states[0, :BATTERY], end[:BATTERY], atol=ROUNDED)
    else:
        start = time_optimal.start_state(track, found.found["battery_v"])
        np.testing.assert_allclose(found.states[0], start, atol=EXACT)


# A program per number of gates and model: one track of them in every run.
REPLAYED = [
    pytest.param(path, id=path.stem, marks=[] if path.stem.startswith("flytrack_") else pytest.mark.slow)
    for path in SHIPPED
]


@pytest.mark.parametrize("path", REPLAYED)
def test_its_commands_fly_in_the_simulator(path: Path) -> None:
    found = load_reference(path)
    flown = replay(found, load_track(found.track))
    assert time_optimal.is_verified(found, flown)
    assert flown.time_s == pytest.approx(found.time_s, abs=1e-4)
    assert flown.drift_m < 1e-3, "half of the clearance"


def test_a_replay_sees_what_goes_wrong() -> None:
    found = shipped_reference("flytrack", "standing")
    hovering = np.zeros_like(found.commands)
    flown = replay(Reference(**{**vars(found), "commands": hovering}), load_track("flytrack"))
    assert flown.gates_passed == 0 and np.isnan(flown.time_s)
    assert not time_optimal.is_verified(found, flown)


def rewritten(path: Path, **changes: Any) -> Path:
    """Write the flying lap of the FlyTrack course with arrays or notes replaced."""
    with np.load(shipped_path("flytrack", "flying", "nominal")) as file:
        data = dict(file)
    notes = json.loads(str(data["notes"]))
    for name, value in changes.items():
        (data if name in data else notes)[name] = value
    np.savez(path, **{**data, "notes": np.array(json.dumps(notes))})
    return path


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"states": np.zeros((3, STATE_SIZE))}, r"states: found shape \(3, 21\), expected \(385, 21\)"),
        ({"states": np.zeros((2**20, 21))}, "cannot be read: found more than 16777216 bytes"),
        ({"commands": np.full((384, 4), 1.5)}, "commands: found 1.5, expected within"),
        ({"commands": np.full((384, 4), np.nan)}, "commands: .*finite"),
        ({"version": 2}, "version: found 2, expected 1"),
        ({"kind": "hovering"}, "kind: found 'hovering', expected one of flying, standing"),
        ({"model": {}}, "model: cannot be read"),
        ({"model_sha256": "0"}, "model: found another"),
        ({"gate_times_s": np.array([object()])}, "cannot be read: .*pickles are never read"),
        ({"gate_times_s": np.array([0.2, 0.1])}, "gate_times_s: found .*expected a row of growing times"),
        ({"time_s": -1.0}, "time_s: found -1.0, expected seconds above 0"),
        ({"track": ["flytrack"]}, r"track: found \['flytrack'\], expected a text"),
        ({"found": "by chance"}, "found: found 'by chance', expected an object"),
    ],
)
def test_a_damaged_file_is_refused(changes: dict[str, Any], reason: str, tmp_path: Path) -> None:
    path = rewritten(tmp_path / "lap.npz", **changes)
    with pytest.raises(ReferenceFileError, match=f"lap.npz.*{reason}"):
        load_reference(path)


def test_a_saved_reference_comes_back_and_half_of_it_is_refused(tmp_path: Path) -> None:
    found, path = shipped_reference("flytrack", "flying"), tmp_path / "lap.npz"
    save_reference(path, found)
    again = load_reference(path)
    np.testing.assert_array_equal(again.states, found.states)
    np.testing.assert_array_equal(again.commands, found.commands)
    assert (again.time_s, again.found) == (found.time_s, found.found)
    path.write_bytes(path.read_bytes()[:1000])
    for broken in (path, tmp_path / "missing.npz"):
        with pytest.raises(ReferenceFileError, match="cannot be read"):
            load_reference(broken)


def test_the_command_verifies_and_writes_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for kind in KINDS:
        shutil.copy(shipped_path("flytrack", kind, "nominal"), tmp_path)
    page = tmp_path / "page.md"
    arguments = ["--verify", "--out", str(tmp_path), "--page", str(page)]
    monkeypatch.setattr("sys.argv", ["time_optimal", *arguments])
    with pytest.raises(SystemExit) as ended:
        time_optimal.main()
    assert ended.value.code == 0
    assert capsys.readouterr().out.count("8 of 8 gates") == len(KINDS)
    assert page.read_text().count("8 of 8") == len(KINDS)
    assert (tmp_path / "page_flytrack.png").stat().st_size > 10_000


def test_first_guesses_pass_the_gates_on_every_grid() -> None:
    pytest.importorskip("casadi")
    from benchmarks.optimal import problem, solve

    track = load_track("flytrack")
    start = time_optimal.start_state(track, 24.0)
    counts = np.full(len(track.gates), 5)
    for kind in KINDS:
        task = problem.Task(kind, build_course(track), RADIUS_M, start)
        first = solve.first_guess(task, counts, 10.0, None)
        gates = np.array([gate.position for gate in track.gates])
        np.testing.assert_allclose(first.states[np.cumsum(counts), POSITION], gates, atol=1e-5)
        finer = solve.resample(first, counts, 3 * counts)
        np.testing.assert_allclose(finer.times(3 * counts), first.times(counts))
        np.testing.assert_allclose(finer.states[::3, POSITION], first.states[:, POSITION], atol=1e-9)


def test_a_straight_flight_takes_as_long_as_it_has_to(row_track: Callable[[list[float]], Track]) -> None:
    pytest.importorskip("casadi")
    from benchmarks.optimal.problem import Task
    from benchmarks.optimal.solve import find_optimum

    acceleration, distance = 20.0, 12.0
    thrust = np.array([acceleration, 0.0, 0.0, 0.0, 0.0, 0.0])  # N, on 1 kg, whatever the stick
    model = nominal_parameters()._replace(thrust_coeffs=thrust, g=0.0)
    track = row_track([0.5 * distance, distance])
    start = time_optimal.start_state(track, 24.0)
    start[POSITION], start[QUATERNION] = (0.0, 0.0, 2.0), (0.5**0.5, 0.0, 0.5**0.5, 0.0)  # body z is ahead
    found = find_optimum(Task("standing", build_course(track), RADIUS_M, start), model, 0.01)
    expected = np.sqrt(2.0 * np.array([0.5, 1.0]) * distance / acceleration)
    np.testing.assert_allclose(found.gate_times_s, expected, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_solver_finds_the_shipped_time_again(kind: str) -> None:
    pytest.importorskip("casadi")
    shipped = shipped_reference("flytrack", kind)
    again = time_optimal.optimise(load_track("flytrack"), kind, shipped.model, "nominal")
    assert again.time_s == pytest.approx(shipped.time_s, rel=1e-4)
    assert time_optimal.is_verified(again, replay(again, load_track("flytrack")))
