"""The controller between sticks and motors, of a PID loop in NumPy that shares no code with it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from flytrack_env import nominal_parameters
from flytrack_sysid.diagnosis.controller import (
    compare_controllers,
    controller_notes,
    examine_controller,
)
from flytrack_sysid.diagnosis.report import describe_side
from flytrack_sysid.log import FlightLog
from flytrack_sysid.split import held_out_rows
from tests.support.motor_models import crafts, model_of
from tests.support.written_logs import through_file, with_channels

STEP_S, SECONDS = 2e-3, 20.0
FULL_STICK = np.deg2rad([700.0, 600.0, 400.0])  # rad/s
# A command per rad/s, rad, rad/s^2, and per 1/s of a stick.
GAIN, INTEGRAL, DERIVATIVE, FEEDFORWARD = 0.12, 0.9, 0.0015, 0.0008
PER_100_DEG = 50.0 * np.deg2rad(100.0)  # in per cent of the motors' range
STICK_S, GYRO_S, LAG_S = 0.008, 0.004, 0.03
PUSH = np.array([900.0, 800.0, 500.0])  # rad/s^2 per command
# Rear right, front right, rear left, front left: roll to the right, pitch down, yaw to the left.
MIX = np.array([[-1, 1, 1], [-1, -1, -1], [1, 1, -1], [1, -1, 1]])


def fly(full_stick=FULL_STICK, seed=0, sense=1.0):
    """Return the log of a PID controller that turns a body, logged each 2 ms."""
    rng = np.random.default_rng(seed)
    count = round(SECONDS / STEP_S)
    sticks = gaussian_filter1d(rng.standard_normal((count, 4)), 0.06 / STEP_S, axis=0)
    sticks *= 0.25 / sticks.std(axis=0)
    gusts = gaussian_filter1d(rng.standard_normal((count, 3)), 0.02 / STEP_S, axis=0)
    gusts *= 10.0 / gusts.std()
    slopes = np.gradient(sticks[:, :3], STEP_S, axis=0)
    late_stick, late_gyro = round(STICK_S / STEP_S), round(GYRO_S / STEP_S)
    rates, shares = np.zeros((count + 1, 3)), np.zeros((count, 3))
    integral, acting = np.zeros(3), np.zeros(3)
    for row in range(count):
        stick, slope = (values[max(row - late_stick, 0)] for values in (sticks[:, :3], slopes))
        now, before = rates[max(row - late_gyro, 0)], rates[max(row - late_gyro - 1, 0)]
        error = full_stick * stick - now
        integral = integral + error * STEP_S
        shares[row] = GAIN * error + INTEGRAL * integral + FEEDFORWARD * slope
        shares[row] -= DERIVATIVE * (now - before) / STEP_S
        acting = acting + (sense * shares[row] - acting) * STEP_S / LAG_S
        rates[row + 1] = rates[row] + (PUSH * acting + gusts[row]) * STEP_S
    motors = shares @ MIX.T - 0.2
    return FlightLog(
        time=np.arange(count) * STEP_S,
        channels={"u": motors, "w": rates[:-1], "sticks": sticks},
        segment=np.zeros(count, int),
        has_motors=True,
    )


def examined(log, stated_deg_s=(700.0, 600.0, 400.0)):
    model = model_of(crafts())._replace(max_rate=np.array(stated_deg_s))
    return examine_controller(log, model, held_out_rows(log))


def notes_on(log):
    return controller_notes(log, held_out_rows(log))


@pytest.fixture(scope="module")
def log():
    return fly()


def test_the_settings_of_a_controller_are_found_and_nothing_is_wrong(log, tmp_path):
    controller = examined(through_file(log, tmp_path / "log.npz"))
    assert controller.faults == ()
    assert [loop.axis for loop in controller.loops] == ["roll", "pitch", "yaw"]
    for loop, full_stick in zip(controller.loops, FULL_STICK, strict=True):
        assert loop.explained > 0.99
        assert loop.full_stick.value == pytest.approx(np.rad2deg(full_stick), rel=0.04)
        assert loop.gain.value == pytest.approx(GAIN * PER_100_DEG, rel=0.05)
        assert loop.integral.value == pytest.approx(INTEGRAL / GAIN, rel=0.1)
        # To first order, a longer delay is as much more of the derivative and the feedforward.
        lead_s = loop.derivative.value - loop.gyro_delay_s
        assert lead_s == pytest.approx(DERIVATIVE / GAIN - GYRO_S, abs=1e-3)
        stick_lead_s = loop.feedforward.value - loop.stick_delay_s
        assert stick_lead_s == pytest.approx(FEEDFORWARD / GAIN / full_stick - STICK_S, abs=1e-3)
        assert loop.gyro_delay_s == pytest.approx(GYRO_S, abs=4.5e-3)


def test_other_rates_at_full_stick_are_a_fault_of_the_controller(log):
    (fault,) = examined(log, (700.0, 900.0, 400.0)).faults
    assert fault.startswith("pitch: full stick asks for 58") and fault.endswith("expected 900")
    # A model that nobody stated rates for has the nominal ones.
    nominal_deg_s = np.asarray(nominal_parameters().max_rate, float)
    assert examined(log, nominal_deg_s).faults == ()


def test_a_change_since_an_earlier_log_is_a_fault_where_both_show_the_axis(log):
    before = examined(log)
    assert compare_controllers(before, before) == (before, [])
    slower, notes = compare_controllers(examined(fly(FULL_STICK * [1.0, 1.0, 0.6], 1)), before)
    (fault,) = slower.faults
    assert fault.startswith("yaw: full stick asks for 24") and notes == []
    assert compare_controllers(None, before) == (None, [])
    none, (note,) = compare_controllers(before, None)
    assert none is None and note.startswith("controller: roll, pitch, yaw: not compared")


def test_motors_that_push_a_turn_on_are_a_fault(log):
    against = examined(replace(log, channels={**log.channels, "u": -0.4 - log["u"]}))
    for faults in (against.faults, compare_controllers(against, examined(log))[0].faults):
        assert [fault.partition(":")[0] for fault in faults] == ["roll", "pitch", "yaw"]
        assert all("push a turn on" in fault for fault in faults)


@pytest.mark.parametrize("are_segments", [True, False])
def test_pieces_of_a_flight_show_the_same_loop(log, are_segments):
    """Flights of 3 s with a second between."""
    piece, second = np.divmod(log.time, 4.0)
    pieces = replace(log, segment=(are_segments * piece).astype(int))
    controller = examined(pieces.select(second < 3.0))
    assert controller.faults == ()
    for loop, full_stick in zip(controller.loops, FULL_STICK, strict=True):
        assert loop.gain.value == pytest.approx(GAIN * PER_100_DEG, rel=0.1)
        assert loop.full_stick.value == pytest.approx(np.rad2deg(full_stick), rel=0.05)


def test_a_log_without_sticks_or_of_few_rows_a_second_shows_no_controller(log):
    assert examined(log.without("sticks")) is None
    assert notes_on(log) == [] and notes_on(log.without("sticks")) == []
    row = np.arange(len(log))
    held = {name: log[name][row - row % 5] for name in ("u", "sticks")}
    cases = {
        "found a row each 10 ms, expected 5 ms": log.select(row % 5 == 0),
        "found other motors each 10 ms": with_channels(log, u=held["u"]),
        "found other sticks each 10 ms": with_channels(log, sticks=held["sticks"]),
        "found steps of 0.002 to 0.004 s, expected equal": replace(
            log, segment=row // 5000, time=np.where(row < 5000, 1.0, 2.0) * log.time
        ),
        "found fewer than 8 blocks of 1 s": log.select(row < 2000),
    }
    for message, case in cases.items():
        (note,) = notes_on(case)
        assert message in note and examined(case) is None


@pytest.mark.parametrize("channel", ["sticks", "w"])
def test_an_axis_that_does_not_move_is_not_examined(log, channel):
    still = log[channel].copy()
    still[:, 1] = 0.1
    controller = examined(with_channels(log, **{channel: still}))
    assert [loop.axis for loop in controller.loops] == ["roll", "yaw"]
    text = describe_side(SimpleNamespace(verdict="consistent", controller=controller))
    assert text.endswith("wrong: neither. Of the controller, only roll and yaw showed.")
