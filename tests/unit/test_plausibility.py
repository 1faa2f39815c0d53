"""Flight logs raise no problem; each wrong unit, sign and stuck column alone is named."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_sysid.log import CHANNELS, FlightLog, LogError
from flytrack_sysid.plausibility import FEWEST_ROWS, GRAVITY, check_plausible, find_problems
from flytrack_sysid.sensors import measure, specific_force_b
from tests.support.handout_plant import HandoutPlant, excited
from tests.support.made_flight import noisy

UPWARDS = np.array([0.0, 0.0, GRAVITY])
Change = Callable[[FlightLog], FlightLog]


@pytest.fixture(scope="module")
def logs() -> dict[str, FlightLog]:
    """The same flights as they are, and as sensors measure them."""
    exact = excited(HandoutPlant())
    clean = replace(exact, channels={**exact.channels, "f": specific_force_b(exact, GRAVITY)})
    return {"clean": clean, "noisy": measure(exact, 1.0, GRAVITY, np.random.default_rng(9))}


def changed(channel: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda log: replace(log, channels={**log.channels, channel: change(log[channel])})


def scaled(channel: str, factor: float | list[float]) -> Change:
    return changed(channel, lambda values: values * np.array(factor))


def constant(channel: str, row: list[float]) -> Change:
    return changed(channel, lambda values: np.tile(row, (len(values), 1)))


def rolled(step: int) -> Change:
    """Return a change of the order of a quaternion's numbers."""
    return changed("q", lambda values: np.roll(values, step, axis=1))


def columns(channel: str) -> str:
    return ", ".join(CHANNELS[channel])


# What is done to a log -> the columns that the one problem names, and what else it says.
WRONG = {
    "w in deg/s": (scaled("w", 180 / np.pi), columns("w"), "looks like deg/s"),
    "t in ms": (
        lambda log: replace(log, time=1e3 * log.time),
        "t",
        "median step of 10, .* looks like ms",
    ),
    "q world to body": (scaled("q", [1.0, -1.0, -1.0, -1.0]), columns("q"), "looks like world to"),
    "q stuck": (constant("q", [1.0, 0.0, 0.0, 0.0]), columns("q"), "the attitude looks stuck"),
    "v_bat in mV": (scaled("v_bat", 1000.0), "v_bat", "looks like mV$"),
    "v_bat in tenths": (scaled("v_bat", 10.0), "v_bat", "looks like tenths of V$"),
    "f in g": (scaled("f", 1 / GRAVITY), columns("f"), "looks like g$"),
    "f with z down": (scaled("f", [1.0, -1.0, -1.0]), "f_z", "pointed down"),
    "a with gravity": (changed("a", lambda acc: acc + UPWARDS), "a_z", "gravity looks left in"),
    "commands stuck": (constant("u", [0.0] * 4), columns("u"), "look stuck"),
    "too few seconds": (
        lambda log: log.select(log.time < 0.06),
        "t",
        r"found \d+ rows and \d\.\d+ s, ",
    ),
    "too few rows": (lambda log: log.select(slice(0, FEWEST_ROWS - 1)), "t", "found 99 rows"),
}


@pytest.mark.parametrize("name", ["clean", "noisy"])
@pytest.mark.parametrize("wrong", [None, *WRONG])
def test_wrong_log_is_named_and_only_that(logs, name, wrong):
    log = replace(logs[name], source="flight.csv")
    if wrong is None:
        check_plausible(log)
        return
    change, where, text = WRONG[wrong]
    if where == "a_z" and "a" not in log:
        pytest.skip("no accelerations are measured")
    log = change(log)
    (problem,) = find_problems(log)
    assert problem.startswith(f"flight.csv: {where}: found ")
    with pytest.raises(LogError, match=text):
        check_plausible(log)


FRD = Rotation.from_rotvec([np.pi, 0.0, 0.0])


def turned(change: Callable[[Rotation], Rotation]) -> Change:
    """Return a change of the attitude."""

    def apply(quat: np.ndarray) -> np.ndarray:
        return change(Rotation.from_quat(quat, scalar_first=True)).as_quat(scalar_first=True)

    return changed("q", apply)


# One wrong word in a mapping -> the channel that is named, and how it agrees.
MISREAD = {
    "wxyz read as xyzw": (rolled(1), "q", "if q is read as wxyz"),
    "xyzw read as wxyz": (rolled(-1), "q", "if q is read as xyzw"),
    "q inverted": (turned(Rotation.inv), "q", "if q is inverted"),
    "q in frd": (turned(lambda quat: quat * FRD), "q", "if q has its body axes turned"),
    "q in ned": (turned(lambda quat: FRD * quat), "q", "if q has its world turned"),
    "q in frd and ned": (
        turned(lambda quat: FRD * quat * FRD),
        "q",
        "if q has body axes and world turned",
    ),
    "w in frd": (scaled("w", [1.0, -1.0, -1.0]), "w", "if w has y and z turned"),
    "v in ned": (scaled("v", [1.0, -1.0, -1.0]), "v", "if v has y and z turned"),
    "p in ned": (scaled("p", [1.0, -1.0, -1.0]), "p", "if p has y and z turned"),
}


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("name", MISREAD)
def test_channels_that_contradict_each_other_are_read_right(name, noise, truth):
    change, channel, text = MISREAD[name]
    right = noisy(truth, 3) if noise else truth
    log = replace(right, channels={**right.channels, "u": np.clip(right["u"], -1.0, 1.0)})
    assert find_problems(log) == []
    (problem,) = find_problems(change(log))
    assert (
        f": {columns(channel)}: found motion that contradicts itself" in problem and text in problem
    )
    with pytest.raises(LogError, match="contradicts itself"):
        check_plausible(change(log))


def test_right_logs_of_any_noise_contradict_nothing(truth):
    """210 logs of 10 s: 7 parts of a flight with 30 noises each, of 0.1 to 10 times the usual."""
    rng = np.random.default_rng(5)
    for seed in range(210):
        start = 150 * (seed % 7)
        log, factor = truth.select(slice(start, start + 1000)), 10.0 ** rng.uniform(-1.0, 1.0)
        shaken = noisy(log, seed)
        channels = {name: log[name] + factor * (shaken[name] - log[name]) for name in log.channels}
        channels["q"] /= np.linalg.norm(channels["q"], axis=1, keepdims=True)
        problems = find_problems(replace(log, channels=channels))
        assert "contradict" not in " ".join(problems), seed


def test_all_problems_are_listed(logs):
    log = logs["noisy"]
    for wrong in ("t in ms", "w in deg/s", "v_bat in mV", "f in g"):
        log = WRONG[wrong][0](log)
    problems = find_problems(log)
    named = ["t", columns("w"), columns("f"), "v_bat"]
    assert [problem.split(": ")[1] for problem in problems] == named
    with pytest.raises(LogError) as error:
        check_plausible(log)
    assert str(error.value).splitlines() == problems


@pytest.mark.parametrize("measured", [("q",), ("p", "v", "a", "f", "q", "w")])
def test_drone_that_stands_while_commands_move(logs, measured):
    log = logs["clean"]
    frozen = {name: np.repeat(log[name][:1], len(log), axis=0) for name in measured}
    (problem,) = find_problems(replace(log, channels={"u": log["u"], **frozen}))
    named = ", ".join(column for name in CHANNELS if name in measured for column in CHANNELS[name])
    assert f": {named}: found the same values in every row" in problem


def test_batteries_of_one_to_fourteen_cells_raise_no_problem(logs):
    for volts in (3.0, 16.8, 60.0):
        assert find_problems(constant("v_bat", [volts])(logs["clean"])) == []
    (problem,) = find_problems(constant("v_bat", [420.0])(logs["clean"]))
    assert problem.endswith("this looks like hundredths of V or tenths of V")
