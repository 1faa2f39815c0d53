"""Black boxes of strangers: each tried out once in a process of its own, and what that finds."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from flytrack_env import blackbox
from flytrack_env.apart import ApartError, ResourceLimits
from flytrack_env.blackbox import BlackBoxError, load

SHIPPED = Path(__file__).resolve().parents[2] / "blackbox" / "acro_step.bin"


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """What is tried out from here on, and nothing is known."""
    seen: list[bytes] = []
    really = blackbox._TRIAL

    def count(argument: Any, content: bytes, limits: ResourceLimits) -> bytes:
        seen.append(content)
        return really(argument, content, limits)

    monkeypatch.setattr(blackbox, "_TRIAL", count)
    monkeypatch.setattr(blackbox, "_TRIED", set())
    return seen


def write(path: Path, step: Callable[..., Any], *trusted: str) -> Path:
    """Export a step as an artifact, with calls that JAX does not vouch for."""
    shapes = [jax.ShapeDtypeStruct((size,), jnp.float32) for size in (21, 4)]
    checks = [export.DisabledSafetyCheck.custom_call(name) for name in trusted]
    exported = export.export(jax.jit(step), platforms=["cpu"], disabled_checks=checks)(*shapes)
    path.write_bytes(exported.serialize())
    return path


def forever(x: jax.Array, u: jax.Array) -> jax.Array:
    """Never end from the start state."""
    return jax.lax.while_loop(lambda c: c[0] >= 0.0, lambda c: 0.5 * c + 1.0, x)


def greedy(x: jax.Array, u: jax.Array) -> jax.Array:
    """Take 4 GiB."""
    grid = jnp.sin(jnp.arange(2**20, dtype=jnp.float32)[:, None] * jnp.arange(2**10) * x[9])
    return x + jnp.sum(jnp.sort(grid, axis=0)[::2])


def solving(x: jax.Array, u: jax.Array) -> jax.Array:
    """Call LAPACK."""
    return x.at[:4].set(jnp.linalg.svd(jnp.eye(4) + u, compute_uv=False))


def calling(depth: int) -> Callable[..., Any]:
    """Return functions that call one another."""

    def outer(inner: Callable[..., Any]) -> Callable[..., Any]:
        return jax.jit(lambda x, u: 0.5 * inner(x, u))

    step: Callable[..., Any] = lambda x, u: x  # noqa: E731
    for _ in range(depth):
        step = outer(step)
    return step


def branching(depth: int) -> Callable[..., Any]:
    """Return conditions in conditions."""

    def step(x: jax.Array, u: jax.Array, left: int = depth) -> jax.Array:
        if left == 0:
            return 0.5 * x
        return jax.lax.cond(x[0] > left, lambda: step(x, u, left - 1), lambda: x)

    return step


@pytest.mark.parametrize("make", [calling, branching])
def test_what_is_nested_deeply_is_refused_before_it_crashes_the_compiler(
    make: Callable[[int], Callable[..., Any]], tmp_path: Path
) -> None:
    assert load(write(tmp_path / "some.bin", make(25))).state_size == 21
    with pytest.raises(BlackBoxError, match=r"deep\.bin: found functions and loops that are nested deeper"):
        load(write(tmp_path / "deep.bin", make(80)))


def test_the_shipped_one_is_known_and_not_tried(trials: list[bytes]) -> None:
    assert hashlib.sha256(SHIPPED.read_bytes()).hexdigest() == blackbox.SHIPPED_SHA256
    load(SHIPPED)
    assert trials == []


def test_bytes_are_tried_once(trials: list[bytes], tmp_path: Path) -> None:
    path = write(tmp_path / "one.bin", lambda x, u: 2.0 * x)
    for box in (load(path), load(path), load(path.rename(tmp_path / "same.bin"))):
        np.testing.assert_allclose(box.step_vector(np.ones(21), np.zeros(4)), 2.0)
    assert len(trials) == 1
    load(path := write(tmp_path / "other.bin", lambda x, u: 3.0 * x))
    assert trials[1:] == [path.read_bytes()]


def test_what_fails_is_tried_again(trials: list[bytes], tmp_path: Path) -> None:
    (tmp_path / "noise.bin").write_bytes(b"noise")
    for _ in range(2):
        with pytest.raises(BlackBoxError, match=r"noise\.bin: found 5 bytes that cannot be deserialised"):
            load(tmp_path / "noise.bin")
    assert len(trials) == 2


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (forever, "took more than 1 s of processor time"),
        (greedy, "does not run on the CPU .*Out of memory|needs more than 1 GiB|crashed"),
        (solving, r"found a call of lapack_\w+, expected a pure function that calls nothing"),
    ],
)
def test_hunger_hanging_and_foreign_calls_are_refused(
    step: Callable[..., Any], message: str, tmp_path: Path
) -> None:
    path = write(tmp_path / "a.bin", step)
    with pytest.raises(BlackBoxError, match=rf"^{path}: .*({message})"):
        load(path, limits=ResourceLimits(cpu_s=1) if step is forever else ResourceLimits())


def test_a_trusted_file_is_not_tried_and_may_call_lapack(trials: list[bytes], tmp_path: Path) -> None:
    box = load(write(tmp_path / "a.bin", solving), limits=None)
    assert trials == []
    np.testing.assert_allclose(box.step_vector(np.zeros(21), np.zeros(4))[:4], 1.0, rtol=1e-5)


@pytest.mark.parametrize("limits", [None, ResourceLimits()])
def test_calls_that_nobody_vouches_for_are_refused(limits: ResourceLimits | None, tmp_path: Path) -> None:
    def step(x: jax.Array, u: jax.Array) -> jax.Array:
        return jax.ffi.ffi_call("my callback", jax.ShapeDtypeStruct(x.shape, x.dtype))(x)

    path = write(tmp_path / "a.bin", step, "my callback")
    with pytest.raises(BlackBoxError, match=r"a\.bin: found a call of my callback, expected"):
        load(path, limits=limits)


def test_a_trial_that_crashes_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def crash(*_: Any) -> bytes:
        raise ApartError("it crashed the process that tried it out (SIGSEGV: )")

    monkeypatch.setattr(blackbox, "_TRIAL", crash)
    with pytest.raises(BlackBoxError, match=r"a\.bin: it crashed the process that tried it out \(SIGSEGV"):
        load(write(tmp_path / "a.bin", lambda x, u: 4.0 * x))


def test_without_fork_only_known_and_trusted_files_are_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(blackbox, "is_possible", lambda: False)
    path = write(tmp_path / "a.bin", lambda x, u: 5.0 * x)
    with pytest.raises(BlackBoxError, match=r"a\.bin: this system has no os\.fork .*limits=None"):
        load(path)
    load(path, limits=None)
    load(SHIPPED)
