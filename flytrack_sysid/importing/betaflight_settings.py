"""Betaflight's settings: the rate at full stick, and stick curve and rate loop as effects.

Source: ``apply...Rates`` in Betaflight 4.6, src/main/fc/rc.c, and controlrate_profile.h. The loop's
body is still to be fitted.
"""

from collections.abc import Callable, Sequence
from typing import Any

from flytrack_env.effects import ActualRates, BetaflightLoop, BetaflightRates, QuickRates, effect_of

RATES_TYPES = ("BETAFLIGHT", "RACEFLIGHT", "KISS", "ACTUAL", "QUICK")
PERCENT = 100.0
STEEP_RC_RATE, STEEP_SLOPE = 2.0, 14.54  # above this RC rate, the curve gets steeper
BETAFLIGHT_RATE_DEG_S = KISS_RATE_DEG_S = 200.0  # at RC rate 1
TENS = 10.0  # deg/s in one unit of the other types' settings
QUICK_RATE_DEG_S = 2.0  # per unit of RC rate
MIN_REMAINDER = 0.01  # of 1 less the super rate, as the firmware bounds it
# What the effect of the loop has as it comes; a craft that differs is flown by another loop.
ASSUMED = {
    "mixer_type": "LEGACY",
    "tpa_mode": "D",
    "iterm_relax_type": "SETPOINT",
    "dterm_lpf1_type": "PT1",
    "dterm_lpf2_type": "PT1",
    "use_integrated_yaw": "OFF",
    "transient_throttle_limit": "0",
    "feedforward_transition": "0",
}
# A racer of 5 inch, before anything was fitted.
GENERIC = BetaflightLoop(20.0, 20.0, 2.0, 2.0, 0.02, 0.5)
SETTINGS = BetaflightLoop._fields[
    BetaflightLoop._fields.index("p_roll") :
]  # before them: the craft
MIN_SMOOTHING_HZ, SMOOTHING, TENTHS = 15, 1.5, 10.0


def full_stick_rate(
    rates_type: str, rc_rate: float, super_rate: float, limit_deg_s: float
) -> float:
    """Return the body rate at full stick, deg/s, by Betaflight's rate settings.

    Expo does not change it.

    rc_rate, super_rate, limit_deg_s: as in the log's headers ``rc_rates``, ``rates``,
    ``rate_limits``.
    """
    remainder = max(1.0 - super_rate / PERCENT, MIN_REMAINDER)
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
    """Return the effect that bends sticks as the rate settings do.

    None for rate types without such an effect, and for straight settings.

    axes: of roll, pitch, yaw, the rates and the expo as in the log's headers ``rc_rates``,
    ``rates``, ``rc_expo``. Assumption: no rate limit is below the rate at full stick, and Quick
    rates leave the expo out of the stick (``quick_rates_rc_expo`` is OFF, as it comes).
    """
    rc_rates, super_rates, expos = zip(*axes, strict=True)

    def bends(slope_deg_s: float) -> list[float]:
        slopes = [slope_deg_s * rc_rate for rc_rate in rc_rates]  # about the centre, deg/s
        return [
            1.0 - slope / max(slope, TENS * top)
            for slope, top in zip(slopes, super_rates, strict=True)
        ]

    shares = [expo / PERCENT for expo in expos]
    if rates_type == "ACTUAL":
        curve: Any = ActualRates(*bends(TENS), *shares)
    elif rates_type == "QUICK":
        curve = QuickRates(*bends(QUICK_RATE_DEG_S), *shares)
    elif rates_type == "BETAFLIGHT":
        most = 1.0 - MIN_REMAINDER
        curve = BetaflightRates(*(min(rate / PERCENT, most) for rate in super_rates), *shares)
    else:
        return None
    return curve if any(getattr(curve, name) for name in effect_of(curve).notable) else None


def rate_loop(value: Callable[[str], str], frames_hz: float) -> BetaflightLoop | None:
    """Return the effect of a craft's settings; None if its firmware's loop is not that effect's.

    value: of a setting, by its name on the command line. frames_hz: how often the receiver's frames
    come, which should be how often a log has commands.
    """
    if any(value(name) not in ("", expected) for name, expected in ASSUMED.items()):
        return None
    found = {name: float(value(name)) for name in SETTINGS if value(name)}
    for stem in ("gyro_lpf1", "dterm_lpf1"):
        if not found[f"{stem}_dyn_min_hz"]:  # then the filter does not follow throttle
            cutoff_hz = float(value(f"{stem}_static_hz"))
            found |= {f"{stem}_dyn_min_hz": cutoff_hz, f"{stem}_dyn_max_hz": cutoff_hz}
    if value("iterm_relax") == "OFF":
        found["iterm_relax_cutoff"] = 0.0
    found["sticks_hz"] = _smoothing(value, "setpoint", "rc_smoothing_auto_factor", frames_hz)
    found["throttle_hz"] = _smoothing(
        value, "throttle", "rc_smoothing_auto_factor_throttle", frames_hz
    )
    return GENERIC._replace(**found)


def _smoothing(value: Callable[[str], str], channel: str, factor: str, frames_hz: float) -> float:
    """Return the cutoff of the receiver's smoothing, a whole number of Hz; 0 without smoothing."""
    if value("rc_smoothing") == "OFF":
        return 0.0
    cutoff_hz = float(value(f"rc_smoothing_{channel}_cutoff"))
    automatic = int(frames_hz * SMOOTHING / (1.0 + float(value(factor)) / TENTHS))
    return cutoff_hz or float(max(automatic, MIN_SMOOTHING_HZ))
