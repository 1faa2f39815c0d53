"""Betaflight's rate loop as an effect of a model, from a craft's settings; its body is still to be fitted."""

from collections.abc import Callable

from flytrack_env.effects import BetaflightLoop

# What the effect has as it comes; a craft that differs is flown by another loop.
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
SETTINGS = BetaflightLoop._fields[BetaflightLoop._fields.index("p_roll") :]  # before them: the craft
LEAST_SMOOTHING_HZ, SMOOTHING, TENTHS = 15, 1.5, 10.0


def rate_loop(value: Callable[[str], str], frames_hz: float) -> BetaflightLoop | None:
    """Return the effect of a craft's settings; None where the firmware flies by a loop that it has not.

    value: of a setting, by its name on the command line. frames_hz: how often the receiver's frames come,
    which should be how often a log has commands.
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
    found["throttle_hz"] = _smoothing(value, "throttle", "rc_smoothing_auto_factor_throttle", frames_hz)
    return GENERIC._replace(**found)


def _smoothing(value: Callable[[str], str], channel: str, factor: str, frames_hz: float) -> float:
    """Return the cutoff of the receiver's smoothing, Hz, whole as the firmware has it; 0 if there is none."""
    if value("rc_smoothing") == "OFF":
        return 0.0
    cutoff_hz = float(value(f"rc_smoothing_{channel}_cutoff"))
    automatic = int(frames_hz * SMOOTHING / (1.0 + float(value(factor)) / TENTHS))
    return cutoff_hz or float(max(automatic, LEAST_SMOOTHING_HZ))
