"""The script that a diagnosis asks for, and why."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis.result import SCHEMA, TO_LOG
from flytrack_sysid.envelope import VOLTAGES
from flytrack_sysid.manoeuvres import MANOEUVRES, SECONDS_PER_MANOEUVRE, flights_of, hover_action
from flytrack_sysid.script_file import Script, ScriptError, script_of


class NextFlight(NamedTuple):
    """A script, and the effects that each of its manoeuvres is for."""

    script: Script
    reasons: Mapping[str, tuple[str, ...]]

    def describe(self) -> str:
        """Return lines on what is in it, why, and how to fly the same on a real drone."""
        lines = [f"{len(self.script.kinds)} flights, {SECONDS_PER_MANOEUVRE:g} s of each manoeuvre"]
        for name, effects in self.reasons.items():
            lines += [f"{name}: to settle {', '.join(effects)}", f"    {MANOEUVRES[name].how}"]
        return "\n".join(lines)


def _reasons(path: Path, content: Any) -> dict[str, tuple[str, ...]]:
    """Return manoeuvre -> effects that a diagnosis names, in the order of ``MANOEUVRES``."""
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        found = content.get("schema") if isinstance(content, dict) else type(content).__name__
        raise ScriptError(f"{path}: schema: found {found!r}, expected {SCHEMA}")
    listed = content.get("not_identifiable")
    if not isinstance(listed, list):
        raise ScriptError(f"{path}: not_identifiable: found {type(listed).__name__}, expected a list")
    wanted: dict[str, list[str]] = {name: [] for name in MANOEUVRES}
    for number, one in enumerate(listed):
        effect, fly = (one.get(key) if isinstance(one, dict) else None for key in ("effect", "fly"))
        place = f"{path}: not_identifiable[{number}]"
        if not isinstance(effect, str):
            raise ScriptError(f"{place}: effect: found {effect!r}, expected a name")
        if isinstance(fly, str) and fly.startswith(TO_LOG):
            continue  # a sensor settles it, no flight
        if not isinstance(fly, str) or fly not in MANOEUVRES:
            raise ScriptError(f"{place}: fly: found {fly!r}, expected one of {', '.join(MANOEUVRES)}")
        wanted[fly].append(effect)
    return {name: tuple(effects) for name, effects in wanted.items() if effects}


def _voltages(path: Path, content: dict[str, Any]) -> tuple[float, float]:
    """Return the voltages that a diagnosis has seen; those of the handout's drone where it saw none."""
    data = content.get("data")
    found = data.get("voltages") if isinstance(data, dict) else None
    if found is None:
        return VOLTAGES
    numbers = found if isinstance(found, list) and all(isinstance(one, int | float) for one in found) else []
    if len(numbers) != 2 or not 0.0 < numbers[0] <= numbers[1] < np.inf:
        raise ScriptError(f"{path}: data: voltages: found {found!r}, expected the lowest and the highest, V")
    return float(numbers[0]), float(numbers[1])


def next_flight(path: str | Path, model: ModelParameters, seed: int = 0) -> NextFlight:
    """Return the flights that a ``diagnosis.json`` asks for, for a drone that hovers as a model does.

    Raises:
        ScriptError: a file that cannot be read or is no diagnosis, or that asks for no flight.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ScriptError(f"{path}: cannot be read: {error}") from error
    reasons = _reasons(path, content)
    if not reasons:
        raise ScriptError(f"{path}: not_identifiable: found nothing that another flight would settle")
    voltages = _voltages(path, content)
    hover = hover_action(model, voltages)
    return NextFlight(script_of(flights_of(reasons, hover, seed, voltages)), reasons)
