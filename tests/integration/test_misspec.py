"""misspec-v1: frozen logs, a sealed truth, a door that survives its methods, and the scores."""

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from benchmarks.misspec.replay import fly
from benchmarks.misspec.rivals import random_distortion
from flytrack_bench.misspec import Answer, AnswerError, Flights, load_log_suite, run_method, scores
from flytrack_bench.misspec.answer import diagnose_log, log_of
from flytrack_bench.misspec.door import show
from flytrack_bench.misspec.suite import LogSuite, draw_all
from flytrack_env.motion import Motion
from flytrack_sysid import load_log

MOODY = "tests.support.misspec_methods:moody"
MOTIONS = {
    "handout": Motion.EULER,
    "semi_implicit": Motion.SEMI_IMPLICIT,
    "fine": Motion.CONTINUOUS,
}
SUITE = load_log_suite("misspec-v1")
DRAWN = draw_all(SUITE.seed)
SHORT = LogSuite("short", "none", SUITE.seed, 4.0, 3.0, dict.fromkeys(("00", "01", "02", "03"), ""))


def first_id(**fields):
    """Return the id of the first plant that was drawn with such fields."""
    is_such = (fields.items() <= drawn._asdict().items() for drawn in DRAWN)
    return f"{list(is_such).index(True):02}"


@pytest.fixture(scope="module")
def drag():
    (number, *_) = (i for i, one in enumerate(DRAWN) if "linear_drag" in one.names)
    return SUITE.plant(f"{number:02}")


def test_a_log_drawn_again_is_the_frozen_one(drag):
    assert drag.is_frozen and drag.log.sha256 == SUITE.sha256[drag.id]
    others = [
        msgspec.structs.replace(SHORT, seed=seed).plant("00").log.sha256 for seed in (1, 1, 2)
    ]
    assert others[0] == others[1] != others[2]


def test_what_a_method_is_given_does_not_hold_the_truth(drag, tmp_path):
    show(drag, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"log.npz", "model.json", "flights.npz"}
    log, text = load_log(tmp_path / "log.npz"), (tmp_path / "model.json").read_text()
    assert log.sha256 == drag.log.sha256 and "linear_drag" not in text
    assert not json.loads(text)["effects"] and "a" not in log
    with np.load(tmp_path / "flights.npz") as arrays:
        past = arrays["p"]
        num_steps = arrays["commands"].shape[1] + 1 - past.shape[1]
        assert num_steps == 50 and len(past) == len(drag.ends_w) > 70
        assert np.abs(past[:, -1] - drag.ends_w).max(axis=1).min() > 0.0
    blind, starts = log_of(drag.flights)
    assert np.all(blind["p"][starts[0] + 1 : starts[0] + 51] == blind["p"][starts[0]])


def test_flights_of_clean_plants_end_where_the_nominal_model_flies():
    """In each motion, by NumPy of the rivals and the equations of the hidden drone."""
    for motion, of_package in MOTIONS.items():
        plant = SHORT.plant(first_id(row="clean", motion=motion))
        model = plant.model._replace(motion=of_package)
        ends_w = fly(model, plant.flights, lambda state: np.zeros((2, len(state.thrust), 3)))
        # Of 10 ms by the midpoint rule, where the hidden drone has parts of 1 ms.
        assert np.abs(ends_w - plant.ends_w).max() < 2e-3
        moved = np.linalg.norm(plant.flights.past["p"][:, -1] - plant.ends_w, axis=1)
        assert moved.max() > 0.05


def test_the_distortion_test_flags_drag_and_no_clean_flight(drag):
    clean = SUITE.plant(first_id(row="clean", noise="sensors"))
    assert random_distortion(drag.log, drag.model).flagged
    assert not random_distortion(clean.log, clean.model).flagged


@pytest.mark.slow
def test_ours_names_drag(drag):
    line = scores.score(drag, diagnose_log(drag.log, drag.model).as_json(drag.flights))
    assert line["exact"] and line["error_m"] < 0.03
    assert {name.partition(".")[0] for name in line["intervals"]} == {*drag.drawn.names}


def test_a_method_that_crashes_invents_or_ends_scores_zero_and_the_result_goes_on(tmp_path):
    out, ids = tmp_path / "result.json", ["00", "01", "02", "03"]
    found = run_method(SHORT, ids, MOODY, out, 60.0)
    reasons = [found["logs"][name].get("reason", "") for name in ids]
    assert reasons[0] == "" and "ZeroDivisionError: by design" in reasons[1]
    assert "found 'gremlins', expected some of" in reasons[2]
    assert reasons[3] == "its process crashed, with exit status 3"
    assert found["summary"]["no_answer"] == 3 and json.loads(out.read_text()) == found
    shares = ("silent", "no_false_name", "exact", "in_class", "detected", "left_open")
    assert not any(found["logs"]["01"][name] for name in shares)
    assert found["logs"]["00"]["names"] == ["linear_drag"] and found["logs"]["00"]["cpu_s"] >= 0.0
    again = run_method(SHORT, ids[:2], MOODY, out, 60.0)
    assert again == found  # nothing was left to ask
    with pytest.raises(AnswerError, match="method: found tests"):
        run_method(SHORT, ids, "benchmarks.misspec.rivals:nominal", out, 60.0)
    out.write_text(json.dumps(found | {"code": "other"}))
    with pytest.raises(AnswerError, match="code: found other"):
        run_method(SHORT, ids, MOODY, out, 60.0)


@pytest.mark.slow
def test_a_method_that_is_not_there_is_refused():
    with pytest.raises(AnswerError, match="cannot be imported"):
        run_method(SHORT, ["00"], MOODY.replace("moody", "absent"), None, 3.0)


def line_of(row, effects, answer, **more):
    """Return the scores of an answer on a plant that is not flown."""
    plant = SHORT.plant("00")
    truth = replace(plant.truth, effects=effects, outside=None)
    plant = replace(plant, truth=truth, drawn=plant.drawn._replace(row=row))
    return scores.score(plant, answer.as_json(plant.flights)) | more


def test_scores_count_names_classes_and_intervals():
    effects = {"linear_drag": {"d_x": 0.3, "d_y": 0.3}, "wind": {"a_x": 1.0}}
    values = {"linear_drag.d_x": (0.31, 0.29, 0.33), "linear_drag.d_y": (0.4, 0.38, 0.42)}
    right = line_of("two", effects, Answer(("wind", "linear_drag"), values=values))
    assert right["exact"] and right["in_class"] and right["no_false_name"]
    assert right["intervals"]["linear_drag.d_x"] == [0.3, 0.31, 0.29, 0.33]
    other = Answer(("wind", "rotor_drag"), {"rotor_drag": ("linear_drag",)})
    assert [line_of("two", effects, other)[name] for name in ("exact", "in_class")] == [False, True]
    one = Answer(("wind",), {"wind": ("linear_drag",)})  # a name stands for one effect
    assert not line_of("two", effects, one)["in_class"]
    assert line_of("two", effects, one)["no_false_name"]
    clean = line_of("clean", {}, Answer(), noise="sensors")
    assert clean["silent"] and clean["quiet"] and not clean["detected"]
    summary = scores.summarize([right, clean])
    assert summary["coverage"]["k"] == 1 and summary["coverage"]["n"] == 2
    assert summary["exact"] == {"k": 1, "n": 1, "ci95": [0.025, 1.0]}  # Clopper and Pearson
    assert summary["error_m"]["named"] is None


def test_a_missing_error_is_the_worst_and_the_interval_is_over_plants():
    assert scores.median([0.1, None, None])["median"] is None
    assert scores.median([0.1, 0.2, None])["median"] == 0.2
    assert scores.share([True] * 15)["ci95"][0] == pytest.approx(0.782, abs=5e-4)  # 0.025^(1/15)
    plants = [{"a": [0.0, 0.0, -1.0, 1.0]}] * 9 + [
        {str(i): [9.0, 0.0, -1.0, 1.0] for i in range(9)}
    ]
    covered = scores.coverage(plants)
    assert (covered["k"], covered["n"], covered["plants"]) == (9, 18, 10)
    assert covered["ci95"][0] < 0.3 and covered["ci95"][1] == 1.0  # the one plant counts as one


def test_predictions_of_another_shape_are_refused():
    flights = Flights(0.01, {"p": np.zeros((2, 101, 3))}, np.zeros((2, 150, 4)))
    with pytest.raises(AnswerError, match=r"predict: found shape \(2, 2\)"):
        Answer(predict=lambda flights: np.zeros((2, 2))).as_json(flights)
