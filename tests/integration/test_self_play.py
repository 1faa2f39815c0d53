"""Self-play begins as good as its first policy, and its races are judged by who finishes first."""

import dataclasses
import re
import shutil
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import flytrack_env
from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.duel_flight import ABOVE_M, BESIDE_M, DuelFlight, DuelState
from baselines.purejaxrl_ppo.duels import Races, fly_races, score, start_pose_params
from baselines.purejaxrl_ppo.flights import start_keys
from baselines.purejaxrl_ppo.networks import Policy
from baselines.purejaxrl_ppo.polish import Settings as PolishSettings
from baselines.purejaxrl_ppo.polish import fly, polish
from baselines.purejaxrl_ppo.race_command import RaceSettings, describe, run_race
from baselines.purejaxrl_ppo.self_play import Settings, pool_opponent, train, widened
from flytrack_env.model_file import model_from_json
from flytrack_env.multi_drone import EntrantState, MultiDroneRace
from flytrack_env.quaternion import Vec3
from flytrack_env.rollout import load_named_rollouts, load_rollout
from tests.support.pages import ROOT

CHAMPION_FILE = ROOT / "baselines" / "purejaxrl_ppo" / "champion" / "flytrack.safetensors"
CHAMPION = load_checkpoint(CHAMPION_FILE)
ENV = flytrack_env.make("FlyTrack-v0", model=model_from_json(CHAMPION.meta["model"], "model"))


def test_a_widened_policy_takes_no_notice_of_the_new_rows():
    wide = widened(CHAMPION.params, 36)
    seen = np.asarray(jax.random.normal(jax.random.key(0), (5, 36)))
    found = CHAMPION.network.act(wide, (), seen)[1]
    np.testing.assert_allclose(found, CHAMPION.network.act(CHAMPION.params, (), seen[:, :29])[1], atol=1e-6)


def test_each_member_of_a_pool_flies_its_share_of_the_races():
    other = jax.tree.map(lambda leaf: 0.5 * leaf, CHAMPION.params)
    pool = jax.tree.map(lambda *leaves: np.stack(leaves), CHAMPION.params, other)
    seen = np.asarray(jax.random.normal(jax.random.key(0), (6, 29)))
    found = pool_opponent(CHAMPION.config, 29, pool).act(pool, seen)
    for share, params in ((slice(0, 3), CHAMPION.params), (slice(3, 6), other)):
        expected = CHAMPION.network.act(params, (), seen[share])[1]
        np.testing.assert_allclose(found[share], expected, atol=1e-6)


def races_of(lap_steps, collisions=()):
    """Two drones that complete laps in these steps of 10, in the middle of each."""
    completed, times_s, hit = np.zeros((1, 10, 2), bool), np.zeros((1, 10, 2)), np.zeros((1, 10, 2), bool)
    for drone, steps in enumerate(lap_steps):
        for step, since in zip(steps, (-0.5, *steps), strict=False):
            completed[0, step, drone], times_s[0, step:, drone] = True, 0.01 * (step - since)
    for step in collisions:
        hit[0, step] = True
    nothing = np.zeros((1, 10, 2))
    return Races(
        np.zeros((1, 10, 2, 21)),
        np.zeros((1, 10, 2, 4)),
        nothing.astype(bool),
        hit,
        completed,
        times_s,
        nothing,
    )


def test_who_flies_the_last_lap_first_wins_and_what_happens_later_does_not_count():
    races = races_of(((3, 6), (4, 8)), collisions=[9])
    np.testing.assert_allclose(races.finish_s(2), [[0.065, 0.085]])
    assert score(races, 2) == (1.0, 1.0, 0.0)
    assert score(races_of(((3, 9), (4, 8)), collisions=[5]), 2) == (1.0, 0.0, 1.0)
    assert score(races_of(((3,), (4, 8))), 2) == (0.0, 0.0, 0.0)


def test_a_race_is_saved_as_rollouts_up_to_where_a_drone_is_out(tmp_path):
    races = races_of(((3,), (4,)))
    races.is_out[0, 6:, 1] = True
    flights = load_named_rollouts(races.save(0, tmp_path)).values()
    assert [len(states) for states, _ in flights] == [10, 7]


def test_a_race_is_described_by_slot():
    settings = RaceSettings((Path("a/final.safetensors"), Path("b/final.safetensors")), races=1, laps=2)
    found = describe(races_of(((3, 6), (4,)), collisions=[9]), settings, slot=1)
    assert found.splitlines() == [
        "races: 1, with collisions: 0.0%",
        "  slot 1  a_final: finishes 100.0% after 0.065 s on average, wins 100.0%, out of time 0.0%",
        "  slot 0  b_final: finishes 0.0%, wins 0.0%, out of time 100.0%",
    ]


@pytest.mark.slow
def test_checkpoints_race_on_the_black_box(tmp_path, capsys):
    other = tmp_path / "other.safetensors"
    shutil.copy(CHAMPION_FILE.with_name("robust.safetensors"), other)
    folder = tmp_path / "race"
    run_race(RaceSettings((other, CHAMPION_FILE, CHAMPION_FILE), races=4, laps=1, out=folder))
    printed = capsys.readouterr().out
    assert printed.startswith("track: flytrack, laps: 1, at most ")
    assert printed.count("races: 4, with collisions: ") == 3
    assert len(re.findall(r"slot 0  \w+: finishes 100.0%", printed)) == 3  # nobody is before it
    assert {path.suffix for path in folder.iterdir()} <= {".npy", ".rrd"}
    paths = list(folder.glob("*.npy"))
    assert len(paths) == 3
    for path in paths:
        assert path.stem in printed
        states, actions = load_rollout(path)
        assert len(states) == len(actions) > 10
    with pytest.raises(FileExistsError):
        run_race(RaceSettings((other, CHAMPION_FILE), out=folder))


def test_nearness_pushes_up_and_neither_to_the_side_nor_back():
    flight = DuelFlight(MultiDroneRace(ENV, 2), CHAMPION.policy)
    drone, nothing = ENV.sample_start(jnp.uint32(0), ENV.default_params)[0], jnp.zeros(2)
    drones = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), drone)

    @jax.jit
    def nearness(own_w):
        """Of a learner at a place, (3,), whose opponent is at the origin and flies along x."""
        pos_w = Vec3(*(jnp.stack([own, jnp.float32(0.0)]) for own in own_w))
        moved = drones._replace(pos_w=pos_w, vel_w=Vec3(jnp.full(2, 9.0), nothing, nothing))
        inner = jax.vmap(ENV.begin, (0, None, None))(moved, jnp.int32(0), ENV.default_params)
        entrants = EntrantState(inner, nothing, nothing, nothing > 0.0, nothing, nothing)
        return flight.nearness(DuelState(entrants, jnp.zeros((2, 36)), jnp.int32(0)))

    hit = float(nearness(jnp.zeros(3)))
    assert hit == pytest.approx(1.0) and float(nearness(jnp.array([0.0, 0.0, -0.3]))) > hit
    for place in ((-0.6, 0.1, 0.1), (0.6, 0.0, 0.1), (0.0, -1.0, -0.1), (0.0, 0.0, 0.0)):
        x, y, z = jax.grad(nearness)(jnp.array(place))
        share = (1.0 - np.hypot(*place[:2]) / BESIDE_M) ** 2
        assert float(nearness(jnp.array(place))) == pytest.approx(share * (1.0 - place[2] / ABOVE_M))
        assert x == 0.0 == y and float(z) == pytest.approx(-share / ABOVE_M)
    for clear in ((2.1, 0.0, 0.0), (0.0, 0.0, 0.7)):
        assert float(nearness(jnp.array(clear))) == 0.0
    with pytest.raises(ValueError, match="race: found 3 drones, expected 2"):
        DuelFlight(MultiDroneRace(ENV, 3), CHAMPION.policy)


@pytest.mark.slow
def test_polishing_among_opponents_keeps_clear_of_them():
    race = MultiDroneRace(ENV, 2)
    member = widened(CHAMPION.params, 36)
    flight = DuelFlight(race, Policy(CHAMPION.network, jax.tree.map(lambda leaf: leaf[None], member)))
    settings = PolishSettings(
        updates=60, learning_rate=2e-4, warm_up=10, flights=8, laps=1, slowest_lap_s=4.6, clips="flight"
    )
    learner = Policy(CHAMPION.network, member)
    found = polish(flight, learner, 0, settings, nearness=flight.nearness)

    def nearness(params):
        policy = Policy(CHAMPION.network, params)
        fly_one = partial(fly, flight, policy, params=flight.default_params, settings=settings)
        flown = jax.jit(jax.vmap(partial(fly_one, nearness=flight.nearness)))(start_keys(1, 32))
        has_finished = np.asarray(flown.gates == 8)
        assert has_finished.mean() > 0.9
        return float(np.asarray(flown.nearness)[has_finished].mean())

    assert nearness(found) < 0.6 * nearness(member)


@pytest.mark.slow
def test_self_play_keeps_what_the_champion_can_and_its_pool_moves_on():
    race, first = MultiDroneRace(ENV, 2), MultiDroneRace(ENV, 2, "first")
    config = dataclasses.replace(
        CHAMPION.config, total_timesteps=8 * 64 * 64, num_envs=64, learning_rate=1e-5, num_minibatches=8
    )
    found = list(train([CHAMPION], first, config, Settings(past=1, every=4), seed=0))
    assert [updates for updates, *_ in found] == [4, 8]
    policies = Policy(CHAMPION.network, found[-1][1]), CHAMPION.policy
    flown = fly_races(race, policies, start_pose_params(race.default_params, 0), 0, 16)
    assert score(flown, 3).finishes > 0.8
    again = list(train([CHAMPION], first, config, Settings(past=1, every=4), seed=0))
    jax.tree.map(np.testing.assert_array_equal, again[-1][1], found[-1][1])
    with pytest.raises(ValueError, match="pool of 3 that divides num_envs, 64"):
        next(train([CHAMPION], first, config, Settings(past=2), seed=0))
