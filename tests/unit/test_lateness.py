"""Late poses: how late they are, and clocks that disagree, on motion made apart from the replay."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from flytrack_env.motion import Motion
from flytrack_sysid import sensors
from flytrack_sysid.clocks import on_one_clock, with_causal_commands
from flytrack_sysid.diagnosis.motion_choice import Moves, how_it_moves
from flytrack_sysid.log import FlightLog
from tests.support.handout_plant import GRAVITY, HandoutPlant, excited
from tests.support.made_flight import TIME_S, flight, noisy

LATE_S = 0.013
STEPS = 2.4  # by which the plant's poses are late


def test_velocity_and_position_come_on_the_clock_of_the_attitude() -> None:
    truth = flight(TIME_S, LATE_S, LATE_S, LATE_S)
    for late_s in (0.0, 0.02):
        logged = noisy(flight(TIME_S, LATE_S, LATE_S + late_s, LATE_S + late_s), seed=1)
        found, is_kept, notes = on_one_clock(logged)
        assert len(found) == is_kept.sum() and len(notes) == 2 * (late_s > 0.0), notes
        for name, bound in (("v", 0.03), ("p", 0.01)):
            assert np.sqrt(np.mean((found[name] - truth[name][is_kept]) ** 2)) < bound, name


def test_commands_stamped_after_the_turns_they_cause_are_put_before_them() -> None:
    plant = HandoutPlant()
    truth = sensors.measure(excited(plant), 1.0, GRAVITY, np.random.default_rng(2))
    for rows in (0, 3, 20):  # of which 3 are less than the plant's lag
        starts = np.cumsum(truth.is_start())
        source = np.maximum(np.arange(len(truth)) - rows, np.searchsorted(starts, starts))
        late = replace(truth, channels={**truth.channels, "u": truth["u"][source]})
        found, is_kept, notes = with_causal_commands(late, plant.model())
        assert len(found) == is_kept.sum() and len(notes) == (rows == 20)
        if notes:
            assert "the clock of the commands was about" in notes[0]
            off = [
                np.abs(found["u"] - np.roll(truth["u"], -by, axis=0)[is_kept]).mean() for by in range(-4, 5)
            ]
            assert min(off) < 0.1 * np.abs(found["u"]).mean()


def late_poses(log: FlightLog, steps: float = STEPS) -> FlightLog:
    """Return a log whose poses are late, linear between rows, without the first rows of each flight."""
    kept = np.ones(len(log), bool)
    channels = {name: np.array(values) for name, values in log.channels.items()}
    for number in np.unique(log.segment):
        rows = np.flatnonzero(log.segment == number)
        at = np.arange(len(rows), dtype=float)
        for name in "pvq":
            columns = [np.interp(at - steps, at, column) for column in log[name][rows].T]
            channels[name][rows] = np.stack(columns, axis=1)
        kept[rows[:5]] = False
    channels["q"] /= np.linalg.norm(channels["q"], axis=1, keepdims=True)
    return replace(log, channels=channels).select(kept)


def test_lateness_is_found_where_there_is_one() -> None:
    plant = HandoutPlant()
    truth = excited(plant)

    def found(log: FlightLog) -> Moves:
        log = sensors.measure(log, 1.0, GRAVITY, np.random.default_rng(2))
        with jax.enable_x64(True):
            return how_it_moves(log, plant.model(), np.ones(len(log), bool), Motion.HANDOUT)

    late = found(late_poses(truth))
    assert 0.0 < late.sigma_s < 1e-3 and abs(late.late_s - 0.01 * STEPS) < 4.0 * late.sigma_s
    assert found(truth) == Moves(Motion.HANDOUT)


@pytest.mark.slow
def test_a_drone_on_time_is_no_simulator_however_little_the_model_explains() -> None:
    """Commands that have nothing to do with the motion stand for a rate loop that the model lacks."""
    log = noisy(flight(TIME_S), seed=1)
    with jax.enable_x64(True):
        assert how_it_moves(log, HandoutPlant().model(), np.ones(len(log), bool)) == Moves(Motion.CONTINUOUS)
