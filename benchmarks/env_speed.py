"""Environment steps per second of process CPU time on one core.

FlyTrack is measured beside Pendulum and l2f, in races of two, and through Gymnasium.

``python -m benchmarks.env_speed [--repeats 7] [--out PAGE]`` prints a table and writes it; with
``--effects`` that of the step's cost with each effect, and with each motion. Keys and actions are
drawn before the clock starts; every output of a step is kept, so that nothing of it can be
optimised away. The contestants take turns, because machines drift: compare ratios of one run, not
rates of two runs.
"""

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import report

NUM_ACTIONS = 16  # drawn in advance and used in turn
L2F_TIME_LIMIT = 500  # steps

PENDULUM = "gymnax Pendulum-v1, vmap, 1,024"
L2F_SMALL, L2F_LARGE = "l2f full step, 1,024", "l2f full step, 4,096"
PLAIN, BATCH = "FlyTrack vmap(step), 1,024", "FlyTrack step_batch, 4,096"
SMALL_BATCH, DUEL = "FlyTrack step_batch, 1,024", "FlyTrackDuel-v0 step_batch, 1,024 races"
SINGLE, MIN_SINGLE = "Gymnasium, 1, ", 0.03  # million steps per CPU second
VARIANTS = {
    f"FlyTrack{name}-v0 vmap(step), 1,024": f"FlyTrack{name}-v0"
    for name in ("Noisy", "ActionHistory", "Randomized", "Robust")
}
MAX_COST = 1.5  # a variant's step over the plain one's
SMALL_COST = 1.1  # rounds differ by as much
# Our rate, the peer's, the ratio to reach.
TARGETS = ((PLAIN, L2F_SMALL, 6.0), (BATCH, L2F_LARGE, 10.0), (DUEL, SMALL_BATCH, 0.4))


class Contestant(NamedTuple):
    """Something that does ``amount`` of work, in the unit of its rate, each time it is run."""

    name: str
    amount: float
    run: Callable[[], Any]
    clock: Callable[[], float] = time.process_time


def jax_contestant(
    name: str,
    env_id: str,
    num_envs: int = 1024,
    length: int = 200,
    is_batch: bool = False,
    model: Any = None,
    unroll: int = 1,
) -> Contestant:
    """Return a scan of ``length`` steps of a gymnax environment, all outputs in the carry.

    Of a race of two, all drones' actions are given.

    Args:
        model: that the environment simulates; None for its default.
        unroll: steps in the body of the scan's loop.
    """
    import gymnax
    import jax

    import flytrack_env  # registers the ids

    drones: tuple[int, ...] = ()
    if env_id == "FlyTrackDuel-v0":
        env, drones = flytrack_env.make_race(env_id), (2,)
        params = env.default_params
    else:
        env, params = gymnax.make(env_id, **({} if model is None else {"model": model}))
    step = env.step_batch if is_batch else jax.vmap(env.step, in_axes=(0, 0, 0, None))
    reset = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))
    keys = jax.random.split(jax.random.key(0), (length,) if is_batch else (length, num_envs))
    shape = (length, num_envs, *drones, *env.action_space(params).shape)
    actions = jax.random.uniform(jax.random.key(1), shape, minval=-1.0)
    _, state = reset(jax.random.split(jax.random.key(2), num_envs), params)

    @jax.jit
    def fly(state: Any, keys: jax.Array, actions: jax.Array, params: Any) -> Any:
        def step_once(outputs: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, None]:
            key, action = inputs
            return step(key, outputs[1], action, params), None

        first = step(keys[0], state, actions[0], params)
        return jax.lax.scan(step_once, first, (keys, actions), unroll=unroll)[0]

    params = jax.device_put(params)  # once: a GPU would be sent every number in every call

    def run() -> None:
        nonlocal state
        outputs = jax.block_until_ready(fly(state, keys, actions, params))
        state = outputs[1]

    return Contestant(name, (length + 1) * num_envs / 1e6, run)


def l2f_contestant(name: str, num_envs: int, length: int) -> Contestant:
    """Return ``length`` full steps of l2f: dynamics, reward, termination, reset, observation."""
    from flytrack_env.extras import check_installed

    check_installed("bench", "comparisons with l2f", "l2f")
    import l2f
    import numpy as np

    vector = l2f.vector_selector[num_envs]
    device, rng, env = l2f.Device(), vector.VectorRng(), vector.VectorEnvironment()
    parameters = vector.VectorParameters()
    state, next_state = vector.VectorState(), vector.VectorState()
    vector.initialize_rng(device, rng, 0)
    vector.initialize_environment(device, env)
    vector.sample_initial_parameters(device, env, parameters, rng)
    vector.sample_initial_state(device, env, parameters, state, rng)
    shape = (NUM_ACTIONS, num_envs, 4)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)
    observation = np.empty((num_envs, env.OBSERVATION_DIM), np.float32)
    reward, terminated = np.empty(num_envs, np.float32), np.empty(num_envs, bool)
    age = np.zeros(num_envs, int)

    def run() -> None:
        nonlocal state, next_state, age
        world = (device, env, parameters)
        for i in range(length):
            action = actions[i % NUM_ACTIONS]
            vector.step(*world, state, action, next_state, rng)
            vector.reward(*world, state, action, next_state, reward, rng)
            vector.terminated(*world, next_state, terminated, rng)
            done = terminated | (age >= L2F_TIME_LIMIT)
            age = (age + 1) * (1 - done)
            vector.sample_initial_state_if_truncated(*world, next_state, done, rng)
            vector.observe(*world, next_state, observation, rng)
            state, next_state = next_state, state

    return Contestant(name, length * num_envs / 1e6, run)


def gymnasium_contestant(
    num_envs: int, length: int, autoreset_mode: str = "SameStep", env_id: str = "FlyTrack-v0"
) -> Contestant:
    """Return steps through Gymnasium, NumPy in and out, of a vector or a single environment."""
    import gymnasium
    import numpy as np

    id_, shape = f"flytrack_env:{env_id}", (NUM_ACTIONS, num_envs, 4)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)
    if num_envs > 1:
        env: Any = gymnasium.make_vec(id_, num_envs=num_envs, autoreset_mode=autoreset_mode)
    else:
        env, actions = gymnasium.make(id_), actions[:, 0]
    env.reset(seed=0)

    def run() -> None:
        for i in range(length):
            _, _, terminated, truncated, _ = env.step(actions[i % NUM_ACTIONS])
            if num_envs == 1 and (terminated or truncated):
                env.reset()

    name = f"Gymnasium, {num_envs:,}, {autoreset_mode}" if num_envs > 1 else f"{SINGLE}{env_id}"
    return Contestant(name, num_envs * length / 1e6, run)


def contestants() -> list[Contestant]:
    """Return all contestants, l2f only where it is installed."""
    entries = [
        jax_contestant(PENDULUM, "Pendulum-v1"),
        jax_contestant(PLAIN, "FlyTrack-v0"),
        jax_contestant(BATCH, "FlyTrack-v0", 4096, is_batch=True),
        jax_contestant(SMALL_BATCH, "FlyTrack-v0", is_batch=True),
        jax_contestant("FlyTrack step_batch, 65,536", "FlyTrack-v0", 65536, 10, is_batch=True),
        jax_contestant(DUEL, "FlyTrackDuel-v0", is_batch=True),
        *(jax_contestant(name, env_id) for name, env_id in VARIANTS.items()),
        gymnasium_contestant(1024, 200),
        gymnasium_contestant(1024, 200, "NextStep"),
        gymnasium_contestant(1, 2000),
        gymnasium_contestant(1, 2000, env_id="FlyTrackRobust-v0"),
    ]
    try:
        entries += [l2f_contestant(L2F_SMALL, 1024, 200), l2f_contestant(L2F_LARGE, 4096, 50)]
    except ImportError as error:
        print(f"l2f is skipped, and the ratios with it: {error}. Install it: pip install l2f")
    return entries


def with_effects() -> dict[str, Any]:
    """Return models with one effect each, 30 % into its ranges, and with each motion.

    Without effects that take the place of the lag: what they cost is the steps of their own loop.
    """
    from flytrack_env import Motion, nominal_parameters
    from flytrack_env.effects import EFFECTS

    nominal = nominal_parameters()
    models = {f"motion {motion.name.lower()}": nominal._replace(motion=motion) for motion in Motion}
    for effect in EFFECTS:
        if "respond" not in effect.hooks:
            ends = zip(effect.parameters(), effect.ranges.values(), strict=True)
            values = [neutral + 0.3 * (extent.high - neutral) for neutral, extent in ends]
            models[effect.name] = nominal.with_effects(effect.parameters(*values))
    return models


def cost_figure(name: str, cost: float, repeats: int) -> report.Figure:
    """Return the figure of a step's cost over the plain one's."""
    return report.Figure(name, f"at most {MAX_COST:g}", f"{cost:.2f}", repeats)


def effect_costs(repeats: int) -> str:
    """Return a table of the step's cost with each effect or motion, relative to the plain step.

    Both are timed in turns. Those that cost little share a sentence.
    """
    plain, rows = jax_contestant(PLAIN, "FlyTrack-v0"), []
    for name, model in report.progress(with_effects().items(), "model"):
        entry = jax_contestant(name, "FlyTrack-v0", model=model)
        costs = ratios(measure([plain, entry], repeats, warm_up=1), PLAIN, name)
        figure = cost_figure(name, statistics.median(costs), repeats)
        rows.append([*figure, report.spread(costs, ".2f")])
    shown = [row for row in rows if float(row[2]) > SMALL_COST]
    small = [row for row in rows if float(row[2]) <= SMALL_COST]
    table = report.table("figure | target | measured | n | lowest to highest", shown)
    if not small:
        return table
    names = ", ".join(str(row[0]) for row in small)
    costs_of_small = report.spread([float(row[2]) for row in small], ".2f")
    return f"{table}\n\nThe medians of the other {len(small)} are {costs_of_small}: {names}."


def measure(entries: list[Contestant], repeats: int, warm_up: int = 3) -> dict[str, list[float]]:
    """Return the rates of each contestant, amount per second of its clock, all taking turns."""
    for entry in report.progress(entries, "compiled"):
        for _ in range(warm_up):
            entry.run()
    rates: dict[str, list[float]] = {entry.name: [] for entry in entries}
    for _ in range(repeats):
        for entry in entries:
            start = entry.clock()
            entry.run()
            rates[entry.name].append(entry.amount / (entry.clock() - start))
    return rates


def ratios(rates: dict[str, list[float]], name: str, peer: str) -> list[float]:
    """Return the rounds' ratios, in which drift of the machine cancels."""
    return [rate / other for rate, other in zip(rates[name], rates[peer], strict=True)]


def main(repeats: int = 7, out: Path | None = None, effects: bool = False) -> None:
    """Measure, print and write.

    Args:
        repeats: rounds, at least 5 for figures to publish.
        out: page.
        effects: measure the cost of each instead.
    """
    core = report.pin_to_one_core()
    if effects:
        costs = effect_costs(repeats)
        report.fill_page(out, "effects_speed", table=costs, repeats=repeats, core=core)
        return
    print(f"pinned to core {core}; compiles every environment first: minutes", flush=True)
    rates = measure(contestants(), repeats)
    speeds = [
        (name, f"{statistics.median(values):.3g}", report.spread(values, ".3g"))
        for name, values in rates.items()
    ]
    figures = []
    for name, peer, goal in TARGETS:
        if peer in rates:
            ratio = f"{statistics.median(ratios(rates, name, peer)):.2g}"
            figures.append(report.Figure(f"{name} to {peer}", f"at least {goal:g}", ratio, repeats))
    single = f"{SINGLE}FlyTrack-v0"
    rate = f"{statistics.median(rates[single]):.2g}"
    figures.append(report.Figure(f"{single}: M steps/s", f"at least {MIN_SINGLE:g}", rate, repeats))
    for name in VARIANTS:
        cost = statistics.median(ratios(rates, PLAIN, name))
        figures.append(cost_figure(f"cost of {name} over the plain step", cost, repeats))
    report.fill_page(
        out,
        "env_speed",
        ["l2f", "gymnasium"],
        speeds=report.table(
            "environment | million steps per CPU second, median | lowest to highest", speeds
        ),
        figures=report.figures_table(figures),
        repeats=repeats,
        core=core,
    )


if __name__ == "__main__":
    report.command(main)
