"""Betaflight's settings: the rate at full stick, and stick curve and rate loop as effects.

Source: ``apply...Rates`` in Betaflight 4.6, src/main/fc/rc.c, and controlrate_profile.h. The
settings do not state the craft's body in the loop; a fit has to determine it.
"""

from collections.abc import Callable, Sequence
from typing import Any

from flytrack_env.effects import ActualRates, BetaflightLoop, BetaflightRates, QuickRates, effect_of

RATES_TYPES = ("BETAFLIGHT", "RACEFLIGHT", "KISS", "ACTUAL", "QUICK")
PERCENT = 100.0
STEEP_RC_RATE, STEEP_SLOPE = 2.0, 14.54  # the curve is steeper above this RC rate
BETAFLIGHT_RATE_DEG_S = KISS_RATE_DEG_S = 200.0  # at RC rate 1
TENS = 10.0  # deg/s in one unit of the other types' settings
QUICK_RATE_DEG_S = 2.0  # per unit of RC rate
MIN_REMAINDER = 0.01  # lower bound of 1 minus the super rate, as in the firmware
# Settings that the effect of the loop assumes; a craft with other settings has another loop.
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
# A racer of 5 inch, before any fit.
GENERIC = BetaflightLoop(20.0, 20.0, 2.0, 2.0, 0.02, 0.5)
SETTINGS = BetaflightLoop._fields[
    BetaflightLoop._fields.index("p_roll") :
]  # the fields before are of the craft
MIN_SMOOTHING_HZ, SMOOTHING, TENTHS = 15, 1.5, 10.0


def full_stick_rate(
    rates_type: str, rc_rate: float, super_rate: float, limit_deg_s: float
) -> float:
    """Return the body rate at full stick, deg/s, by Betaflight's rate settings.

    Expo does not change it.

    Args:
        rates_type: one of ``RATES_TYPES``.
        rc_rate: as in the log's header ``rc_rates``.
        super_rate: as in the log's header ``rates``.
        limit_deg_s: as in the log's header ``rate_limits``.
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
    """Return the effect with the stick curve of the rate settings.

    Assumption: no rate limit is below the rate at full stick, and Quick rates do not apply expo to
    the stick (``quick_rates_rc_expo`` is OFF, the default).

    Args:
        rates_type: one of ``RATES_TYPES``.
        axes: of roll, pitch and yaw, the values of the log's headers ``rc_rates``, ``rates`` and
            ``rc_expo``.

    Returns:
        The effect; None for rate types without one, and for linear curves.
    """
    rc_rates, super_rates, expos = zip(*axes, strict=True)

    def bends(slope_deg_s: float) -> list[float]:
        slopes = [slope_deg_s * rc_rate for rc_rate in rc_rates]  # about the centre, deg/s
        return [
            1.0 - slope / max(slope, TENS * super_rate)
            for slope, super_rate in zip(slopes, super_rates, strict=True)
        ]

    expo_fractions = [expo / PERCENT for expo in expos]
    if rates_type == "ACTUAL":
        curve: Any = ActualRates(*bends(TENS), *expo_fractions)
    elif rates_type == "QUICK":
        curve = QuickRates(*bends(QUICK_RATE_DEG_S), *expo_fractions)
    elif rates_type == "BETAFLIGHT":
        max_fraction = 1.0 - MIN_REMAINDER
        curve = BetaflightRates(
            *(min(rate / PERCENT, max_fraction) for rate in super_rates), *expo_fractions
        )
    else:
        return None
    return curve if any(getattr(curve, name) for name in effect_of(curve).notable) else None


def rate_loop(value: Callable[[str], str], frames_hz: float) -> BetaflightLoop | None:
    """Return the rate loop with a craft's settings; None if they select another loop.

    Args:
        value: returns a setting by its name on the command line.
        frames_hz: rate of the receiver's frames, which should be that of the commands in a log.
    """
    if any(value(name) not in ("", expected) for name, expected in ASSUMED.items()):
        return None
    settings = {name: float(value(name)) for name in SETTINGS if value(name)}
    for stem in ("gyro_lpf1", "dterm_lpf1"):
        if not settings[f"{stem}_dyn_min_hz"]:  # the filter does not follow throttle
            cutoff_hz = float(value(f"{stem}_static_hz"))
            settings |= {f"{stem}_dyn_min_hz": cutoff_hz, f"{stem}_dyn_max_hz": cutoff_hz}
    if value("iterm_relax") == "OFF":
        settings["iterm_relax_cutoff"] = 0.0
    settings["sticks_hz"] = _smoothing(value, "setpoint", "rc_smoothing_auto_factor", frames_hz)
    settings["throttle_hz"] = _smoothing(
        value, "throttle", "rc_smoothing_auto_factor_throttle", frames_hz
    )
    return GENERIC._replace(**settings)


def _smoothing(value: Callable[[str], str], channel: str, factor: str, frames_hz: float) -> float:
    """Return the cutoff of the receiver's smoothing, a whole number of Hz; 0 without smoothing."""
    if value("rc_smoothing") == "OFF":
        return 0.0
    cutoff_hz = float(value(f"rc_smoothing_{channel}_cutoff"))
    automatic = int(frames_hz * SMOOTHING / (1.0 + float(value(factor)) / TENTHS))
    return cutoff_hz or float(max(automatic, MIN_SMOOTHING_HZ))
