"""Distillation: a policy that has a camera learns from one that sees the state.

``python -m baselines.purejaxrl_ppo.distill [--teacher robust] [--out FOLDER]``.

PPO has to find out at once where the drone is and how to race; a teacher that sees the state knows
the second. The student flies, and in every state that it gets into it learns what the teacher would
command there (DAgger: S. Ross et al., arXiv 1011.0686). So it also learns to come back from its own
errors, and its memory to hold what the teacher sees. Only the actor learns: the critic, which
flights do not need, stays untrained.
"""

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
import tyro

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import (
    FINAL,
    Checkpoint,
    CheckpointError,
    describe_run,
    load_checkpoint,
    save_checkpoint,
)
from baselines.purejaxrl_ppo.config import Config, Count
from baselines.purejaxrl_ppo.networks import Memory, Policy
from baselines.purejaxrl_ppo.ppo import choose_step, make_network_for
from baselines.purejaxrl_ppo.training import training_params
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.messages import error_text
from flytrack_env.model_file import model_from_json
from flytrack_env.observations import OBSERVATION_SIZE
from flytrack_env.progress import ProgressBar
from flytrack_env.wrappers import StateObservation

PROG = "python -m baselines.purejaxrl_ppo.distill"
# Episodes are as long as a lap and a half, so that a memory is of use; the drone is as thick as in
# the race, because how wide the teacher flies is the teacher's. The state's error is weighted so
# that it is about as large as the action's.
CONFIG = Config(
    total_timesteps=33_000_000,
    num_minibatches=16,
    episode_steps=600,
    gate_margin=0.0,
    learning_rate=1e-3,
    memory_size=64,
    encoder_sizes=(64,),
    critic_sees_state=True,
    state_coef=0.1,
)
TEACHER_FLIES = 0.2  # of the updates: the share of drones that the teacher flies falls to 0
NOISE = 0.05  # standard deviation added to flown actions, so that more states are seen


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a distillation, which are the flags of the command."""

    teacher: Path = Path("robust")
    """Checkpoint of a policy that sees the state, trained on FlyTrack-v0 or a variant with the same
    observation; champion and robust are the shipped ones. Its model and track are those flown."""
    env_id: str = "FlyTrackCorners-v0"
    """Id of the environment of the student."""
    out: Path = Path("runs/distill")
    """Folder of final.safetensors."""
    total_timesteps: Count = CONFIG.total_timesteps
    """Environment steps over all environments."""
    seed: int = 0
    """Seed of the student and of its flights."""


class Errors(NamedTuple):
    """Mean squared errors of the student.

    Attributes:
        action: from the teacher's.
        state: of the estimate that a linear layer reads from what the student knows.
    """

    action: jax.Array
    state: jax.Array


class Lesson(NamedTuple):
    """What is learnt from; leaves (num_envs, num_steps, ...).

    Attributes:
        memory: before the step.
        observation: before the step, with the state's rows behind it.
        action: of the teacher there.
        done: whether the episode ends with the step.
    """

    memory: Memory
    observation: jax.Array
    action: jax.Array
    done: jax.Array


class Flights(NamedTuple):
    """The flights that go on from update to update; leaves (num_envs, ...)."""

    memory: Memory
    observation: jax.Array
    state: Any


def check_teacher(teacher: Checkpoint) -> Policy:
    """Return a teacher's policy.

    Raises:
        CheckpointError: one that does not see the state, or remembers.
    """
    try:
        teacher.check_fits(flytrack_env.make("FlyTrack-v0", track=teacher.track))
    except CheckpointError as error:
        raise CheckpointError(f"teacher: expected one that sees the state: {error}") from error
    if teacher.config.memory_size:
        raise CheckpointError(
            f"teacher: memory_size: found {teacher.config.memory_size}, expected 0: what it "
            "remembers of its own flights is not known in those of the student"
        )
    return teacher.policy


def distill(
    env: EpisodicEnvironment,
    teacher: Policy,
    config: Config,
    seed: int,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Any, Errors]:
    """Return the parameters of a student, and its errors in each update, (num_updates,).

    Args:
        env: that the student flies in, whose observation is of rows.
        teacher: as ``check_teacher`` returns it.
        config: of the student; its settings of PPO are not used.
        seed: of the student and of its flights.
        report: called with the number of updates done and of all.

    Raises:
        ValueError: a configuration that cannot be trained with, an environment of images.
    """
    config.check()
    env_params = training_params(env, config)
    env = StateObservation(env)
    network: Any = make_network_for(env, env_params, config)
    step_all = choose_step(env, config)
    num_gradients = config.num_updates * config.num_minibatches
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.adam(optax.cosine_decay_schedule(config.learning_rate, num_gradients)),
    )

    def fly_step(
        params: Any, share: jax.Array, flights: Flights, key: jax.Array
    ) -> tuple[Flights, Lesson]:
        key_noise, key_step = jax.random.split(key)
        rows = flights.observation
        seen, state = rows[:, :-OBSERVATION_SIZE], rows[:, -OBSERVATION_SIZE:]
        memory, policy = network.apply(params, flights.memory, seen, method="decide")
        right = teacher.network.act(teacher.params, (), state)[1]
        is_taught = jnp.arange(config.num_envs)[:, None] < share * config.num_envs
        flown = jnp.where(is_taught, right, policy.mode())
        flown = flown + NOISE * jax.random.normal(key_noise, flown.shape)
        observation, env_state, _, terminated, truncated, _ = step_all(
            key_step, flights.state, jnp.clip(flown, -1.0, 1.0), env_params
        )
        done = terminated | truncated
        memory = jax.tree.map(lambda leaf: jnp.where(done[:, None], 0.0, leaf), memory)
        lesson = Lesson(flights.memory, rows, right, done)
        return Flights(memory, observation, env_state), lesson

    def compute_loss(params: Any, lesson: Lesson) -> tuple[jax.Array, Errors]:
        policy, _, state_error = network.apply(
            params, lesson.memory, lesson.observation, lesson.done, method="unroll"
        )
        errors = Errors(((policy.mode() - lesson.action) ** 2).mean(), state_error)
        return errors.action + config.state_coef * errors.state, errors

    def learn(learner: tuple[Any, Any], lesson: Lesson) -> tuple[tuple[Any, Any], Errors]:
        params, optimizer_state = learner
        gradient, errors = jax.grad(compute_loss, has_aux=True)(params, lesson)
        change, optimizer_state = optimizer.update(gradient, optimizer_state, params)
        return (optax.apply_updates(params, change), optimizer_state), errors

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(
        learner: tuple[Any, Any], flights: Flights, key: jax.Array, share: jax.Array
    ) -> tuple[tuple[Any, Any], Flights, Errors]:
        key_order, *keys = jax.random.split(key, config.num_steps + 1)
        flights, lessons = jax.lax.scan(
            partial(fly_step, learner[0], share), flights, jnp.stack(keys)
        )
        order = jax.random.permutation(key_order, config.num_envs)
        lessons = jax.tree.map(
            lambda leaf: leaf.swapaxes(0, 1)[order].reshape(
                config.num_minibatches, -1, config.num_steps, *leaf.shape[2:]
            ),
            lessons,
        )
        learner, errors = jax.lax.scan(learn, learner, lessons)
        return learner, flights, jax.tree.map(jnp.mean, errors)

    @jax.jit
    def start(key: jax.Array) -> tuple[tuple[Any, Any], Flights]:
        key_network, key_reset = jax.random.split(key)
        keys = jax.random.split(key_reset, config.num_envs)
        observation, state = jax.vmap(env.reset, (0, None))(keys, env_params)
        params = network.init(key_network, observation[:1])
        memory = network.first_memory((config.num_envs,))
        return (params, optimizer.init(params)), Flights(memory, observation, state)

    key_start, key_updates = jax.random.split(jax.random.key(seed))
    learner, flights = start(key_start)
    history = []
    for done, key in enumerate(jax.random.split(key_updates, config.num_updates)):
        share = jnp.float32(max(0.0, 1.0 - done / (TEACHER_FLIES * config.num_updates)))
        learner, flights, errors = update(learner, flights, key, share)
        history.append(jax.device_get(errors))
        report(done + 1, config.num_updates)
    return learner[0], jax.tree.map(lambda *values: jnp.stack(values), *history)


def main(settings: Settings) -> None:
    """Train a student, and write its checkpoint."""
    begun_s = time.perf_counter()
    teacher = load_checkpoint(settings.teacher)
    policy = check_teacher(teacher)
    model = model_from_json(teacher.meta["model"], f"{settings.teacher}: model")
    env = flytrack_env.make(settings.env_id, track=teacher.track, model=model)
    config = dataclasses.replace(CONFIG, total_timesteps=settings.total_timesteps)
    params, errors = distill(env, policy, config, settings.seed, ProgressBar("updates"))
    description = {
        **describe_run(env, settings.env_id, teacher.track, config, settings.seed),
        "steps": config.num_updates * config.batch_size,
        "seconds": time.perf_counter() - begun_s,
        "distilled": {"teacher": str(settings.teacher), "updates": config.num_updates},
    }
    save_checkpoint(settings.out / FINAL, params, config, description)
    print(
        f"root mean square error of the last update's actions: {errors.action[-1] ** 0.5:.3f}; "
        f"checkpoint: {settings.out / FINAL}"
    )


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, prog=PROG, description=__doc__))
    except (ValueError, OSError) as error:
        raise SystemExit(f"{PROG}: error: {error_text(error)}") from error
