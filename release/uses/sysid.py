"""From a plant to a diagnosis by ``flytrack-sysid``, with ``[sysid]`` alone; for ``release.check_wheel``."""

import subprocess
import sys
from pathlib import Path

COMMAND = Path(sys.executable).with_name("flytrack-sysid")
ROBOT = """
import jax, numpy as np
from flytrack_env.dynamics import nominal_parameters, step as one

advance = jax.jit(one)

def step(x, u):
    return np.asarray(advance(x, u, np.float32(0.01), nominal_parameters()))
"""


def must_write(path: str, *arguments: str) -> None:
    """Run the command, which must end well and write a file."""
    ran = subprocess.run([COMMAND, *arguments], capture_output=True, text=True)
    assert ran.returncode == 0 and Path(path).is_file(), f"{arguments}: {ran.stdout}{ran.stderr}"


def main() -> None:
    """Collect, fit, validate, diagnose; and a log that needs [logs]."""
    Path("robot.py").write_text(ROBOT)
    must_write("data.npz", *["collect", "--black-box", "robot:step", "--minutes", "1", "--out", "data.npz"])
    must_write("model.json", *["fit", "data.npz", "--out", "model.json"])
    must_write("report/validation.html", *["validate", "model.json", "data.npz", "--out", "report"])
    must_write("found/diagnosis.json", *["diagnose", "data.npz", "--model", "model.json", "--out", "found"])
    Path("a.ulg").write_bytes(b"")
    refused = subprocess.run(
        [COMMAND, *["import", "a.ulg", "--format", "ulog", "--out", "b.npz"]], capture_output=True, text=True
    )
    assert refused.returncode == 2 and "pip install 'flytrack[logs]'" in refused.stderr, refused.stderr


if __name__ == "__main__":
    main()
