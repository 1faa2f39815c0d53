"""Compilation without optimisation, for programs that run so briefly that it does not pay."""

from functools import partial

import jax

QUICKLY = {"xla_backend_optimization_level": 0}
quick_jit = partial(jax.jit, compiler_options=QUICKLY)
