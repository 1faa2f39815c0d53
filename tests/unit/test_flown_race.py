"""The race that a recorded flight flew: the environment's own counts, times, laps and end."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flytrack_env import FlyTrack, load_track
from flytrack_env.flown_race import follow_race, why_ended
from flytrack_env.plants import Plant
from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.state import BATTERY, POSITION, VELOCITY, Action, pack, unpack
from tests.support.coasting import drone_at, track_of_row
from tests.support.tables import table

TRACK = load_track("flytrack")
REFERENCES = shipped_references(TRACK, ("nominal",))
NUM_STATES = 900  # of flights in the environment: one shape, compiled once


class Recorded(Plant):
    """A plant that moves the drone along recorded states (T, 21), whatever is commanded."""

    def __init__(self, states):
        self.states = states

    def reset(self, drone, model):
        return jnp.int32(0)

    def step(self, state, command, dt, model):
        return state + 1

    def drone(self, state):
        return unpack(self.states[state])


@jax.jit
def races_and_causes(states):
    """Return the environment's first race, its races and its causes after each step."""
    env = FlyTrack(plant=Recorded(states), missed_gate="fly_on")
    params = env.default_params
    begun = env.begin(unpack(states[0]), 0, params)

    def advance(state, _):
        after, _, causes, events = env.transition(state, Action(0.0, 0.0, 0.0, 0.0), params)
        return after, (after.race, causes._replace(missed_gate=events.is_miss))

    return begun.race, *jax.lax.scan(advance, begun, None, len(states) - 1)[1]


def fly_recorded(states):
    """Return the environment's races at each state and its causes after each step."""
    first, races, causes = races_and_causes(jnp.asarray(states, jnp.float32))
    return jax.tree.map(lambda a, b: np.append(a, b), first, races), jax.device_get(causes)


@pytest.mark.parametrize("shift", [0.9, 2.0])
def test_race_is_the_environments_number_by_number(shift):
    """Flown aside by up to 2 m: gates are passed, touched and missed."""
    states, _ = ghost_rollout(REFERENCES, NUM_STATES)
    states[:, POSITION] += np.linspace(0.0, 1.0, NUM_STATES)[:, None] * (0.0, shift, 0.0)
    race = follow_race(states[:, POSITION], TRACK, first_gate=0)
    races, _ = fly_recorded(states)
    assert_array_equal(race.gate, races.gate_index)
    assert_array_equal(race.laps, races.laps)
    assert_allclose(race.lap_time_s, races.lap_time_s, atol=1e-5)
    assert_allclose(race.lap_start_s, races.lap_start_s, atol=1e-5)
    centres = np.stack(races.gate.centre, axis=-1)
    distance = np.linalg.norm(states[:, POSITION] - centres, axis=1)
    assert_allclose(race.gate_distance_m, distance, rtol=1e-5)
    assert len(race.passes) == races.gates_passed[-1]
    assert shift < 2.0 or len(race.passes) < 17  # the ghost's, which flies on


def test_step_after_the_last_state_is_extrapolated():
    """A rollout of complete laps ends before the step that completes the last one."""
    states, _ = ghost_rollout(REFERENCES, 900)
    whole = follow_race(states[:, POSITION], TRACK)
    lap = whole.passes[7]
    cut = states[: lap.row]
    without = follow_race(cut[:, POSITION], TRACK)
    extrapolated = follow_race(cut[:, POSITION], TRACK, last_vel_w=cut[-1, VELOCITY])
    assert len(without.passes) == 7 and len(extrapolated.passes) == 8
    assert extrapolated.passes[7].row == len(cut) and extrapolated.passes[7].lap == 1
    assert extrapolated.passes[7].lap_time_s == pytest.approx(
        REFERENCES["standing"].time_s, abs=2e-4
    )
    for field, expected in zip(extrapolated[:5], without[:5], strict=True):
        assert_array_equal(field, expected)


ENDS = table("flown_ends")


def race_and_end(states, track=TRACK):
    """Return the race of a flight and why it ended."""
    race = follow_race(states[:, POSITION], track, last_vel_w=states[-1, VELOCITY])
    return race, why_ended(states, track, race)


@pytest.mark.parametrize("end", ENDS)
def test_end_is_the_environments(end):
    """The last state before the environment ends a flight shows why."""
    (start, velocity), (states, _) = ENDS[end], ghost_rollout(REFERENCES, NUM_STATES)
    states[:, VELOCITY] = velocity
    states[:, POSITION] = start + 0.01 * np.arange(NUM_STATES)[:, None] * np.array(velocity)
    _, causes = fly_recorded(states)
    last = int(np.argmax(np.any(list(causes), axis=0)))
    names = [
        name.replace("_", " ") for name, happened in causes._asdict().items() if happened[last]
    ]
    assert names == [end]
    assert race_and_end(states[: last + 1])[1] == end


def test_first_gate_is_the_tracks_near_its_start_else_the_one_passed_first():
    states, _ = ghost_rollout(REFERENCES, 900)
    later = follow_race(states[200:, POSITION], TRACK)
    assert [gate_pass.gate for gate_pass in later.passes[:3]] == [4, 5, 6] and later.gate[0] == 4
    missed = states[:388].copy()  # past gate 0 and on through all others: that lap has not begun
    near = np.abs(missed[:, POSITION] - TRACK.gates[0].position).max(axis=1) < 4.0
    missed[near, 1] += 4.0
    race = follow_race(missed[:, POSITION], TRACK)
    assert race.passes == () and race.is_miss.sum() == 1 and set(race.gate) == {0}


@pytest.mark.parametrize(
    ("shift_m", "end"), [(0.0, "all steps flown"), (1.0, "crash"), (3.0, "missed gate")]
)
def test_two_gates_in_one_step_each_have_their_time_and_end(shift_m, end):
    row = track_of_row([2.0, 2.1, 20.0])  # the second gate is close behind the first, and aside
    aside = replace(row.gates[1], position=(2.1, shift_m, 2.0))
    track = replace(row, gates=(row.gates[0], aside, row.gates[2]))
    states = np.tile(pack(drone_at((0.0, 0.0, 2.0), (20.0, 0.0, 0.0))), (10, 1))
    states[:, 0] = 0.15 + 0.2 * np.arange(10)
    race, actual_end = race_and_end(states, track)
    assert actual_end == end
    num_passed = 1 + (shift_m == 0.0)
    passed = [(gate_pass.time_s, gate_pass.pos_w[0]) for gate_pass in race.passes]
    assert_allclose(passed, [(0.0925, 2.0), (0.0975, 2.1)][:num_passed], atol=1e-5)


def test_flight_that_goes_on_ended_when_its_steps_did():
    states, _ = ghost_rollout(REFERENCES, 100)
    assert race_and_end(states)[1] == "all steps flown"
    states[-1, BATTERY] = 21.9
    assert race_and_end(states)[1] == "battery empty"
    states[:, BATTERY], states[:, VELOCITY] = 24.0, np.nan  # an unknown velocity ends nothing
    assert race_and_end(states)[1] == "all steps flown"
