"""What every craft's record holds: a diagnosis, models flown on windows, and a mapping written for it."""

import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np

from benchmarks.report import commit_of_checkout
from flytrack_env.dynamics import ModelParameters
from flytrack_env.motion import Motion
from flytrack_sysid import FlightLog, Imported, diagnose, import_log
from flytrack_sysid.diagnosis import Diagnosis
from flytrack_sysid.diagnosis.refinement import Tested
from flytrack_sysid.diagnosis.report import verdict_of
from flytrack_sysid.prediction_windows import QUANTITIES, Windows, chunks_of, prediction_errors

Record = dict[str, Any]


def diagnosed(
    log: FlightLog, model: ModelParameters, held_out: np.ndarray | None = None
) -> tuple[Diagnosis, Record]:
    """Return a log's diagnosis, and a record of it: JSON values, number of rows, CPU time."""
    started = time.process_time()
    found = diagnose(log, model, held_out, motion=Motion.CONTINUOUS)
    return found, {
        "num_rows": len(log),
        "cpu_s": time.process_time() - started,
        "jax": jax.__version__,
        "commit": commit_of_checkout(),
        "sentence": verdict_of(found).text,
        "diagnosis": found.as_json(),
    }


def imported(files: Path | Sequence[Path], kind: str, mapping: str) -> Imported:
    """Return logs imported with a mapping that is given as text."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mapping.toml"
        path.write_text(mapping, encoding="utf-8")
        return import_log(files, kind, path)


def tested(model: ModelParameters, windows: Windows) -> Tested:
    """Return a model's errors on windows; inside ``jax.enable_x64(True)``."""
    model = jax.tree.map(lambda leaf: np.asarray(leaf, float), model)
    parts = [np.asarray(_errors(model, chunk)) for chunk in chunks_of(windows)]
    errors = np.concatenate(parts, axis=1)[:, : len(windows.start)]
    return Tested(errors.reshape(1, *errors.shape[:-1], len(QUANTITIES), 3), windows)


_errors = jax.jit(prediction_errors)
