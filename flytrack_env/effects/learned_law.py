"""An unnamed law that a diagnosis found in a log: see ``flytrack_env.effects.grammar``."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, ForceContext, Memory, Range, Search, StepContext
from flytrack_env.effects.grammar import Flight, Law, law_from_json, moment_of
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone


class LearnedLaw(NamedTuple):
    """A law, and how it acts.

    Draw ``spread`` from -1 to 1, say, to fly what the log cannot tell.

    Attributes:
        scale: share of it that acts, 1 as learnt.
        spread: by how many standard errors its coefficients are larger.
        law: static.
    """

    scale: Scalar = 0.0
    spread: Scalar = 0.0
    law: Law = Law()


def _start(parameters: LearnedLaw, drone: Drone) -> Flight | None:
    if not parameters.law.uses("time"):
        return None
    return Flight(jnp.zeros_like(jnp.asarray(drone.battery_v)))


def _remember(parameters: LearnedLaw, flight: Flight | None, context: StepContext) -> Flight | None:
    return None if flight is None else Flight(flight.time_s + context.dt)


def _add_terms(
    parameters: LearnedLaw, acts: str, flight: Flight | None, value_b: Vec3, context: ForceContext
) -> Vec3:
    terms = [term for term in parameters.law.terms if term.acts == acts]
    if not terms:
        return value_b
    moment = moment_of(context, flight)
    for term in terms:
        value_b = value_b + term.at(moment, parameters.spread).scale(parameters.scale)
    return value_b


LEARNED_LAW = Effect(
    name="learned_law",
    parameters=LearnedLaw,
    ranges={"scale": Range(-2.0, 2.0, "1"), "spread": Range(-3.0, 3.0, "1")},
    notable={"scale": 0.05},
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b + s \sum_k \mathbf{c}_k\, g_k h_k",
    source="the log that it was learnt from; sums of products of given functions: "
    "S. Brunton et al., "
    '"Discovering governing equations from data by sparse identification", 2016',
    hooks={
        "force": lambda parameters, flight, value, context: _add_terms(
            parameters, "force", flight, value, context
        ),
        "rates": lambda parameters, flight, value, context: _add_terms(
            parameters, "rate", flight, value, context.force
        ),
    },
    memory=Memory(start=_start, remember=_remember),
    search=Search(needs=("q",), shapes=("spread",)),
    static="law",
    written=lambda law: law.as_json(),
    read=law_from_json,
)
