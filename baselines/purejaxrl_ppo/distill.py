"""Distillation: a policy that has a camera learns from one that sees the state.

``python -m baselines.purejaxrl_ppo.distill [--teacher robust] [--out FOLDER]``.

PPO must learn both where the drone is and how to race. The teacher already knows how to race. The
student flies, and in every state that it gets into it learns what the teacher would command there
(DAgger: S. Ross et al., arXiv 1011.0686). So it also learns to come back from its own errors, and
its memory learns to hold what the teacher sees. The critic and the standard deviation of the
actions, which flights do not need, are not trained.
"""

import dataclasses
import hashlib
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import (
    FINAL,
    Checkpoint,
    CheckpointError,
    checkpoints_in,
    describe_run,
    load_checkpoint,
    save_checkpoint,
)
from baselines.purejaxrl_ppo.config import Config, ConfigError, Count
from baselines.purejaxrl_ppo.networks import Memory, Policy
from baselines.purejaxrl_ppo.ppo import choose_step, make_network_for
from baselines.purejaxrl_ppo.train_ppo import MAX_SEED
from baselines.purejaxrl_ppo.training import DivergedError, find_not_finite, training_params
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.files import locked_folder
from flytrack_env.messages import error_text
from flytrack_env.model_file import model_from_json
from flytrack_env.progress import ProgressBar
from flytrack_env.wrappers import StateObservation

PROG = "python -m baselines.purejaxrl_ppo.distill"
# Episodes last longer than a lap, so that a memory is of use. The drone is as thick as in the race:
# the teacher's own margin decides. What is not PPO's default here is a first choice, not a tuned
# one; so are TEACHER_FLIES and NOISE.
CONFIG = Config(
    total_timesteps=33_000_000,
    num_minibatches=16,
    episode_steps=600,
    gate_margin=0.0,
    learning_rate=1e-3,
    adam_eps=1e-8,
    memory_size=64,
    encoder_sizes=(64,),
    critic_sees_state=True,
    state_coef=0.1,
)
TEACHER_FLIES = 0.2  # of the updates; in these the teacher flies ever fewer of the drones
NOISE = 0.05  # standard deviation added to flown actions, so that more states are seen


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a distillation, which are the flags of the command."""

    teacher: Path = Path("robust")
    """Checkpoint of a policy that observes what FlyTrack-v0 shows and remembers nothing; champion
    and robust are the shipped ones. Its model, track and rule for missed gates are those flown."""
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

    action: Any
    state: Any


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
    """The flights, which go on from update to update; leaves (num_envs, ...).

    Attributes:
        memory: of the student.
        observation: of the student, with the state's rows behind it.
        state: of the environments.
    """

    memory: Memory
    observation: jax.Array
    state: Any


def make_env(teacher: Checkpoint, env_id: str) -> EpisodicEnvironment:
    """Return an environment with a teacher's model, track and rule for missed gates.

    Raises:
        CheckpointError: a teacher without its model.
        ValueError, TrackError: an id or a track that cannot be used.
    """
    if "model" not in teacher.meta:
        raise CheckpointError("teacher: model: found none, expected the one it was trained on")
    model = model_from_json(teacher.meta["model"], "teacher: model")
    missed_gate = teacher.meta["missed_gate"]
    return flytrack_env.make(env_id, track=teacher.track, model=model, missed_gate=missed_gate)


def check_teacher(teacher: Checkpoint) -> Policy:
    """Return a teacher's policy.

    Raises:
        CheckpointError: one that observes something else than FlyTrack-v0 shows, or remembers.
    """
    env = make_env(teacher, "FlyTrack-v0")
    try:
        teacher.check_fits(env)
    except CheckpointError as error:
        raise CheckpointError(
            f"teacher: expected one that observes what FlyTrack-v0 shows: {error}"
        ) from error
    if teacher.config.memory_size:
        raise CheckpointError(
            f"teacher: memory_size: found {teacher.config.memory_size}, expected 0: what it "
            "remembers of its own flights is not known in those of the student"
        )
    return teacher.policy


def check_config(config: Config) -> None:
    """Raise ConfigError, naming the field, for a configuration that a student cannot learn with."""
    config.check()
    if not config.critic_sees_state:
        raise ConfigError("critic_sees_state: found False, expected True: the teacher sees it")
    if config.num_envs % config.num_minibatches:
        raise ConfigError(
            f"num_minibatches: found {config.num_minibatches}, expected a divisor of the "
            f"{config.num_envs} environments"
        )


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
        config: of the student's network, environments, episodes, minibatches and optimizer.
            Fields of PPO alone are not used.
        seed: of the student and of its flights.
        report: called with the number of updates done and of all.

    Raises:
        ValueError: a configuration that cannot be trained with, an environment of images.
        DivergedError: numbers that are not finite.
    """
    check_config(config)
    env_params = training_params(env, config)
    own_size = env.observation_space().shape[0]
    env = StateObservation(env)
    network: Any = make_network_for(env, env_params, config)
    step_all = choose_step(env, config)
    num_gradients = config.num_updates * config.num_minibatches
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.adam(
            optax.cosine_decay_schedule(config.learning_rate, num_gradients), eps=config.adam_eps
        ),
    )

    def fly_step(
        params: Any, teacher_share: jax.Array, flights: Flights, key: jax.Array
    ) -> tuple[Flights, Lesson]:
        key_noise, key_step = jax.random.split(key)
        own, state = jnp.split(flights.observation, [own_size], axis=-1)
        memory, policy = network.apply(params, flights.memory, own, method="decide")
        target = teacher.network.act(teacher.params, (), state)[1]
        is_taught = jnp.arange(config.num_envs)[:, None] < teacher_share * config.num_envs
        action = jnp.where(is_taught, target, policy.mode())
        action = action + NOISE * jax.random.normal(key_noise, action.shape)
        observation, env_state, _, terminated, truncated, _ = step_all(
            key_step, flights.state, jnp.clip(action, -1.0, 1.0), env_params
        )
        done = terminated | truncated
        memory = jax.tree.map(lambda leaf: jnp.where(done[:, None], 0.0, leaf), memory)
        lesson = Lesson(flights.memory, flights.observation, target, done)
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
        learner: tuple[Any, Any], flights: Flights, key: jax.Array, teacher_share: jax.Array
    ) -> tuple[tuple[Any, Any], Flights, Errors]:
        key_order, *keys = jax.random.split(key, config.num_steps + 1)
        flights, lessons = jax.lax.scan(
            partial(fly_step, learner[0], teacher_share), flights, jnp.stack(keys)
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
    for index, key in enumerate(jax.random.split(key_updates, config.num_updates)):
        teacher_share = jnp.float32(max(0.0, 1.0 - index / (TEACHER_FLIES * config.num_updates)))
        learner, flights, errors = update(learner, flights, key, teacher_share)
        history.append(jax.device_get(errors))
        report(index + 1, config.num_updates)
    errors = jax.tree.map(lambda *values: np.stack(values), *history)
    not_finite = find_not_finite(errors._asdict(), learner[0])
    if not_finite:
        raise DivergedError(f"learning diverged: found {not_finite[0]} not finite")
    return learner[0], errors


def main(settings: Settings) -> None:
    """Train a student, and write its checkpoint.

    Raises:
        ValueError: settings or a teacher that cannot be used, or a folder that holds a run.
        OSError: files that cannot be read or written.
    """
    begun_s = time.perf_counter()
    if not 0 <= settings.seed <= MAX_SEED:
        raise ValueError(f"--seed: found {settings.seed}, expected 0 to {MAX_SEED}")
    teacher = load_checkpoint(settings.teacher)
    policy, env = check_teacher(teacher), make_env(teacher, settings.env_id)
    config = dataclasses.replace(CONFIG, total_timesteps=settings.total_timesteps)
    with locked_folder(settings.out):
        if checkpoints_in(settings.out):
            raise ValueError(
                f"--out: {settings.out} holds the checkpoints of a run; give another folder, or "
                "remove it"
            )
        params, errors = distill(env, policy, config, settings.seed, ProgressBar("updates"))
        sha256 = hashlib.sha256(teacher.path.read_bytes()).hexdigest()
        description = {
            **describe_run(env, settings.env_id, teacher.track, config, settings.seed),
            "steps": config.num_updates * config.batch_size,
            "seconds": round(time.perf_counter() - begun_s, 1),
            "distilled": {"teacher": str(settings.teacher), "teacher_sha256": sha256},
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
