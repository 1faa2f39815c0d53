"""The flight that a pilot flies against: a lap from standstill, then flying laps, at any time."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import numpy as np
from scipy.interpolate import make_interp_spline

from flytrack_env import ModelParameters, Track, make, nominal_parameters
from flytrack_env.flown_race import STEP_S, follow_race
from flytrack_env.model_file import model_from_json
from flytrack_env.params import EnvParams
from flytrack_env.references import KINDS, ReferenceFileError, is_model_of, shipped_references
from flytrack_env.resets import ResetParams
from flytrack_env.state import POSITION, VELOCITY

Kind = Literal["reference", "champion", "none"]
CHAMPION_NEEDS = "expected 2 or more: fly on its own track, flytrack, without --model"
MAX_STEPS, NUM_LAPS = 6000, 3  # of the champion's flight
STILL_START = ResetParams(0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # no noise, full, never on the course


class GhostLap(NamedTuple):
    """A lap: its states (21,) over time, and its gate times (num_gates,), s since it began."""

    state_at: Callable[[float], np.ndarray]
    gate_times_s: np.ndarray


class Ghost(NamedTuple):
    """A ghost: its name, the lap from standstill, and a flying lap, which it repeats."""

    name: str
    first: GhostLap
    flying: GhostLap

    def lap(self, laps: int) -> GhostLap:
        """Return what it flies after so many laps."""
        return self.flying if laps else self.first

    def lap_begin_s(self, laps: int) -> float:
        """Return when it has flown so many laps, s since its start."""
        return (
            float(self.first.gate_times_s[-1] + (laps - 1) * self.flying.gate_times_s[-1])
            if laps
            else 0.0
        )

    def state_at(self, laps: int, time_s: float) -> np.ndarray:
        """Return the state (21,) at ``time_s`` after the pilot's lap began.

        After the end of its lap, the ghost flies on.
        """
        beyond_s = time_s - self.lap(laps).gate_times_s[-1]
        if beyond_s < 0.0:
            return self.lap(laps).state_at(time_s)
        return self.flying.state_at(beyond_s % self.flying.gate_times_s[-1])


def _lap(states: np.ndarray, first_s: float, gate_times_s: np.ndarray) -> GhostLap:
    """Return the lap of states (N, 21), the first of them at a time since the lap began, s."""
    return GhostLap(
        make_interp_spline(first_s + STEP_S * np.arange(len(states)), states, k=1), gate_times_s
    )


def still_start(params: EnvParams, num_steps: int) -> EnvParams:
    """Return parameters of episodes from rest at the start, of at most ``num_steps`` steps."""
    return params.replace(reset=STILL_START, max_steps_in_episode=num_steps)


def make_ghost(
    kind: Kind, track: Track, model: ModelParameters | None
) -> tuple[Ghost | None, ModelParameters]:
    """Return the ghost of a kind, and the pilot's model.

    Args:
        model: if None, the champion's own or the nominal one.

    Raises:
        ValueError: no reference of this track, or a champion that flies no two laps here.
        ImportError: "champion" without the extra [train].
    """
    if kind == "champion":
        states, _, model = fly_champion(track, model)
        laps = cut_laps(states, track)
        if len(laps) < 2:
            raise ValueError(
                f"--ghost champion: {len(laps)} laps of {track.name}, {CHAMPION_NEEDS}"
            )
        return Ghost(
            kind, laps[0], min(laps[1:], key=lambda lap: float(lap.gate_times_s[-1]))
        ), model
    model = model or nominal_parameters()
    if kind == "none":
        return None, model
    name = "black_box" if is_model_of(track.name, "black_box", model) else "nominal"
    try:
        references = shipped_references(track, (name,))
    except ReferenceFileError as error:
        raise ValueError(f"--ghost reference: {error}; --ghost none flies without one") from error
    flying, standing = (
        _lap(one.states, 0.0, np.append(one.gate_times_s[:-1], one.time_s))
        for one in (references[kind] for kind in KINDS)
    )
    return Ghost("time-optimal", standing, flying), model


def fly_champion(
    track: Track, model: ModelParameters | None
) -> tuple[np.ndarray, np.ndarray, ModelParameters]:
    """Return states (T, 21), commands (T, 4) and model of a flight of the shipped champion.

    Args:
        model: the champion's own if None.

    Raises:
        ImportError: without the extra [train].
    """
    import baselines.purejaxrl_ppo as baseline  # needs the extra
    from baselines.purejaxrl_ppo.flights import fly_episode

    champion = baseline.load_checkpoint("champion")
    model = model or model_from_json(champion.meta["model"], "checkpoint: model")
    env = make(champion.env_id, track=track, model=model)
    params = still_start(env.default_params, MAX_STEPS)
    flight = fly_episode(env, champion.policy, jax.random.key(0), params, MAX_STEPS, NUM_LAPS)
    states, commands = flight.flown()
    return states.astype(float), commands, model


def cut_laps(states: np.ndarray, track: Track) -> list[GhostLap]:
    """Return the complete laps of a flight from the start pose, states (T, 21) at 100 Hz."""
    passes = follow_race(states[:, POSITION], track, 0, states[-1, VELOCITY]).passes
    times_s = np.array([0.0, *(one.time_s for one in passes)])
    laps, num_gates = [], len(track.gates)
    for first in range(0, len(passes) - num_gates + 1, num_gates):
        begin_s, gates_s = times_s[first], times_s[first + 1 : first + num_gates + 1]
        row, end = int(begin_s / STEP_S), int(gates_s[-1] / STEP_S) + 2
        laps.append(_lap(states[row:end], row * STEP_S - begin_s, gates_s - begin_s))
    return laps
