"""Betaflight's rate settings: the rate at full stick, and the curve of the sticks as an effect of a model.

Source: ``apply...Rates`` in Betaflight 4.6, src/main/fc/rc.c, and controlrate_profile.h.
"""

from collections.abc import Sequence
from typing import Any

from flytrack_env.effects import ActualRates, BetaflightRates, QuickRates, effect_of

RATES_TYPES = ("BETAFLIGHT", "RACEFLIGHT", "KISS", "ACTUAL", "QUICK")
PERCENT = 100.0
STEEP_RC_RATE, STEEP_SLOPE = 2.0, 14.54  # above this RC rate, the curve gets steeper
BETAFLIGHT_RATE_DEG_S = KISS_RATE_DEG_S = 200.0  # at RC rate 1
TENS = 10.0  # deg/s in one unit of the other types' settings
QUICK_RATE_DEG_S = 2.0  # per unit of RC rate
LEAST_REMAINDER = 0.01  # of 1 less the super rate, as the firmware bounds it


def full_stick_rate(rates_type: str, rc_rate: float, super_rate: float, limit_deg_s: float) -> float:
    """Return the body rate at full stick, deg/s, by Betaflight's rate settings; expo plays no part there.

    rc_rate, super_rate, limit_deg_s: as in the log's headers ``rc_rates``, ``rates``, ``rate_limits``.
    """
    remainder = max(1.0 - super_rate / PERCENT, LEAST_REMAINDER)
    rate = rc_rate / PERCENT
    steep = rate + STEEP_SLOPE * max(rate - STEEP_RC_RATE, 0.0)
    at_full_stick = {
        "BETAFLIGHT": BETAFLIGHT_RATE_DEG_S * steep / remainder,
        "RACEFLIGHT": TENS * rc_rate * (1.0 + super_rate / PERCENT),
        "KISS": KISS_RATE_DEG_S * rate / remainder,
        "ACTUAL": TENS * max(super_rate, rc_rate),
        "QUICK": max(TENS * super_rate, QUICK_RATE_DEG_S * rc_rate),
    }
    return min(at_full_stick[rates_type], limit_deg_s)


def stick_curve(rates_type: str, axes: Sequence[Sequence[float]]) -> Any:
    """Return the effect that bends sticks as the rate settings do; None of types without one, or straight.

    axes: of roll, pitch, yaw, the rates and the expo as in the log's headers ``rc_rates``, ``rates``,
    ``rc_expo``. Assumption: no rate limit is below the rate at full stick, and Quick rates leave the expo
    out of the stick (``quick_rates_rc_expo`` is OFF, as it comes).
    """
    rc_rates, super_rates, expos = zip(*axes, strict=True)

    def bends(slope_deg_s: float) -> list[float]:
        slopes = [slope_deg_s * rc_rate for rc_rate in rc_rates]  # about the centre, deg/s
        return [1.0 - slope / max(slope, TENS * top) for slope, top in zip(slopes, super_rates, strict=True)]

    shares = [expo / PERCENT for expo in expos]
    if rates_type == "ACTUAL":
        curve: Any = ActualRates(*bends(TENS), *shares)
    elif rates_type == "QUICK":
        curve = QuickRates(*bends(QUICK_RATE_DEG_S), *shares)
    elif rates_type == "BETAFLIGHT":
        most = 1.0 - LEAST_REMAINDER
        curve = BetaflightRates(*(min(rate / PERCENT, most) for rate in super_rates), *shares)
    else:
        return None
    return curve if any(getattr(curve, name) for name in effect_of(curve).notable) else None
