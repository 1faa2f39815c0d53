"""Seeds that were cut off between each other: every one goes on from where it was, in which folder ever."""

import pytest
from baselines.purejaxrl_ppo.options import OPTIONS, write_options
from baselines.purejaxrl_ppo.plans import make_plans, options_of

from baselines.purejaxrl_ppo import tracking, train_ppo
from baselines.purejaxrl_ppo.resume import newest_intact
from baselines.purejaxrl_ppo.training import Options, Trainer
from tests.support.ppo_runs import BATCH, DEAD_URI, EVERY_OTHER_UPDATE, SEED, assert_same_end, make_trainer

SEEDS = (SEED, SEED + 1)


@pytest.fixture(autouse=True)
def no_store(monkeypatch):
    """Keep all that is told in the journal, and send it nowhere."""
    monkeypatch.setattr(tracking, "send_journal", lambda journal, uri: None)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A folder of two seeds that were trained one after the other and not cut off."""
    root = tmp_path_factory.mktemp("alone")
    for seed in SEEDS:
        make_trainer().train(root / f"seed{seed}", seed, EVERY_OTHER_UPDATE)
    return root


def parse(*arguments):
    return train_ppo.make_parser().parse_args([*map(str, arguments)])


def test_a_seed_killed_before_its_first_checkpoint_begins_in_its_folder(alone, tmp_path):
    options = EVERY_OTHER_UPDATE._replace(tracking_uri=DEAD_URI)
    make_trainer().train(tmp_path / "seed3", 3, options)
    write_options(tmp_path / "seed3", options)
    killed = tmp_path / "seed4"
    write_options(killed, options._replace(evaluation_episodes=7))
    (killed / ".step_0.msgpack.0123456789abcdef").touch()
    tracker = tracking.Tracker(killed, DEAD_URI, "the run that was killed", {})
    tracker.metrics(2 * BATCH, {"policy_loss": 9.0})
    arguments = parse("--resume", tmp_path)
    plans = make_plans(arguments)
    assert [(plan.seed, plan.resume) for plan in plans] == [
        (3, tmp_path / "seed3/final.safetensors"),
        (4, killed),
    ]
    found = options_of(arguments, plans)
    assert found[1] == options._replace(evaluation_episodes=7, resume=killed)
    for plan, own in zip(plans, found, strict=True):
        make_trainer().train(plan.out, plan.seed, own)
    assert_same_end(killed / "final.safetensors", alone / "seed4" / "final.safetensors")
    journal = tracking.Journal(killed)
    assert journal.beginning()["name"] == "the run that was killed"
    assert not list(killed.glob(".*"))
    steps = [entry["step"] for entry in journal.of_kind("metrics")]
    assert steps == [2 * BATCH, 4 * BATCH, 6 * BATCH, 7 * BATCH]


def test_a_folder_that_a_seed_does_not_own_is_still_refused(alone, tmp_path):
    tracking.Journal(tmp_path / "seed5").append("run", experiment="e", name="n", params={})
    with pytest.raises(ValueError, match=r"seed5/tracking\.jsonl tells of a run, and no store has all of it"):
        make_plans(parse("--resume", alone, "--out", tmp_path, "--seed", 3, "--num-seeds", 3))


@pytest.mark.parametrize("killed", ["first", "second"])
def test_seeds_that_go_on_elsewhere_are_there_before_any_trains(alone, tmp_path, monkeypatch, killed):
    before, after = tmp_path / "before", tmp_path / "after"
    for seed, updates in zip(SEEDS, (4, 7), strict=True):
        for path in (alone / f"seed{seed}").glob("*.msgpack"):
            steps = newest_intact(path)[1].meta["steps"]
            if steps <= updates * BATCH:
                (before / f"seed{seed}").mkdir(parents=True, exist_ok=True)
                (before / f"seed{seed}" / path.name).write_bytes(path.read_bytes())
    trained, original = [], Trainer.train_all

    def train_all(self, asked):
        if killed == "first" or trained:
            raise KeyboardInterrupt
        trained.append(asked)
        return original(make_trainer(), asked)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "train_all", train_all)
        given = ("--resume", before, "--out", after, "--seeds-at-once", 1)
        given = (*given, "--no-tracking", "--evaluate-every", 0)
        train_ppo.run(train_ppo.prepare(parse(*given)))
    plans = make_plans(parse("--resume", after))
    first = "final" if killed == "second" else f"step_{4 * BATCH}"
    assert [plan.resume for plan in plans] == [
        after / f"seed3/{first}.msgpack",
        after / f"seed4/step_{7 * BATCH}.msgpack",
    ]
    assert [plan.checkpoint.meta["steps"] for plan in plans] == [(7 if trained else 4) * BATCH, 7 * BATCH]
    for plan in plans:
        make_trainer().train(plan.out, plan.seed, Options(resume=plan.resume))
    for seed in SEEDS:
        assert_same_end(after / f"seed{seed}/final.safetensors", alone / f"seed{seed}/final.safetensors")


def test_a_disk_that_is_full_leaves_no_seed_behind(alone, tmp_path, monkeypatch):
    def full(self, mode="r", **options):
        if "x" in mode and self.parent.name == "seed4":
            raise OSError(28, "No space left on device")
        return open_path(self, mode, **options)

    given = ("--resume", alone, "--out", tmp_path / "after", "--no-tracking")
    asked = train_ppo.prepare(parse(*given))
    path_type = type(tmp_path)
    open_path = path_type.open
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(path_type, "open", full)
        train_ppo.run(asked)
    assert [path for path in (tmp_path / "after").rglob("*") if path.is_file()] == []
    assert len(make_plans(parse(*given))) == 2  # the command can be given again


def test_one_run_that_goes_on_elsewhere_is_there_before_it_trains(alone, tmp_path, monkeypatch):
    trainer = make_trainer()
    monkeypatch.setattr(trainer, "chunk", None)
    source = alone / "seed3" / f"step_{2 * BATCH}.msgpack"
    with pytest.raises(TypeError):
        trainer.train(tmp_path, SEED, Options(resume=source))
    assert newest_intact(tmp_path)[0] == tmp_path / source.name
    assert not (tmp_path / OPTIONS).exists()
