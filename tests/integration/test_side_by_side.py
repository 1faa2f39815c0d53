"""Seeds that train side by side in one program: as alone, cut off, diverged, taken up again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from baselines.purejaxrl_ppo.plans import batched, make_plans
from baselines.purejaxrl_ppo.side_by_side import Ready, groups_of

from baselines.purejaxrl_ppo.checkpoint import as_named_arrays, load_checkpoint
from baselines.purejaxrl_ppo.resume import at_common_step, newest_intact
from baselines.purejaxrl_ppo.run import DivergedError, Run
from baselines.purejaxrl_ppo.train_ppo import make_parser
from tests.support.ppo_runs import BATCH, EVERY_OTHER_UPDATE, SEED, assert_same_end, make_trainer

SEEDS = (SEED, SEED + 1, SEED + 2)


def asked_for(root, options=EVERY_OTHER_UPDATE, seeds=SEEDS):
    return [(root / f"seed{seed}", seed, options) for seed in seeds]


@pytest.fixture(scope="module")
def trainer():
    return make_trainer()


@pytest.fixture(scope="module")
def together(trainer, tmp_path_factory):
    root = tmp_path_factory.mktemp("together")
    return root, trainer.train_all(asked_for(root))


def test_a_seed_learns_what_it_learns_alone(trainer, together, tmp_path):
    # Sums are taken in another order, and learning drives what is not the same apart: the first update only.
    for seed, (checkpoint, metrics) in zip(SEEDS, together[1], strict=True):
        assert checkpoint.meta["seed"] == seed
        alone = trainer.chunk(trainer.start(jax.random.key(seed)), jnp.int32(1))[1]
        for name, values in metrics.items():
            assert values.shape == (7,)
            np.testing.assert_allclose(values[0], alone[name][0], rtol=2e-3, atol=2e-5, err_msg=name)


def test_every_seed_has_its_checkpoints(together):
    for seed in SEEDS:
        names = {path.name for path in (together[0] / f"seed{seed}").iterdir()}
        assert names == {"final.safetensors"} | {f"step_{step * BATCH}.msgpack" for step in (0, 2, 4, 6)}
    kernels = [
        checkpoint.params["params"]["actor_tower"]["layers_0"]["kernel"] for checkpoint, _ in together[1]
    ]
    assert not any(np.array_equal(kernels[0], other) for other in kernels[1:])


@pytest.mark.parametrize("killed", [1, 2])
def test_seeds_killed_between_their_checkpoints_end_bit_for_bit(
    trainer, together, tmp_path, monkeypatch, killed
):
    write = Run.checkpoint

    def die(self, name, runner, update):
        if update == 4 and self.description["seed"] == SEEDS[killed]:
            raise KeyboardInterrupt
        write(self, name, runner, update)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Run, "checkpoint", die)
        trainer.train_all(asked_for(tmp_path))
    steps = [newest_intact(folder)[1].meta["steps"] for folder, _, _ in asked_for(tmp_path)]
    assert steps == [4 * BATCH] * killed + [2 * BATCH] * (3 - killed)
    plans = make_plans(make_parser().parse_args(["--resume", str(tmp_path)]))
    options = [EVERY_OTHER_UPDATE._replace(resume=plan.resume) for plan in plans]
    trainer.train_all([(plan.out, plan.seed, own) for plan, own in zip(plans, options, strict=True)])
    for folder, _, _ in asked_for(tmp_path):
        assert_same_end(folder / "final.safetensors", together[0] / folder.name / "final.safetensors")


def test_seeds_that_did_not_train_together_stay_where_they_are(trainer, together, caplog):
    starts = [newest_intact(together[0] / f"seed{seed}") for seed in SEEDS]
    behind = newest_intact(together[0] / f"seed{SEED}" / f"step_{4 * BATCH}.msgpack")
    assert [start[1].meta["steps"] for start in at_common_step([behind, *starts[1:]])] == [4 * BATCH] * 3
    for others in ([behind, starts[1]], [behind, starts[1], None], [None] * 3, []):
        assert at_common_step(others) is others
    behind[1].meta["machine"] = "a stranger's"
    assert at_common_step([behind, *starts[1:]])[0] is behind
    lost = newest_intact(together[0] / f"seed{SEED}" / f"step_{4 * BATCH}.msgpack")
    lost[1].meta["steps"] = 5 * BATCH  # of which nobody has a checkpoint
    assert at_common_step([lost, *starts[1:]])[0] is lost
    assert "go on from where each of them was" in caplog.text


def test_groups_of_seeds_are_as_asked_for_or_as_before(together, tmp_path):
    def at_once(*flags):
        return {plan.at_once for plan in make_plans(make_parser().parse_args([*map(str, flags)]))}

    root = together[0]
    assert at_once("--resume", root) == {3} and at_once("--resume", root, "--seeds-at-once", 2) == {2}
    new = ("--out", tmp_path / "new", "--num-seeds", 5)
    assert at_once(*new) == {5} and at_once(*new, "--seeds-at-once", 2) == {2}
    assert at_once("--out", tmp_path / "new") == {1}
    assert batched([1, 2, 3], 2) == [[1, 2], [3]]
    with pytest.raises(ValueError, match="--seeds-at-once: found 0"):
        at_once(*new, "--seeds-at-once", 0)


def test_one_that_diverges_does_not_end_the_others(trainer, tmp_path, monkeypatch):
    advance = trainer.chunk_of_many

    def poisoned(runners, count):
        runners, rows = advance(runners, count)
        state = runners.train_state
        broken = jax.tree.map(lambda leaf: leaf.at[1].multiply(jnp.nan), state.params)
        return runners._replace(train_state=state.replace(params=broken)), rows

    monkeypatch.setattr(trainer, "chunk_of_many", poisoned)
    with pytest.raises(DivergedError, match="training diverged between steps 0 and"):
        trainer.train_all(asked_for(tmp_path))
    complete = [(folder / "final.safetensors").exists() for folder, _, _ in asked_for(tmp_path)]
    assert complete == [True, False, True]
    arrays = as_named_arrays(load_checkpoint(tmp_path / f"seed{SEED}" / "final.safetensors").params)
    assert all(np.isfinite(array).all() for array in arrays.values())


def test_a_loop_is_shared_by_seeds_as_far_and_as_often_looked_at(trainer, tmp_path):
    def ready(update, options=EVERY_OTHER_UPDATE):
        return Ready(Run(trainer, tmp_path, {}, options), None, update)

    often = EVERY_OTHER_UPDATE._replace(evaluate_every=BATCH)
    runs = [ready(0), ready(2), ready(0), ready(0, often)]
    assert groups_of(runs) == [[runs[0], runs[2]], [runs[1]], [runs[3]]]


def test_another_number_of_seeds_is_reported(trainer):
    alone, three = (trainer.describe(SEED, number)["machine"] for number in (1, 3))
    assert three == {**alone, "seeds": 3}
