"""What to fly next: manoeuvres that show what a hovering log could not, once they are flown."""

from functools import cache
from typing import NamedTuple

import jax
import numpy as np
import pytest

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.plants import Simulator
from flytrack_sysid import collect
from flytrack_sysid.diagnosis.identifiability import Question, advise
from flytrack_sysid.inference.chunks import cut_chunks
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.score_test import Linearization
from flytrack_sysid.inference.search import FittedModel, SearchState
from flytrack_sysid.manoeuvres import MANOEUVRES, flights_of, hover_action
from flytrack_sysid.script_file import build_script
from tests.support.tables import table

MODEL = nominal_parameters()
GYRO, FORCE, ATTITUDE, VELOCITY, VOLTAGE = 0.1, 1.5, 0.009, 0.05, 0.01  # rad/s, m/s^2, rad, m/s, V
LITTLE, SHORT_S = 0.05, 0.3  # what wanders, over the sensors' noise, and how long it lasts
DIRECT, LEVEL = [GYRO] * 3 + [FORCE] * 3 + [1.0], [ATTITUDE] * 3 + [VELOCITY] * 3 + [VOLTAGE]
NOISE = np.log(
    [DIRECT, LEVEL, [LITTLE] * 7, [LITTLE] * 7, [SHORT_S] * 7, [1.0] * 7]
)  # as a problem has it
WANTED = table("diagnoses")["hidden_by_hover"]


class Logged(NamedTuple):
    """The problem of a log, the model that is right, and its linearization."""

    problem: Problem
    model: FittedModel
    linearization: Linearization


def logged(log):
    chunks = cut_chunks(log, np.ones(len(log), bool), MODEL)
    state = SearchState(Problem.of(chunks, MODEL).with_noise(NOISE))
    model = FittedModel((), state.problem.start, 0.0, tuple(state.base_indices))
    return Logged(state.problem, model, state.linearized(model.vector)[1])


@pytest.fixture(scope="module", autouse=True)
def in_float64():
    """Diagnose in float64; collecting flies float32 anyway."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def hover():
    """Twenty seconds of hover, the nose in one direction."""
    first = flights_of(["headings"], hover_action(MODEL))[0]
    return logged(collect(Simulator(), script=build_script([first] * 8)).without("uprev"))


def test_a_hovering_log_cannot_tell_wind_from_tilt(hover):
    alone, beside = (
        Question(hover.linearization, hover.model, "thrust_tilt", alike).shares()[0]
        for alike in ((), ("wind",))
    )
    assert alone > 1.0 > 10.0 * beside


@pytest.mark.slow
def test_what_is_advised_shows_once_it_is_flown(hover):
    """In flights that are collected with other commands than foreseen."""
    script = build_script(flights_of(MANOEUVRES, hover_action(MODEL), seed=1))
    log = collect(Simulator(), script=script).without("uprev")
    kinds = np.array(script.kinds)[log.segment]

    @cache
    def told(name):
        return logged(log.select(kinds == name)).linearization.by_block.sum(axis=0)

    advice = advise(hover.problem, hover.model, hover.linearization, WANTED)
    assert set(advice) == set(WANTED)
    for effect, alike in WANTED.items():
        question = Question(hover.linearization, hover.model, effect, alike)
        before, after = question.shares()[0], question.shares(told(advice[effect]))[0]
        assert before < 1.0 <= after, (
            f"{effect}: {before} before and {after} after {advice[effect]}"
        )
