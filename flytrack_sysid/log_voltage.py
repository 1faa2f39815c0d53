"""The voltages at which a log was flown, and the battery of its craft.

Where ``v_bat`` was not logged, thrust is taken at the middle of the pack's stated range, else of
the model's battery.
"""

from dataclasses import replace

import numpy as np

from flytrack_env.battery import MAX_EXTRAPOLATION, Battery
from flytrack_env.dynamics import ModelParameters
from flytrack_env.state import BATTERY_EMPTY_V, BATTERY_FULL_V
from flytrack_sysid.log import FlightLog

# Percentiles of a logged voltage, so that an isolated wrong sample does not widen the range. A pack
# that falls evenly from 16.7 to 14.4 V loses only 12 mV at each end.
LOWEST_PERCENTILE, HIGHEST_PERCENTILE = 0.5, 99.5
DECIMALS = 3  # of a battery's voltages, V; sensors have two


def voltages_of(battery: Battery) -> tuple[float, float]:
    """Return the voltages of an empty and a full battery, V."""
    return float(battery.empty_v), float(battery.full_v)


def with_voltage(log: FlightLog, model: ModelParameters) -> FlightLog:
    """Return a log with a voltage; that of the model's battery if none is logged or stated."""
    if "v_bat" in log or log.stated_voltage_v is not None:
        return log
    return replace(log, stated_voltage_v=voltages_of(model.battery))


def assumed_voltage(log: FlightLog) -> float:
    """Return the voltage of a log without ``v_bat``, V.

    It is the middle of the stated range, else of the handout's battery.
    """
    low, high = log.stated_voltage_v or (BATTERY_EMPTY_V, BATTERY_FULL_V)
    return 0.5 * (low + high)


def flown_voltages(log: FlightLog) -> tuple[float, float]:
    """Return the lowest and the highest voltage of a log, logged or stated, V."""
    if "v_bat" not in log:
        return log.stated_voltage_v or (assumed_voltage(log), assumed_voltage(log))
    low, high = np.percentile(log["v_bat"], [LOWEST_PERCENTILE, HIGHEST_PERCENTILE]).round(DECIMALS)
    return float(low), float(high)


def is_within(voltages: tuple[float, float], battery: Battery) -> bool:
    """Return whether voltages are in a battery's range, extended by the allowed extrapolation."""
    margin = MAX_EXTRAPOLATION * float(battery.full_v)
    return (
        voltages[0] >= float(battery.empty_v) - margin
        and voltages[1] <= float(battery.full_v) + margin
    )


def battery_of_craft(log: FlightLog, battery: Battery) -> Battery:
    """Return the battery of a log's craft: the model's, unless the log has other voltages.

    In that case it ranges from the highest voltage of the log down to the lowest. If the log hardly
    drains it, it goes down by the same fraction as the model's battery.
    """
    low, high = flown_voltages(log)
    if is_within((low, high), battery):
        return battery
    empty_v = min(low, round(high * float(battery.empty_v) / float(battery.full_v), DECIMALS))
    return battery._replace(full_v=high, empty_v=empty_v, fitted_low_v=low, fitted_high_v=high)


def fitted_battery(log: FlightLog, battery: Battery) -> Battery:
    """Return the battery of a log's craft, with a thrust map that was fitted to the log."""
    low, high = flown_voltages(log) if "v_bat" in log else (assumed_voltage(log),) * 2
    return battery_of_craft(log, battery)._replace(fitted_low_v=low, fitted_high_v=high)


def voltage_notes(log: FlightLog, battery: Battery) -> list[str]:
    """Return notes on an assumed voltage, and on a voltage beyond the model's battery.

    Args:
        log: as given, without a voltage from the model.
        battery: the model's, as given.
    """
    notes = []
    if "v_bat" not in log:
        lender = (
            "the model's battery"
            if log.stated_voltage_v is None
            else "the voltages stated for the craft"
        )
        low, high = log.stated_voltage_v or voltages_of(battery)
        notes.append(
            f"v_bat is absent: {log.source} is taken as flown at {0.5 * (low + high):.4g} V, the "
            f"middle of {lender} ({low:.4g} to {high:.4g} V)"
        )
        if log.stated_voltage_v is None:
            return notes
    low, high = flown_voltages(log)
    if not is_within((low, high), battery):
        overlap = (
            "exceeds"
            if low <= float(battery.full_v) and high >= float(battery.empty_v)
            else "is outside"
        )
        notes.append(
            f"voltage: {log.source} was flown at {low:.4g} to {high:.4g} V, which {overlap} the "
            f"model's battery, {battery.describe()} (thrust map of {battery.describe_fitted()}); "
            "is it of this craft?"
        )
    return notes
