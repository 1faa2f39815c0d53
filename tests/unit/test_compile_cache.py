"""Compiled programs are kept for the next process in the user's folder, if the user allows it."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from flytrack_env import compile_cache

COMPILE = """
import jax, flytrack_env
hits = []
def listen(name, **_):
    if name.endswith("/cache_hits"):
        hits.append(name)
jax.monitoring.register_event_listener(listen)
jax.jit(lambda x: jax.numpy.sin(x) + 1.0).lower(0.5).compile()
print(len(hits))
"""
MIN_COMPILE_TIME = compile_cache.MIN_S.upper()


@pytest.fixture
def config(monkeypatch, tmp_path):
    """JAX's settings as the module sees them, without a folder; the user's cache is temporary."""
    settings = SimpleNamespace(jax_compilation_cache_dir=None)
    settings.update = lambda name, value: setattr(settings, name, value)
    monkeypatch.setattr(compile_cache.jax, "config", settings)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for variable in (compile_cache.SWITCH, MIN_COMPILE_TIME):
        monkeypatch.delenv(variable, raising=False)
    return settings


def test_the_next_process_does_not_compile_again(tmp_path):
    kept = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment = kept | {
        "XDG_CACHE_HOME": str(tmp_path),
        "JAX_PLATFORMS": "cpu",
        MIN_COMPILE_TIME: "0",
    }
    command = [sys.executable, "-c", COMPILE]
    runs = [
        subprocess.run(command, env=environment, capture_output=True, check=True) for _ in range(2)
    ]
    assert [int(run.stdout) for run in runs] == [0, 1], runs


def test_a_folder_of_the_user_stands(config):
    config.jax_compilation_cache_dir = "mine"
    compile_cache.keep_compiled_programs()
    assert vars(config).keys() == {"jax_compilation_cache_dir", "update"}
    assert config.jax_compilation_cache_dir == "mine"


def test_a_folder_that_cannot_be_made_or_is_not_wanted_is_not_used(config, monkeypatch, tmp_path):
    (tmp_path / "flytrack").write_text("a file")
    compile_cache.keep_compiled_programs()
    assert config.jax_compilation_cache_dir is None
    (tmp_path / "flytrack").unlink()
    monkeypatch.setenv(compile_cache.SWITCH, "0")
    compile_cache.keep_compiled_programs()
    assert config.jax_compilation_cache_dir is None and not list(tmp_path.iterdir())


def test_a_folder_that_has_grown_too_large_is_begun_afresh(config, monkeypatch):
    compile_cache.keep_compiled_programs()
    assert config.jax_persistent_cache_min_compile_time_secs == 0.3
    folder = compile_cache.Path(config.jax_compilation_cache_dir)
    (folder / "old").write_bytes(b"12345")
    config.jax_compilation_cache_dir = None
    compile_cache.keep_compiled_programs()
    assert (folder / "old").exists()
    monkeypatch.setattr(compile_cache, "MAX_BYTES", 4)
    config.jax_compilation_cache_dir = None
    compile_cache.keep_compiled_programs()
    assert config.jax_compilation_cache_dir == str(folder)
    assert not (folder / "old").exists()
