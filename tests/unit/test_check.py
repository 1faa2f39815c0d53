"""The check of conventions: each changed channel is named, and right logs contradict nothing."""

import json
from dataclasses import replace
from itertools import product

import gymnasium
import numpy as np
import pytest

from benchmarks.check import compare
from benchmarks.seams.faults import FAULTS, Change, inject
from benchmarks.seams.simulators import SIMULATORS
from flytrack_bench.misspec import load_log_suite
from flytrack_env import blackbox
from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid import collect
from flytrack_sysid.check import (
    check_environment,
    check_log,
    check_plant,
    plant,
    problems_of,
    text_of,
    write_check,
)
from flytrack_sysid.check.frames import IDENTITY, number_of
from flytrack_sysid.check.pairs import AGREES, CONTRADICTS, MANOEUVRES, STILL, compare_pairs
from flytrack_sysid.check.samples import sample_changes
from flytrack_sysid.check.thrust import motor_changes, thrust_changes
from tests.support.compiling import programs
from tests.support.hidden_flights import scripted
from tests.support.made_flight import noisy
from tests.support.seam_flights import LENGTH_S, seam_flight
from tests.support.slow import slow_but
from tests.support.written_logs import held_still, with_channels

KINDS = ("race", "excitation", "gentle", "hover")
FRD, NED = "x -y -z", "y x -z"
CURVES = ("actual", "betaflight", "quick")


@pytest.fixture(scope="module")
def flights():
    """A flight of each kind."""
    return {kind: seam_flight(kind) for kind in KINDS}


@pytest.fixture(scope="module")
def checks(flights):
    """The checks of these flights."""
    return {kind: check_log(flight.log, None, flight.motors) for kind, flight in flights.items()}


@pytest.fixture(scope="module")
def turned_gyro(flights):
    """A race whose gyroscope is FRD, and its check."""
    log = changed(flights["race"], Change("w", "axes", FRD)).log
    return log, check_log(log)


def changed(flight, *changes):
    """Return a flight with changes of its log."""
    return inject(np.random.default_rng(1), flight, frozenset(changes))


def model_of(craft):
    """Return a model with a craft's lags and full rates."""
    return nominal_parameters()._replace(
        max_rate=np.array(craft.max_rate), tau=np.array(craft.lags)
    )


def verdicts(check):
    """Return the verdict on each pair."""
    return {pair.name: pair.verdict for pair in check.pairs}


# --- likelihoods ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def planar(truth):
    """Position and velocity of a motion along x and y, with noise."""
    flat = {name: truth[name] * [1.0, 1.0, 0.0] for name in ("p", "v")}
    log = noisy(with_channels(truth, u=0.0 * truth["u"], **flat), seed=3)
    return log.without("q", "w", "f", "v_bat")


def position_pair(log):
    """Return the pair of position and velocity, and the frames it allows."""
    pairs, edges = compare_pairs(log)
    return next(pair for pair in pairs if pair.name == "p and v"), edges.positions


def test_sign_of_an_axis_without_motion_is_unseen(planar):
    pair, is_allowed = position_pair(planar)
    assert (pair.verdict, pair.unseen) == (AGREES, ("z",))
    assert is_allowed[IDENTITY] and is_allowed[number_of(np.diag([1.0, 1.0, -1.0]))]
    assert sum(is_allowed) == 2


def test_without_any_motion_nothing_is_compared(planar):
    rng = np.random.default_rng(4)
    noise = {name: rng.normal(0.0, 0.005, planar[name].shape) for name in ("p", "v")}
    pair, is_allowed = position_pair(with_channels(planar, **noise))
    assert (pair.verdict, pair.unseen) == (STILL, ("x", "y", "z"))
    assert is_allowed.all()


def test_fault_of_half_a_log_is_no_convention(planar):
    is_first = np.arange(len(planar))[:, None] < len(planar) // 2
    log = with_channels(planar, v=np.where(is_first, -planar["v"], planar["v"]))
    pair, is_allowed = position_pair(log)
    assert pair.verdict != CONTRADICTS and is_allowed[IDENTITY]
    assert not check_log(log).contradicts


# --- explanations ---------------------------------------------------------------------------------


def test_channels_that_cannot_be_told_apart_are_alternatives(turned_gyro):
    log = turned_gyro[0].without("p", "v", "f", "v_bat")
    explanations = check_log(with_channels(log, u=0.0 * log["u"])).explanations
    assert set(explanations) == {(Change("q", "body", FRD),), (Change("w", "axes", FRD),)}


def test_mirror_images_are_listed_last(planar):
    """Without motion along z, a mirrored x axis may also be a half turn about y."""
    explanations = check_log(with_channels(planar, v=planar["v"] * [-1.0, 1.0, 1.0])).explanations
    values = [value for ((_, _, value),) in explanations]
    assert values == ["-x y -z", "-x y -z", "-x y z", "-x y z"]


# --- faults of flights ----------------------------------------------------------------------------

VALUES = {  # of faults that draw one of them
    **{f"q {order}": Change("q", "order", order) for order in ("xyzw", "zwxy")},
    **{f"q {world}": Change("q", "world", world) for world in (FRD, NED)},
    **{f"{curve} rates": Change("u_rates", "curve", curve) for curve in CURVES},
}
NUM_EXPLANATIONS = {"all NED and FRD": 2, **{f"{curve} rates": 3 for curve in CURVES}}
FAST = (
    "w in deg/s",
    "v swapped",
    "q conjugate",
    "q zwxy",
    "u delay",
    "q delay",
    "w held",
    "v_bat rises",
    "all NED and FRD",
    "quick rates",
)
SLOW = (
    "v in km/h",
    "w sign",
    "f frame",
    "u_rates frame",
    "v delay",
    "q body",
    "rows repeated",
    *(fault for fault in VALUES if fault not in FAST),
)


@pytest.mark.parametrize("fault", slow_but(FAST, FAST + SLOW))
def test_fault_gives_its_change_and_no_other(flights, fault):
    race, rng = flights["race"], np.random.default_rng(0)
    truth = {VALUES[fault]} if fault in VALUES else FAULTS[fault](rng, 0.01)
    faulty = changed(race, *truth)
    check = check_log(faulty.log, model_of(race.craft), faulty.motors)
    assert 1 <= len(check.explanations) <= NUM_EXPLANATIONS.get(fault, 1)
    assert compare(check, truth)["outcome"] == "exact", check.explanations


def test_two_faults_give_both_changes(flights):
    rng = np.random.default_rng(2)
    truth = FAULTS["q order"](rng, 0.01) | FAULTS["u_rates sign"](rng, 0.01)
    check = check_log(changed(flights["race"], *truth).log)
    assert len(truth) == 2 and len(check.explanations) == 1
    assert compare(check, truth)["outcome"] == "exact"


@pytest.mark.parametrize("kind", KINDS)
def test_right_flight_contradicts_nothing(checks, kind):
    check = checks[kind]
    assert check.explanations == () and not check.contradicts and problems_of(check) == []
    assert CONTRADICTS not in verdicts(check).values()


RIGHT_LOGS = {
    # The response of roll is bent, by 0.2 % of its variance, without a curve.
    "a lag of one axis": lambda: scripted([74, 105], LENGTH_S, motion="fine")[1],
    "of the readme": lambda: collect(blackbox.load(blackbox.SHIPPED), 2.0, seed=0, noise=1.0),
    "coloured noise": lambda: load_log_suite("misspec-v1").plant("14").log,
    "heavy-tailed noise": lambda: load_log_suite("misspec-v1").plant("22").log,
}


@pytest.mark.parametrize("name", slow_but(["a lag of one axis"], RIGHT_LOGS))
def test_right_log_contradicts_nothing(name):
    assert check_log(RIGHT_LOGS[name]()).explanations == ()


def test_hover_says_what_to_fly_and_a_race_shows_all_pairs(checks, flights, tmp_path):
    assert [*verdicts(checks["race"]).values()] == [AGREES] * 6
    still = [pair.name for pair in checks["hover"].pairs if pair.verdict == STILL]
    assert {"v, f and q", "u and w"} <= set(still)
    text = text_of(checks["hover"])
    assert all(MANOEUVRES[name] in text for name in still)
    assert not any(MANOEUVRES[name] in text_of(checks["race"]) for name in still)
    write_check(tmp_path, checks["hover"], flights["hover"].log)
    content = read_json(tmp_path / "check.json")
    assert content["contradicts"] is False and content["explanations"] == []
    assert {path.name for path in tmp_path.iterdir()} == {"check.json", "check.txt", "check.html"}


def test_check_compiles_nothing(flights):
    with programs() as compiled:
        check_log(flights["excitation"].log)
    assert compiled == []


def test_voltage_of_a_short_flight_decides_nothing(flights):
    log = flights["race"].log
    rising = with_channels(log, v_bat=2.0 * log["v_bat"].mean() - log["v_bat"])
    verdict = verdicts(check_log(rising.select(log.time < 8.0)))["v_bat and t"]
    assert verdict == STILL


def test_corrected_log_is_the_right_one(flights, turned_gyro):
    _, check = turned_gyro
    np.testing.assert_array_equal(check.corrected["w"], flights["race"].log["w"])
    assert {pair.verdict for pair in check.after} == {AGREES}


def test_model_with_other_full_rates_is_remarked(flights):
    race = flights["race"]
    model = model_of(race.craft)
    right = set(check_log(race.log, model).remarks)  # on other constants, which are not the craft's
    doubled = check_log(race.log, model._replace(max_rate=2.0 * model.max_rate))
    assert not doubled.contradicts and right <= set(doubled.remarks)
    sentences = set(doubled.remarks) - right
    assert any("roll" in one for one in sentences) and not any("roll" in one for one in right)


# --- samples --------------------------------------------------------------------------------------


HELD = [Change(channel, "held", rows) for channel, rows in product("wfqvp", (3, 10))]
WRAPPED = Change("q", "wrapped", True)  # a heading that was interpolated across its wrap


@pytest.mark.parametrize("change", [*HELD, WRAPPED])
def test_samples_that_were_held_or_interpolated(flights, change):
    assert sample_changes(changed(flights["race"], change).log) == [change]


def test_log_faster_than_its_sensors_repeats_no_rows(flights):
    log = flights["race"].log
    rows = np.arange(len(log))
    slow = replace(log.select(rows - rows % 3), time=log.time)
    assert "repeated" not in [change.kind for change in sample_changes(slow)]


# --- thrust and motors ----------------------------------------------------------------------------

CHANGED_RANGE = Change("u_thrust", "range", "0..1")
THRUSTS = [Change("u_thrust", "range", "pwm"), CHANGED_RANGE, Change("u_thrust", "axes", "-")]


@pytest.mark.parametrize("has_force", [True, False])
@pytest.mark.parametrize("kind", ["race", "excitation"])
def test_range_and_sign_of_thrust(flights, kind, has_force):
    def changes_in(flight):
        return thrust_changes(flight.log if has_force else flight.log.without("f"))

    assert changes_in(flights[kind]) == []
    for change in THRUSTS:
        # In 20 s of excitation, velocity and attitude alone tell 0..1 from -1..1 by 6 nats.
        is_shown = has_force or kind == "race" or change != CHANGED_RANGE
        assert changes_in(changed(flights[kind], change)) == [change] * is_shown


@pytest.mark.parametrize(
    ("zero", "exponent", "changes"), [(-1.0, 2.2, []), (0.0, 1.5, [CHANGED_RANGE])]
)
def test_range_of_thrust_that_is_hardly_moved(flights, zero, exponent, changes):
    """A race at full throttle whose force is a little steeper than a square of the command."""
    log, rng = flights["race"].log, np.random.default_rng(1)
    thrust = 1.0 - 0.1 * np.sin(np.linspace(0.0, 40.0 * np.pi, len(log))) ** 8
    above = (thrust - zero) / (1.0 - zero)
    along_z = 30.0 * above**exponent + 0.5 * rng.standard_normal(len(log))
    sticks = np.column_stack([log["u"][:, :3], thrust])
    force = np.outer(along_z, [0.0, 0.0, 1.0])
    assert thrust_changes(with_channels(log, u=sticks, f=force)) == changes


@pytest.mark.parametrize("kind", ["race", "excitation"])
def test_order_of_motors(flights, kind):
    flight = flights[kind]
    assert motor_changes(flight.log, flight.motors) == [()]
    for order in ("2 1 3 4", "4 2 3 1", "1 3 2 4"):
        swapped = Change("motors", "order", order)
        motors = changed(flight, swapped).motors
        assert motor_changes(flight.log, motors) == [(swapped,)]


# --- plants ---------------------------------------------------------------------------------------


BY_NAME = {simulator.name: simulator for simulator in SIMULATORS}
EPISODES = {"the handout": 20, "crazyflow": 12, "AirSim": plant.NUM_EPISODES}


@pytest.mark.parametrize("name", slow_but(["crazyflow"], EPISODES))
def test_conventions_of_a_plant(name, monkeypatch):
    monkeypatch.setattr(plant, "NUM_EPISODES", EPISODES[name])
    simulator = BY_NAME[name]
    check = check_plant(simulator.step, simulator.layout)
    assert compare(check, simulator.expected)["outcome"] == "exact"


class Environment:
    """A simulator as a Gymnasium environment; an episode is cut after a second."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def __init__(self, simulator):
        self.simulator = simulator

    def reset(self, seed):
        self.x, self.steps = self.simulator.layout["x0"], 0
        return self.x, {}

    def step(self, action):
        self.x, self.steps = self.simulator.step(self.x, action), self.steps + 1
        return self.x, 0.0, False, self.steps == 100, {}


@pytest.mark.slow
def test_environment_is_checked_through_its_observations(monkeypatch):
    monkeypatch.setattr(plant, "NUM_EPISODES", 20)
    simulator = BY_NAME["crazyflow"]
    check = check_environment(Environment(simulator), simulator.layout)
    assert compare(check, simulator.expected)["outcome"] == "exact"
    assert any("hovers" in remark for remark in check.remarks)


# --- reports --------------------------------------------------------------------------------------


def read_json(path):
    """Return the content of a file without NaN and infinities, which JSON does not have."""
    return json.loads(path.read_text(), parse_constant=pytest.fail)


def test_files_of_a_contradiction(tmp_path, turned_gyro):
    log, check = turned_gyro
    contradicting = {name for name, verdict in verdicts(check).items() if verdict == CONTRADICTS}
    assert contradicting == {"q and w", "u and w"}
    paths = write_check(tmp_path, check, log)
    assert sorted(paths) == sorted(tmp_path.iterdir())
    content = read_json(tmp_path / "check.json")
    assert content["contradicts"] is True
    assert {pair["name"]: pair["verdict"] for pair in content["pairs"]} == verdicts(check)
    ((change,),) = content["explanations"]
    assert (change["channel"], change["kind"], change["value"]) == ("w", "axes", FRD)
    text = (tmp_path / "check.txt").read_text()
    assert text == text_of(check) + "\n" and "\nq and w      contradicts " in text
    (problem,) = problems_of(check)
    assert change["text"] in text and change["text"] in problem
    html = (tmp_path / "check.html").read_text()
    assert all(pair.name in html for pair in check.pairs) and change["text"] in html
    pictures = {path.stem: path.read_bytes() for path in tmp_path.glob("*.png")}
    assert set(pictures) == {"q_and_w", "u_and_w"}
    assert all(picture.startswith(b"\x89PNG") for picture in pictures.values())


# --- logs that show less --------------------------------------------------------------------------


@pytest.mark.parametrize("names", ["p", "v", "q", "f", "w", "p v q w f v_bat"])
def test_missing_and_constant_channels_name_nothing(flights, names):
    log, names = flights["race"].log.select(slice(1000)), names.split()
    check = check_log(log.without(*names))
    assert check.explanations == ()
    compared = {name for pair in check.pairs for name in pair.name.replace(",", "").split()}
    assert compared.isdisjoint(names)
    assert check_log(held_still(log, names)).explanations == ()


@pytest.mark.parametrize("kind", KINDS)
def test_short_logs_name_nothing(flights, kind):
    log = flights[kind].log
    for length_s in (0.5, 3.0):
        assert check_log(log.select(log.time < length_s)).explanations == ()


def test_stuck_axis_is_said(flights):
    log = flights["race"].log
    rates = log["w"].copy()
    rates[:, 1] = 0.1
    check = check_log(with_channels(log, w=rates))
    assert check.explanations == () and any(text.startswith("w_y: ") for text in check.remarks)
