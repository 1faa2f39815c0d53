"""Changes of the thrust between two logs, where these share thrusts and where they do not."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks.diagnosis import model_of
from flytrack_sysid.diagnosis.before import Change, scaled_thrust, share_thrusts
from flytrack_sysid.inference.chunks import make_chunks
from flytrack_sysid.inference.parameters import THRUST_COEFFS
from flytrack_sysid.inference.problem import Problem
from tests.support.hidden_flights import scripted


@pytest.fixture(scope="module")
def estimate():
    """Return a function that makes an estimate of a log at some thrusts."""
    truth, log = scripted(3, 12.0)
    chunks = make_chunks(log, np.ones(len(log), bool), np.array(truth.tau), truth.gravity)

    def at(mean, factor):
        command = chunks.record.command.copy()
        command[..., 3] = mean + 0.02 * np.sin(np.arange(command[..., 3].size)).reshape(
            command[..., 3].shape
        )
        record = chunks.record._replace(command=command)
        problem = Problem.of(chunks._replace(record=record), model_of(truth))
        vector = problem.start.copy()
        vector[problem.parameter_indices(THRUST_COEFFS)] *= factor
        state, model = SimpleNamespace(problem=problem), SimpleNamespace(vector=vector)
        return SimpleNamespace(state=state, model=model)

    with jax.enable_x64(True):
        yield at


def test_logs_share_thrusts_if_one_flew_at_those_of_the_other(estimate):
    high, low, near = estimate(0.6, 1.0), estimate(-0.3, 1.0), estimate(0.59, 1.0)
    assert share_thrusts(high, near) and not share_thrusts(low, high)


@pytest.mark.parametrize(("half_n", "is_told"), [(1e-3, True), (1e3, False)])
def test_thrusts_that_are_not_shared_are_each_compared_with_the_model(estimate, half_n, is_told):
    """No curve is read where its log has no commands: the factors of both are divided."""
    later, earlier = estimate(-0.3, 1.2), estimate(0.6, 0.4)
    marginal = SimpleNamespace(half_widths=lambda weights: np.array([half_n]))
    change = Change(None, (marginal, marginal))
    values = scaled_thrust("thrust_scale", later, earlier, change)
    assert bool(values) == is_told
    if is_told:
        assert values["factor"].value == pytest.approx(3.0)
        assert values["factor"].ci95[0] < 2.5  # the curve of the model may have a wrong exponent
    assert scaled_thrust("thrust_scale", later, later, change) == {}
