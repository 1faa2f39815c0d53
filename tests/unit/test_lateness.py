"""Late poses: residuals of what was logged, and how late poses are, on motion made apart from the replay."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.motion import Motion
from flytrack_sysid import sensors
from flytrack_sysid.diagnosis import motion_choice
from flytrack_sysid.diagnosis.lanes import NUM_AXES, make_lanes
from flytrack_sysid.diagnosis.lateness import judged_as_logged, read_poses
from flytrack_sysid.diagnosis.motion_choice import Moves, how_it_moves
from flytrack_sysid.diagnosis.sensor_clocks import on_one_clock, with_causal_commands
from flytrack_sysid.log import FlightLog
from tests.support.handout_plant import GRAVITY, HandoutPlant, excited
from tests.support.made_flight import TIME_S, flight, noisy

LATE_S, TAU = 0.013, np.full(4, 0.03)
STEPS = 2.4  # by which the plant's poses are late


def changes(log: FlightLog) -> np.ndarray:
    """Return turns, rad, and changes of velocity, m/s, since the row before, world frame, (num_rows, 6)."""
    quat = Rotation.from_quat(log["q"], scalar_first=True)
    turns = (quat[1:] * quat[:-1].inv()).as_rotvec()
    return np.pad(np.concatenate([turns, np.diff(log["v"], axis=0)], axis=1), ((1, 0), (0, 0)))


@pytest.mark.parametrize("motion", [Motion.CONTINUOUS, Motion.HANDOUT])
def test_a_perfect_model_leaves_the_noise_of_the_poses_as_logged(motion: Motion) -> None:
    """Interpolation, which smooths the corrected poses, leaves no trace."""
    truth, late = flight(TIME_S), flight(TIME_S, LATE_S, LATE_S, LATE_S)
    logged = noisy(late, seed=1)
    corrected, is_known = read_poses(logged, LATE_S)
    corrected = corrected.select(is_known)
    lanes = make_lanes(corrected, np.ones(len(corrected), bool), TAU, GRAVITY)
    lanes, found = judged_as_logged(lanes, corrected, logged, LATE_S, motion)
    left = np.zeros((1, *lanes.row.shape, NUM_AXES, 2))
    left[0, ..., :6, 1] = (changes(corrected) - changes(truth)[: len(corrected)])[lanes.row]
    counts = lanes.counts[..., :6, 1].all(axis=-1)
    counts[-1] = False  # its next row is that of no lane
    expected = (changes(logged) - changes(late))[np.minimum(lanes.row + 1, len(logged) - 1)]
    off = (found.residuals(left)[0, ..., :6, 1] - expected)[counts]
    assert counts.sum() > 1500 and np.all(off.std(axis=0) < 0.01 * expected[counts].std(axis=0))


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
def test_poses_that_seem_early_are_on_time(monkeypatch) -> None:
    """Where the correlation says late, their lateness is fitted down to none and no further."""
    plant, wrong_s, half_step_s = HandoutPlant(), 0.0017, 0.005
    early = late_poses(excited(plant), steps=-0.05)
    log = sensors.measure(early, 1.0, GRAVITY, np.random.default_rng(1))
    says = wrong_s - half_step_s, 3e-4, 1.0, ""
    monkeypatch.setattr(motion_choice, "offset_between", lambda *_: says)
    with jax.enable_x64(True):
        found = how_it_moves(log, plant.model(), np.ones(len(log), bool), Motion.HANDOUT)
    assert found == Moves(Motion.HANDOUT)


@pytest.mark.slow
def test_a_drone_on_time_is_no_simulator_however_little_the_model_explains() -> None:
    """Commands that have nothing to do with the motion stand for a rate loop that the model lacks."""
    log = noisy(flight(TIME_S), seed=1)
    with jax.enable_x64(True):
        assert how_it_moves(log, HandoutPlant().model(), np.ones(len(log), bool)) == Moves(Motion.CONTINUOUS)
