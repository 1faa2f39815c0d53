"""Time-optimal references: the shipped files, their replays, the loader, and the search."""

import json

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from benchmarks import time_optimal
from benchmarks.time_optimal import replay
from flytrack_env import available_tracks, load_track, nominal_parameters, references
from flytrack_env.dynamics import step
from flytrack_env.effects import EFFECTS
from flytrack_env.state import POSITION, STATE_SIZE, VELOCITY
from tests.support.black_boxes import random_inputs
from tests.support.slow import slow_but

SHIPPED = sorted(references.FOLDER.glob("*.npz"))
EXACT = 1e-6  # of the simulator in float64


def test_the_symbolic_step_is_the_simulators():
    symbolic = pytest.importorskip("benchmarks.optimal", exc_type=ImportError)
    rng, model = np.random.default_rng(0), nominal_parameters()
    for effect in EFFECTS:
        if effect.memory is None:  # no memory
            neutral = effect.parameters()._asdict()
            sizes = {
                name: neutral[name] + effect.notable.get(name, 0.0) * rng.uniform()
                for name in neutral
            }
            model = model.with_effects(effect.parameters(**sizes))
    traced = symbolic.step_function(model)
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda leaf: np.asarray(leaf, float), model)
        simulated = jax.jit(lambda x, u, dt: step(x, u, dt, exact))
        for x, u in zip(*(rows.astype(float) for rows in random_inputs(100)), strict=True):
            dt = rng.uniform(0.002, 0.04)
            assert_allclose(
                traced(x, u, dt).full()[:, 0], simulated(x, u, dt), rtol=0.0, atol=EXACT
            )


def test_every_track_has_its_references():
    wanted = {
        references.shipped_path(track, kind, "nominal")
        for track in available_tracks()
        for kind in references.KINDS
    }
    assert wanted <= set(SHIPPED)
    nominal = references.shipped_reference("flytrack", "flying")
    assert references.model_digest(nominal.model) == references.model_digest(nominal_parameters())
    assert nominal.percent_above(1.08 * nominal.time_s) == pytest.approx(8.0)
    with pytest.raises(references.ReferenceFileError, match="flytrack_nominal_flying"):
        references.shipped_reference("nowhere")


# A program per number of gates and model: one of them in every run.
FAST = [path for path in SHIPPED if path.stem.startswith("flytrack_nominal")]


@pytest.mark.parametrize("path", slow_but(FAST, SHIPPED), ids=lambda path: path.stem)
def test_its_commands_fly_in_the_simulator(path):
    reference = references.load_reference(path)
    track = load_track(reference.track)
    assert path.stem == f"{reference.track}_{reference.model_name}_{reference.kind}"
    assert (
        reference.track_sha256 == references.track_digest(track)
        and reference.found["status"] == "Solve_Succeeded"
    )
    flown = replay(reference, track)
    assert time_optimal.is_verified(reference, flown)
    assert flown.time_s == pytest.approx(reference.time_s, abs=1e-4)
    assert flown.drift_m < 1e-3, "half of the clearance"
    before, behind = reference.states[-2:]
    end = before + (reference.time_s / reference.dt_s % 1.0) * (behind - before)
    start = time_optimal.start_state(track, reference.found["battery_v"])
    first, wanted = (
        (end, reference.states[0]) if reference.kind == "flying" else (reference.states[0], start)
    )
    assert_allclose(first[POSITION], wanted[POSITION], atol=5e-3)
    assert_allclose(first[VELOCITY], wanted[VELOCITY], atol=5e-3)


def rewritten(path, **changes):
    """Write the flying lap of the FlyTrack course with arrays or notes replaced."""
    with np.load(references.shipped_path("flytrack", "flying", "nominal")) as file:
        data = dict(file)
    notes = json.loads(str(data["notes"]))
    for name, value in changes.items():
        (data if name in data else notes)[name] = value
    np.savez(path, **{**data, "notes": np.array(json.dumps(notes))})
    return path


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"states": np.zeros((3, STATE_SIZE))},
            r"states: found shape \(3, 21\), expected \(385, 21\)",
        ),
        ({"commands": np.full((384, 4), np.nan)}, "commands: .*finite"),
        ({"version": 2}, "version: found 2, expected one of 1"),
        ({"kind": "hovering"}, "kind: found 'hovering', expected one of flying, standing"),
        ({"model_sha256": "0"}, "model: found another"),
        ({"time_s": -1.0}, "time_s: found -1.0, expected a number above 0"),
    ],
)
def test_a_damaged_file_is_refused(changes, reason, tmp_path):
    path = rewritten(tmp_path / "lap.npz", **changes)
    with pytest.raises(references.ReferenceFileError, match=f"lap.npz.*{reason}"):
        references.load_reference(path)


def test_a_saved_reference_comes_back(tmp_path):
    reference, path = references.shipped_reference("flytrack", "flying"), tmp_path / "lap.npz"
    references.save_reference(path, reference)
    loaded = references.load_reference(path)
    assert_array_equal(loaded.states, reference.states)
    assert_array_equal(loaded.commands, reference.commands)
    assert (loaded.time_s, loaded.found) == (reference.time_s, reference.found)


@pytest.mark.slow
def test_the_solver_finds_the_shipped_time_again():
    pytest.importorskip("casadi")
    shipped = references.shipped_reference("flytrack", "flying")
    again = time_optimal.optimise(load_track("flytrack"), "flying", shipped.model, "nominal")
    assert again.time_s == pytest.approx(shipped.time_s, rel=1e-4)
    assert time_optimal.is_verified(again, replay(again, load_track("flytrack")))
