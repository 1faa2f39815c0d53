"""Betaflight blackbox logs (``.bbl``, ``.bfl``), decoded by orangebox.

Betaflight's body frame is ours: x forward, y left, z up; so is its accelerometer's sign (+1 g at rest), and
positive yaw is to the left. docs/real_logs.md says how that was checked on a real log. There is no
attitude or velocity in these logs.
"""

from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.files import read_at_most
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_sysid.importing.craft import Craft
from flytrack_sysid.importing.decoding import decode
from flytrack_sysid.importing.flight import Flight
from flytrack_sysid.importing.mapping import Mapping
from flytrack_sysid.importing.resample import growing
from flytrack_sysid.importing.units import GRAVITY, PER_DEGREE, UNITS
from flytrack_sysid.log import CHANNELS, LogError
from flytrack_sysid.log_table import Table, log_of_table

FIRMWARE = "Betaflight"
LARGEST_BYTES = 2**29  # of a chip
FIRST_BYTES = b"H Product:Blackbox"
END_OF_LOG = b"E\xffEnd of log"  # the event that a logger writes last
STICKS = tuple(f"setpoint[{axis}]" for axis in range(4))
GYRO = tuple(f"gyroADC[{axis}]" for axis in range(3))
ACCELEROMETER = tuple(f"accSmooth[{axis}]" for axis in range(3))
BATTERY = "vbatLatest"
FULL_THROTTLE = 1000.0  # setpoint[3] at full throttle; 0 at none
LEAST_FULL_CELL_V = 2.0  # a setting below that was in tenths of V, as old firmware has all voltages
FINE = 10.0  # units in one deg/s where blackbox_high_resolution is set
MICROSECOND = UNITS["time"]["us"]
# Of Betaflight 4, src/main/fc/rc.c and controlrate_profile.h.
RATES_TYPES = ("BETAFLIGHT", "RACEFLIGHT", "KISS", "ACTUAL", "QUICK")
PERCENT = 100.0
STEEP_RC_RATE, STEEP_SLOPE = 2.0, 14.54  # above this RC rate, the curve gets steeper
BETAFLIGHT_RATE_DEG_S = 200.0  # at RC rate 1
KISS_RATE_DEG_S = 200.0  # at RC rate 1
TENS = 10.0  # deg/s in one unit of the other types' settings
QUICK_RATE_DEG_S = 2.0  # per unit of RC rate
LARGEST = 1e9  # of numbers in the header
LONGEST_LIST = 1000  # characters of names of fields
LEAST_REMAINDER = 0.01  # of 1 less the super rate, as the firmware bounds it


def full_stick_rate(rates_type: str, rc_rate: float, super_rate: float, limit_deg_s: float) -> float:
    """Return the body rate at full stick, deg/s, by Betaflight's rate settings.

    rates_type: of ``RATES_TYPES``. rc_rate, super_rate, limit_deg_s: as in the log's header ``rc_rates``,
    ``rates``, ``rate_limits``. Source: ``apply...Rates`` in Betaflight 4.5, src/main/fc/rc.c, where expo
    plays no part at full stick.
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


def read_betaflight(path: Path, mapping: Mapping) -> list[Flight]:
    """Return the flights in a blackbox file, one per log in it: commands, rates, specific force, voltage.

    Commands are the rate setpoints over the rates at full stick (by the mapping's ``craft.max_rate_deg_s``,
    else by the rate settings in the log's header), and throttle from none to full as -1 to 1. Rates and
    force are what the flight controller works with, filtered by it.

    Raises:
        LogError: orangebox is not installed; no blackbox file of Betaflight 4, or cut off; a field of the
            header or of the frames that is missing or cannot be meant. The message names file and field.
    """
    num_logs = _count(path)
    notes, frames = decode(str(path), "betaflight", path, num_logs)
    return [
        _flight(str(path) if num_logs == 1 else f"{path}, log {number}", error_text, rows, mapping)
        for number, (error_text, rows) in enumerate(zip(notes, frames, strict=True), start=1)
    ]


def _flight(source: str, error_text: dict[str, Any], frames: np.ndarray, mapping: Mapping) -> Flight:
    headers, names = error_text["headers"], error_text["names"]
    if not len(frames):
        raise LogError(f"{source}: found no frames, expected at least one")
    revision = str(headers.get("Firmware revision", "none"))
    if not revision.startswith(FIRMWARE):
        raise LogError(
            f"{source}: header Firmware revision: found {quote_value(revision)}, expected {FIRMWARE} 4"
        )
    for name in ("time", *STICKS, *GYRO, *ACCELEROMETER):
        if name not in names:
            listed = ", ".join(map(quote_name, names))[:LONGEST_LIST]
            raise LogError(f"{source}: field {name}: missing; found {listed}")
    columns = dict(zip(names, frames.T, strict=True))
    is_used = growing(columns["time"])
    craft = mapping.craft
    if craft.max_rate_deg_s is None:
        craft = craft._replace(max_rate_deg_s=_full_stick(source, headers))
    table = Table(source, {name: values[is_used] for name, values in columns.items()})
    log = log_of_table(table._replace(columns=_channels(table, headers, craft)))
    dropped = np.count_nonzero(~is_used)
    notes: tuple[str, ...] = (f"{source}: {quote_name(revision)}, {len(frames)} frames",)
    if dropped:
        notes += (f"{source}: {dropped} frames left out: their time was not later than those before",)
    return Flight(log, craft, notes)


def _channels(table: Table, headers: dict[str, Any], craft: Craft) -> dict[str, np.ndarray]:
    """Return the columns of the log."""
    is_fine = _header(table.source, headers, "blackbox_high_resolution", 1, [0])[0] > 0
    per_unit = 1.0 / FINE if is_fine else 1.0  # deg/s
    full = np.array([*(craft.max_rate_deg_s or ()), FULL_THROTTLE])
    units = np.array([per_unit, per_unit, per_unit, 1.0])
    commands = table.matrix(STICKS) * units / full
    commands[:, 3] = 2.0 * commands[:, 3] - 1.0
    # Setpoints are whole numbers: half of one past full stick is rounding.
    is_rounding = np.abs(commands) <= 1.0 + units / 2 / full
    time, g_unit = table.columns["time"], _header(table.source, headers, "acc_1G", 1)[0]
    if g_unit == 0.0:
        raise LogError(
            f"{table.source}: header acc_1G: found 0, expected what the accelerometer shows at 1 g"
        )
    found = {"t": (time - time[0]) * MICROSECOND}
    parts = [
        ("u", np.where(is_rounding, np.clip(commands, -1.0, 1.0), commands)),
        ("f", table.matrix(ACCELEROMETER) * GRAVITY / g_unit),
        ("w", table.matrix(GYRO) * per_unit * PER_DEGREE),
    ]
    if BATTERY in table.columns:
        largest_cell = _header(table.source, headers, "vbatcellvoltage", 3)[-1]
        unit = "cV" if largest_cell * UNITS["voltage"]["cV"] >= LEAST_FULL_CELL_V else "dV"
        parts.append(("v_bat", table.matrix([BATTERY]) * UNITS["voltage"][unit]))
    for name, values in parts:
        found |= dict(zip(CHANNELS[name], values.T, strict=True))
    return found


def _header(
    source: str, headers: dict[str, Any], name: str, size: int, default: list[float] | None = None
) -> list[float]:
    """Return some numbers of the header, 0 or more, or the default where the header has none."""
    value: Any = headers.get(name, default)
    values = value if isinstance(value, list) else [value]
    if len(values) != size or not all(isinstance(one, (int, float)) and 0 <= one < LARGEST for one in values):
        raise LogError(
            f"{source}: header {name}: found {quote_value(value)}, expected {size} numbers of at least 0"
        )
    return [float(one) for one in values]


def _full_stick(source: str, headers: dict[str, Any]) -> tuple[float, float, float]:
    """Return the rates at full stick of roll, pitch, yaw, deg/s."""
    if "rc_rates" not in headers:
        hint = "a mapping can state craft.max_rate_deg_s"
        raise LogError(f"{source}: header rc_rates: missing, so full stick is unknown; {hint}")
    number = int(_header(source, headers, "rates_type", 1)[0])
    if number >= len(RATES_TYPES):
        raise LogError(f"{source}: header rates_type: found {number}, expected below {len(RATES_TYPES)}")
    settings = [_header(source, headers, name, 3) for name in ("rc_rates", "rates", "rate_limits")]
    axes = zip(*settings, strict=True)
    roll, pitch, yaw = rates = tuple(full_stick_rate(RATES_TYPES[number], *axis) for axis in axes)
    if min(rates) <= 0.0:
        raise LogError(f"{source}: headers rc_rates, rates, rate_limits: found full stick at {rates} deg/s")
    return roll, pitch, yaw


def _count(path: Path) -> int:
    """Return the number of logs in a blackbox file, each of which has its end."""
    try:
        content = read_at_most(path, LARGEST_BYTES)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error_text(error)}") from error
    if not content.startswith(FIRST_BYTES):
        raise LogError(f"{path}: found {content[: len(FIRST_BYTES)]!r} first, expected {FIRST_BYTES!r}")
    logs = content.split(FIRST_BYTES)[1:]
    for number, log in enumerate(logs, start=1):
        if END_OF_LOG not in log:
            found = f"no end-of-log event in {len(log)} bytes"
            raise LogError(f"{path}: log {number} of {len(logs)}: cut off: found {found}")
    return len(logs)
