"""What is compiled in tests is kept on the disk, and a damaged program is compiled again."""

import os
import subprocess
import sys
from pathlib import Path

import jax

from tests.support.compiled_programs import FOLDER

ROOT = Path(__file__).parents[2]
DAMAGE = """
import sys, warnings
from pathlib import Path
import jax, jax.numpy as jnp

def compiled():
    return float(jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))(jnp.ones(64)))

first, files = compiled(), sorted(Path(sys.argv[1]).glob("*-cache"))
assert files, "nothing was kept"
for file in files:
    file.write_bytes(file.read_bytes()[:100])
jax.clear_caches()
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    assert compiled() == first
print(*{str(warning.message) for warning in told}, sep="\\n")
"""


def test_programs_are_kept_where_git_does_not_look() -> None:
    assert jax.config.jax_compilation_cache_dir == os.environ["JAX_COMPILATION_CACHE_DIR"]
    assert f"{FOLDER.name}/" in (ROOT / ".gitignore").read_text().splitlines()


def test_a_damaged_program_is_compiled_again_with_the_warning_that_tests_ignore(tmp_path: Path) -> None:
    settings = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-c", DAMAGE, str(tmp_path)]
    done = subprocess.run(command, env=os.environ | settings, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert said and all(line.startswith("Error reading persistent compilation cache entry") for line in said)
