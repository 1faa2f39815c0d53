"""What each part of the recipe is worth: ``python -m benchmarks.ablations [--seeds 3]``.

Trains PPO with one thing taken out or put in, several seeds each, on the model that ``make demo`` identifies
from the shipped black box; flies 256 noisy starts over 3 laps in that simulator, on the black box and on
256 drones drawn around the model. Writes a page, a chart and a line per training (ablations.jsonl); trainings
that have a line already are not repeated.
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.evaluate import SHIPPED_BLACK_BOX
from baselines.purejaxrl_ppo.flights import race_many, score, start_keys
from baselines.purejaxrl_ppo.plants import draw_plants
from baselines.purejaxrl_ppo.ppo import make_network_for, make_ppo
from baselines.purejaxrl_ppo.program import make_chunk, training_params, with_strong_types
from baselines.purejaxrl_ppo.race_env import with_model_as_given
from baselines.purejaxrl_ppo.run import is_due
from benchmarks import report
from flytrack_env import EnvParams, blackbox, load_model
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import CommandDelay
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.files import write_atomically
from flytrack_env.observations import BATTERY_MIDDLE_V, OBSERVATION, Entry
from flytrack_env.pictures.drawing import new_figure, png_of
from flytrack_env.state import Action, Drone
from flytrack_env.wrappers import Wrapper

NUM_EPISODES, NUM_LAPS, NUM_STEPS = 256, 3, 2500
EVALUATION_SEED, PLANTS_SEED = 30_000, 200
PAGE = report.RESULTS / "ablations.md"
LINES = PAGE.with_suffix(".jsonl")
MODEL = "benchmarks/data/ablations/model.json"
EVERY = 2_000_000  # environment steps between points of a curve
DELAY_S = 0.03
LONG_EPISODE = 1000  # steps: from the start pose, in 2 s no more than two gates are reached
Wrap = Callable[[EpisodicEnvironment], EpisodicEnvironment]


GATE_FRAME = {entry.key: entry for entry in OBSERVATION}


def _in_world(key: str) -> Entry:
    """Return an entry of the observation, as it is called in the world's frame."""
    entry = GATE_FRAME[key]
    return entry._replace(name=entry.name.replace("body to gate", "body to world"), frame="world")


# The course spans 25 m and 35 m, hence the scale of the position; all else is scaled as in the gate's frame.
WORLD = (
    Entry("position", "position", 3, "world", "m", 10.0, 10.0),
    _in_world("velocity"),
    _in_world("attitude"),
    GATE_FRAME["rates"],
    GATE_FRAME["applied"],
    GATE_FRAME["battery"],
    Entry("gate", "gate's centre relative to the drone", 3, "world", "m", 3.0, 30.0),
    Entry("direction", "gate's direction of flight", 3, "world", "1", 1.0, 1.0),
    _in_world("next_gate"),
    _in_world("next_direction"),
)


class Shown(NamedTuple):
    """The inner state and nothing else."""

    inner: Any


class OtherObservation(Wrapper):
    """A wrapper that changes only what is shown."""

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> Shown:
        """Return the inner state of an episode that begins."""
        return Shown(self.env.begin(drone, gate_index, params, seed))

    def advance(
        self, state: Shown, command: Action, params: EnvParams
    ) -> tuple[Shown, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment."""
        inner, *outcome = self.env.advance(state.inner, command, params)
        return Shown(inner), *outcome


class WithoutEntries(OtherObservation):
    """Show zeros in place of some entries of the observation."""

    key = "without_entries"

    def __init__(self, env: EpisodicEnvironment, keys: tuple[str, ...]):
        super().__init__(env)
        self.keys = keys

    def observe_drone(self, drone: Drone, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the inner observation with zeros where the entries were."""
        values = self.env.observe_drone(drone, state.inner, params)
        hidden = [entry.key in self.keys for entry in self.observation_table for _ in range(entry.size)]
        return [
            jnp.zeros_like(value) if is_hidden else value
            for value, is_hidden in zip(values, hidden, strict=True)
        ]


class InWorldFrame(OtherObservation):
    """Show everything in the world's frame, the same quantities as in the gate's."""

    key = "in_world_frame"

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """The rows of ``WORLD``."""
        return WORLD

    def observe_drone(self, drone: Drone, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the observation; gates as the race of the state has them."""
        race = self.race(state)
        body_axes = drone.quat.axes()
        quantities: list[tuple[Any, ...]] = [
            drone.pos_w,
            drone.vel_w,
            tuple(component for row in zip(*body_axes, strict=True) for component in row),
            drone.rates_b,
            drone.applied,
            (drone.battery_v - BATTERY_MIDDLE_V,),
            race.gate.centre - drone.pos_w,
            race.gate.forward,
            race.next_gate.centre - race.gate.centre,
            race.next_gate.forward,
        ]
        return [
            jnp.clip(value * (1.0 / entry.scale), -entry.limit, entry.limit)
            for entry, group in zip(WORLD, quantities, strict=True)
            for value in group
        ]


@dataclass(frozen=True)
class Ablation:
    """One change of the recipe: settings, id, reward, starts, observation, drone; change: as text."""

    change: str
    config: Mapping[str, Any] = field(default_factory=dict)
    env_id: str = "FlyTrack-v0"
    reward: Mapping[str, float] = field(default_factory=dict)
    reset: Mapping[str, float] = field(default_factory=dict)
    wrap: Wrap = lambda env: env
    delay_s: float = 0.0


NO_RATE_TERMS = {"body_rates": 0.0, "action_change": 0.0}
ABLATIONS = {
    "default": Ablation("the recipe as it is"),
    "no_curriculum": Ablation(
        "all episodes start at the start pose, and last 10 s",
        config={"episode_steps": LONG_EPISODE},
        reset={"course_fraction": 0.0},
    ),
    "world_frame": Ablation("observation in the world's frame, not the gate's", wrap=InWorldFrame),
    "no_action": Ablation(
        "no applied action in the observation", wrap=partial(WithoutEntries, keys=("applied",))
    ),
    "no_next_gate": Ablation(
        "no next gate in the observation", wrap=partial(WithoutEntries, keys=("next_gate", "next_direction"))
    ),
    "truncation_terminates": Ablation(
        "the time limit counts as an end: nothing is bootstrapped", config={"bootstrap_at_truncation": False}
    ),
    "no_rate_terms": Ablation("no penalty on body rates and changes of the action", reward=NO_RATE_TERMS),
    "no_margin": Ablation("gates as wide in training as in the race", config={"gate_margin": 0.0}),
    "randomised": Ablation(
        "FlyTrackRandomized-v0: another drone every episode", env_id="FlyTrackRandomized-v0"
    ),
    "delay": Ablation(f"commands {1e3 * DELAY_S:g} ms late, in training and in the race", delay_s=DELAY_S),
    "delay_history": Ablation(
        "the same, with the last three commands in the observation",
        env_id="FlyTrackActionHistory-v0",
        delay_s=DELAY_S,
    ),
}


def make_env(ablation: Ablation, **arguments: Any) -> EpisodicEnvironment:
    """Return the environment of an ablation; arguments: of ``flytrack_env.make``."""
    return ablation.wrap(flytrack_env.make(ablation.env_id, reward=ablation.reward, **arguments))


def with_delay(model: ModelParameters, delay_s: float) -> ModelParameters:
    """Return a model whose commands are late."""
    return model.with_effects(CommandDelay(delay_s)) if delay_s else model


class Contest:
    """An ablation, compiled once: trains a seed and races it in the simulator as it learns."""

    def __init__(self, ablation: Ablation, model: ModelParameters, total_timesteps: int):
        self.ablation = ablation
        self.model = with_delay(model, ablation.delay_s)
        self.config = replace(Config(total_timesteps=total_timesteps), **ablation.config)
        self.env = make_env(ablation, model=self.model)
        params = training_params(self.env, self.config)
        params = params.replace(reset=params.reset._replace(**ablation.reset))
        ppo = make_ppo(self.env, params, self.config)
        self.network = make_network_for(self.env, params, self.config)
        self.start = jax.jit(lambda key: with_strong_types(ppo.start(key)))
        self.chunk = make_chunk(ppo, 1)

    def race(
        self, policy: Any, env: EpisodicEnvironment, params: EnvParams, models: ModelParameters | None = None
    ) -> dict[str, float | None]:
        """Return success and flying lap of 256 noisy starts; models: a drone for each flight."""
        keys = start_keys(EVALUATION_SEED, NUM_EPISODES)
        result = score(race_many(env, self.network, policy, keys, NUM_STEPS, NUM_LAPS, params, models))
        lap_s = result.flying_lap_s
        return {"success": result.success, "flying_lap_s": None if np.isnan(lap_s) else lap_s}

    def train(self, seed: int) -> dict[str, Any]:
        """Return the curve of a seed, and its race in the simulator, on the black box, on drawn drones."""
        runner, curve = self.start(jax.random.key(seed)), []
        params = with_model_as_given(self.env.default_params)
        for update in report.progress(range(1, self.config.num_updates + 1), "update"):
            runner, _ = self.chunk(runner, jnp.int32(1))
            if is_due(update, EVERY, self.config.batch_size) or update == self.config.num_updates:
                raced = self.race(runner.train_state.params, self.env, params)
                curve.append([update * self.config.batch_size, raced["success"]])
        policy = runner.train_state.params
        plants = draw_plants(PLANTS_SEED, NUM_EPISODES, self.model)
        result = {
            "curve": curve,
            "simulator": raced,  # of the last update
            "drawn": self.race(policy, self.env, params, plants.models),
            "black_box": None,
        }
        if not self.ablation.delay_s:
            env = make_env(self.ablation, plant=blackbox.load(SHIPPED_BLACK_BOX))
            result["black_box"] = self.race(policy, env, with_model_as_given(env.default_params))
        return result


def measure(num_seeds: int, num_steps: int, model: ModelParameters) -> dict[tuple[str, int], dict[str, Any]]:
    """Return a result per ablation and seed, from ``LINES`` or measured now and added to it."""
    text = LINES.read_text() if LINES.exists() else ""
    lines = map(json.loads, text.splitlines())
    done = {(line["ablation"], line["seed"]): line for line in lines if line["steps"] == num_steps}
    for name, ablation in ABLATIONS.items():
        missing = [seed for seed in range(num_seeds) if (name, seed) not in done]
        contest = Contest(ablation, model, num_steps) if missing else None
        for seed in missing:
            started_s = time.process_time()
            line = {"ablation": name, "seed": seed, "steps": num_steps, **contest.train(seed)}
            done[name, seed] = line | {"cpu_s": round(time.process_time() - started_s, 1)}
            text += json.dumps(done[name, seed], allow_nan=False) + "\n"
            write_atomically(LINES, text.encode())
    return done


def table(done: Mapping[tuple[str, int], dict[str, Any]]) -> str:
    """Return a row per ablation, a number per seed, the smallest first."""
    header = "ablation | change | simulator | flying lap (s) | black box | flying lap (s) | drawn drones"
    rows = []
    for name, ablation in ABLATIONS.items():
        lines = [line for (of, _), line in done.items() if of == name]

        def cell(place: str, key: str, form: str, lines: list[dict[str, Any]] = lines) -> str:
            values = [line[place][key] for line in lines if line[place] and line[place][key] is not None]
            return " ".join(format(value, form) for value in sorted(values)) or "-"

        places = ("simulator", "black_box")
        cells = [cell(at, *one) for at in places for one in (("success", ".1%"), ("flying_lap_s", ".3f"))]
        if lines:
            rows.append([name, ablation.change, *cells, cell("drawn", "success", ".1%")])
    return report.table(header, rows)


def draw(path: Path, done: Mapping[tuple[str, int], dict[str, Any]]) -> None:
    """Write a PNG: the share that finishes 3 laps in the simulator over training, a panel per ablation."""
    num_rows = -(-len(ABLATIONS) // 4)
    figure = new_figure(12, 2.2 * num_rows + 0.6)
    panels = figure.subplots(num_rows, 4, sharex=True, sharey=True).flat
    for panel, name in zip(panels, ABLATIONS, strict=False):
        for (of, _), line in sorted(done.items()):
            if of in (name, "default"):
                steps, success = np.array(line["curve"]).T
                style = {"color": "C0"} if of == name else {"color": "0.8", "zorder": 0}
                panel.plot(steps / 1e6, 100 * success, **style)
        panel.set_title(name, fontsize=10)
    for panel in panels[len(ABLATIONS) :]:
        panel.set_axis_off()
    figure.supxlabel("environment steps (millions); grey: the recipe as it is")
    figure.supylabel("3 laps in the simulator (%)")
    write_atomically(path, png_of(figure))


def main() -> None:
    """Measure what is missing, print and write page, lines and chart."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=Config.total_timesteps)
    arguments = parser.parse_args()
    pinned = report.pin_to_one_core()
    done = measure(arguments.seeds, arguments.steps, load_model(report.ROOT / MODEL))
    chart = PAGE.with_suffix(".png")
    draw(chart, done)
    report.fill_page(
        PAGE,
        "ablations",
        table=table(done),
        millions=arguments.steps / 1e6,
        last_seed=arguments.seeds - 1,
        model=MODEL,
        episodes=NUM_EPISODES,
        laps=NUM_LAPS,
        chart=chart.name,
        pinned=pinned.capitalize(),
    )


if __name__ == "__main__":
    main()
