"""Betaflight in the loop: built once, then flown, logged, configured and broken."""

import os
import signal
from functools import partial

import jax
import numpy as np
import pytest

pytest.importorskip("firmware", reason="firmware/ is in clones only")

import flytrack_env
from firmware import Betaflight, Body, FirmwareError, build
from firmware.cli import check
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import BetaflightLoop, effect_of
from flytrack_env.plants import Simulator
from flytrack_env.state import ACCELERATION, BATTERY, RATES, Action, pack, unpack, unpack_action
from flytrack_sysid import CollectError, collect, diagnose_change, import_log
from flytrack_sysid.excitation import script, start_state
from flytrack_sysid.manoeuvres import hover_action
from flytrack_sysid.script_file import build_script
from tests.support.pages import DOCS, run_examples
from tests.support.simulated_flights import flown_by

pytestmark = [pytest.mark.slow, pytest.mark.firmware]

MODEL = nominal_parameters()
SETTLE_S = 0.7  # from arming to the first row of a log, and some more


@pytest.fixture(scope="module", autouse=True)
def _is_built():
    try:
        build(lambda line: None)
    except FirmwareError as error:
        pytest.skip(f"the firmware cannot be built here: {error}")


@pytest.fixture(scope="module")
def plant():
    """The stock firmware on the default body."""
    with Betaflight() as flown:
        yield flown


def starts(number=3, volts=23.0):
    rng = np.random.default_rng(0)
    rows = [
        start_state(rng, volts, -0.2, tilt_deg=20.0 * row, speed=2.0 * row) for row in range(number)
    ]
    return np.array(rows, np.float32)


def sticks(number=3, steps=80):
    rng = np.random.default_rng(1)
    return np.repeat(rng.uniform(-1, 1, (number, steps // 8, 4)), 8, axis=1).astype(np.float32)


def fly_compiled(plant, rows, commands, model=MODEL):
    """Return the states (number, steps, 21) after each command, by the plant's own steps."""
    return np.asarray(jax.jit(jax.vmap(partial(flown_by, plant, model)))(rows, commands))


def test_same_flights_alone_among_others_again_and_of_another_plant(plant):
    rows, commands = starts(), sticks()
    first = plant.fly(rows, commands)
    assert np.isfinite(first).all() and np.abs(first[..., RATES]).max() > 5.0
    np.testing.assert_array_equal(fly_compiled(plant, rows, commands), first)
    np.testing.assert_array_equal(plant.fly(rows[1:2], commands[1:2])[0], first[1])
    with Betaflight() as other:
        np.testing.assert_array_equal(other.fly(rows[::-1], commands[::-1])[::-1], first)


def test_noise_of_the_gyro_is_of_the_seed_and_filtered():
    body, rows, commands = Body(gyro_noise=0.05), starts(2), np.zeros((2, 40, 4), np.float32)
    flown = []
    for seed in (0, 0, 1):
        with Betaflight(body=body, seed=seed) as plant:
            flown.append(plant.fly(rows, commands))
    np.testing.assert_array_equal(flown[0], flown[1])
    difference = np.abs(flown[0] - flown[2])[..., RATES]
    assert 0.0 < difference.max() < 0.5


def test_sick_motors_sag_and_settings_show():
    sick = Body(health=(0.9, 1.0, 1.0, 1.0), resistance_ohm=0.02, full_current_a=80.0)
    rows, commands = (
        starts(1, volts=24.0),
        np.tile([[[0.0, 0.0, 0.0, 1.0]]], (1, 60, 1)).astype(np.float32),
    )
    with (
        Betaflight({"motor_output_limit": 80}, sick) as limited,
        Betaflight(body=Body()) as healthy,
    ):
        weak, strong = limited.fly(rows, commands)[0], healthy.fly(rows, commands)[0]
    assert weak[-1, ACCELERATION][2] < 0.8 * strong[-1, ACCELERATION][2]
    assert strong[-1, BATTERY] - weak[-1, BATTERY] == pytest.approx(0.02 * 80 * 0.8**3, rel=0.15)


@pytest.mark.parametrize(
    ("rates_type", "rc_rate", "rate", "expo"),
    [("ACTUAL", 7, 67, 30), ("BETAFLIGHT", 100, 70, 40), ("QUICK", 90, 67, 30)],
)
def test_a_held_stick_turns_as_the_models_curve_says(rates_type, rc_rate, rate, expo):
    rates = {
        "rates_type": rates_type,
        "roll_rc_rate": rc_rate,
        "roll_srate": rate,
        "roll_expo": expo,
    }
    held = np.zeros((3, 60, 4), np.float32)
    held[:, :, 0] = np.array([[0.3], [-0.6], [0.9]])
    with Betaflight(rates) as curved:
        model, flown = curved.nominal_model(), curved.fly(starts(3), held)
    curve = model.effects[0]
    bent = [
        effect_of(curve).hooks["command"](curve, None, Action(*u), None).roll for u in held[:, 0]
    ]
    expected = np.deg2rad(model.max_rate[0]) * np.array(bent)
    np.testing.assert_allclose(
        flown[:, 40:, RATES][..., 0].mean(axis=1), expected, rtol=0.01, atol=0.01
    )


def test_settings_are_read_back():
    dump = "feature -AIRMODE\nprofile 1\nset p_roll = 60\nrateprofile 2\nset rates_type = ACTUAL\n"
    expected = {"p_roll": "60", "roll_srate": "80", "feature AIRMODE": "OFF", "nonsense": ""}
    with Betaflight(dump + "set roll_srate = 80\n") as plant:
        assert {name: plant.value(name) for name in expected} == expected
        assert plant.full_stick_deg_s[0] == 800.0
        values = plant.firmware.values
    lines = [
        f"set {name} = {value}"
        for (scope, _, name), value in values.items()
        if scope == "master" and " " not in name and "profile" not in name
    ]
    with Betaflight("\n".join(lines)) as again:  # names and values that the firmware itself has
        assert len(lines) > 200 and again.value("p_roll") == "45"


def test_refused_settings_are_named():
    wrong = {"p_rol": 60, "roll_srate": 10_000, "feature wings": True}
    with pytest.raises(FirmwareError, match="refused roll_srate, p_rol, feature WINGS; skip="):
        Betaflight({**wrong, "p_pitch": 50})
    with Betaflight({"p_rol": 60, "p_pitch": 50}, skip=["p_ro*"]) as plant:
        assert plant.value("p_pitch") == "50"


def test_collected_log_and_blackbox_are_the_same_flight(tmp_path):
    pytest.importorskip(
        "orangebox", reason="orangebox is not installed: pip install 'flytrack[logs]'"
    )
    body = Body(drain_v_per_min=5.0)
    with Betaflight({"blackbox_high_resolution": True}, body, blackbox=tmp_path / "box") as plant:
        log = collect(plant, minutes=1.0, seed=0)
        directory = plant.firmware.folder
    assert not directory.exists() and len(log) > 4000
    boxes = sorted((tmp_path / "box").iterdir())
    assert len(boxes) == 24  # of the excitation; the search for hover is too short
    (tmp_path / "all.toml").write_text("[rows]\nevery = 1\n")
    box = import_log(boxes[0], "betaflight", tmp_path / "all.toml").log
    flown = log.select(log.segment == 0)

    def seen(channel, shift_s):
        time = flown.time + shift_s
        return np.stack([np.interp(time, box.time, column) for column in box[channel].T], axis=1)

    # The firmware's log begins where its header is written, while the craft is held and settles.
    shifts_s = np.arange(0.0, SETTLE_S, 0.0005)
    errors = [np.sqrt(np.mean((seen("w", shift_s) - flown["w"]) ** 2)) for shift_s in shifts_s]
    assert min(errors) < 0.05  # rad/s, at up to 10
    shift_s = shifts_s[int(np.argmin(errors))]
    wrong = np.abs(seen("u", shift_s + 0.005) - flown["u"])
    assert np.median(wrong) < 0.02 and np.median(wrong[:, 3]) < 0.01
    np.testing.assert_allclose(seen("v_bat", shift_s), flown["v_bat"], atol=0.03)


def test_environment_flies_it_and_goes_back_no_further_than_a_step(plant):
    env = flytrack_env.make("FlyTrack-v0", plant=plant)
    params, key = env.default_params, jax.random.key(0)
    _, state = env.reset(key, params)
    act = np.zeros(4, np.float32)
    states = [state]
    for _ in range(3):
        states.append(env.step_env(None, states[-1], act, params)[1])
    again = env.step_env(None, states[2], act, params)[1]
    np.testing.assert_array_equal(pack(env.drone(again)), pack(env.drone(states[3])))
    with Betaflight() as other:
        never_begun = other.reset(unpack(starts(1)[0]), MODEL)._replace(flight=np.int32(7))
        lost = other.step(never_begun, unpack_action(act), 0.01, MODEL)
        assert np.isnan(pack(lost.drone)).all()
        with pytest.raises(FirmwareError, match="flight 7 has ended"):
            other.check_alive()


def test_a_process_that_dies_or_hangs_is_one_sentence_and_nothing_is_left(monkeypatch):
    monkeypatch.setattr("firmware.process.MAX_ANSWER_S", 2.0)
    arguments = unpack_action(np.zeros(4)), 0.01, MODEL
    blows = {signal.SIGKILL: "has ended by itself", signal.SIGSTOP: "did not answer within 2 s"}
    for blow, said in blows.items():
        with Betaflight() as plant:
            state = plant.step(plant.reset(unpack(starts(1)[0]), MODEL), *arguments)
            os.kill(plant._flights[int(state.flight)].link.pid, blow)
            after = plant.step(state, *arguments)
            assert np.isnan(pack(after.drone)).all()
            with pytest.raises(CollectError, match=f"the process of a flight {said}"):
                collect(plant, minutes=1.0)
            assert plant.firmware.process is None and not plant.firmware.folder.exists()


def test_craft_that_cannot_arm_says_why():
    said = r"it does not arm: .*THROTTLE"
    with pytest.raises(FirmwareError, match=said), Betaflight({"min_check": 900}) as plant:
        plant.fly(starts(1), sticks(1))


def test_page_runs_and_check_is_repeatable(tmp_path, monkeypatch):
    pytest.importorskip(
        "orangebox", reason="orangebox is not installed: pip install 'flytrack[logs]'"
    )
    assert "the same twice" in check()
    names = run_examples((DOCS / "firmware.md").read_text(encoding="utf-8"), tmp_path, monkeypatch)
    assert len(names["log"]) > 3000 and len(names["flown"]) > 200


def known_model(plant):
    """Return the model of the default body: its own numbers, and its thrust curve about 23 V."""
    body, model = plant.body, plant.nominal_model()
    craft = (body.arm_m[1] / body.inertia[0], body.arm_m[0] / body.inertia[1])
    turn = (body.torque_m / body.inertia[2], body.rotor_inertia / body.inertia[2], body.lag_up_s)
    loop = model.effect("betaflight_loop")._replace(
        **dict(zip(BetaflightLoop._fields[:5], (*craft, *turn), strict=True)),
        precession=0.0025 / 0.0035,
    )
    factor = (23.0 / body.full_v) ** body.volt_exponent
    per_volt = body.volt_exponent * factor / 23.0
    most, at_rest = 4.0 * body.max_thrust_n, factor - 23.0 * per_volt
    bend = np.array(
        [0.5275**2, 2.0 * 0.5275 * 0.4725, 0.4725**2]
    )  # of the square of the motors' command
    coeffs = most * np.array([*(at_rest * bend[:2]), factor * bend[2], 0.0, *(per_volt * bend[:2])])
    return model._replace(thrust_coeffs=coeffs).with_effects(loop)


def test_loop_with_the_numbers_of_the_body_flies_as_the_firmware_does(plant):
    model = known_model(plant)
    flown = build_script(script(24, hover_action(nominal_parameters()), np.random.default_rng(3)))
    expected = plant.fly(flown.starts, flown.commands)
    found = fly_compiled(Simulator(), flown.starts, flown.commands, model)
    off = np.sqrt(np.mean((found - expected) ** 2, axis=(0, 1))) / expected.std(axis=(0, 1))
    assert off[RATES].max() < 0.04 and off[ACCELERATION].max() < 0.08  # measured 0.03, 0.05
    away = np.linalg.norm((found - expected)[:, 99, :3], axis=-1)
    assert np.median(away) < 0.02  # m after a second; measured 0.012


def test_what_was_changed_is_named_and_a_matched_set_up_has_no_name():
    weak = Body(health=(1.0, 0.85, 1.0, 1.0))
    logs = []
    for number, body in enumerate((Body(), Body(), weak)):
        with Betaflight(body=body) as flown:
            log = collect(flown, 1.0, number, 1.0)
            logs.append(log.select(log.segment % 3 == 0))  # enough to tell
            model = known_model(flown)
    before, same, changed = logs
    assert diagnose_change(same, before, model, motion=model.motion).causes == ()
    (cause,) = diagnose_change(changed, before, model, motion=model.motion).causes
    assert cause.effect == "betaflight_loop"
    assert cause.parameters["front_right"].value == pytest.approx(0.85, abs=0.03)
