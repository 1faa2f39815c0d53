"""The simulator's own step as a CasADi function: its jaxpr, evaluated with symbols.

There is no second copy of the physics: ``flytrack_env.dynamics.advance`` is traced by JAX for one drone of
scalars and one model, and every operation of the trace is carried out on CasADi symbols, including those of
all effects.
"""

import operator
from collections.abc import Callable
from typing import Any

import casadi
import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters, advance
from flytrack_env.effects import effect_of
from flytrack_env.state import ACTION_SIZE, POSITION, STATE_SIZE, Action, Drone, unpack

SENSOR = ("sensor",)  # stage of effects that do not change the flight


class UnsupportedModelError(ValueError):
    """A model that CasADi cannot express; the message names the effect or the operation."""


def _identity(value: Any) -> Any:
    return value


OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "add_any": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "pow": operator.pow,
    "square": lambda value: value * value,
    "exp": casadi.exp,
    "log": casadi.log,
    "sqrt": casadi.sqrt,
    "sin": casadi.sin,
    "cos": casadi.cos,
    "tanh": casadi.tanh,
    "abs": casadi.fabs,
    "sign": casadi.sign,
    "floor": casadi.floor,
    "max": casadi.fmax,
    "min": casadi.fmin,
    "lt": operator.lt,
    "le": operator.le,
    "gt": operator.gt,
    "ge": operator.ge,
    "eq": operator.eq,
    "and": casadi.logic_and,
    "or": casadi.logic_or,
    "not": casadi.logic_not,
    "select_n": lambda which, off, on: casadi.if_else(which, on, off),
    "convert_element_type": _identity,
    "broadcast_in_dim": _identity,
    "reshape": _identity,
    "squeeze": _identity,
    "copy": _identity,
    "stop_gradient": _identity,
}


def flown_effects(model: ModelParameters) -> tuple[Any, ...]:
    """Return a model's effects without those of sensors, which do not change the flight.

    Raises:
        UnsupportedModelError: an effect with a memory, which has no place in the state vector.
    """
    flown = tuple(effect for effect in model.effects if effect_of(effect).acts_on != SENSOR)
    for effect in map(effect_of, flown):
        if effect.start is not None:
            raise UnsupportedModelError(
                f"model: effect {effect.name}: found one with a memory, expected effects without"
            )
    return flown


def _apply(equation: Any, values: list[Any]) -> list[Any]:
    """Return the outputs of one operation of a trace; numbers stay numbers."""
    inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
    if inner is not None:
        return _evaluate(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), values)
    name = equation.primitive.name
    if name == "flytrack_compute_once":
        return values
    if not any(isinstance(value, casadi.SX) for value in values):
        found = equation.primitive.bind(*values, **equation.params)
        return list(found) if equation.primitive.multiple_results else [found]
    if any(not isinstance(value, casadi.SX) and np.size(value) != 1 for value in values):
        raise UnsupportedModelError(f"model: operation {name} on an array, expected scalars")
    values = [value if isinstance(value, casadi.SX) else float(value) for value in values]
    if name == "integer_pow":
        return [values[0] ** equation.params["y"]]
    if name not in OPERATIONS:
        raise UnsupportedModelError(f"model: operation {name}: expected one of {', '.join(OPERATIONS)}")
    return [OPERATIONS[name](*values)]


def _evaluate(jaxpr: Any, constants: Any, arguments: list[Any]) -> list[Any]:
    """Return the outputs of a trace for CasADi symbols or numbers."""
    known = dict(zip(jaxpr.constvars, constants, strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))

    def value_of(atom: Any) -> Any:
        return atom.val if hasattr(atom, "val") else known[atom]

    for equation in jaxpr.eqns:
        outputs = _apply(equation, [value_of(atom) for atom in equation.invars])
        known.update(zip(equation.outvars, outputs, strict=True))
    return [value_of(atom) for atom in jaxpr.outvars]


def step_function(model: ModelParameters) -> casadi.Function:
    """Return the model's step, (21,), (4,), s -> (21,), packed as ``flytrack_env.state`` says, float64.

    Raises:
        UnsupportedModelError: an effect with a memory, or an operation that has no counterpart in CasADi.
    """
    effects = flown_effects(model)
    with jax.enable_x64(True):
        model = jax.tree.map(lambda leaf: np.asarray(leaf, float), model._replace(effects=effects))
        structure = jax.tree.structure(unpack(np.zeros(STATE_SIZE)))

        def leaves_after(*leaves: Any) -> list[Any]:
            drone: Drone = jax.tree.unflatten(structure, leaves[:STATE_SIZE])
            command = Action(*leaves[STATE_SIZE:-1])
            memories = (None,) * len(effects)
            return jax.tree.leaves(advance(drone, memories, command, leaves[-1], model)[0])

        scalar = jax.ShapeDtypeStruct((), np.float64)
        trace = jax.make_jaxpr(leaves_after)(*[scalar] * (STATE_SIZE + ACTION_SIZE + 1))
        state, command = casadi.SX.sym("x", STATE_SIZE), casadi.SX.sym("u", ACTION_SIZE)
        dt = casadi.SX.sym("dt")
        arguments = [*casadi.vertsplit(state), *casadi.vertsplit(command), dt]
        after = casadi.vertcat(*_evaluate(trace.jaxpr, trace.consts, arguments))
    return casadi.Function("step", [state, command, dt], [after])


def needed_states(step: casadi.Function) -> list[int]:
    """Return the indices of the state vector on which a path depends, directly or indirectly."""
    depends = np.array(casadi.DM(step.jac_sparsity(0, 0), 1).full(), bool)
    needed = set(range(STATE_SIZE)[POSITION])
    while True:
        more = needed | {int(place) for row in needed for place in np.flatnonzero(depends[row])}
        if more == needed:
            return sorted(needed)
        needed = more
