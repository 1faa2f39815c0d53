"""The reward: a weighted sum of small terms, each a pure function of one transition."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone


class Transition(NamedTuple):
    """What the reward terms may look at; before, after: the drone before and after the step.

    Attributes:
        gate_centre_w: centre of the gate that was flown to when the step began, m.
        num_passed: gates passed in this step.
        offset: how far off-centre, 0 at the centre, 1 at the edge of the free opening.
        is_terminated: whether the episode terminates (not: is truncated).
    """

    before: Drone
    after: Drone
    gate_centre_w: Vec3
    num_passed: jax.Array
    offset: jax.Array
    is_terminated: jax.Array


class RewardWeights(NamedTuple):
    """Weight of each term; the function of that name in ``TERMS`` says what it measures.

    progress, gate_pass, off_centre, termination, body_rates, action_change.
    """

    progress: Scalar = 0.2
    gate_pass: Scalar = 1.0
    off_centre: Scalar = -1.0
    termination: Scalar = -1.0
    body_rates: Scalar = -4e-5
    action_change: Scalar = -1e-2


def make_weights(changes: Mapping[str, float]) -> RewardWeights:
    """Return the default weights with some of them changed, by the name of the term.

    Raises:
        ValueError: an unknown term, or a weight that is not a finite number.
    """
    for name, weight in changes.items():
        if name not in RewardWeights._fields:
            expected = ", ".join(RewardWeights._fields)
            raise ValueError(f"reward: found {name!r}, expected one of {expected}")
        if (
            isinstance(weight, bool)
            or not isinstance(weight, (int, float))
            or not math.isfinite(weight)
        ):
            raise ValueError(f"reward.{name}: found {weight!r}, expected a finite number")
    return RewardWeights()._replace(**{name: float(weight) for name, weight in changes.items()})


def progress(transition: Transition) -> Scalar:
    """Return how much nearer the gate's centre the drone came, m."""
    before = (transition.before.pos_w - transition.gate_centre_w).norm()
    return before - (transition.after.pos_w - transition.gate_centre_w).norm()


def gate_pass(transition: Transition) -> Scalar:
    """Return the number of gates passed."""
    return transition.num_passed.astype(jnp.float32)


def off_centre(transition: Transition) -> Scalar:
    """Return the squared offset of the pass from the gate's centre, 0 to 1 per pass."""
    return jnp.where(transition.num_passed > 0, transition.offset * transition.offset, 0.0)


def termination(transition: Transition) -> Scalar:
    """Return 1 where the episode terminates."""
    return transition.is_terminated.astype(jnp.float32)


def body_rates(transition: Transition) -> Scalar:
    """Return the squared body rates, (rad/s)^2."""
    return transition.after.rates_b.dot(transition.after.rates_b)


def action_change(transition: Transition) -> Scalar:
    """Return the squared change of the applied action."""
    pairs = zip(transition.after.applied, transition.before.applied, strict=True)
    return sum((after - before) * (after - before) for after, before in pairs)


TERMS = (progress, gate_pass, off_centre, termination, body_rates, action_change)


def total_reward(transition: Transition, weights: RewardWeights) -> jax.Array:
    """Return the weighted sum of all terms, a scalar."""
    return sum(getattr(weights, term.__name__) * term(transition) for term in TERMS)
