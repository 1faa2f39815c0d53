"""rejax's PPO, through the 5-value step."""

import jax
import pytest

from clients import rejax_ppo
from flytrack_env.registration import ENVIRONMENTS


def test_ppo_improves_on_its_own_first_evaluation() -> None:
    outcome = rejax_ppo.measure(seed=0)
    assert outcome.return_gain >= rejax_ppo.RETURN_MARGIN, outcome
    assert outcome.gate_gain >= rejax_ppo.GATE_MARGIN, outcome


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_training_can_be_traced_on_every_id(env_id: str) -> None:
    ppo = rejax_ppo.make_ppo(env_id)
    train_state, (lengths, returns) = jax.eval_shape(ppo.train, jax.random.key(0))
    assert lengths.shape == returns.shape == (5, 128)
    observation_shape = ppo.env.observation_space(ppo.env_params).shape
    assert train_state.last_obs.shape == (ppo.num_envs, *observation_shape)
