"""The battery of a craft: the voltages it is flown at, and those its thrust map was fitted at."""

import warnings
from typing import Any, NamedTuple

import numpy as np

from flytrack_env.quaternion import Scalar
from flytrack_env.state import BATTERY_EMPTY_V, BATTERY_FULL_V

# Share of the full voltage by which the battery may exceed the voltages of the fit before a
# warning. Thrust goes with the first to second power of the voltage: with no slope at all, it would
# be 3 to 6 % wrong there.
MAX_EXTRAPOLATION = 0.03


class BatteryWarning(UserWarning):
    """A model is flown at voltages that its thrust map was not fitted at, or that are not known."""


class Battery(NamedTuple):
    """Voltages of a craft's battery; the defaults are the handout's.

    Attributes:
        full_v, empty_v: where episodes may start, and where they end, V.
        fitted_low_v, fitted_high_v: between which the thrust map was measured, V.
    """

    full_v: Scalar = BATTERY_FULL_V
    empty_v: Scalar = BATTERY_EMPTY_V
    fitted_low_v: Scalar = BATTERY_EMPTY_V
    fitted_high_v: Scalar = BATTERY_FULL_V

    def voltage(self, charge: Scalar) -> Scalar:
        """Return the voltage at a charge from 0 (empty) to 1 (full), V."""
        return self.empty_v + charge * (self.full_v - self.empty_v)

    def scaled(self, battery_v: Scalar) -> Scalar:
        """Return a voltage as -1 for empty to 1 for full."""
        half_v = 0.5 * (self.full_v - self.empty_v)
        return (battery_v - 0.5 * (self.full_v + self.empty_v)) * (1.0 / half_v)

    def describe(self) -> str:
        """Return the range of the battery as text."""
        return f"{_shown(self.empty_v)} to {_shown(self.full_v)} V"

    def describe_fitted(self) -> str:
        """Return the range of the fit as text."""
        return f"{_shown(self.fitted_low_v)} to {_shown(self.fitted_high_v)} V"

    def check(self) -> None:
        """Raise ValueError for impossible voltages, or a thrust map of another battery.

        Any leaf may be batched.
        """
        full, empty, low, high = (np.asarray(value, float) for value in self)
        if not np.all((empty > 0.0) & (empty < full) & np.isfinite(full)):
            raise ValueError(
                f"model.battery: found empty_v {self.empty_v}, full_v {self.full_v}, "
                "expected 0 < empty_v < full_v"
            )
        if not np.all((low > 0.0) & (low <= high) & np.isfinite(high)):
            raise ValueError(
                f"model.battery: found fitted_low_v {self.fitted_low_v}, "
                f"fitted_high_v {self.fitted_high_v}, "
                "expected 0 < fitted_low_v <= fitted_high_v"
            )
        margin = MAX_EXTRAPOLATION * full
        if not np.all((low <= full + margin) & (high >= empty - margin)):
            raise ValueError(
                f"model.battery: the thrust map was fitted at {self.describe_fitted()}, "
                f"and the battery goes from {self.describe()}: expected ranges that overlap"
            )

    def warn_of_extrapolation(self) -> None:
        """Warn where the battery goes well beyond the voltages of the fit; for concrete scalars."""
        margin = MAX_EXTRAPOLATION * float(self.full_v)
        is_above = float(self.full_v) > float(self.fitted_high_v) + margin
        if is_above or float(self.empty_v) < float(self.fitted_low_v) - margin:
            text = (
                f"model: the thrust map was fitted at {self.describe_fitted()}, "
                f"and the battery goes from {self.describe()}: "
                "beyond the fit its thrust is extrapolated"
            )
            warnings.warn(BatteryWarning(text), stacklevel=3)


def _shown(value: Any) -> str:
    return f"{float(np.asarray(value).mean()):.4g}"
