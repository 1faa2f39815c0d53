"""Evaluations of a checkpoint by ``eval_agent.py``, as a benchmark's page needs them."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


def evaluate(checkpoint: Path, flags: str) -> tuple[dict[str, Any], str]:
    """Return the report of ``eval_agent.py`` on a checkpoint, as JSON values, and what it prints of it.

    flags: of its command line, but for the files.

    Raises:
        subprocess.CalledProcessError: it failed; its own words are on the standard error output.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        files = [
            "--checkpoint",
            str(checkpoint),
            "--out",
            str(out / "rollout.npy"),
            "--json",
            str(out / "report"),
        ]
        command = [sys.executable, str(ROOT / "eval_agent.py"), *files, *flags.split()]
        done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
        report = json.loads((out / "report").read_text())
    return report, "\n".join(line for line in done.stdout.splitlines() if folder not in line)
