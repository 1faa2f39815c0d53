"""Settings of the firmware, from a dict or the text of a pilot's ``dump`` or ``diff all``.

Each setting is read back.

A setting's name is that of the command line's ``set``, or ``feature NAME`` with the value ON or
OFF.
"""

from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

from firmware.body import FirmwareError
from flytrack_env.messages import quote_name

ARM_SWITCH = "aux 0 0 0 1700 2100 0 0"
CHANNEL_ORDER = "map AETR1234"
# Lines of a dump about pins, lights, radio and switches, which a simulated board has not: left out.
HARDWARE = {
    "adjrange",
    "aux",
    "batch",
    "beacon",
    "beeper",
    "board_name",
    "color",
    "defaults",
    "dma",
    "led",
    "manufacturer_id",
    "map",
    "mcu_id",
    "mode_color",
    "resource",
    "rxfail",
    "rxrange",
    "save",
    "serial",
    "signature",
    "timer",
    "vtx",
    "vtxtable",
}
PROFILES, RATE_PROFILES = 4, 4
MAX_NAMES = 12  # in a message


class Setting(NamedTuple):
    """One setting and the profiles that were selected when it was made."""

    name: str
    value: str
    profile: int
    rate_profile: int

    @property
    def line(self) -> str:
        """The line that makes the setting."""
        if self.name.startswith("feature "):
            feature = self.name.removeprefix("feature ")
            return f"feature {'' if self.value == 'ON' else '-'}{feature}"
        return f"set {self.name} = {self.value}"


def _number(line: str, most: int) -> int:
    words = line.split()
    if len(words) != 2 or not words[1].isdecimal() or int(words[1]) >= most:
        raise FirmwareError(f"settings: found {quote_name(line)}, expected a number below {most}")
    return int(words[1])


def _setting_in(line: str) -> tuple[str, str] | None:
    """Return name and value of a line ``set`` or ``feature``, None for another line."""
    command, _, rest = line.partition(" ")
    if command == "feature" and rest:
        name = rest.strip().upper()
        return f"feature {name.removeprefix('-')}", "OFF" if name.startswith("-") else "ON"
    if command == "set" and "=" in rest:
        name, _, value = rest.partition("=")
        return name.strip().lower(), value.strip()
    return None


def parse_dump(text: str) -> list[Setting]:
    """Return the settings in the text of a dump, in its order; lines about hardware are left out.

    Raises: FirmwareError: a line that is none of ``set``, ``feature``, ``profile``,
            ``rateprofile``, ``mixer QUADX`` or hardware; the message names it.
    """
    profile = rate_profile = 0
    found = []
    for raw in text.splitlines():
        line = raw.partition("#")[0].strip()
        command = line.partition(" ")[0]
        if not line or command in HARDWARE or line.upper() == "MIXER QUADX":
            continue
        if command == "profile":
            profile = _number(line, PROFILES)
        elif command == "rateprofile":
            rate_profile = _number(line, RATE_PROFILES)
        elif setting := _setting_in(line):
            found.append(Setting(*setting, profile, rate_profile))
        else:
            raise FirmwareError(
                f"settings: found {quote_name(line)}, expected set, feature or profile lines"
            )
    return found


def _values_in(name: str) -> dict[str, str]:
    """Return the settings in a file of this folder, the text of a dump, by name."""
    return {one.name: one.value for one in parse_dump(Path(__file__).with_name(name).read_text())}


DEFAULTS, REQUIRED = _values_in("defaults.txt"), _values_in("required.txt")


def settings_of(
    given: str | Mapping[str, object], skip: Iterable[str] = (), has_blackbox: bool = False
) -> list[Setting]:
    """Return the settings to make: those given, above the defaults.

    The defaults are ``DEFAULTS`` for a dict, and the firmware's own for a dump.

    ``REQUIRED`` ones come last. skip: patterns of names to leave out, ``osd_*`` say. has_blackbox:
    it logs.

    Raises:
        FirmwareError: a dump that cannot be read, or a required setting that a dict would change.
    """
    if isinstance(given, str):
        made = parse_dump(given)
    else:
        values = {_name(str(name)): _text(value) for name, value in given.items()}
        for name in REQUIRED.keys() & values.keys():
            if values[name].upper() != REQUIRED[name]:
                expected = f"expected {REQUIRED[name]}, which the plant needs"
                raise FirmwareError(f"settings: {name}: found {values[name]}, {expected}")
        made = [Setting(name, value, 0, 0) for name, value in (DEFAULTS | values).items()]
    skipped = tuple(skip)
    made = [
        one
        for one in made
        if one.name not in REQUIRED and not any(fnmatch(one.name, p) for p in skipped)
    ]
    last = made[-1] if made else Setting("", "", 0, 0)
    required = REQUIRED | ({"blackbox_device": "VIRTUAL"} if has_blackbox else {})
    return [*made, *(last._replace(name=name, value=value) for name, value in required.items())]


def _name(text: str) -> str:
    name = text.strip().lower()
    return f"feature {name[8:].upper()}" if name.startswith("feature ") else name


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "ON" if value else "OFF"
    if isinstance(value, (list, tuple)):
        return ",".join(map(str, value))
    return str(value).strip()


def lines_of(settings: list[Setting]) -> list[str]:
    """Return the lines to type, without ``save``.

    Profiles are selected before the settings made in them.
    """
    lines, profile, rate_profile = [], 0, 0
    for one in settings:
        if one.profile != profile:
            profile = one.profile
            lines.append(f"profile {profile}")
        if one.rate_profile != rate_profile:
            rate_profile = one.rate_profile
            lines.append(f"rateprofile {rate_profile}")
        lines.append(one.line)
    return [*lines, CHANNEL_ORDER, ARM_SWITCH]


def values_of(dump: str) -> dict[tuple[str, int, str], str]:
    """Return the values in the firmware's own ``dump all`` by scope, profile number and name."""
    scope, number, found = "master", 0, {}
    for raw in dump.splitlines():
        line = raw.partition("#")[0].strip()
        command, _, rest = line.partition(" ")
        if command in ("profile", "rateprofile"):
            scope, number = command, int(rest)
            found["master", 0, command] = rest  # its last lines select what was selected
        elif setting := _setting_in(line):
            name, value = setting
            found[scope, number, name] = value  # features come before the profiles
    return found


def value_of(values: Mapping[tuple[str, int, str], str], setting: Setting) -> str | None:
    """Return what the firmware has for a setting, in its profile; None if it has no such name."""
    places = (("master", 0), ("profile", setting.profile), ("rateprofile", setting.rate_profile))
    return next((values[*p, setting.name] for p in places if (*p, setting.name) in values), None)


def configure(settings: list[Setting], type_line: Callable[[str], str]) -> None:
    """Make the settings; type_line: types a line and returns the firmware's answer.

    Raises:
        FirmwareError: the firmware refuses some; the message names them, and how to leave them out.
    """
    refused = []
    for line in lines_of(settings):
        answer = type_line(line)
        if "###ERROR" in answer or "ERR_CMD_NA" in answer:
            refused.append(line.partition("=")[0].removeprefix("set ").strip())
    _complain("refused", refused)


def check_read_back(settings: list[Setting], dump: str) -> None:
    """Raise FirmwareError unless the firmware, started again, has every setting as it was made."""
    values, wanted = values_of(dump), {}
    for one in settings:  # a later line replaces an earlier one
        wanted[one.name, one.profile, one.rate_profile] = one
    wrong = []
    for name, number in (
        ("profile", settings[-1].profile),
        ("rateprofile", settings[-1].rate_profile),
    ):
        wanted[name, 0, 0] = Setting(name, str(number), 0, 0)
    for one in wanted.values():
        found = value_of(values, one)
        if found is None or found.replace(" ", "").upper() != one.value.replace(" ", "").upper():
            wrong.append(f"{one.name} (asked for {one.value}, has {found})")
    _complain("did not keep", wrong)


def _complain(what: str, names: list[str]) -> None:
    if names:
        more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
        listed = ", ".join(names[:MAX_NAMES])
        raise FirmwareError(
            f"settings: the firmware {what} {listed}{more}; skip=[...] leaves names out"
        )
