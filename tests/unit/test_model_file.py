"""Model files: written, read, and refused with a clear message."""

import json
import re

import chex
import numpy as np
import pytest

from flytrack_env.battery import Battery, BatteryWarning
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import CommandDelay, LinearDrag, QuadraticDrag
from flytrack_env.env import FlyTrack
from flytrack_env.model_file import UNITS, ModelFileError, load_model, save_model
from flytrack_env.motion import Motion
from tests.support.tables import table

CASES = table("models")
FIELDS = CASES["fields"]
MINIMAL = json.dumps(FIELDS)


CHANGED = nominal_parameters()._replace(
    m=0.1,
    g=1.62,
    battery_drain_v_per_min=0.0,
    motion=Motion.CONTINUOUS,
    thrust_coeffs=np.float32([0.1, -0.2, 1 / 3, 1e-7, 1e5, 0]),
    battery=Battery(4.2, 3.4, 3.5, 4.1),
    effects=(CommandDelay(0.013), LinearDrag(0.1, 0.2, -0.05)),
)


@pytest.mark.parametrize("model", [nominal_parameters(), CHANGED], ids=["nominal", "changed"])
def test_round_trip(model, tmp_path):
    path = tmp_path / "model.json"
    provenance = {"source": "a test", "seed": 3, "files": ["a.npy"]}
    save_model(path, model, provenance)
    chex.assert_trees_all_equal(load_model(path), model)
    chex.assert_trees_all_equal(load_model(str(path)), model)
    document = json.loads(path.read_text(encoding="utf-8"))
    assert document["provenance"] == provenance
    assert set(document["units"]) == {*document["parameters"], *document["effects"]}


def test_minimal_file_by_hand(tmp_path):
    path = tmp_path / "model.json"
    path.write_text(MINIMAL, encoding="utf-8")
    model = load_model(path)
    for name in UNITS:
        np.testing.assert_allclose(getattr(model, name), np.float32(FIELDS[name]))
    chex.assert_trees_all_equal(FlyTrack(model=path).default_params.model, model)
    nested = tmp_path / "nested.json"
    nested.write_text(json.dumps({"version": 1, "parameters": FIELDS}), encoding="utf-8")
    chex.assert_trees_all_equal(load_model(nested), model)


def test_the_old_name_of_the_euler_step_is_read_and_the_new_one_written(tmp_path):
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    old.write_text(json.dumps({**FIELDS, "motion": "handout"}), encoding="utf-8")
    model = load_model(old)
    assert model.motion is Motion.EULER
    save_model(new, model, {})
    assert json.loads(new.read_text(encoding="utf-8"))["motion"] == "euler"
    old.write_text(json.dumps({**FIELDS, "motion": "hand"}), encoding="utf-8")
    with pytest.raises(ModelFileError, match="motion: found 'hand'"):
        load_model(old)


def test_a_file_without_a_battery_is_warned_of(tmp_path):
    path = tmp_path / "m.json"
    path.write_text(json.dumps({n: FIELDS[n] for n in FIELDS if n != "battery"}), encoding="utf-8")
    with pytest.warns(BatteryWarning, match=r"m\.json: battery: missing.*handout's 22 to 24 V"):
        assert load_model(path).battery == Battery()


def test_effects_by_hand_beside_or_among_the_parameters(tmp_path):
    path = tmp_path / "model.json"
    some = {"quadratic_drag": {"k_x": 0.1}, "command_delay": {"delay_s": 0.02}}
    for document in ({**FIELDS, "effects": some}, {"parameters": FIELDS, "effects": some}):
        path.write_text(json.dumps(document), encoding="utf-8")
        # In the order of the list of effects, whatever the file's; neutral where the file says
        # nothing.
        assert load_model(path).effects == (CommandDelay(0.02), QuadraticDrag(0.1, 0.0, 0.0))
    path.write_text(MINIMAL, encoding="utf-8")
    assert load_model(path).effects == ()


BAD_FILES = [
    *((FIELDS | changes, reason) for changes, reason in CASES["refused"]),
    (FIELDS | {"m": [["x" * 5000]]}, "m: found .{1,300}, expected a number"),
    ({"tau": [1, 1, 1, 1]}, "thrust_coeffs: missing"),
    ({"version": 2, "parameters": FIELDS}, "version: found 2, expected 1"),
]


@pytest.mark.parametrize(("document", "reason"), BAD_FILES)
def test_bad_files_are_refused(document, reason, tmp_path):
    path = tmp_path / "model.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ModelFileError, match=rf"^{re.escape(str(path))}: {reason}"):
        load_model(path)
