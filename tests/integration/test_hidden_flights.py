"""Flights of plants with hidden effects, and the logs that sensors make of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.hidden import (
    CHANGES,
    EFFECTS,
    FLIGHT_KINDS,
    NOISE_KINDS,
    OUTSIDE_KINDS,
    CrashError,
    Gust,
    Outside,
    Truth,
    draw_base,
    draw_change,
    draw_effect,
    draw_gust,
    draw_outside,
    draw_truth,
    fly,
    measure,
    signal_to_noise,
)
from benchmarks.hidden.noise import COLOURS, LOST_ROWS, STD
from benchmarks.hidden.outside import SCALES
from flytrack_sysid.log import FlightLog

MINUTE_S, SHORT_S = 60.0, 20.0
AXES = ("roll", "pitch", "yaw")


def base() -> Truth:
    return draw_base(np.random.default_rng(3))


def flown(truth: Truth, kind: str = "scripted", seconds: float = SHORT_S, seed: int = 1) -> FlightLog:
    return fly(truth, kind, seconds, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def scripted() -> list[FlightLog]:
    return [flown(draw_base(np.random.default_rng(seed)), seconds=MINUTE_S, seed=seed) for seed in range(4)]


def assert_in_envelope(log: FlightLog) -> None:
    assert all(np.isfinite(values).all() for values in log.channels.values())
    assert log["p"][:, 2].min() >= 0.1
    assert np.linalg.norm(log["v"], axis=1).max() <= 20.0
    assert np.abs(log["u"]).max() <= 1.0


def difficult(number: int) -> Truth:
    """Return a plant with several drawn effects, one of the largest, or something outside the list."""
    rng = np.random.default_rng([number, 9])
    if number % 3 == 0:
        return replace(draw_truth(rng, 4), gust=draw_gust(rng))
    if number % 3 == 1:
        outside = draw_outside(rng, OUTSIDE_KINDS[number // 3 % len(OUTSIDE_KINDS)], 3.0)
        return replace(draw_base(rng), outside=outside, gust=draw_gust(rng))
    names = [str(name) for name in rng.choice(list(EFFECTS), 3, replace=False)]
    effects = {name: draw_effect(name, rng, EFFECTS[name].high, has_drag=True) for name in names}
    return replace(draw_base(rng), effects=effects)


@pytest.mark.parametrize("number", range(40))
def test_flights_stay_in_the_envelope(number: int) -> None:
    kind = list(FLIGHT_KINDS)[number % len(FLIGHT_KINDS)]
    log = flown(difficult(number), kind, MINUTE_S if kind == "scripted" else SHORT_S, number)
    assert_in_envelope(log)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(40, 160))
def test_all_kinds_of_flights_stay_in_the_envelope(number: int) -> None:
    for kind in FLIGHT_KINDS:
        assert_in_envelope(flown(difficult(number), kind, MINUTE_S, number))


def test_a_log_is_whole_and_consistent(scripted: list[FlightLog]) -> None:
    for log in scripted:
        assert sorted(log.channels) == sorted(["u", "p", "v", "a", "f", "q", "w", "v_bat"])
        assert len(log) == round(MINUTE_S / 0.01) and not log.segment.any()
        np.testing.assert_allclose(np.diff(log.time), 0.01)
        attitude = Rotation.from_quat(log["q"][:-1], scalar_first=True)
        np.testing.assert_allclose(
            attitude.apply(log["f"][1:]) - [0.0, 0.0, 9.80665], log["a"][1:], atol=1e-9
        )
        np.testing.assert_allclose(np.diff(log["v"], axis=0), 0.01 * log["a"][1:], atol=1e-9)
        assert 23.1 < log["v_bat"][0, 0] <= 24.0
        assert log["v_bat"][0, 0] - log["v_bat"][-1, 0] == pytest.approx(1.0, abs=1e-3)


def test_scripted_flights_visit_what_tells_effects_apart(scripted: list[FlightLog]) -> None:
    for log in scripted:
        speed = np.linalg.norm(log["v"][:, :2], axis=1)
        assert speed.max() > 9.0 and np.mean(speed < 1.0) > 0.1
        assert np.mean(log["p"][:, 2] < 1.5) > 0.03 and log["p"][:, 2].max() > 14.0
        matrix = Rotation.from_quat(log["q"], scalar_first=True).as_matrix()
        assert (matrix[:, 2, 2] < 0.0).any(), "no flip"
        heading = np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0])
        assert len(np.unique(np.floor(heading / (np.pi / 4)))) >= 5
        way = np.arctan2(log["v"][:, 1], log["v"][:, 0])[speed > 3.0]
        assert len(np.unique(np.floor(way / (np.pi / 4)))) >= 4
        assert log["u"][:, 3].max() > 0.3 and log["u"][:, 3].min() < -0.8
        for axis, name in enumerate(AXES):
            stick = np.abs(log["u"][:, axis])
            assert stick.max() == 1.0, name
            assert np.mean((stick > 0.09) & (stick < 0.7)) > 0.01, name


def test_other_kinds_are_what_they_are_called() -> None:
    logs = {kind: flown(base(), kind, MINUTE_S) for kind in FLIGHT_KINDS}
    headings = {
        kind: Rotation.from_quat(log["q"], scalar_first=True).as_euler("ZYX")[:, 0]
        for kind, log in logs.items()
    }
    assert np.ptp(headings["hover"]) < 0.3 < 2.0 < np.ptp(headings["hover_headings"])
    fastest = {kind: np.linalg.norm(log["v"], axis=1).max() for kind, log in logs.items()}
    assert fastest["hover"] < 1.5 and fastest["hover_headings"] < 1.0 < fastest["slow"] < 7.0
    assert np.median(np.linalg.norm(logs["race"]["v"], axis=1)) > 8.0
    with pytest.raises(ValueError, match="found 'walk'"):
        flown(base(), "walk")


def test_a_plant_that_cannot_fly_is_said_to_crash() -> None:
    with pytest.raises(CrashError, match=r"thrust_scale\(factor 0\.1\)"):
        flown(replace(base(), effects={"thrust_scale": {"factor": 0.1}}), "slow", 5.0)


def test_same_seed_same_log() -> None:
    def log(seed: int) -> FlightLog:
        rng = np.random.default_rng(seed)
        truth = replace(draw_truth(rng, 3), gust=draw_gust(rng), outside=draw_outside(rng))
        return measure(fly(truth, "scripted", 5.0, rng), "coloured", rng)

    assert log(1).sha256 == log(1).sha256 != log(2).sha256


@pytest.mark.parametrize("noise", [kind for kind in NOISE_KINDS if kind != "none"])
def test_noise_has_the_standard_deviation_it_says(noise: str, scripted: list[FlightLog]) -> None:
    clean = scripted[0]
    many = [measure(clean, noise, np.random.default_rng(seed)) for seed in range(8)]
    assert np.mean([len(log) for log in many]) / len(clean) == pytest.approx(1.0 - LOST_ROWS, abs=0.003)
    for name, std in STD.items():
        errors = []
        for log in many:
            rows = np.searchsorted(clean.time, log.time - 1e-9)
            if name == "q":
                true, seen = (
                    Rotation.from_quat(of, scalar_first=True) for of in (clean["q"][rows], log["q"])
                )
                errors.append((true.inv() * seen).as_rotvec())
            else:
                errors.append(log[name] - clean[name][rows])
        assert np.std(np.concatenate(errors)) == pytest.approx(std, rel=0.1, abs=0.004)


def test_noises_differ_in_tails_and_colour(scripted: list[FlightLog]) -> None:
    clean = scripted[0]
    far, next_to = {}, {}
    for noise in ("sensors", "heavy", "coloured"):
        log = measure(clean, noise, np.random.default_rng(2))
        error = (log["f"] - clean["f"][np.searchsorted(clean.time, log.time - 1e-9)]) / STD["f"]
        far[noise] = np.mean(np.abs(error) > 5.0)
        next_to[noise] = [np.corrcoef(column[:-1], column[1:])[0, 1] for column in error.T]
    assert far["sensors"] < 1e-4 < 1e-3 < far["heavy"]
    assert max(np.abs([*next_to["sensors"], *next_to["heavy"]])) < 0.1
    assert all(COLOURS[0] - 0.1 < value < COLOURS[1] + 0.05 for value in next_to["coloured"])


def test_without_noise_only_the_acceleration_is_left_out(scripted: list[FlightLog]) -> None:
    log = measure(scripted[0], "none", np.random.default_rng(0))
    assert log.sha256 == scripted[0].without("a").sha256
    with pytest.raises(ValueError, match="found 'pink'"):
        measure(scripted[0], "pink", np.random.default_rng(0))


def test_the_accelerometer_feels_gusts() -> None:
    logs = {std: flown(replace(base(), gust=Gust(std, 0.3, 0.05)), "hover", MINUTE_S) for std in (0.3, 1.5)}
    for std, log in logs.items():
        # The pilot fights them with thrust, which has no part in body x and y.
        assert np.std(log["f"][:, :2]) == pytest.approx(std, rel=0.15)
        assert 0.04 < np.std(log["w"][:, 2]) < 0.08


@pytest.mark.parametrize("kind", OUTSIDE_KINDS)
def test_what_is_outside_shows_in_its_channel_as_large_as_it_says(kind: str) -> None:
    for seed in range(2):
        rng = np.random.default_rng([seed, 5])
        outside = draw_outside(rng, kind, 2.0)
        assert outside.kind == kind and outside.depends_on
        log = flown(replace(base(), outside=outside), seconds=MINUTE_S, seed=seed)
        largest = 2.0 * SCALES[outside.channel]
        assert signal_to_noise(base(), log, is_base_known=True) > 3.0
        if outside.channel == "force":
            across = np.linalg.norm(log["f"][:, :2], axis=1).max()
            assert across <= largest * (1.001 if kind != "stochastic" else 6.0)


def test_a_bump_is_felt_at_its_place_and_nowhere_else() -> None:
    shape = {"x": 1.0, "y": 0.0, "z": 0.0, "radius_m": 3.0, "at_share": 0.5}
    truth = replace(base(), outside=Outside("position", ("position",), "force", 2.0, shape))
    log = flown(truth, "race", MINUTE_S)
    push = np.linalg.norm(log["f"][:, :2], axis=1)
    middle = log["p"][push.argmax()]
    away = np.linalg.norm(log["p"] - middle, axis=1)
    assert push.max() > 1.0 and push[away > 15.0].max() < 0.1


def test_changes_of_the_base_change_one_parameter() -> None:
    for name in CHANGES:
        truth = base()
        other = draw_change(truth, name, np.random.default_rng(1))
        assert getattr(other, name) != getattr(truth, name)
        assert replace(other, **{name: getattr(truth, name)}) == truth


def test_draws_are_distinct_in_range_and_told_in_a_line() -> None:
    rng = np.random.default_rng(0)
    truth = draw_truth(rng, 6)
    assert len(truth.effects) == 6 and len(truth.text().splitlines()) == 1
    assert all(name in truth.text() for name in truth.effects)
    assert base().text() == "no effects"
    sizes = [draw_effect("thrust_tilt", rng) for _ in range(300)]
    lengths = [np.hypot(*values.values()) for values in sizes]
    drawn = EFFECTS["thrust_tilt"]
    assert drawn.low <= min(lengths) < 1.2 * drawn.low and drawn.high / 1.2 < max(lengths) <= drawn.high
    assert set(draw_effect("wind", rng)) == {"a_x", "a_y", "a_z"}
    assert set(draw_effect("wind", rng, has_drag=True)) == {"v_x", "v_y", "v_z"}
    with pytest.raises(KeyError, match="rain"):
        draw_effect("rain", rng)
