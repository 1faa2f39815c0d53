"""Self-play begins as good as its first policy, and counts who finishes first."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import flytrack_env
from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.self_play import (
    Settings,
    fly_races,
    main,
    make_pool_opponent,
    summarize,
    train,
    widen_params,
)
from flytrack_env.model_file import model_from_json
from flytrack_env.multi_drone import MultiDroneRace

START = load_checkpoint("champion")
ENV = flytrack_env.make("FlyTrack-v0", model=model_from_json(START.meta["model"], "model"))
RACE = MultiDroneRace(ENV, 2, "first")


def test_a_widened_policy_gives_new_rows_no_weight():
    wide = widen_params(START.params, 36)
    seen = np.asarray(jax.random.normal(jax.random.key(0), (5, 36)))
    action = START.network.act(wide, (), seen)[1]
    assert_allclose(action, START.network.act(START.params, (), seen[:, :29])[1], atol=1e-6)


def test_each_member_of_a_pool_flies_its_share_of_the_races():
    weaker = jax.tree.map(lambda leaf: 0.5 * leaf, START.params)
    pool = jax.tree.map(lambda *leaves: np.stack(leaves), START.params, weaker)
    seen = np.asarray(jax.random.normal(jax.random.key(0), (6, 29)))
    actions = make_pool_opponent(START.network, pool).act(pool, seen)
    for share, params in ((slice(0, 3), START.params), (slice(3, 6), weaker)):
        expected = START.network.act(params, (), seen[share])[1]
        assert_allclose(actions[share], expected, atol=1e-6)


def test_who_finishes_first_wins():
    finish_s = jnp.array([[11.0, 12.0], [12.0, 11.0], [12.0, jnp.inf], [jnp.inf, jnp.inf]])
    collided = jnp.array([False, True, False, False])
    assert summarize(finish_s, collided) == (0.75, 0.5, 0.25)


@pytest.mark.slow
def test_self_play_keeps_what_the_champion_can_and_prints_its_wins(tmp_path, capsys):
    settings = Settings(
        out=tmp_path, total_timesteps=2 * 512 * 64, num_past=1, updates_per_phase=1, num_races=16
    )
    main(settings)
    *_, in_front, behind = capsys.readouterr().out.splitlines()
    assert (
        in_front.startswith("16 races from in front of flytrack: finishes ") and "wins" in in_front
    )
    assert behind.startswith("16 races from behind flytrack: finishes ") and "collisions" in behind
    learner = load_checkpoint(tmp_path / "final.safetensors")
    opponent = widen_params(START.params, 36)
    keys = jax.random.split(jax.random.key(1), 16)
    assert (
        summarize(*fly_races(RACE, START.network, learner.params, opponent, 0, keys)).finishes > 0.8
    )


def test_a_pool_that_does_not_divide_the_environments_is_refused():
    settings = Settings(num_past=2)
    with pytest.raises(
        ValueError, match="num_past: found 2, expected a pool, of one more, that divides"
    ):
        next(train(START, RACE, START.config, settings))
