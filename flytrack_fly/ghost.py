"""The flight that a pilot flies against: a lap from standstill, then flying laps, at any time."""

from pathlib import Path
from typing import Literal, NamedTuple

import jax
import numpy as np

from flytrack_env import ModelParameters, Track, make, nominal_parameters
from flytrack_env.flown_race import STEP_S, follow_race
from flytrack_env.model_file import model_from_json
from flytrack_env.params import EnvParams
from flytrack_env.references import KINDS, Reference, ReferenceFileError, is_model_of, shipped_references
from flytrack_env.resets import ResetParams
from flytrack_env.state import BATTERY_FULL_V, POSITION, QUATERNION, VELOCITY

Kind = Literal["reference", "champion", "none"]
CHAMPION = "champion/flytrack.safetensors"  # in baselines.purejaxrl_ppo
MOST_STEPS, NUM_LAPS = 6000, 3  # of the champion's flight
STILL_START = ResetParams(0.0, 0.0, 0.0, 0.0, 0.0, BATTERY_FULL_V)  # no noise, and never on the course


class GhostLap(NamedTuple):
    """A lap: states (N, 21) every ``STEP_S``, the time of the first, and times of the gates (num_gates,).

    Times are in s since the lap began; the last gate's is the lap time.
    """

    states: np.ndarray
    first_s: float
    gate_times_s: np.ndarray

    def state_at(self, time_s: float) -> np.ndarray:
        """Return the state (21,) at a time, linear between samples; beyond an end, that end's."""
        place = np.clip((time_s - self.first_s) / STEP_S, 0.0, len(self.states) - 1.0)
        index = min(int(place), len(self.states) - 2)
        before, after = self.states[index], self.states[index + 1].copy()
        if before[QUATERNION] @ after[QUATERNION] < 0.0:
            after[QUATERNION] *= -1.0  # the same attitude, on the near side
        state: np.ndarray = before + (place - index) * (after - before)
        state[QUATERNION] /= np.linalg.norm(state[QUATERNION])
        return state


class Ghost(NamedTuple):
    """A ghost: its name, the lap from standstill, and a flying lap, which it repeats."""

    name: str
    first: GhostLap
    flying: GhostLap

    def lap(self, laps: int) -> GhostLap:
        """Return what it flies after so many laps."""
        return self.flying if laps else self.first

    def state_at(self, laps: int, time_s: float) -> np.ndarray:
        """Return the state (21,) so many s after the pilot's lap began; through with a lap, it flies on."""
        lap_time_s = self.lap(laps).gate_times_s[-1]
        if time_s < lap_time_s:
            return self.lap(laps).state_at(time_s)
        return self.flying.state_at((time_s - lap_time_s) % self.flying.gate_times_s[-1])


def still_start(params: EnvParams, num_steps: int) -> EnvParams:
    """Return parameters whose episodes begin at rest at the start pose and may last that many steps."""
    return params.replace(reset=STILL_START, max_steps_in_episode=num_steps)


def make_ghost(
    kind: Kind, track: Track, model: ModelParameters | None
) -> tuple[Ghost | None, ModelParameters]:
    """Return the ghost of a kind, and the pilot's model: if None, the champion's own or the nominal one.

    Raises:
        ValueError: no reference of this track, or a champion that flies no two laps here.
        ImportError: "champion" without the extra [train].
    """
    if kind == "champion":
        states, _, model = fly_champion(track, model)
        first, *flying = cut_laps(states, track) or [None]
        if not flying:
            raise ValueError(
                f"--ghost champion: it flies no two laps of {track.name} with this model, expected its own: "
                "flytrack, without --model"
            )
        return Ghost("champion", first, min(flying, key=lambda lap: float(lap.gate_times_s[-1]))), model
    model = model or nominal_parameters()
    if kind == "none":
        return None, model
    name = "black_box" if is_model_of(track.name, "black_box", model) else "nominal"
    try:
        references = shipped_references(track, (name,))
    except ReferenceFileError as error:
        raise ValueError(f"--ghost reference: {error}; --ghost none flies without one") from error
    flying, standing = (_lap_of(references[kind]) for kind in KINDS)
    return Ghost("time-optimal", standing, flying), model


def _lap_of(reference: Reference) -> GhostLap:
    return GhostLap(reference.states, 0.0, np.append(reference.gate_times_s[:-1], reference.time_s))


def fly_champion(
    track: Track, model: ModelParameters | None
) -> tuple[np.ndarray, np.ndarray, ModelParameters]:
    """Return states (T, 21) and commands (T, 4) of the shipped champion's flight with a model, and the model.

    model: the champion's own if None.

    Raises:
        ImportError: without the extra [train].
    """
    import baselines.purejaxrl_ppo as baseline  # needs the extra
    from baselines.purejaxrl_ppo.flights import fly_episode

    champion = baseline.load_checkpoint(Path(baseline.__file__).parent / CHAMPION)
    model = model or model_from_json(champion.meta["model"], "checkpoint: model")
    env = make(champion.env_id, track=track, model=model)
    params, policy = still_start(env.default_params, MOST_STEPS), (champion.network, champion.params)
    flown = fly_episode(env, *policy, jax.random.key(0), params, MOST_STEPS, NUM_LAPS)
    count = int(np.sum(flown.is_flying))
    return np.asarray(flown.states, float)[:count], np.asarray(flown.actions)[:count], model


def cut_laps(states: np.ndarray, track: Track) -> list[GhostLap]:
    """Return the complete laps of a flight from the start pose, states (T, 21) at 100 Hz."""
    passes = follow_race(states[:, POSITION], track, 0, states[-1, VELOCITY]).passes
    times_s = np.array([0.0, *(one.time_s for one in passes)])
    laps, num_gates = [], len(track.gates)
    for first in range(0, len(passes) - num_gates + 1, num_gates):
        begin_s, gates_s = times_s[first], times_s[first + 1 : first + num_gates + 1]
        row, end = int(begin_s / STEP_S), int(gates_s[-1] / STEP_S) + 2
        laps.append(GhostLap(states[row:end], row * STEP_S - begin_s, gates_s - begin_s))
    return laps
