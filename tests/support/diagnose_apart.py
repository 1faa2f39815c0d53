"""Diagnoses logs in a process of its own, which sees nothing but the logs and the nominal models.

``python -m tests.support.diagnose_apart FOLDER`` reads log_NAME.npz and model_NAME.json there, and writes
found_NAME.json: the diagnosis, or ``{"raised": type, "message": text}``. Of the log called REPORTED it writes
all files of a diagnosis too, into a folder of that name.
"""

import json
import sys
import time
from pathlib import Path

from flytrack_env import load_model
from flytrack_sysid import load_log
from flytrack_sysid.diagnosis import diagnose, write_diagnosis

REPORTED = "one_signed"


def diagnosed(folder: Path, name: str) -> dict:
    """Return what is found in a log of the folder, or what is raised."""
    log = load_log(folder / f"log_{name}.npz")
    model = load_model(folder / f"model_{name}.json")
    started = time.process_time()
    try:
        found = diagnose(log, model)
    except Exception as error:  # a test says which are right
        return {"raised": type(error).__name__, "message": str(error)}
    if name == REPORTED:
        write_diagnosis(folder / name, found, log)
    return found.as_json() | {"cpu_s": time.process_time() - started}


def main() -> None:
    """Diagnose all logs of the folder that is named."""
    folder = Path(sys.argv[1])
    for path in sorted(folder.glob("log_*.npz")):
        name = path.stem.removeprefix("log_")
        text = json.dumps(diagnosed(folder, name), allow_nan=False)
        (folder / f"found_{name}.json").write_text(text)


if __name__ == "__main__":
    main()
