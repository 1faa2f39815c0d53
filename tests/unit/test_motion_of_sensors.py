"""How a log moves within a step, by its sensors alone."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hidden import MOTIONS, draw_late, draw_truth, fly, measure
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis.motion_of_sensors import motion_of_sensors
from tests.support.hidden_flights import scripted

FOUND = {"fine": Motion.CONTINUOUS}
DRAG = {"linear_drag": {"d_x": 0.3, "d_y": 0.4, "d_z": 0.1}}


@pytest.mark.parametrize("motion", MOTIONS)
def test_sensors_show_which_attitude_turns_the_force(motion):
    log = scripted(5, 40.0, motion=motion, effects=DRAG)[1]
    assert motion_of_sensors(log) is (FOUND.get(motion) or Motion(motion))
    assert motion_of_sensors(log.without("f")) is None
    assert motion_of_sensors(log.select(slice(0, 300))) is None  # too few pieces


@pytest.mark.slow
def test_sensors_are_never_sure_of_another_motion():
    """Two effects, or poses that are late: 24 plants."""
    shown = []
    for seed in range(24):
        rng, motion = np.random.default_rng([31, seed]), MOTIONS[seed % 3]
        truth = draw_late(rng) if seed % 4 == 0 else draw_truth(rng, 2)
        log = measure(fly(replace(truth, motion=motion), 40.0, rng), "sensors", rng)
        shown.append(motion_of_sensors(log))
        assert shown[-1] in (None, FOUND.get(motion) or Motion(motion)), truth.text()
    assert sum(one is not None for one in shown) >= 12
