"""Files from strangers: a few of some kinds keep the promise, and a loader that breaks it is found out."""

import json
from collections import Counter
from typing import Any

import numpy as np
import pytest

from benchmarks.reliability import files
from benchmarks.reliability.strangers import archives, noise, trees
from benchmarks.reliability.strangers.pool import measure_kind
from tests.support.planted_kinds import FAULTS

BROKEN = {
    "unpickles": ("forbidden", r"pickle.find_class ('builtins', 'len')"),
    "runs": ("forbidden", "compile"),
    "writes": ("forbidden", "outside' to write"),
    "removes": ("forbidden", "os.remove"),
    "connects": ("forbidden", "socket.__new__"),
    "starts": ("forbidden", "os.system"),
    "raises": ("other error", "KeyError: 'first' (planted_kinds.py, line "),
    "mumbles": ("unclear", "found 'ill'"),
    "shouts": ("unclear", "xxx"),
    "paints": ("unclear", "red"),
    "eats": ("memory", "MemoryError"),
    "swallows": ("memory", "cannot be read"),
    "spins": ("time", "more than 5 s of processor time"),
    "crashes": ("crash", "the process ended with -6"),
    "lies": ("unsound", "found what is not sound"),
}


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What is found of a file that is well, one for every fault, and five that are refused."""
    folder = tmp_path_factory.mktemp("planted")
    return measure_kind("planted", 0, 1 + len(FAULTS) + 5, folder, kinds="tests.support.planted_kinds")


def test_every_broken_promise_is_reported_and_nothing_else(planted):
    assert list(BROKEN) == list(FAULTS)
    sorts = Counter(sort for sort, _ in BROKEN.values())
    assert (planted["loaded"], planted["refused"], planted["broken"]) == (1, 5, sorts)
    assert planted["crafted"] == len(FAULTS) and planted["failure"] is None
    assert not files.is_held({"kinds": {"planted": planted}})


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_promise_is_named(fault, planted):
    sort, text = BROKEN[fault]
    (found,) = (one for one in planted["examples"] if one["number"] == 1 + list(FAULTS).index(fault))
    assert found["sort"] == sort and text in found["text"]


def test_a_share_of_some_kinds_keeps_the_promise(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "KINDS", dict.fromkeys(("rollout", "script")))
    result = json.loads(json.dumps(files.SECTION.measure(0, 0.02, tmp_path)))
    assert files.SECTION.is_held(result), result
    for found in result["kinds"].values():
        assert found["files"] == 200 == found["loaded"] + found["refused"]
        assert 30 < found["crafted"] < 150 and found["failure"] is None
        assert found["loaded"] > 3 and found["refused"] > 100
    text = files.SECTION.as_markdown(result)
    assert (
        f"| rollout (`.npy`) | 200 | {result['kinds']['rollout']['crafted']} |" in text
        and "Broken" not in text
    )


def test_examples_of_what_broke_are_on_the_page():
    example = {"number": 7, "sort": "crash", "text": "the process ended with -11"}
    found = {
        "files": 9,
        "crafted": 4,
        "loaded": 1,
        "refused": 7,
        "broken": {"crash": 1},
        "failure": None,
        "slowest_s": 0.1,
        "cpu_s": 1.0,
    }
    result = {"seed": 3, "kinds": {"black_box": {**found, "examples": [example]}}}
    text = files.SECTION.as_markdown(result)
    assert "| black box (`acro_step.bin`) | 9 | 4 | 1 | 7 | 1 | 0.1 |" in text
    assert "seed 3" in text and "number 7: crash: `the process ended with -11`" in text


def test_a_failed_measurement_of_a_kind_is_shown_and_loses_no_other(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "KINDS", dict.fromkeys(("no_such_kind", "rollout")))
    monkeypatch.setitem(files.TITLES, "no_such_kind", "none")
    result = json.loads(json.dumps(files.SECTION.measure(0, 0.0005, tmp_path)))
    assert not files.SECTION.is_held(result)
    text = files.SECTION.as_markdown(result)
    assert "| none | 0 | 0 | 0 | 0 | 0, then the measurement failed | 0 |" in text
    assert "- none: the measurement failed: `" in text and "found 'no_such_kind'" in text
    assert result["kinds"]["rollout"]["files"] == 5 and result["kinds"]["rollout"]["failure"] is None


def test_every_kind_has_a_title():
    from benchmarks.reliability.strangers.kinds import KINDS

    assert list(files.TITLES) == list(KINDS) == list(files.KINDS)


def test_damage_is_the_same_for_the_same_seed_and_damages():
    text = b'name = "a"\nlow = [1.0, 2.0]\n' * 20
    for mutate in (noise.damage, noise.damage_text):
        found = [mutate(np.random.default_rng([5, number]), [text]) for number in range(200)]
        assert found == [mutate(np.random.default_rng([5, number]), [text]) for number in range(200)]
        assert len(set(found)) > 150 and found.count(text) < 20
    tree = {"a": [1, 2.5, {"b": "text"}], "c": None}
    written = [
        trees.as_json(rng, trees.damage_tree(rng, tree)) for rng in map(np.random.default_rng, range(99))
    ]
    assert len(set(written)) > 80 and tree == {"a": [1, 2.5, {"b": "text"}], "c": None}


def test_a_bomb_is_small_and_unpacks_to_gigabytes():
    arrays = {"t": np.zeros(3), "x": np.zeros((3, 4))}
    assert 2_000_000 < len(archives.bomb()) < 4_000_000
    assert all(len(content) < 5_000_000 for content in archives.bombs(arrays))
    assert archives.BOMB_BLOCK * archives.BOMB_BLOCKS > 3e9
