"""FlyTrack: the drone-racing environment, native to gymnax 1.0."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import acts, delay_steps_of
from flytrack_env.episodes import EpisodicEnvironment, without_nan
from flytrack_env.fusion import compute_once
from flytrack_env.model_file import load_model
from flytrack_env.observations import OBSERVATION, Entry, observe_race
from flytrack_env.params import DT_S, EnvParams
from flytrack_env.plants import Plant, Simulator
from flytrack_env.race import Race, RaceEvents, advance_race, start_race
from flytrack_env.resets import ResetParams, sample_start
from flytrack_env.rewards import Transition, make_weights, total_reward
from flytrack_env.state import Action, Drone
from flytrack_env.terminations import Causes, find_causes
from flytrack_env.tracks import Track, build_course, load_track

MISSED_GATE_CHOICES = ("terminate", "fly_on")


class EnvState(NamedTuple):
    """State of one episode: the plant's own state, the race, and time, in steps since the reset."""

    plant: Any
    race: Race
    time: jax.Array


class FlyTrack(EpisodicEnvironment):
    """Race an acro-mode quadcopter through the gates of a track at 100 Hz.

    Args:
        track: name of a shipped track, the path of a track file, or a ``Track``.
        model: parameters of the simulated drone, or the path of a model file; nominal if None.
        plant: what moves the drone; the simulator if None. ``flytrack_env.blackbox`` has others.
        missed_gate: "terminate" the episode when a gate's plane is crossed outside its frame, or
            "fly_on" with the same gate still to be flown.
        reward: weights of reward terms by name, for those that are not to have the default weight.

    Raises:
        TrackError, ModelFileError: a track or model that cannot be read.
        ValueError: another value of ``missed_gate``; an unknown reward term, or a weight that is no
            number; a battery beyond all voltages that the model was fitted at.
        TypeError: a plant that is not a ``flytrack_env.plants.Plant``.
    """

    def __init__(
        self,
        track: str | Path | Track = "flytrack",
        model: ModelParameters | str | Path | None = None,
        plant: Plant | None = None,
        missed_gate: str = "terminate",
        reward: Mapping[str, float] | None = None,
    ):
        super().__init__()
        if missed_gate not in MISSED_GATE_CHOICES:
            raise ValueError(
                f"missed_gate: found {missed_gate!r}, expected one of {MISSED_GATE_CHOICES}"
            )
        self.track: Track = track if isinstance(track, Track) else load_track(track)
        self.missed_gate = missed_gate
        if model is None:
            model = nominal_parameters()
        elif not isinstance(model, ModelParameters):
            model = load_model(model)
        self.plant: Plant = (
            Simulator(delay_steps_of(model.effects, DT_S)) if plant is None else plant
        )
        if not isinstance(self.plant, Plant):
            raise TypeError(
                f"plant: found {type(plant).__name__}, expected a subclass of plants.Plant"
            )
        if self.plant.battery is not None:
            model = model._replace(battery=self.plant.battery)
        model.battery.check()
        model.battery.warn_of_extrapolation()
        self._default_params = EnvParams(
            model=model,
            course=build_course(self.track),
            reset=ResetParams(),
            reward=make_weights(reward or {}),
        )

    @property
    def default_params(self) -> EnvParams:  # type: ignore[override]  # of gymnax: see EpisodicEnvironment
        """Parameters with the track and model that the environment was made with."""
        return self._default_params

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """The table ``flytrack_env.observations.OBSERVATION``."""
        return OBSERVATION

    def drone(self, state: EnvState) -> Drone:
        """Return the drone of an environment state."""
        return self.plant.drone(state.plant)

    def race(self, state: EnvState) -> Race:
        """Return where the drone stands in the race."""
        return state.race

    def model(self, state: EnvState, params: EnvParams) -> ModelParameters:
        """Return the model of the parameters."""
        return params.model

    def observe_drone(self, drone: Drone, state: EnvState, params: EnvParams) -> list[jax.Array]:
        """Return the observation before the gate to be flown, float32 scalars.

        Rates and pose are the sensors' where the model has effects on them.
        """
        if acts(params.model.effects, "gyro") or acts(params.model.effects, "pose"):
            drone = self.plant.sensed(state.plant, drone, params.dt, params.model)
        return observe_race(drone, state.race.gate, state.race.next_gate, params.model.battery)

    def is_truncated(self, state: EnvState, params: EnvParams) -> jax.Array:
        """Return whether the time limit is reached."""
        return state.time >= params.max_steps_in_episode

    def transition(
        self, state: EnvState, command: Action, params: EnvParams
    ) -> tuple[EnvState, jax.Array, Causes, RaceEvents]:
        """Return the next state, the reward (scalar), the causes of termination, and the events."""
        is_nan = jnp.isnan(sum(command))
        command = without_nan(command)
        before = self.drone(state)
        plant_state = self.plant.step(state.plant, command, params.dt, params.model)
        after = self.plant.drone(plant_state)
        start_time_s = state.time.astype(state.race.lap_start_s.dtype) * params.dt
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
        causes = find_causes(
            after, params.course, params.model.battery, events.is_frame | is_nan, is_missed
        )
        causes = compute_once(causes)
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

    def advance(
        self, state: EnvState, command: Action, params: EnvParams
    ) -> tuple[EnvState, jax.Array, jax.Array, dict[str, Any]]:
        """Return the next state, the reward, whether the episode terminates, and info.

        info: each cause of termination, ``gates_passed``, ``laps``, ``lap_completed``,
        ``lap_time_s`` (last complete lap, interpolated at the crossing; 0 if none),
        ``gate_distance_m``.
        """
        next_state, reward, causes, events = self.transition(state, command, params)
        race = next_state.race
        info = {
            **causes._asdict(),
            "gates_passed": race.gates_passed,
            "laps": race.laps,
            "lap_completed": events.is_lap,
            "lap_time_s": race.lap_time_s,
            "gate_distance_m": (self.drone(next_state).pos_w - race.gate.centre).norm(),
        }
        return next_state, reward, causes.any(), info

    def sample_start(self, seed: jax.Array, params: EnvParams) -> tuple[Drone, jax.Array]:
        """Return a drone at the start pose or on the course, and the gate to fly first."""
        return sample_start(seed, params.course, params.reset, params.model)

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> EnvState:
        """Return the state of an episode that begins; the seed is unused, nothing else is drawn."""
        del seed
        race = start_race(jnp.asarray(gate_index, jnp.int32), params.course)
        return EnvState(plant=self.plant.reset(drone, params.model), race=race, time=jnp.int32(0))

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError for what cannot be flown, or another time step than the plant's."""
        params.check(self.plant.delay_steps)
        plant_dt = self.plant.dt
        if plant_dt is not None and not np.allclose(params.dt, plant_dt, rtol=1e-5):
            raise ValueError(
                f"dt: found {params.dt} s, expected {plant_dt} s, which the plant has baked in"
            )
