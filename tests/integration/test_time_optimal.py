"""Time-optimal references: shipped files, dynamics, gates, replays; the solver's parts, the solve."""

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
from flytrack_env.effects import EFFECTS, CommandDelay, GyroBias, RateSlewLimit
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
from flytrack_env.state import BATTERY, POSITION, QUATERNION, RATES, STATE_SIZE, VELOCITY
from flytrack_env.tracks import build_course

SHIPPED = sorted(FOLDER.glob("*.npz"))
LARGEST_FILE = 100_000
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


def test_what_cannot_be_expressed_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    symbolic = pytest.importorskip("benchmarks.optimal.symbolic", exc_type=ImportError)
    with pytest.raises(symbolic.UnsupportedModelError, match=r"command_delay.*memory"):
        symbolic.step_function(nominal_parameters().with_effects(CommandDelay(0.02)))
    assert symbolic.flown_effects(nominal_parameters().with_effects(GyroBias(0.1))) == ()
    monkeypatch.delitem(symbolic.OPERATIONS, "exp")
    with pytest.raises(symbolic.UnsupportedModelError, match="operation exp"):
        symbolic.step_function(nominal_parameters())


def test_states_that_a_path_depends_on() -> None:
    symbolic = pytest.importorskip("benchmarks.optimal.symbolic", exc_type=ImportError)
    plain = symbolic.needed_states(symbolic.step_function(nominal_parameters()))
    limited = nominal_parameters().with_effects(RateSlewLimit(0.01))
    slewed = symbolic.needed_states(symbolic.step_function(limited))
    rates = set(range(STATE_SIZE)[RATES])
    assert set(slewed) - set(plain) == rates
    assert set(range(STATE_SIZE)) - set(slewed) == {6, 7, 8}, "the acceleration is only told"


def test_every_track_has_its_references() -> None:
    for track in available_tracks():
        for kind in KINDS:
            assert shipped_path(track, kind, "nominal") in SHIPPED
    nominal = shipped_reference("flytrack", "flying")
    assert model_digest(nominal.model) == model_digest(nominal_parameters())
    assert nominal.percent_above(1.08 * nominal.time_s) == pytest.approx(8.0)
    with pytest.raises(ReferenceFileError, match="flytrack_nominal_flying"):
        shipped_reference("nowhere")


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_file_is_well_formed(path: Path) -> None:
    found = load_reference(path)
    assert path.stat().st_size < LARGEST_FILE
    assert path.stem == f"{found.track}_{found.model_name}_{found.kind}"
    track = load_track(found.track)
    assert found.track_sha256 == track_digest(track)
    assert found.found["status"] == "Solve_Succeeded"
    assert len(found.gate_times_s) == len(track.gates) and (np.diff(found.gate_times_s) > 0.0).all()
    assert found.time_s == found.gate_times_s[-1]
    steps = len(found.commands)
    assert (steps - 1) * found.dt_s < found.time_s < steps * found.dt_s
    np.testing.assert_allclose(np.linalg.norm(found.states[:, QUATERNION], axis=1), 1.0, atol=1e-6)
    if found.kind == "standing":
        start = time_optimal.start_state(track, found.found["battery_v"])
        np.testing.assert_allclose(found.states[0], start, atol=EXACT)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_flight_obeys_the_simulator_and_the_gates(path: Path) -> None:
    found = load_reference(path)
    with jax.enable_x64(True):
        model, num_steps = in_float64(found.model), len(found.commands)
        durations = np.full(num_steps, found.dt_s)
        after = step_many(found.states[:-1], found.commands, durations, model)
        durations[-1] = found.time_s - (num_steps - 1) * found.dt_s
        end = step_many(found.states[:-1], found.commands, durations, model)[-1]
    np.testing.assert_allclose(found.states[1:], after, atol=ROUNDED)
    gates = build_course(load_track(found.track)).gates
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


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_its_commands_fly_in_the_simulator(path: Path) -> None:
    found = load_reference(path)
    flown = replay(found, load_track(found.track))
    assert flown.gates_passed == len(found.gate_times_s) and flown.ended_by == ()
    assert flown.frames_touched == 0
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
    text = changes.pop("notes", None)
    for name, value in changes.items():
        if name in data:
            data[name] = value
        else:
            notes[name] = value
    np.savez(path, **{**data, "notes": np.array(json.dumps(notes)) if text is None else text})
    return path


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"states": np.zeros((3, STATE_SIZE))}, r"states: found shape \(3, 21\), expected \(385, 21\)"),
        ({"commands": np.full((384, 4), 1.5)}, "commands: found 1.5, expected within"),
        ({"commands": np.full((384, 4), np.nan)}, "commands: .*finite"),
        ({"version": 2}, "version: found 2, expected 1"),
        ({"kind": "hovering"}, "kind: found 'hovering', expected one of flying, standing"),
        ({"model_sha256": "0"}, "model: found another"),
        ({"model": {}}, "model: cannot be read"),
        ({"gate_times_s": np.array([object()])}, "cannot be read: .*pickles are never read"),
        ({"gate_times_s": np.array([[0.1]])}, "gate_times_s: found .*expected a row of growing times"),
        ({"gate_times_s": np.array([0.2, 0.1])}, "gate_times_s: found .*expected a row of growing times"),
        (
            {"notes": np.full((), 0xD800, np.uint32).view("<U1")},
            "found text of numbers that are no characters",
        ),
        ({"dt_s": "soon"}, "dt_s: found 'soon', expected seconds above 0"),
        ({"dt_s": True}, "dt_s: found True, expected seconds above 0"),
        ({"time_s": -1.0}, "time_s: found -1.0, expected seconds above 0"),
        ({"time_s": 10**400}, "time_s: found 1000.*, expected seconds above 0"),
        ({"track": ["flytrack"]}, r"track: found \['flytrack'\], expected a text"),
        ({"found": "by chance"}, "found: found 'by chance', expected an object"),
        ({"version": [["x" * 999]] * 999}, "version: found .{1,300}, expected 1"),
        ({"model": {"parameters": {"m": "x" * 999}, "effects": {}}}, "model: cannot be read: .{1,400}$"),
        ({"states": np.zeros((2**20, 21))}, "cannot be read: found more than 16777216 bytes"),
    ],
)
def test_a_damaged_file_is_refused(changes: dict[str, Any], reason: str, tmp_path: Path) -> None:
    path = rewritten(tmp_path / "lap.npz", **changes)
    with pytest.raises(ReferenceFileError, match=f"lap.npz.*{reason}"):
        load_reference(path)


def test_a_file_cut_short_is_refused_and_a_saved_one_comes_back(tmp_path: Path) -> None:
    found = shipped_reference("flytrack", "flying")
    save_reference(tmp_path / "lap.npz", found)
    again = load_reference(tmp_path / "lap.npz")
    np.testing.assert_array_equal(again.states, found.states)
    np.testing.assert_array_equal(again.commands, found.commands)
    assert (again.time_s, again.found) == (found.time_s, found.found)
    whole = (tmp_path / "lap.npz").read_bytes()
    for cut in (b"", whole[: len(whole) // 2], b"no archive"):
        (tmp_path / "cut.npz").write_bytes(cut)
        with pytest.raises(ReferenceFileError, match="cannot be read"):
            load_reference(tmp_path / "cut.npz")
    with pytest.raises(ReferenceFileError, match="cannot be read"):
        load_reference(tmp_path / "missing.npz")


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


def test_the_battery_drains_as_float32_does() -> None:
    nominal, start = nominal_parameters(), time_optimal.start_state(load_track("flytrack"), 24.0)
    drained = time_optimal.drained_in_float32(nominal, start, 0.01).battery_drain_v_per_min
    x = np.asarray(start, np.float32)
    for _ in range(100):
        x = np.asarray(step(x, np.zeros(4, np.float32), np.float32(0.01), nominal))
    assert drained != pytest.approx(1.0, abs=1e-3), "rounded away from 1 V/min"
    assert 24.0 - x[BATTERY] == pytest.approx(drained / 60.0, abs=1e-9)


def test_guesses_and_grids() -> None:
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
    flipped = first._replace(
        states=first.states * np.where(np.arange(len(first.states)) > 20, -1.0, 1.0)[:, None]
    )
    assert first.closure() == -flipped.closure()
    assert solve._shifts(np.array([0.02, 0.5, 0.98])).tolist() == [-1, 0, 1]
    moved = solve._lengthened(first, int(counts.sum()) + 1, np.array([0] * 7 + [1]))
    assert len(moved.states) == counts.sum() + 2 and moved.fractions[-1] == problem.FRACTION_EDGE


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
    again = time_optimal.optimise(load_track("flytrack"), kind, shipped.model, "nominal", 24.0, "test")
    assert again.time_s == pytest.approx(shipped.time_s, rel=1e-4)
    assert time_optimal.is_verified(again, replay(again, load_track("flytrack")))
