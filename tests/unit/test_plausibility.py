"""Logs of flights raise no problem; each wrong unit, sign and stuck column is named, and nothing else."""

from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters, step
from flytrack_sysid import collect
from flytrack_sysid.log import CHANNELS, FlightLog, LogError, log_of_states
from flytrack_sysid.plausibility import FEWEST_ROWS, GRAVITY, check_plausible, find_problems
from flytrack_sysid.split import blocks_of
from tests.support.handout_plant import HandoutPlant

DT = 0.01
NUM_STEPS = 600
SEEDS = (0, 1, 2)
NOISE = {"w": 0.1, "a": 1.5, "f": 1.5, "v": 0.05, "p": 0.02}
ATTITUDE_NOISE_DEG = 0.5
LOST = 0.02

Change = Callable[[FlightLog], FlightLog]


def with_force(log: FlightLog) -> FlightLog:
    """Return a log with the specific force that an accelerometer at the centre would measure."""
    before = np.concatenate([log["q"][:1], log["q"][:-1]])
    force_b = Rotation.from_quat(before, scalar_first=True).inv().apply(log["a"] + [0.0, 0.0, GRAVITY])
    return replace(log, channels={**log.channels, "f": force_b})


def commands(seed: int) -> np.ndarray:
    """Return sums of slow sines about hover, (NUM_STEPS, 4)."""
    rng = np.random.default_rng(seed)
    frequency_hz, phase = rng.uniform(0.2, 2.0, (3, 4)), rng.uniform(0, 2 * np.pi, (3, 4))
    time = np.arange(NUM_STEPS)[:, None, None] * DT
    waves = np.sin(2 * np.pi * frequency_hz * time + phase).mean(axis=1)
    return (0.5 * waves + [0.0, 0.0, 0.0, -0.25]).astype(np.float32)


def noisy(log: FlightLog, seed: int) -> FlightLog:
    """Return a log as sensors and estimators measure it, a few samples lost."""
    rng = np.random.default_rng(seed)
    channels = dict(log.channels)
    for name, sigma in NOISE.items():
        channels[name] = channels[name] + sigma * rng.standard_normal(channels[name].shape)
    error = Rotation.from_rotvec(np.deg2rad(ATTITUDE_NOISE_DEG) * rng.standard_normal((len(log), 3)))
    attitude = Rotation.from_quat(channels["q"], scalar_first=True) * error
    flips = rng.choice([-1.0, 1.0], (len(log), 1))
    channels["q"] = flips * attitude.as_quat(scalar_first=True)
    return replace(log, channels=channels).select(rng.random(len(log)) >= LOST)


@pytest.fixture(scope="module")
def logs() -> dict[str, FlightLog]:
    """Clean and noisy logs of the simulator, by name."""
    model = nominal_parameters()
    start = np.zeros(21, np.float32)
    start[[2, 9, 19, 20]] = 50.0, 1.0, -0.25, 23.8

    def one(state: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        return step(state, action, DT, model), state

    actions = np.stack([commands(seed) for seed in SEEDS])
    states = np.asarray(jax.jit(jax.vmap(lambda u: jax.lax.scan(one, start, u)[1]))(actions))
    clean = {f"clean {i}": with_force(log_of_states([(states[i], actions[i])], DT)) for i in SEEDS}
    whole = {"clean, segments": with_force(log_of_states(zip(states, actions, strict=True), DT))}
    logs = {**clean, **whole}
    return {**logs, **{name.replace("clean", "noisy"): noisy(log, 9) for name, log in logs.items()}}


def scaled(channel: str, factor: float | np.ndarray) -> Change:
    return lambda log: replace(log, channels={**log.channels, channel: log[channel] * factor})


def shifted(channel: str, offset: float | np.ndarray) -> Change:
    return lambda log: replace(log, channels={**log.channels, channel: log[channel] + offset})


def time_times(factor: float) -> Change:
    return lambda log: replace(log, time=log.time * factor)


def constant(channel: str, values: list[float]) -> Change:
    return lambda log: replace(log, channels={**log.channels, channel: np.tile(values, (len(log), 1))})


def columns(channel: str) -> str:
    return ", ".join(CHANNELS[channel])


UPWARDS = np.array([0.0, 0.0, GRAVITY])
# What is done to a log -> the columns that the one problem names, and what else it says.
WRONG = {
    "w in deg/s": (scaled("w", 180 / np.pi), columns("w"), "looks like deg/s"),
    "t in ms": (time_times(1e3), "t", "median step of 10, .* looks like ms"),
    "q world to body": (scaled("q", np.array([1.0, -1.0, -1.0, -1.0])), columns("q"), "looks like world to"),
    "q stuck": (constant("q", [1.0, 0.0, 0.0, 0.0]), columns("q"), "the attitude looks stuck"),
    "v_bat in mV": (scaled("v_bat", 1000.0), "v_bat", "looks like mV$"),
    "v_bat in tenths": (scaled("v_bat", 10.0), "v_bat", "looks like tenths of V$"),
    "f in g": (scaled("f", 1 / GRAVITY), columns("f"), "looks like g$"),
    "f with z down": (scaled("f", np.array([1.0, -1.0, -1.0])), "f_z", "pointed down"),
    "a in g": (scaled("a", 1 / GRAVITY), columns("a"), "looks like g, not m/s"),
    "a with gravity": (shifted("a", UPWARDS), "a_z", "gravity looks left in"),
    "p in mm": (scaled("p", 1000.0), columns("p"), "looks like mm, not m$"),
    "commands stuck": (constant("u", [0.0] * 4), columns("u"), "look stuck"),
    # Of the log with segments these are more than 100 rows, but less than 2 s.
    "too few seconds": (lambda log: log.select(log.time < 0.6), "t", r"found \d+ rows and \d\.\d+ s, "),
    "too few rows": (lambda log: log.select(slice(0, FEWEST_ROWS - 1)), "t", "found 99 rows"),
}
NAMES = ("clean 0", "noisy 1", "noisy, segments")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_log_is_named_and_only_that(logs, name, wrong):
    change, where, text = WRONG[wrong]
    log = replace(change(logs[name]), source="flight.csv")
    problems = find_problems(log)
    assert len(problems) == 1
    assert problems[0].startswith(f"flight.csv: {where}: found ")
    with pytest.raises(LogError, match=text):
        check_plausible(log)


def test_all_problems_are_listed(logs):
    log = logs["noisy 1"]
    for wrong in ("t in ms", "w in deg/s", "v_bat in mV", "f in g"):
        log = WRONG[wrong][0](log)
    problems = find_problems(log)
    assert [problem.split(": ")[1] for problem in problems] == ["t", columns("w"), columns("f"), "v_bat"]
    with pytest.raises(LogError) as error:
        check_plausible(log)
    assert str(error.value).splitlines() == problems


@pytest.mark.parametrize("measured", [("q",), ("p", "v", "a", "f", "q", "w")])
def test_drone_that_stands_while_commands_move(logs, measured):
    log = logs["clean 0"]
    frozen = {name: np.repeat(log[name][:1], len(log), axis=0) for name in measured}
    problems = find_problems(replace(log, channels={"u": log["u"], **frozen}))
    named = ", ".join(column for name in CHANNELS if name in measured for column in CHANNELS[name])
    assert len(problems) == 1 and f": {named}: found the same values in every row" in problems[0]


def test_noise_of_a_drone_that_stands_is_no_motion_to_judge(logs):
    log = logs["noisy 0"]
    rng = np.random.default_rng(5)
    noise = {name: sigma * rng.standard_normal((len(log), 3)) for name, sigma in NOISE.items()}
    noise["f"] += UPWARDS
    log = replace(log, channels={**log.channels, **noise, "q": np.tile([1.0, 0.0, 0.0, 0.0], (len(log), 1))})
    assert find_problems(log) == []
    # What needs motion to be told is passed over, not guessed.
    assert find_problems(WRONG["p in mm"][0](log)) == []
    assert find_problems(WRONG["a in g"][0](log)) == []
    assert "gravity looks left in" in find_problems(WRONG["a with gravity"][0](log))[0]


def test_free_fall_is_no_force_in_g(logs):
    # Falling with little thrust measures about 1 m/s^2: the velocity tells it from g.
    log = logs["noisy 0"]
    rng = np.random.default_rng(6)
    force = rng.normal([0.0, 0.0, 1.0], 0.1, (len(log), 3))
    velocity = np.cumsum(np.gradient(log.time)[:, None] * (force - UPWARDS), axis=0)
    channels = {"u": log["u"], "f": force}
    assert find_problems(replace(log, channels={**channels, "v": velocity})) == []
    # Without one, a fall that long is not believed; a short one is.
    assert "looks like g" in find_problems(replace(log, channels=channels))[0]
    assert find_problems(replace(log, channels=channels, segment=blocks_of(log))) == []


def test_flights_and_batteries_of_one_to_fourteen_cells_raise_no_problem(logs):
    for name in NAMES:
        assert find_problems(logs[name]) == []
    for volts in (3.0, 16.8, 60.0):
        assert find_problems(constant("v_bat", [volts])(logs["clean 0"])) == []
    (problem,) = find_problems(constant("v_bat", [420.0])(logs["clean 0"]))
    assert problem.endswith("this looks like hundredths of V or tenths of V")


def test_excitation_raises_no_problem():
    assert find_problems(collect(HandoutPlant(), minutes=1.0, seed=1, noise=3.0)) == []
