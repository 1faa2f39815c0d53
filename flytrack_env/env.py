"""FlyTrack: the drone-racing environment, native to gymnax 1.0."""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import environment, spaces

from flytrack_env.auto_reset import reset_ended
from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.fusion import compute_once
from flytrack_env.model_file import load_model
from flytrack_env.observations import OBSERVATION_LIMIT, OBSERVATION_SIZE, observe_race
from flytrack_env.params import EnvParams
from flytrack_env.plants import Plant, Simulator
from flytrack_env.race import Race, RaceEvents, advance_race, look_up_gates, start_race
from flytrack_env.randomness import seed_of, seeds_of
from flytrack_env.resets import ResetParams, sample_start
from flytrack_env.rewards import RewardWeights, Transition, total_reward
from flytrack_env.state import ACTION_SIZE, Action, Drone, unpack_action
from flytrack_env.terminations import Causes, find_causes
from flytrack_env.tracks import Track, build_course, load_track

MISSED_GATE_CHOICES = ("terminate", "fly_on")


class EnvState(NamedTuple):
    """State of one episode: the plant's own state, the race, and steps since the reset."""

    plant: Any
    race: Race
    time: jax.Array


def clean_command(action: jax.Array) -> tuple[Action, jax.Array]:
    """Return the command of an action (4,), clipped to [-1, 1], and whether it was not a number.

    Infinite values clip; a NaN becomes 0, so that it cannot poison the state, and ends the episode.
    """
    command = unpack_action(jnp.asarray(action))
    # The fence: a batch of actions is strided, and what reads strided memory is not vectorised.
    clipped = compute_once([jnp.clip(value, -1.0, 1.0) for value in command])
    cleaned = (jnp.where(jnp.isnan(value), 0.0, value) for value in clipped)
    return Action(*cleaned), jnp.isnan(sum(clipped))


class FlyTrack(environment.Environment[EnvState, EnvParams]):
    """Race an acro-mode quadcopter through the gates of a track at 100 Hz.

    Args:
        track: name of a shipped track, the path of a track file, or a ``Track``.
        model: parameters of the simulated drone, or the path of a model file; nominal if None.
        plant: what moves the drone; the simulator if None. Black boxes: ``flytrack_env.blackbox``.
        missed_gate: "terminate" the episode when a gate's plane is crossed outside its frame, or
            "fly_on" with the same gate still to be flown.

    Raises:
        TrackError, ModelFileError: a track or model that cannot be read.
        ValueError: another value of ``missed_gate``.
    """

    _supports_transition_gradients = True

    def __init__(
        self,
        track: str | Path | Track = "flytrack",
        model: ModelParameters | str | Path | None = None,
        plant: Plant | None = None,
        missed_gate: str = "terminate",
    ):
        super().__init__()
        if missed_gate not in MISSED_GATE_CHOICES:
            raise ValueError(f"missed_gate: found {missed_gate!r}, expected one of {MISSED_GATE_CHOICES}")
        self.track: Track = track if isinstance(track, Track) else load_track(track)
        self.plant: Plant = Simulator() if plant is None else plant
        self.missed_gate = missed_gate
        if model is None:
            model = nominal_parameters()
        elif not isinstance(model, ModelParameters):
            model = load_model(model)
        self._default_params = EnvParams(
            model=model,
            course=build_course(self.track),
            reset=ResetParams(),
            reward=RewardWeights(),
        )

    @property
    def name(self) -> str:
        """Environment name."""
        return "FlyTrack-v0"

    @property
    def default_params(self) -> EnvParams:
        """Parameters with the track and model that the environment was made with."""
        return self._default_params

    @property
    def num_actions(self) -> int:
        """Number of components of an action."""
        return ACTION_SIZE

    def action_space(self, params: EnvParams | None = None) -> spaces.Box:
        """Roll-rate, pitch-rate, yaw-rate and thrust command, each in [-1, 1]."""
        return spaces.Box(-1.0, 1.0, (ACTION_SIZE,), jnp.float32)

    def observation_space(self, params: EnvParams | None = None) -> spaces.Box:
        """The table ``flytrack_env.observations.OBSERVATION`` as a box."""
        limit = jnp.asarray(OBSERVATION_LIMIT)
        return spaces.Box(-limit, limit, (OBSERVATION_SIZE,), jnp.float32)

    def drone(self, state: EnvState) -> Drone:
        """Return the drone of an environment state."""
        return self.plant.drone(state.plant)

    def race(self, state: EnvState) -> Race:
        """Return where the drone stands in the race."""
        return state.race

    def observe(self, key: jax.Array | None, state: EnvState, action: Any, params: EnvParams) -> jax.Array:
        """Return the observation of a state, (OBSERVATION_SIZE,) float32; key and action are unused."""
        del key, action
        return observe_race(self.drone(state), state.race.gate, state.race.next_gate)

    def is_truncated(self, state: EnvState, params: EnvParams) -> jax.Array:
        """Return whether the time limit is reached."""
        return state.time >= params.max_steps_in_episode

    def transition(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, jax.Array, Causes, RaceEvents]:
        """Return the next state, the reward, the causes of termination and the race's events."""
        command, is_nan = clean_command(action)
        before = self.drone(state)
        plant_state = compute_once(self.plant.step(state.plant, command, params.dt, params.model))
        after = self.plant.drone(plant_state)
        start_time_s = state.time * params.dt
        race, events = advance_race(
            state.race,
            before.pos_w,
            after.pos_w,
            start_time_s,
            params.dt,
            params.course,
            params.drone_radius,
        )
        is_missed = events.is_miss & (self.missed_gate == "terminate")
        causes = compute_once(find_causes(after, params.course, events.is_frame | is_nan, is_missed))
        is_terminated = compute_once(causes.any())
        reward = total_reward(
            Transition(
                before=before,
                after=after,
                gate_centre_w=state.race.gate.centre,
                num_passed=events.num_passed,
                offset=events.offset,
                is_terminated=is_terminated,
            ),
            params.reward,
        )
        return EnvState(plant=plant_state, race=race, time=state.time + 1), reward, causes, events

    def step_env(
        self, key: jax.Array | None, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, dict[str, Any]]:
        """Return observation, state, reward, terminated and info of one step, without auto-reset.

        info: each cause of termination, ``gates_passed``, ``laps``, ``lap_completed``, ``lap_time_s``
        (last complete lap, interpolated at the crossing; 0 if none), ``gate_distance_m``.
        """
        del key
        next_state, reward, causes, events = self.transition(state, action, params)
        observation = self.observe(None, next_state, action, params)
        observation, next_state = self._apply_transition_gradient_policy(observation, next_state)
        race = next_state.race
        info = {
            **causes._asdict(),
            "gates_passed": race.gates_passed,
            "laps": race.laps,
            "lap_completed": events.is_lap,
            "lap_time_s": race.lap_time_s,
            "gate_distance_m": (self.drone(next_state).pos_w - race.gate.centre).norm(),
        }
        return observation, next_state, reward, causes.any(), info

    def reset(self, key: jax.Array, params: EnvParams | None = None) -> tuple[jax.Array, EnvState]:
        """Return observation and state of an episode that begins.

        Raises:
            ValueError: parameters that no episode can be flown with, or a step of time that the plant does
                not have, where their values are known (not while tracing).
        """
        if params is None:
            params = self.default_params
        if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(params)):
            params.check()
            plant_dt = getattr(self.plant, "dt", params.dt)
            if not np.allclose(params.dt, plant_dt, rtol=1e-5):
                raise ValueError(
                    f"dt: found {params.dt} s, expected {plant_dt} s, which the plant has baked in"
                )
        return super().reset(key, params)

    def _begin_from(self, seed: jax.Array, params: EnvParams) -> EnvState:
        """Return the state of an episode that begins, from one random word."""
        start = sample_start(seed, params.course, params.reset, params.model)
        return self.begin(*start, params)

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams) -> EnvState:
        """Return the state of an episode that begins with a given drone and gate to fly first."""
        race = start_race(jnp.asarray(gate_index, jnp.int32), params.course)
        return EnvState(plant=self.plant.reset(drone), race=race, time=jnp.int32(0))

    def reset_env(self, key: jax.Array, params: EnvParams) -> tuple[jax.Array, EnvState]:
        """Return observation and state of an episode that begins."""
        state = self._begin_from(seed_of(key), params)
        return self.observe(None, state, None, params), state

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self,
        key: jax.Array,
        state: EnvState,
        action: jax.Array,
        params: EnvParams | None = None,
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """Return observation, state, reward, terminated, truncated and info, with auto-reset.

        gymnax's protocol, except that the whole key serves the reset: the step itself draws nothing.
        """
        if params is None:
            params = self.default_params
        final_observation, next_state, reward, terminated, info = self.step_env(None, state, action, params)
        truncated = self.is_truncated(next_state, params)
        done = terminated | truncated
        fresh_state = self._begin_from(seed_of(key), params)
        next_state = compute_once(
            jax.tree.map(partial(jnp.where, compute_once(done)), fresh_state, next_state)
        )
        # Gates are looked up after the choice, by its index: a fifth faster than to choose frames.
        next_state = next_state._replace(race=look_up_gates(next_state.race, params.course))
        observation = self.observe(None, next_state, None, params)
        info = {
            **info,
            "terminated": terminated,
            "truncated": truncated,
            "final_observation": final_observation,
        }
        return observation, next_state, reward, terminated, truncated, info

    def _sample_starts(
        self, places: jax.Array, inputs: tuple[jax.Array, EnvParams]
    ) -> tuple[jax.Array, EnvState]:
        """Return observations and states of episodes that begin in some environments of a batch."""
        key, params = inputs
        begin_all = jax.vmap(self._begin_from, in_axes=(0, None))
        states = begin_all(seeds_of(key, places), params)
        observe_all = jax.vmap(self.observe, in_axes=(None, 0, None, None))
        return observe_all(None, states, None, params), states

    @partial(jax.jit, static_argnames=("self",))
    def step_batch(
        self, key: jax.Array, states: EnvState, actions: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """``step`` for a whole batch with one key, faster than ``vmap(step)``.

        states: leaves (num_envs,). actions: (num_envs, 4). params: one for all. Same results as
        ``vmap(step)`` up to the random draws: starts are sampled only in steps where an episode ended.
        """
        step_all = jax.vmap(self.step_env, in_axes=(None, 0, 0, None))
        final_observations, next_states, rewards, terminated, info = step_all(None, states, actions, params)
        truncated = self.is_truncated(next_states, params)
        done = terminated | truncated

        observations, next_states = reset_ended(
            self._sample_starts, done, (final_observations, next_states), (key, params)
        )
        info = {
            **info,
            "terminated": terminated,
            "truncated": truncated,
            "final_observation": final_observations,
        }
        return observations, next_states, rewards, terminated, truncated, info
