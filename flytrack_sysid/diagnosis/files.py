"""Writing a diagnosis: JSON, the extended model, the report."""

import json
from pathlib import Path

import numpy as np

from flytrack_env import __version__, save_model
from flytrack_env.files import write_atomically
from flytrack_sysid.diagnosis.report import write_report
from flytrack_sysid.diagnosis.result import TO_LOG, Diagnosis
from flytrack_sysid.log import FlightLog

JSON_NAME, MODEL_NAME, REPORT_NAME = "diagnosis.json", "extended_model.json", "report.html"


def write_diagnosis(folder: str | Path, diagnosis: Diagnosis, log: FlightLog) -> list[Path]:
    """Write a diagnosis into a folder, which is made if need be, and return the files.

    log: what was diagnosed (``diagnose.joined`` of several).

    Raises:
        OSError: a file cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    content = diagnosis.as_json()
    provenance = {
        "tool": f"flytrack_sysid.diagnose {__version__}",
        "data": content["data"],
        "causes": content["causes"],
        "verdict": diagnosis.verdict,
    }
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_atomically(folder / JSON_NAME, text.encode())
    save_model(folder / MODEL_NAME, diagnosis.extended, provenance)
    write_report(folder / REPORT_NAME, diagnosis, log)
    return [folder / name for name in (JSON_NAME, MODEL_NAME, REPORT_NAME)]


def text_of(diagnosis: Diagnosis) -> str:
    """Return a diagnosis as a few lines of text."""
    lines = [f"verdict: {diagnosis.verdict}"]
    for cause in diagnosis.causes:
        values = ", ".join(
            f"{name} {one.value:.4g} ({one.ci95[0]:.4g} to {one.ci95[1]:.4g}) {one.unit}"
            for name, one in cause.parameters.items()
        )
        twins = f"; not told apart from {', '.join(cause.equivalent)}" if cause.equivalent else ""
        lines.append(f"  {cause.effect}: {values}; held-out gain {cause.heldout_gain:.4g}{twins}")
    if diagnosis.unexplained.flagged:
        lines.append(f"unexplained, depends on: {', '.join(diagnosis.unexplained.depends_on)}")
    for one in diagnosis.not_identifiable:
        below = f" below {one.smallest:.3g} {one.unit}" if np.isfinite(one.smallest) else ""
        alike = f", looks like {', '.join(one.confused_with)}" if one.confused_with else ""
        to_do = one.fly if one.fly.startswith(TO_LOG) else f"fly {one.fly}"
        is_named = any(one.effect == cause.effect for cause in diagnosis.causes)
        what = "not told apart by this log" if is_named else "not shown by this log"
        lines.append(f"{what}: {one.effect}{below}{alike}; {to_do}")
    return "\n".join([*lines, *diagnosis.warnings])
