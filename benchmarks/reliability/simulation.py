"""Simulation: a thousand million steps of actions that no pilot would give, every one of them checked."""

import math
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

import flytrack_env
from benchmarks.flown import ROOT
from benchmarks.reliability.actions import KINDS, kinds_of
from benchmarks.reliability.checked import VIOLATIONS, Checked
from benchmarks.reliability.extremes import draw_extremes
from benchmarks.reliability.flying import ENDS, NEVER, PILOTED_SHARE, Pilot, Tally, fly, load_pilot
from benchmarks.reliability.section import Section
from flytrack_env import blackbox
from flytrack_env.effects import EFFECTS
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.params import EnvParams
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.tracks import available_tracks, build_course, load_track, random_track
from flytrack_env.wrappers import (
    ActionDelay,
    ActionHistory,
    DomainRandomization,
    EpisodeStatistics,
    ObservationNoise,
)

NUM_STEPS = 10**9
NUM_ENVS = 1024
LONGEST_FLIGHT = 2000  # steps of every environment, from a reset on: two time limits
PILOTED = "the champion's, with bursts of full stick"
# Of all steps: with extreme parameters, all effects or all wrappers each; in episodes of one step.
EXTREME_SHARE, SHORT_SHARE = 0.1, 0.005
BLACK_BOX, BLACK_BOX_SHARE = ROOT / "blackbox" / "acro_step.bin", 0.02
# Of random tracks, by their names here: number of gates (as many as others have compiles nothing anew), and
# the size of the arena, m.
RANDOM_TRACKS = {
    "random, 3 gates": (3, (30.0, 40.0)),
    "random, 8": (8, (30.0, 40.0)),
    "random, 10": (10, (50.0, 60.0)),
}
TIME_LIMITS = (20, 200, 1000)  # steps
MOST_SHOWN = 20  # of the steps that show a violation, to be flown again


class Case(NamedTuple):
    """One environment and where its parameters come from.

    group: of the table. draw: of the default parameters, a generator and a number of environments.
    is_batched: every environment has parameters of its own, and vmap(step) flies them; else step_batch.
    share: of all steps.
    """

    group: str
    name: str
    env: EpisodicEnvironment
    draw: Callable[[EnvParams, np.random.Generator, int], EnvParams]
    is_batched: bool
    share: float


def with_all_effects() -> Checked:
    """Return the plain environment, its model with every effect that there is."""
    model = flytrack_env.nominal_parameters().with_effects(*(effect.parameters() for effect in EFFECTS))
    return Checked(flytrack_env.make("FlyTrack-v0", model=model, missed_gate="fly_on"))


def with_all_wrappers() -> Checked:
    """Return the plain environment in every wrapper that there is."""
    env: Any = ActionDelay(DomainRandomization(flytrack_env.make("FlyTrack-v0")))
    env = ActionHistory(ActionHistory(ObservationNoise(env), kind="applied"), length=2)
    return Checked(EpisodeStatistics(env))


def with_black_box() -> Checked:
    """Return the plain environment with the shipped black box."""
    return Checked(flytrack_env.make("FlyTrack-v0", plant=blackbox.load(BLACK_BOX)))


def draw_track(name: str, params: EnvParams, generator: np.random.Generator, num_envs: int) -> EnvParams:
    """Return the parameters with a shipped track, or one as RANDOM_TRACKS has it, and any time limit."""
    limit = int(generator.choice(TIME_LIMITS))
    if name in RANDOM_TRACKS:
        track = random_track(int(generator.integers(2**32)), *RANDOM_TRACKS[name])
    else:
        track = load_track(name)
    return params.replace(course=build_course(track), max_steps_in_episode=limit)


def draw_short(params: EnvParams, generator: np.random.Generator, num_envs: int) -> EnvParams:
    """Return the parameters with a time limit of one step."""
    return params.replace(max_steps_in_episode=1)


def make_cases() -> list[Case]:
    """Return all that is flown: every id on every track, and what is extreme."""
    envs = {env_id: Checked(flytrack_env.make(env_id)) for env_id in ENVIRONMENTS}
    tracks = [*available_tracks(), *RANDOM_TRACKS]
    share = (1.0 - 2 * EXTREME_SHARE - SHORT_SHARE - BLACK_BOX_SHARE) / (len(envs) * len(tracks))
    cases = [
        Case(env_id, f"{env_id}, {track}", env, partial(draw_track, track), False, share)
        for env_id, env in envs.items()
        for track in tracks
    ]
    short = list(envs)[-1]
    cases.append(Case(short, f"{short}, one step", envs[short], draw_short, False, SHORT_SHARE))
    name = "FlyTrack-v0, black box"
    cases.append(Case(name, name, with_black_box(), partial(draw_track, "flytrack"), False, BLACK_BOX_SHARE))
    for name, make in (("all effects", with_all_effects), ("all wrappers", with_all_wrappers)):
        name = f"extreme, {name}"
        cases.append(Case(name, name, make(), draw_extremes_of, True, EXTREME_SHARE))
    return cases


def draw_extremes_of(params: EnvParams, generator: np.random.Generator, num_envs: int) -> EnvParams:
    """Return extreme parameters of a batch."""
    return draw_extremes(generator, params, num_envs)


def fly_once(case: Case, pilot: Pilot, seed: int, flight: int, num_steps: int, num_envs: int) -> Tally:
    """Return what one of a case's flights comes to, as NumPy arrays; seed and flight decide all of it.

    Raises:
        ValueError: parameters that the environment refuses.
    """
    generator = np.random.default_rng([seed, zlib.crc32(case.name.encode()), flight])
    params = case.draw(case.env.default_params, generator, num_envs)
    case.env.check_params(jax.tree.map(np.asarray, params))
    word = np.uint32(generator.integers(2**32))
    tally = fly(case.env, pilot, word, params, np.int32(num_steps), num_envs, case.is_batched)
    return jax.tree.map(np.asarray, tally)


def kinds_flown(num_envs: int) -> list[str]:
    """Return the kind of actions of every environment of a batch."""
    num_piloted = round(num_envs * PILOTED_SHARE)
    names = [*KINDS]
    return [names[place] for place in kinds_of(num_envs - num_piloted)] + [PILOTED] * num_piloted


def first_of(case: Case, flight: int, tally: Tally, kinds: np.ndarray) -> dict[str, Any]:
    """Return where a flight first shows a violation, and which ones that environment shows."""
    place = int(np.argmin(tally.first))
    found = [name for name, counts in zip(VIOLATIONS, tally.violations, strict=True) if counts[place]]
    return {
        "case": case.name,
        "flight": flight,
        "environment": place,
        "step": int(tally.first[place]),
        "actions": str(kinds[place]),
        "violations": found,
    }


def count(case: Case, tally: Tally, kinds: np.ndarray, length: int, totals: dict[Any, Counter[str]]) -> None:
    """Add a flight to the totals of its case's group and each kind of actions."""
    named = {"episodes": tally.episodes, **tally.ends, **dict(zip(VIOLATIONS, tally.violations, strict=True))}
    for kind in dict.fromkeys(kinds.tolist()):
        is_kind = kinds == kind
        total = totals.setdefault((case.group, kind), Counter())
        total["steps"] += int(is_kind.sum()) * length
        for name, values in named.items():
            total[name] += int(values[is_kind].sum())


def measure_cases(
    cases: Sequence[Case], seed: int, num_steps: float, num_envs: int = NUM_ENVS
) -> dict[str, Any]:
    """Return what at least ``num_steps`` steps of all cases come to, by group and kind of actions."""
    started_s, pilot, kinds = time.process_time(), load_pilot(), np.array(kinds_flown(num_envs))
    totals: dict[Any, Counter[str]] = {}
    firsts: list[dict[str, Any]] = []
    whole = sum(case.share for case in cases)
    for case in tqdm(cases, unit="case"):
        rounds = num_steps * case.share / whole / num_envs
        num_flights = math.ceil(rounds / LONGEST_FLIGHT)
        length = math.ceil(rounds / num_flights)
        for flight in range(num_flights):
            tally = fly_once(case, pilot, seed, flight, length, num_envs)
            count(case, tally, kinds, length, totals)
            if (tally.first < NEVER).any():
                firsts.append(first_of(case, flight, tally, kinds))
    return {
        "rows": [{"group": group, "actions": kind, **total} for (group, kind), total in totals.items()],
        "broken_flights": len(firsts),
        "firsts": firsts[:MOST_SHOWN],
        "num_envs": num_envs,
        "cpu_minutes": round((time.process_time() - started_s) / 60.0, 1),
    }


def measure(seed: int, share: float, folder: Path) -> dict[str, Any]:
    """Fly all cases, NUM_STEPS steps where the share is 1."""
    return measure_cases(make_cases(), seed, share * NUM_STEPS)


def is_held(result: dict[str, Any]) -> bool:
    """Return whether no step showed a violation, and episodes ended in every group."""
    groups = sum_by("group", result["rows"])
    return result["broken_flights"] == 0 and all(total["episodes"] for total in groups.values())


def sum_by(name: str, rows: Iterable[dict[str, Any]]) -> dict[str, Counter[str]]:
    """Return the totals of rows that are alike in a column."""
    totals: dict[str, Counter[str]] = {}
    for row in rows:
        numbers = {key: value for key, value in row.items() if key not in ("group", "actions")}
        totals.setdefault(row[name], Counter()).update(numbers)
    return totals


def millions(value: int) -> str:
    """Return a number in millions, in three digits where it has them."""
    return f"{value / 1e6:,.3g}" if value < 1e9 else f"{value / 1e6:,.0f}"


def as_markdown(result: dict[str, Any]) -> str:
    """Return what was flown and found."""
    groups, kinds = (sum_by(name, result["rows"]) for name in ("group", "actions"))
    steps, episodes = (sum(row[name] for row in result["rows"]) for name in ("steps", "episodes"))
    text = (
        f"{millions(steps)} million steps, {millions(episodes)} million episodes, {result['cpu_minutes']:g} "
        "minutes of processor time. Every id flew every shipped track and random ones of 3, 8 and 10 "
        'gates. "Extreme" flew parameters from all of their ranges (`flytrack_env.params.RANGES`, those '
        "of effects and wrappers), many at an end of it, on courses up to 1,200 km wide too. "
        "Counted in every step, also of the state that auto-reset replaces: "
        + "; ".join(VIOLATIONS)
        + ".\n\n"
    )
    names = " | ".join(name.replace("_", " ") for name in ENDS)
    text += f"| environment | million steps | million episodes | {names} | violations |\n"
    text += "|---" * (len(ENDS) + 4) + "|\n"
    for group, total in groups.items():
        shares = " | ".join(f"{total[name] / max(total['episodes'], 1):.1%}" for name in ENDS)
        broken = sum(total[name] for name in VIOLATIONS)
        sizes = " | ".join(millions(total[name]) for name in ("steps", "episodes"))
        text += f"| {group} | {sizes} | {shares} | {broken} |\n"
    text += f"\nMillion steps by actions:\n\n| actions | {' | '.join(groups)} | violations |\n"
    text += "|---" * (len(groups) + 2) + "|\n"
    for kind, total in kinds.items():
        by_group = sum_by("group", [row for row in result["rows"] if row["actions"] == kind])
        cells = " | ".join(millions(by_group[group]["steps"]) for group in groups)
        text += f"| {kind} | {cells} | {sum(total[name] for name in VIOLATIONS)} |\n"
    return text + describe_firsts(result)


def describe_firsts(result: dict[str, Any]) -> str:
    """Return where violations first showed, one line for each of the flights that had any."""
    if not result["firsts"]:
        return ""
    lines = [
        f"- {', '.join(first['violations'])}: {first['case']}, flight {first['flight']}, environment "
        f"{first['environment']} of {result['num_envs']}, step {first['step']}, actions {first['actions']}\n"
        for first in result["firsts"]
    ]
    return f"\n{result['broken_flights']} flights with violations, of the first ones:\n\n{''.join(lines)}"


SECTION = Section("simulation", "Simulation", measure, as_markdown, is_held)
