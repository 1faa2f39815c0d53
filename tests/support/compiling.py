"""Compilation without optimisation, for programs that run briefly; what is traced and compiled."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import jax

QUICKLY = {"xla_backend_optimization_level": 0}
quick_jit = partial(jax.jit, compiler_options=QUICKLY)
COUNTED = ("/jax/core/compile/backend_compile_duration", "/jax/core/compile/jaxpr_trace_duration")


@contextmanager
def programs() -> Iterator[list[str]]:
    """Yield a list that grows by JAX's event for each program that is traced or compiled."""
    events: list[str] = []

    def note(event: str, duration_s: float, **_: object) -> None:
        if event in COUNTED:
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
