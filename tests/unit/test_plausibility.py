"""Flight logs raise no problem; each wrong unit, sign and stuck column alone is named."""

import re
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from flytrack_env import nominal_parameters
from flytrack_env.effects.betaflight_rates import BetaflightRates
from flytrack_sysid.kinematics import GRAVITY
from flytrack_sysid.log import CHANNELS, LogError
from flytrack_sysid.plausibility import MIN_ROWS, check_plausible, find_problems
from flytrack_sysid.sensors import measure, specific_force_b
from tests.support.handout_plant import HandoutPlant, excited
from tests.support.made_flight import noisy
from tests.support.tables import table
from tests.support.written_logs import held_still, with_channels

NUM_SEGMENTS = 8  # of the excitation, 2.5 s each


@pytest.fixture(scope="module")
def logs():
    """The same flights as they are, and as sensors measure them."""
    exact = excited(HandoutPlant())
    exact = exact.select(exact.segment < NUM_SEGMENTS)
    clean = with_channels(exact, f=specific_force_b(exact, GRAVITY))
    return {"clean": clean, "noisy": measure(exact, 1.0, GRAVITY, np.random.default_rng(9))}


class Change(NamedTuple):
    """What is wrong with a channel of a log, and which problem is found."""

    channel: str
    text: str = ""
    scale: float | list[float] = 1.0
    offset: float | list[float] = 0.0
    order: Any = slice(None)
    columns: str = ""

    def apply(self, log):
        """Return the log that is wrong."""
        if self.channel == "t":
            return replace(log, time=self.scale * log.time)
        values = log[self.channel][:, self.order] * np.array(self.scale) + self.offset
        return with_channels(log, **{self.channel: values})

    def named(self):
        """Return the columns that the problem names."""
        return self.columns or ", ".join(CHANNELS[self.channel])


WRONG, MISREAD = (
    {name: Change(**fields) for name, fields in changes.items()}
    for changes in table("implausible_logs").values()
)


@pytest.mark.parametrize("wrong", WRONG)
def test_what_no_flight_has_is_named_and_only_that(logs, wrong):
    change = WRONG[wrong]
    log = replace(logs["clean" if change.channel == "a" else "noisy"], source="flight.csv")
    with pytest.raises(LogError, match=change.text) as error:
        check_plausible(change.apply(log))
    (problem,) = str(error.value).splitlines()
    assert problem.startswith(f"flight.csv: {change.named()}: found ")


@pytest.mark.parametrize("misread", MISREAD)
def test_channel_that_contradicts_others_is_named_and_only_that(logs, misread):
    change = MISREAD[misread]
    log = change.apply(logs["noisy"])
    (problem,) = find_problems(log)
    before, wanted, after = problem.partition(f"{change.named()}: ")
    assert wanted and change.text in after
    others = {", ".join(columns) for columns in CHANNELS.values()} - {change.named()}
    assert not any(f"{columns}: " in before + after for columns in others)
    assert find_problems(log, accept=True) == []


@pytest.mark.parametrize("name", ["clean", "noisy"])
def test_right_logs_are_plausible(logs, name):
    check_plausible(logs[name])


def test_too_little_is_no_log(logs):
    whole = logs["noisy"]
    for rows, found in (
        (whole.time < 0.06, r"found \d+ rows and \d\.\d+ s, "),
        (slice(0, MIN_ROWS - 1), "found 99 rows"),
    ):
        log = whole.select(rows)
        (problem,) = find_problems(log)
        assert re.search(f": t: {found}", problem)


@pytest.mark.slow
def test_right_logs_of_any_noise_contradict_nothing(truth):
    """70 logs of 10 s: 7 parts of a flight with 10 noises each, of 0.1 to 10 times the usual."""
    rng = np.random.default_rng(5)
    for seed in range(70):
        start = 150 * (seed % 7)
        log = truth.select(slice(start, start + 1000))
        assert find_problems(noisy(log, seed, 10.0 ** rng.uniform(-1.0, 1.0))) == [], seed


def test_all_problems_are_listed(logs):
    log = logs["clean"]
    wrong = ("t in ms", "commands stuck", "q stuck", "a with gravity")
    for name in wrong:
        log = WRONG[name].apply(log)
    problems = find_problems(log)
    assert [problem.split(": ")[1] for problem in problems] == [WRONG[n].named() for n in wrong]
    with pytest.raises(LogError) as error:
        check_plausible(log)
    assert str(error.value).splitlines() == problems


@pytest.mark.parametrize("measured", [("q",), ("p", "v", "a", "f", "q", "w")])
def test_drone_that_stands_while_commands_move(logs, measured):
    log = held_still(logs["clean"], measured)
    unseen = log.channels.keys() - {"u", *measured}
    (problem,) = find_problems(log.without(*unseen))
    named = ", ".join(column for name in CHANNELS if name in measured for column in CHANNELS[name])
    assert f": {named}: found the same values in every row" in problem


def test_a_rate_curve_that_the_model_has_contradicts_nothing(logs):
    model = nominal_parameters().with_effects(BetaflightRates(0.7, 0.7, 0.7))
    sticks = np.linspace(-1.0, 1.0, 2001)
    bent = sticks * 0.3 / (1.0 - 0.7 * np.abs(sticks))
    log = logs["noisy"]
    rates = np.interp(log["u"][:, :3], bent, sticks)
    log = with_channels(log, u=np.concatenate([rates, log["u"][:, 3:]], axis=1))
    (problem,) = find_problems(log)
    assert "before a rate curve (Betaflight's betaflight)" in problem
    assert find_problems(log, model=model) == []


def test_batteries_of_one_to_fourteen_cells_raise_no_problem(logs):
    log = logs["noisy"]
    log = replace(log, channels={name: log[name] for name in ("u", "v_bat")})
    for volts in (3.0, 16.8, 60.0):
        battery = Change("v_bat", scale=0.0, offset=volts)
        assert find_problems(battery.apply(log)) == []
    (problem,) = find_problems(battery._replace(offset=420.0).apply(log))
    assert "hundredths of V" in problem and "tenths of V" in problem
