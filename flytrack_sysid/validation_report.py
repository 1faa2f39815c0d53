"""A validation as files: numbers, text, figures, and a page with all of them."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_sysid.log import FlightLog
from flytrack_sysid.page import (
    Bullets,
    Picture,
    Section,
    Table,
    Text,
    page,
    text_table,
    write_report,
)
from flytrack_sysid.plots import draw_steps, draw_thrust, png_of
from flytrack_sysid.prediction_errors import (
    NORMALISED_BY,
    NRMSE_MEANING,
    SHOWN_UNITS,
    START_EVERY_S,
    UNITS,
    ThrustError,
)
from flytrack_sysid.validate import NAMES, Validation

# Heading of each figure, in the order of the page, and its caption.
HEADINGS = {
    "steps": "Step responses",
    "rollouts": "Free flight",
    "one_step": "One step",
    "thrust": "Thrust by command and voltage",
}
CAPTIONS = {
    "steps": (
        "Body rates, measured (solid) and of the model flying by itself from 0.1 s before the "
        "command."
    ),
    "thrust": "Mass times specific force along body z: mean error by applied action and voltage.",
}


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if np.isfinite(value) else "diverges"


def _one_step_table(validation: Validation) -> Table:
    rows = []
    for name, error in validation.one_step.channels.items():
        unit = {"1": "1", "m": "m^2"}.get(UNITS[name], f"({UNITS[name]})^2")
        rows.append([f"{NAMES[name]} ({name})", _number(error.mse), unit, _number(error.nrmse)])
        if error.angle_rms_deg is not None:
            rows.append(["attitude, rms angle", _number(error.angle_rms_deg), "deg", ""])
    caption = f"One step: {validation.one_step.num_steps} steps"
    return Table(["channel", "MSE", "unit", "NRMSE"], rows, caption)


def _rollout_table(validation: Validation) -> Table:
    rows = []
    for rollout in validation.rollouts:
        for name, spread in rollout.errors.items():
            numbers = [_number(number) for number in spread]
            quantity = f"{name} ({SHOWN_UNITS[name]})"
            rows.append([f"{rollout.horizon_s:g} s", quantity, *numbers, str(rollout.num_starts)])
    caption = f"Free flight: a start every {START_EVERY_S:g} s of judged flight"
    return Table(["after", "error", "median", "rms", "95th pct", "starts"], rows, caption)


def _thrust_table(thrust: ThrustError) -> Table:
    rows = [
        [f"{low:.2f} to {high:.2f}", *(_number(None if np.isnan(mean) else mean) for mean in means)]
        for (low, high), means in zip(pairwise(thrust.voltage_edges), thrust.mean_n, strict=True)
    ]
    middles = 0.5 * (thrust.action_edges[:-1] + thrust.action_edges[1:])
    caption = (
        f"Thrust error, mean in N, by voltage (rows, V) and applied action (columns); rms of all "
        f"{_number(thrust.total_rms_n)} N, measured with {thrust.source}"
    )
    return Table(["V", *(f"{middle:+.1f}" for middle in middles)], rows, caption)


def _tables(validation: Validation) -> dict[str, Table]:
    """Return the tables that are not empty, by the figure that they belong to."""
    tables = {"one_step": _one_step_table(validation), "rollouts": _rollout_table(validation)}
    if validation.thrust is not None:
        tables["thrust"] = _thrust_table(validation.thrust)
    return {name: table for name, table in tables.items() if table.rows}


def _text_of_table(table: Table) -> str:
    return "\n".join([table.caption, *text_table([table.header, *table.rows], str.rjust)])


def _head(validation: Validation, model_name: str, log: FlightLog) -> str:
    scored = f"{validation.num_judged} of {validation.num_rows} rows are judged"
    return f"Model {model_name}, on {log.source}: {scored}."


def _nrmse_meanings(validation: Validation) -> list[str]:
    """Return the definitions of the NRMSE of the scored channels, a sentence for each kind."""
    kinds: dict[str, list[str]] = {}
    for name in validation.one_step.channels:
        kinds.setdefault(NORMALISED_BY[name], []).append(name)
    return [f"NRMSE of {', '.join(names)}: {NRMSE_MEANING[kind]}." for kind, names in kinds.items()]


def text_of(validation: Validation, model_name: str, log: FlightLog) -> str:
    """Return a validation as plain text, tables and notes."""
    tables = _tables(validation)
    blocks = [_head(validation, model_name, log)]
    for name, table in tables.items():
        block = _text_of_table(table)
        if name == "one_step":
            block = "\n".join([block, *_nrmse_meanings(validation)])
        blocks.append(block)
    if validation.notes:
        blocks.append("\n".join(["Notes", *(f"- {note}" for note in validation.notes)]))
    return "\n\n".join(blocks) + "\n"


def html_of(
    validation: Validation, model_name: str, log: FlightLog, pictures: dict[str, bytes]
) -> str:
    """Return a validation as a self-contained page.

    Args:
        validation: errors of the model.
        model_name: name of the model, for the heading.
        log: the log on which the model is validated.
        pictures: PNG files by name of the figure.
    """
    tables = _tables(validation)
    sections = []
    for name, heading in HEADINGS.items():
        parts: list[Any] = [Picture(pictures[name], CAPTIONS[name])] if name in pictures else []
        parts += [tables[name]] if name in tables else []
        if name == "one_step":
            parts += [Text(meaning) for meaning in _nrmse_meanings(validation)]
        sections.append(Section(heading, parts or [Text("Not judged; see the notes.")]))
    introduction: list[Any] = [Text(_head(validation, model_name, log))]
    if validation.notes:
        introduction += [
            Text("What the log lacks, and what was assumed:"),
            Bullets(validation.notes),
        ]
    return page(f"Validation of {model_name}", sections, introduction)


def write_validation(
    out: str | Path, validation: Validation, model_name: str, log: FlightLog
) -> list[Path]:
    """Write validation.json, .txt and .html and the figures into a folder; return their paths.

    Everything is computed before the first file is written.
    """
    figures = {"steps": draw_steps(validation.steps), "thrust": draw_thrust(validation.thrust)}
    pictures = {name: png_of(figure) for name, figure in figures.items()}
    numbers = {
        "model": model_name,
        "log": log.source,
        "log_sha256": log.sha256,
        **validation.as_json(),
    }
    document = json.dumps(numbers, indent=1, allow_nan=False) + "\n"
    files = {
        "validation.json": document.encode(),
        "validation.txt": text_of(validation, model_name, log).encode(),
        "validation.html": html_of(validation, model_name, log, pictures).encode(),
        **{f"{name}.png": png for name, png in pictures.items()},
    }
    return write_report(out, files)
