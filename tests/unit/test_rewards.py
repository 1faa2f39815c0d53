"""Every reward term by hand, and their weighted sum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env import rewards
from flytrack_env.quaternion import Vec3
from flytrack_env.rewards import TERMS, RewardWeights, Transition, total_reward
from tests.support.coasting import coasting_env, drone_at
from tests.support.tables import table


def make_transition(before=None, after=None, **fields):
    """Return a still transition 5 m before a gate, with some parts replaced."""
    quiet = {"num_passed": 0, "offset": 0.5, "is_terminated": False}
    drones = [drone_at(**{"position": (-4.0, 2.0, 3.0), **(d or {})}) for d in (before, after)]
    events = jax.tree.map(jnp.asarray, {**quiet, **fields})
    return Transition(*drones, gate_centre_w=Vec3(*map(jnp.float32, (1.0, 2.0, 3.0))), **events)


CASES = table("rewards")["terms"]
STILL = [(name, {}, 0.0) for name in RewardWeights._fields]


@pytest.mark.parametrize(("name", "parts", "expected"), [*STILL, *CASES])
def test_term(name, parts, expected):
    value = getattr(rewards, name)(make_transition(**parts))
    assert float(value) == pytest.approx(expected, abs=1e-5)


def test_every_weight_is_named_after_a_term_and_every_term_is_tested():
    names = [term.__name__ for term in TERMS]
    assert len(set(names)) == len(names)
    assert set(RewardWeights._fields) == set(names) == {case[0] for case in CASES}


def test_gradient_is_finite_at_the_gates_centre():
    at_centre = {"position": (1.0, 2.0, 3.0)}

    def reward(x):
        transition = make_transition(before=at_centre, after=at_centre)
        after = transition.after._replace(pos_w=transition.after.pos_w._replace(x=x))
        return total_reward(transition._replace(after=after), RewardWeights())

    assert np.isfinite(jax.grad(reward)(jnp.float32(1.0)))


# Progress from 0.9 m before the centre of a gate to 0.1 m behind it, 0.3 m aside.
CLOSER_M = np.hypot(0.9, 0.3) - np.hypot(0.1, 0.3)


@pytest.mark.parametrize(
    ("y", "expected"),
    [
        (0.0, {"progress": 0.8, "gate_pass": 1, "off_centre": 0.0, "termination": 0}),
        (0.3, {"progress": CLOSER_M, "gate_pass": 1, "off_centre": 0.25, "termination": 0}),
        (1.0, {"gate_pass": 0, "off_centre": 0.0, "termination": 1}),
        (2.0, {"gate_pass": 0, "off_centre": 0.0, "termination": 1}),
    ],
)
def test_environment_hands_its_transition_to_the_terms(y, expected):
    env = coasting_env(0.0, 10.0)
    transition = jax.jit(env.transition)
    for name, value in expected.items():
        only = RewardWeights(**{field: float(field == name) for field in RewardWeights._fields})
        params = env.default_params.replace(reward=only)
        state = env.begin(drone_at((-0.9, y, 2.0), (100.0, 0.0, 0.0)), 0, params)
        reward = float(transition(state, jnp.zeros(4), params)[1])
        assert reward == pytest.approx(value, abs=1e-4)
