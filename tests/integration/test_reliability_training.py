"""The part on training of the reliability page: a small share of it, and that it reports what is broken."""

import random

import pytest

from baselines.purejaxrl_ppo.run_folder import checkpoints_in
from benchmarks.reliability.training import (
    SECTION,
    are_equal,
    as_markdown,
    damaged,
    damages,
    is_held,
    lost,
)
from tests.support.ppo_runs import EVERY_OTHER_UPDATE, SEED, make_trainer


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("training")
    make_trainer().train(root / "whole", SEED, EVERY_OTHER_UPDATE)
    return root


def test_a_damaged_checkpoint_is_recognised(folder, tmp_path):
    (tmp_path / "whole").symlink_to(folder / "whole")
    assert damages(tmp_path, 40, random.Random(0)) == {"damages": 40, "not recognised": 0}


def test_damage_that_is_not_recognised_is_counted(folder, tmp_path, monkeypatch):
    (tmp_path / "whole").symlink_to(folder / "whole")
    monkeypatch.setattr("benchmarks.reliability.training.damaged", lambda content, rng: content)
    assert damages(tmp_path, 3, random.Random(0))["not recognised"] == 3


def test_damage_is_a_cut_or_a_bit():
    content, rng = bytes(range(100)), random.Random(0)
    changed = [damaged(content, rng) for _ in range(200)]
    cut = [one for one in changed if len(one) < 100]
    assert 50 < len(cut) < 150 and all(content.startswith(one) for one in cut)
    for one in changed:
        if len(one) == 100:
            assert sum((a ^ b).bit_count() for a, b in zip(one, content, strict=True)) == 1


def test_lost_checkpoints_and_other_ends_are_seen(folder, tmp_path):
    known = set(checkpoints_in(folder / "whole"))
    assert lost(known, folder / "whole") == []
    assert lost({*known, tmp_path / "step_1.msgpack"}, folder / "whole") == [tmp_path / "step_1.msgpack"]
    final, before = checkpoints_in(folder / "whole")[:2]
    (tmp_path / final.name).write_bytes(final.read_bytes()[:-1])
    assert lost(set(), tmp_path) == [tmp_path / final.name]
    assert are_equal(final, final) and not are_equal(final, before)


def test_what_is_broken_breaks_the_promise():
    good = {
        "kills": 2,
        "while writing": 1,
        "checkpoints lost": 0,
        "runs": 1,
        "runs that end otherwise": 0,
        "updates": 9,
        "damages": 3,
        "not recognised": 0,
        "full disk": "as promised",
        "read-only folder": "not tried: only root can mount",
        "tracking server down": "as promised",
    }
    assert is_held(good) and "2 kills" in as_markdown(good)
    for name, value in (
        ("checkpoints lost", 1),
        ("runs that end otherwise", 1),
        ("not recognised", 1),
        ("full disk", "exit 0"),
    ):
        assert not is_held({**good, name: value})


@pytest.mark.slow
def test_a_small_share_is_held(tmp_path):
    assert is_held(SECTION.measure(0, 0.04, tmp_path))
