"""What a fit says of a log that it cannot use, or uses only with an assumption."""

from dataclasses import replace

import numpy as np
import pytest

from flytrack_sysid import FitError, fit
from flytrack_sysid.log import FlightLog
from tests.support.handout_plant import HandoutPlant, excited

SHORT_S = 0.14  # a few lags: what was applied before is not forgotten


@pytest.fixture(scope="module")
def log() -> FlightLog:
    return replace(excited(HandoutPlant()), source="flight.npz")


@pytest.mark.slow
def test_every_refusal_names_the_log(log):
    since_start = log.time - log.time[log.is_start()][np.cumsum(log.is_start()) - 1]
    short = log.select(since_start < SHORT_S)
    with pytest.raises(FitError, match=r"^flight\.npz: tau_roll, .* nothing that the log measured"):
        fit(short.without("uprev"))


@pytest.mark.slow
def test_missing_voltage_is_said_with_what_is_taken_instead(log):
    assert "the log as flown at 23 V" in "\n".join(fit(log.without("v_bat")).warnings)
