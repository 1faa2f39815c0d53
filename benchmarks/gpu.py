"""FlyTrack on an accelerator: ``python -m benchmarks.gpu``.

Environment steps with random actions, observations and resets included, beside gymnax's Pendulum
and, where they are installed, a rigid body with four motors in MJX and a Crazyflie in crazyflow;
PPO with the recipe for a GPU, alone and many seeds side by side; a training until 95 % of 256
starts finish; and the same flights on the accelerator and on the CPU. Times are wall times without
compilation. Without an accelerator the page says so and nothing else; ``--cpu`` measures small
sizes without a page.

crazyflow cannot be imported after SciPy unless ``SCIPY_ARRAY_API=1`` is set, and is measured only
where it is. It asks for a later Gymnasium than FlyTrack, which only its renderer and environments
need: ``pip install --no-deps crazyflow``, and its other dependencies as usual.
"""

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.config import RECIPES
from baselines.purejaxrl_ppo.flights import race_many, score, start_keys
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks import report
from benchmarks.champion import CHAMPION, MODEL
from benchmarks.env_speed import Contestant, jax_contestant, measure
from benchmarks.learning_curve import evaluate, held_from, train

PLAIN, ROBUST, PENDULUM = "FlyTrack-v0", "FlyTrackRobust-v0", "Pendulum-v1"
MJX, CRAZYFLOW = "rigid body in MJX", "crazyflow"
# Environments, as powers of 2, by contestant; of some fewer, because each size is a compilation.
POWERS: dict[str, tuple[int, ...]] = {
    PLAIN: (8, 10, 16, 20, 21),
    ROBUST: (10, 20),
    PENDULUM: (10, 16, 20),
    MJX: (16,),
    CRAZYFLOW: (10, 16, 20),
}
PEERS = {
    MJX: (
        "The rigid body in MJX has four motors; a decision is a step of 0.01 s, without "
        "observations, gates or resets."
    ),
    CRAZYFLOW: (
        "crazyflow is its `Sim` with all defaults: first-principles dynamics and attitude "
        "controller of a Crazyflie, explicit Euler at 500 Hz. A decision is a random command of "
        "attitude and thrust, held for five of its steps, without observations, gates or resets."
    ),
}
UNROLL = 4
TRAININGS = (("cpu", 1), ("gpu", 1), ("gpu", 16))  # recipe, seeds side by side
STEPS, EVERY = 40_000_000, 1_000_000  # environment steps: of the training, between evaluations
NUM_FLIGHTS = 256
REPEATS, LENGTH = 5, 64  # calls, and steps of each
CALLS = 200  # of one step each
PACKAGES = ("mujoco-mjx", "crazyflow")
PAGE = report.RESULTS / "gpu.md"
# A quadcopter's size and nothing else: no battery, lags, gates, observations or resets.
RIGID_BODY = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body pos="0 0 1">
      <freejoint/>
      <inertial pos="0 0 0" mass="0.85" diaginertia="0.0025 0.0025 0.004"/>
      <site name="a" pos="0.1 0.1 0"/> <site name="b" pos="-0.1 0.1 0"/>
      <site name="c" pos="-0.1 -0.1 0"/> <site name="d" pos="0.1 -0.1 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor site="a" gear="0 0 1 0 0 0.01"/> <motor site="b" gear="0 0 1 0 0 -0.01"/>
    <motor site="c" gear="0 0 1 0 0 0.01"/> <motor site="d" gear="0 0 1 0 0 -0.01"/>
  </actuator>
</mujoco>
"""


def is_measured(name: str) -> bool:
    """Return whether a contestant's packages are installed, and can be imported."""
    if name == MJX:
        return bool(find_spec("mujoco") and find_spec("mujoco.mjx"))
    if name == CRAZYFLOW:
        return bool(find_spec("crazyflow")) and os.environ.get("SCIPY_ARRAY_API") == "1"
    return True


def mjx_contestant(num_envs: int) -> Contestant:
    """Return a scan of ``LENGTH`` steps of 0.01 s of a rigid body with four motors in MJX."""
    import mujoco
    from mujoco import mjx

    model = mjx.put_model(mujoco.MjModel.from_xml_string(RIGID_BODY))
    rates = jax.random.normal(jax.random.key(0), (num_envs, 6))
    state = jax.vmap(lambda rate: mjx.make_data(model).replace(qvel=rate))(rates)
    controls = jax.random.uniform(jax.random.key(1), (LENGTH, num_envs, 4), maxval=4.0)
    step = jax.vmap(lambda data, control: mjx.step(model, data.replace(ctrl=control)))
    return scan_contestant(MJX, step, state, controls)


def scan_contestant(
    name: str, step: Callable[[Any, jax.Array], Any], state: Any, actions: jax.Array
) -> Contestant:
    """Return a scan of ``LENGTH`` steps with actions (LENGTH, num_envs, ...)."""

    @jax.jit
    def fly(state: Any, actions: jax.Array) -> Any:
        return jax.lax.scan(lambda state, action: (step(state, action), None), state, actions)[0]

    return waiting_contestant(name, LENGTH * actions.shape[1] / 1e6, partial(fly, state, actions))


def waiting_contestant(name: str, amount: float, run: Callable[[], Any]) -> Contestant:
    """Return a contestant that waits for what a function returns."""
    return Contestant(name, amount, lambda: jax.block_until_ready(run()))


def crazyflow_contestant(num_envs: int) -> Contestant:
    """Return a scan of ``LENGTH`` commands of attitude and thrust, 0.01 s each, in crazyflow."""
    import crazyflow  # type: ignore[import-not-found]

    attitude_control = crazyflow.sim.functional.attitude_control
    sim = crazyflow.Sim(n_worlds=num_envs, device=jax.default_backend())
    step, steps_per_command = sim.build_step_fn(), sim.freq // 100
    space = crazyflow.envs.drone_env.action_space(sim.control, sim.dynamics, sim.drone)
    shape = (LENGTH, num_envs, 1, *space.shape)
    commands = jax.random.uniform(jax.random.key(1), shape, minval=space.low, maxval=space.high)

    def hold(data: Any, command: jax.Array) -> Any:
        return step(attitude_control(data, command), n_steps=steps_per_command)

    return scan_contestant(CRAZYFLOW, hold, sim.data, commands)


def rate_of(entry: Contestant) -> float:
    """Return the median rate of a contestant, amount per second."""
    rates = measure([entry._replace(clock=time.perf_counter)], REPEATS, warm_up=1)
    return statistics.median(rates[entry.name])


def open_loop(keys: jax.Array) -> jax.Array:
    """Return positions, (num_flights, 3), after a second of random actions from the start pose.

    The actions are the same in every call.
    """
    env = flytrack_env.make("FlyTrack-v0")
    actions = jax.random.uniform(jax.random.key(1), (NUM_FLIGHTS, 100, 4), minval=-1.0)

    def fly(key: jax.Array, actions: jax.Array) -> jax.Array:
        _, state = env.reset(key, env.default_params)

        def step(state: Any, action: jax.Array) -> tuple[Any, None]:
            return env.step_env(key, state, action, env.default_params)[1], None

        return jnp.stack(env.drone(jax.lax.scan(step, state, actions)[0]).pos_w)

    return jax.jit(jax.vmap(fly))(keys, actions)


def agreement() -> str:
    """Compare flights on the accelerator with those on the CPU, and a champion's races on both."""
    champion = load_checkpoint(CHAMPION)
    env = flytrack_env.make("FlyTrack-v0", model=MODEL)
    ends, rows = [], []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(device):
            keys = start_keys(0, NUM_FLIGHTS)
            ends.append(np.asarray(open_loop(keys)))
            races = score(race_many(env, champion.policy, keys, 2500, 3))
        rows.append([device.device_kind, f"{races.success:.1%}", f"{races.flying_lap_s:.4f}"])
    apart_m = np.abs(ends[0] - ends[1]).max()
    return (
        report.table("the champion on | finish | flying lap (s)", rows)
        + "\n\nAfter the same second of random actions, positions differ by at most "
        f"{apart_m:.1g} m. Both devices run the same equations: this tells of rounding, not of "
        "physics."
    )


def contestant(name: str, power: int, unroll: int = 1) -> Contestant:
    """Return a contestant of 2^power environments."""
    if name == MJX:
        return mjx_contestant(2**power)
    if name == CRAZYFLOW:
        return crazyflow_contestant(2**power)
    return jax_contestant(name, name, 2**power, LENGTH, unroll=unroll)


def environments(powers: dict[str, tuple[int, ...]]) -> str:
    """Return a table of decisions a second by number of environments, and of unrolled loops."""
    names = [name for name in powers if is_measured(name)]
    rates = {
        (name, power): f"{1e6 * rate_of(contestant(name, power)):.3g}"
        for name in names
        for power in report.progress(powers[name], name)
    }
    rows = [
        [f"2^{power}", *(rates.get((name, power), "") for name in names)]
        for power in sorted({power for _, power in rates})
    ]
    header = ["environments", *(f"{name}, decisions/s" for name in names)]
    unrolled = ", ".join(
        f"{name} {1e6 * rate_of(contestant(name, 10, UNROLL)):.3g}" for name in (PLAIN, PENDULUM)
    )
    parts = [
        report.table(header, rows),
        *(PEERS[name] for name in names if name in PEERS),
        f"With 2^10 environments and {UNROLL} steps in the body of the loop "
        f"(`unroll={UNROLL}` of `jax.lax.scan`), decisions/s: {unrolled}.",
    ]
    return "\n\n".join(parts)


def single_steps() -> str:
    """Return how long a call of one step takes, with parameters of either place."""
    env, params = gymnax.make(PLAIN)
    keys = jax.random.split(jax.random.key(0), 2**10)
    actions = jax.random.uniform(jax.random.key(1), (2**10, 4), minval=-1.0)
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    times = []
    for params_of_call in (params, jax.device_put(params)):
        _, state = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
        jax.block_until_ready(step(keys, state, actions, params_of_call))
        started_s = time.perf_counter()
        for _ in range(CALLS):
            _, state, *_ = step(keys, state, actions, params_of_call)
        jax.block_until_ready(state)
        times.append(1e3 * (time.perf_counter() - started_s) / CALLS)
    return (
        f"A call of one step of 2^10 environments takes {times[1]:.2g} ms, and {times[0]:.2g} ms "
        "where the parameters are Python's numbers: put them on the device once, "
        "`params = jax.device_put(params)`."
    )


def trainings(recipes: dict[str, Config]) -> str:
    """Return a table of training steps a second by recipe and number of seeds side by side."""
    rows = []
    for recipe, number in TRAININGS:
        config = recipes[recipe]
        trainer = Trainer(config)
        runners = [trainer.start(jax.random.key(seed)) for seed in range(number)]
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runners)
        update = jax.jit(jax.vmap(trainer.update))
        amount = number * config.batch_size
        entry = waiting_contestant("", amount, partial(update, together))
        sizes = f"{config.num_envs} x {config.num_steps}, {config.num_minibatches} minibatches"
        rows.append([recipe, sizes, number, f"{rate_of(entry):.3g}"])
    header = "recipe (`--device`) | an update | seeds side by side | steps/s, all together"
    return report.table(header, rows)


def race(config: Config) -> str:
    """Return when a training's policy races, and how fast in the end."""
    trainer = Trainer(config)
    evaluate(trainer, trainer.start(jax.random.key(0)).train_state.params, 0, 0.0)  # compiles
    points = train(trainer, 0, EVERY, time.perf_counter)
    held, last = held_from(points), points[-1]
    since = (
        "never"
        if held is None
        else f"from {held.steps / 1e6:.2f} M steps, {held.spent_s:.2g} s of training, on"
    )
    return (
        f"Seed 0, recipe `gpu`: 95 % of 256 starts finish three laps {since}; after "
        f"{last.steps / 1e6:.0f} M steps, {last.spent_s:.2g} s, {last.success:.1%} do, with a mean "
        f"flying lap of {last.flying_lap_s:.3f} s. Evaluations every {EVERY / 1e6:g} M steps and "
        "compilation are not counted."
    )


def main(cpu: bool = False) -> None:
    """Measure, and write the page where there is an accelerator.

    Args:
        cpu: measure a CPU with small sizes, write nothing.
    """
    path, parts = (None if cpu else PAGE), ["Not measured."]
    if cpu or jax.default_backend() != "cpu":
        small = replace(Config(), num_envs=64, num_steps=8, num_minibatches=4)
        recipes, powers, steps = RECIPES, POWERS, STEPS
        if cpu:
            recipes, powers, steps = {"cpu": small, "gpu": small}, dict.fromkeys(POWERS, (4,)), 4096
        parts = []
        for part in (
            partial(environments, powers),
            partial(trainings, recipes),
            partial(race, replace(recipes["gpu"], total_timesteps=steps)),
            single_steps,
            agreement,
        ):
            parts.append(part())
            print(parts[-1], end="\n\n", flush=True)
        device = jax.devices()[0].device_kind
        parts.append(f"{device}. {report.provenance_line(report.provenance(*PACKAGES))}")
    report.fill_page(path, "gpu", parts="\n\n".join(parts))


if __name__ == "__main__":
    report.command(main)
