"""The sandbox's limits, and foreign black boxes tried in it."""

import hashlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from flytrack_env import blackbox, sandbox
from flytrack_env.blackbox import BlackBoxError, load
from flytrack_env.sandbox import ResourceLimits, SandboxError
from tests.support.black_boxes import SHIPPED, write_artifact
from tests.support.tables import table

FUNCTION = """
import os, sys, time

def do(argument, content):
    match argument:
        case "reverse": print("printed"); return content[::-1]
        case "raise": raise KeyError("a name")
        case "exit": sys.exit("enough")
        case "abort": os.abort()
        case "spin":
            while True: pass
        case "sleep": time.sleep(60.0)
        case "allocate": return bytes(2**30)[:1]
        case "write": open(content.decode(), "wb", buffering=0).write(b"x")
"""
LIMITS = ResourceLimits(cpu_s=1, memory_bytes=2**27, wall_s=30.0)


@pytest.fixture
def do(tmp_path):
    """The function above, in the sandbox."""
    (tmp_path / "function.py").write_text(FUNCTION)
    return lambda argument, content=b"", limits=LIMITS: sandbox.run(
        tmp_path / "function.py", "do", argument, content, limits
    )


def test_a_result_comes_back(do):
    assert do("reverse", b"\x00\n12") == b"21\n\x00"


@pytest.mark.parametrize(("argument", "message", "kind"), table("sandbox")["failures"])
def test_failures_are_reported(argument, message, kind, do, tmp_path):
    limits = LIMITS._replace(wall_s=0.5) if argument == "sleep" else LIMITS
    with pytest.raises(SandboxError, match=message) as caught:
        do(argument, str(tmp_path / "written").encode(), limits)
    assert kind in ("any", caught.value.kind)
    assert not (tmp_path / "written").exists() or not (tmp_path / "written").read_bytes()


@pytest.fixture
def trials(monkeypatch):
    """The files that are tried from here on; none has passed yet."""
    seen: list[bytes] = []
    run = sandbox.run

    def count(file, function, argument, content, *rest):
        seen.append(content)
        return run(file, function, argument, content, *rest)

    monkeypatch.setattr(sandbox, "run", count)
    monkeypatch.setattr(blackbox, "_PASSED", set())
    return seen


def test_a_black_box_is_tried_once_and_the_shipped_one_never(trials, tmp_path):
    assert hashlib.sha256(SHIPPED.read_bytes()).hexdigest() == blackbox.SHIPPED_SHA256
    load(SHIPPED)
    assert trials == []
    path = write_artifact(tmp_path / "one.bin", lambda x, u: 2.0 * x)
    for box in (load(path), load(path), load(path.rename(tmp_path / "same.bin"))):
        np.testing.assert_allclose(box.step_vector(np.ones(21), np.zeros(4)), 2.0)
    assert len(trials) == 1


def test_a_script_without_a_guard_may_load_a_black_box(tmp_path):
    write_artifact(tmp_path / "a.bin", lambda x, u: 3.0 * x)
    (tmp_path / "script.py").write_text(
        "print('ran once')\nfrom flytrack_env import blackbox\nprint(blackbox.load('a.bin'))\n"
    )
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.stdout.splitlines() == ["ran once", "BlackBox('a.bin', state_size=21)"], done.stderr


def endless(x, u):
    """Never end from the start state."""
    return jax.lax.while_loop(lambda c: c[0] >= 0.0, lambda c: 0.5 * c + 1.0, x)


def solving(x, u):
    """Call LAPACK."""
    return x.at[:4].set(jnp.linalg.svd(jnp.eye(4) + u, compute_uv=False))


def calling(x, u):
    """Call an unknown function."""
    return jax.ffi.ffi_call("my callback", jax.ShapeDtypeStruct(x.shape, x.dtype))(x)


@pytest.mark.parametrize(
    ("step", "message"),
    [
        pytest.param(endless, "took more than 1 s of processor time", marks=pytest.mark.slow),
        (solving, r"found a call of lapack_\w+, expected a pure function that calls nothing"),
        (calling, "found a call of my callback, expected a pure function that calls nothing"),
    ],
)
def test_hostile_black_boxes_are_refused(step, message, tmp_path):
    checks = [export.DisabledSafetyCheck.custom_call("my callback")]
    path = write_artifact(tmp_path / "a.bin", step, disabled_checks=checks)
    with pytest.raises(BlackBoxError, match=rf"^{path}: .*({message})"):
        load(path, limits=ResourceLimits(cpu_s=1) if step is endless else ResourceLimits())


def test_a_trusted_file_is_not_tried_and_may_call_lapack(trials, tmp_path):
    box = load(write_artifact(tmp_path / "a.bin", solving), limits=None)
    assert trials == []
    np.testing.assert_allclose(box.step_vector(np.zeros(21), np.zeros(4))[:4], 1.0, rtol=1e-5)
    checks = [export.DisabledSafetyCheck.custom_call("my callback")]
    with pytest.raises(BlackBoxError, match="found a call of my callback"):
        load(write_artifact(tmp_path / "b.bin", calling, disabled_checks=checks), limits=None)
