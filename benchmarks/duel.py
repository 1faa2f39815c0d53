"""Duels of policies trained by self-play: ``python -m benchmarks.duel [--seeds 0 1 2 3 4]``.

Trains each seed by self-play, then polishes it among opponents, unless it is in runs/duel, on the model of
the champion. Its races against both shipped champions, from the slot behind and from the one in front,
ratings of the pool of the first seed, and a picture of an overtake go to docs/results/duel.md.
"""

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import minimize
from scipy.special import log_expit

import flytrack_env
from baselines.purejaxrl_ppo import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import observation_layout, save_checkpoint
from baselines.purejaxrl_ppo.duel_flight import DuelFlight
from baselines.purejaxrl_ppo.duels import Races, fly_races, score, start_pose_params
from baselines.purejaxrl_ppo.networks import Policy
from baselines.purejaxrl_ppo.polish import Settings as PolishSettings
from baselines.purejaxrl_ppo.polish import alone, polish
from baselines.purejaxrl_ppo.self_play import Settings, train, widened
from benchmarks import report
from benchmarks.champion import CHAMPION, FOLDER, REWARD
from benchmarks.env_speed import jax_contestant, measure, median_ratio
from flytrack_env import blackbox
from flytrack_env.files import write_atomically
from flytrack_env.model_file import model_from_json
from flytrack_env.multi_drone import MultiDroneRace
from flytrack_env.pictures import drawing
from flytrack_env.progress import ProgressBar
from flytrack_env.scene import BLUE, ORANGE
from flytrack_env.state import POSITION
from flytrack_env.tracks import Track

RUNS, PICTURE = Path("runs/duel"), report.RESULTS / "duel_overtake.png"
OPPONENTS = {"champion": CHAMPION, "robust champion": FOLDER / "robust.safetensors"}
CHANGES: dict[str, Any] = {
    "total_timesteps": 5_000_000,
    "learning_rate": 5e-5,
    "episode_steps": 400,
    "gamma": 0.998,
    "min_std": 0.01,
}
SETTINGS = Settings(every=25, std=0.015, course_fraction=0.8)
SELF = "itself"


class Polishing(NamedTuple):
    """How a policy is polished: among which opponents, behind them in which share of flights.

    keeps_clear: their nearness costs something.
    """

    settings: PolishSettings
    opponents: tuple[str, ...]
    behind: float
    keeps_clear: bool


RACE = PolishSettings(updates=100, learning_rate=1e-4, warm_up=20, flights=24, penalty_s=40.0, clips="flight")
OVERTAKE = RACE._replace(learning_rate=2e-4, flights=48, nearness_weight=0.65)
TO_RACE, TO_OVERTAKE = "polished to race", "polished to overtake"
POLISHING = {
    TO_RACE: Polishing(RACE, ("champion", "robust champion", SELF), behind=0.5, keeps_clear=False),
    # Twice the one that can be overtaken.
    TO_OVERTAKE: Polishing(
        OVERTAKE, ("champion", "robust champion", "robust champion", SELF), behind=0.7, keeps_clear=True
    ),
}
SLOTS = {"behind": 1, "in front": 0}
NUM_RACES, NUM_RATED, LAPS, FLIGHT_SEED = 256, 64, 3, 1000
NUM_SNAPSHOTS = 4  # of the first seed, that are rated
ELO = 400.0 / np.log(10.0)
AROUND_STEPS = 120  # before and after an overtake, in the picture


def races_on(champion: Checkpoint) -> tuple[MultiDroneRace, MultiDroneRace]:
    """Return the race to be judged and the one to train in, with the champion's drone."""
    model = model_from_json(champion.meta["model"], "champion")
    env = flytrack_env.make("FlyTrack-v0", model=model, reward=REWARD)
    return MultiDroneRace(env, 2), MultiDroneRace(env, 2, "first")


def train_seed(seed: int, starts: list[Checkpoint], race: MultiDroneRace) -> list[Checkpoint]:
    """Return snapshots of a seed's self-play, the last of them the result; train unless it is there."""
    folder = RUNS / f"seed{seed}"
    if not (folder / "final.safetensors").exists():
        config = dataclasses.replace(starts[0].config, **CHANGES)
        meta = {**starts[0].meta, "env_id": "FlyTrackDuel-v0", "seed": seed, "self_play": SETTINGS._asdict()}
        meta |= {"observation_size": race.observation_space().shape[0]}
        meta |= {"observation": observation_layout(race)}
        begun_s, phases = time.process_time(), config.num_updates // SETTINGS.every
        found = report.progress(train(starts, race, config, SETTINGS, seed), "phases")
        for number, (updates, params, _) in enumerate(found, start=1):
            meta |= {"steps": updates * config.batch_size, "seconds": time.process_time() - begun_s}
            name = "final" if number == phases else f"phase_{number:03d}"
            save_checkpoint(folder / f"{name}.safetensors", params, config, meta)
    paths = sorted(folder.glob("phase_*.safetensors"))
    return [load_checkpoint(path) for path in (*paths, folder / "final.safetensors")]


def polish_seed(seed: int, learnt: Checkpoint, race: MultiDroneRace, name: str) -> Checkpoint:
    """Return what self-play has learnt, polished in a way of ``POLISHING``, unless it is there."""
    path = RUNS / f"seed{seed}" / f"{name.replace(' ', '_')}.safetensors"
    if not path.exists():
        how, size = POLISHING[name], race.observation_space().shape[0]
        champions = {who: load_checkpoint(file).params for who, file in OPPONENTS.items()}
        known = {SELF: learnt.params, **{who: widened(params, size) for who, params in champions.items()}}
        members = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(known[who] for who in how.opponents))
        flight, begun_s = DuelFlight(race, Policy(learnt.network, members), how.behind), time.process_time()
        nearness = flight.nearness if how.keeps_clear else alone
        bar = ProgressBar("updates")
        params = polish(flight, learnt.policy, seed, how.settings, report=bar, nearness=nearness)
        polished = {"seed": seed, "seconds": time.process_time() - begun_s, **how._asdict()}
        polished["settings"] = how.settings._asdict()
        save_checkpoint(path, params, learnt.config, {**learnt.meta, "polished": polished})
    return load_checkpoint(path)


def flown(race: MultiDroneRace, own: Checkpoint, other: Checkpoint, slot: int, count: int) -> Races:
    """Return races of two policies from the start pose, the first of them in a slot of the grid."""
    params = start_pose_params(race.default_params, slot)
    return fly_races(race, (own.policy, other.policy), params, FLIGHT_SEED, count)


def listed(settings: dict[str, Any]) -> str:
    """Return settings as text."""
    return ", ".join(
        f"{name} {value if isinstance(value, str) else f'{value:g}'}" for name, value in settings.items()
    )


def polishing_text(how: Polishing) -> str:
    """Return how policies are polished as text."""
    opponents = ", ".join(how.opponents)
    return f"among {opponents}; {how.behind:.0%} of flights from behind; {listed(how.settings._asdict())}"


class Result(NamedTuple):
    """Races against one opponent from one slot: shares, and mean times of those that finish, s."""

    finishes: float
    wins: float
    collisions: float
    own_s: float
    other_s: float


Results = dict[tuple[str, str], Result]  # by opponent and slot


def results_of(race: MultiDroneRace, policy: Checkpoint) -> Results:
    """Return a policy's results against each champion, from each slot."""
    results = {}
    for opponent, path in OPPONENTS.items():
        for where, slot in SLOTS.items():
            races = flown(race, policy, load_checkpoint(path), slot, NUM_RACES)
            finish_s = np.where(np.isfinite(races.finish_s(LAPS)), races.finish_s(LAPS), np.nan)
            means_s = (float(np.nanmean(one)) if np.isfinite(one).any() else np.nan for one in finish_s.T)
            results[opponent, where] = Result(*score(races, LAPS), *means_s)
    return results


def table_of(found: dict[str, dict[int, Results]], is_whole: bool) -> str:
    """Return results as a table: of every seed, or the lowest and the highest of all seeds of a kind."""
    header = "policy | against | starts | finishes | wins | collisions | finish (s) | its opponent's (s)"
    rows = []
    for kind, seeds in found.items():
        groups = {kind: list(seeds.values())}
        if is_whole:
            groups = {f"{kind}, seed {seed}": [results] for seed, results in seeds.items()}
        for name, group in groups.items():
            for case in group[0]:
                columns = zip(*(results[case] for results in group), strict=True)
                cells = [as_text(column, place) for place, column in enumerate(columns)]
                rows.append([name, *case, *cells])
    return report.table(header, rows)


def as_text(values: tuple[float, ...], place: int) -> str:
    """Return one value, or the lowest and the highest of several; the first three columns are shares."""
    known = [value for value in values if np.isfinite(value)]
    if not known:
        return "-"
    show = "{:.1%}" if place < 3 else "{:.3f}"
    low, high = show.format(min(known)), show.format(max(known))
    return low if low == high else f"{low} to {high}"


def ratings(race: MultiDroneRace, members: dict[str, Checkpoint]) -> list[list[str]]:
    """Return the members' Elo ratings, best first, by the Bradley-Terry model of all their races.

    A race that both finish, or neither, at the same time counts half for each. A prior of one drawn race with
    an opponent of mean strength keeps ratings finite.
    """
    names = list(members)
    wins = np.zeros((len(names), len(names)))
    pairs = list(itertools.permutations(range(len(names)), 2))
    for first, second in report.progress(pairs, "pairs"):
        races = flown(race, members[names[first]], members[names[second]], 0, NUM_RATED)
        own, other = races.finish_s(LAPS).T
        wins[first, second] += (own < other).sum() + 0.5 * (own == other).sum()
        wins[second, first] += (other < own).sum() + 0.5 * (own == other).sum()

    def surprise(strength: np.ndarray) -> float:
        prior = log_expit(strength) + log_expit(-strength)
        return -float((wins * log_expit(strength[:, None] - strength[None])).sum() + 0.5 * prior.sum())

    strength = minimize(surprise, np.zeros(len(names))).x
    share = wins.sum(axis=1) / (wins + wins.T).sum(axis=1)
    order = np.argsort(-strength)
    return [[names[i], f"{ELO * strength[i]:+.0f}", f"{share[i]:.0%}"] for i in order]


def duel_rates() -> str:
    """Return how fast a batch of duels is stepped, as a share of single races stepped in turns with it."""
    alone = jax_contestant("alone", "FlyTrack-v0", 1024, 200, is_batch=True)
    duel = jax_contestant("duel", "FlyTrackDuel-v0", 1024, 200, is_batch=True)
    return f"{median_ratio(measure([alone, duel], repeats=7), 'duel', 'alone'):.2f}"


def draw_overtake(races: Races, track: Track) -> Figure | None:
    """Return a picture of the first race that drone 0 wins from behind, about where it gets ahead.

    From above, and heights over time: who passes above or below another does so on the same line.
    """
    finish_s = races.finish_s(LAPS)
    for race in np.flatnonzero(finish_s[:, 0] < finish_s[:, 1]):
        states, rank = races.states[race], races.rank[race]
        middle = int(np.flatnonzero(rank[: int(100 * finish_s[race, 0]), 0] == 2)[-1])
        steps = slice(max(middle - AROUND_STEPS, 0), middle + AROUND_STEPS)
        figure = drawing.new_figure(8.0, 10.0)
        axes, heights = figure.subplots(2, height_ratios=(4, 1))
        times_s = 0.01 * np.arange(len(states))[steps]
        drawing.draw_gates(axes, track, [0, 1])
        for drone, colour, name in ((1, ORANGE, "opponent"), (0, BLUE, "self-play policy, from behind")):
            points = states[steps, drone, POSITION]
            rows = ((axes, points[:, :2]), (heights, np.column_stack([times_s, points[:, 2]])))
            for plot, line in rows:
                plot.plot(*line.T, color=colour, label=name)
                for number, point in enumerate(line[::20]):
                    plot.plot(*point, "o", color=colour, markersize=8)
                    plot.annotate(str(number), point, fontsize=6, color="white", ha="center", va="center")
        seen = states[steps, :, POSITION][..., :2].reshape(-1, 2)
        axes.set(
            aspect="equal",
            xlim=(seen[:, 0].min() - 1.5, seen[:, 0].max() + 1.5),
            ylim=(seen[:, 1].min() - 1.5, seen[:, 1].max() + 1.5),
            xlabel="x (m)",
            ylabel="y (m)",
            title=f"An overtake {0.01 * middle:.1f} s after the start; dots of a number are at one moment",
        )
        axes.legend(loc="best", frameon=False)
        heights.set(xlabel="time (s)", ylabel="z (m)")
        return figure
    return None


Kinds = dict[str, dict[int, Checkpoint]]


def times_of(kinds: Kinds) -> str:
    """Return how long polishing took, for each way to polish, as text."""
    found = []
    for name in POLISHING:
        seconds = [one.meta["polished"]["seconds"] for one in kinds[name].values()]
        found.append(f"{report.spread(seconds)} {name}")
    return ", ".join(found)


def rated_members(pool: list[Checkpoint], starts: list[Checkpoint], kinds: Kinds) -> dict[str, Checkpoint]:
    """Return the champions, snapshots of the first seed's self-play, and what it was polished to."""
    seed = next(iter(kinds["self-play"]))
    chosen = [pool[i] for i in np.linspace(0, len(pool) - 1, NUM_SNAPSHOTS).astype(int)]
    return {
        **dict(zip(OPPONENTS, starts, strict=True)),
        **{f"seed {seed} after {one.steps / 1e6:.1f} M steps": one for one in chosen},
        **{f"seed {seed}, {name}": kinds[name][seed] for name in POLISHING},
    }


def write_overtake(race: MultiDroneRace, own: Checkpoint, other: Checkpoint) -> str:
    """Write the picture of a race that a policy wins from behind; return the line that shows it, or none."""
    picture = draw_overtake(flown(race, own, other, SLOTS["behind"], NUM_RACES), race.env.track)
    if picture is None:
        return ""
    write_atomically(PICTURE, drawing.png_of(picture))
    return f"![An overtake from above]({PICTURE.name})"


def all_results(race: MultiDroneRace, kinds: Kinds, where: str) -> dict[str, dict[int, Results]]:
    """Return the results of all policies."""
    return {
        kind: {seed: results_of(race, one) for seed, one in policies.items()}
        for kind, policies in report.progress(kinds.items(), f"kinds of policies, {where}")
    }


def main(seeds: tuple[int, ...] = (0, 1, 2, 3, 4)) -> None:
    """Train, race, rate and write the page."""
    starts = [load_checkpoint(path) for path in OPPONENTS.values()]
    race, first_out = races_on(starts[0])
    trained = {seed: train_seed(seed, starts, first_out) for seed in seeds}
    kinds: Kinds = {"self-play": {seed: found[-1] for seed, found in trained.items()}}
    for name in POLISHING:
        kinds[name] = {seed: polish_seed(seed, trained[seed][-1], race, name) for seed in seeds}
    kinds["champion, untrained for duels"] = {0: starts[0]}
    simulated = all_results(race, kinds, "simulator")
    env = flytrack_env.make("FlyTrack-v0", plant=blackbox.load(blackbox.SHIPPED), reward=REWARD)
    on_black_box = all_results(MultiDroneRace(env, 2), kinds, "black box")
    members = rated_members(trained[seeds[0]], starts, kinds)
    report.fill_page(
        report.RESULTS / "duel.md",
        "duel",
        summary=table_of(simulated, is_whole=False),
        black_box=table_of(on_black_box, is_whole=False),
        every=table_of(simulated, is_whole=True),
        rated=NUM_RATED,
        ratings=report.table("policy | Elo | races won", ratings(race, members)),
        settings=listed({**CHANGES, **SETTINGS._asdict()}),
        race=polishing_text(POLISHING[TO_RACE]),
        overtake=polishing_text(POLISHING[TO_OVERTAKE]),
        seconds=report.spread([found[-1].meta["seconds"] for found in trained.values()]),
        polishing_s=times_of(kinds),
        rates=duel_rates(),
        picture=write_overtake(race, kinds[TO_OVERTAKE][seeds[0]], starts[1]),
    )


if __name__ == "__main__":
    report.command(main)
