"""What a side of the residuals determines."""

import numpy as np

from flytrack_sysid.diagnosis import unexplained
from flytrack_sysid.diagnosis.unexplained import SIDES, SideTest, fitted_on
from flytrack_sysid.inference.chunks import NUM_AXES

SHAPE = (6 * 20, 2, NUM_AXES, 2)  # rows, chunks, axes, direct and level


def test_a_side_does_not_fit_what_the_other_side_determines():
    """A thrust that makes a motor imbalance turn the drone does not explain the imbalance."""
    rng = np.random.default_rng(0)
    thrust, imbalance = np.zeros(SHAPE), np.zeros(SHAPE)
    imbalance[..., SIDES["rate"], :] = rng.normal(size=(*SHAPE[:2], 3, 2))
    thrust[..., SIDES["rate"], :] = 0.1 * imbalance[..., SIDES["rate"], :]
    thrust[..., SIDES["force"], :] = rng.normal(size=(*SHAPE[:2], 3, 2))
    idle = np.zeros(SHAPE)
    slopes = np.stack([thrust, imbalance, idle])
    np.testing.assert_array_equal(fitted_on("rate", slopes), [False, True, False])
    np.testing.assert_array_equal(fitted_on("force", slopes), [True, False, False])

    test = SideTest.of("rate", np.zeros(SHAPE), np.stack([thrust, idle]))
    columns = SideTest.of("rate", np.zeros(SHAPE), imbalance[None]).given
    information = float(np.sum(np.square(columns)))
    assert test.noncentrality(columns, np.ones(1)) > 0.99 * information


def test_what_wanders_on_one_side_is_told_beside_a_pattern_on_the_other(monkeypatch):
    heading = unexplained.Dependence("heading", "force", 90.0, 0.5, np.zeros(0))
    wandering = {"rate": 0.4, "force": 0.3}
    monkeypatch.setattr(unexplained, "find_lines", lambda *_: [])
    monkeypatch.setattr(unexplained, "build_waves", lambda *_: {})
    monkeypatch.setattr(unexplained, "find_dependences", lambda *_: [heading])
    monkeypatch.setattr(unexplained, "stochastic_shares", lambda *_: wandering)
    found, _ = unexplained.find_unexplained(None, None, None)
    assert found.shares == {"force: heading": 0.5, "rate: stochastic": 0.4}
