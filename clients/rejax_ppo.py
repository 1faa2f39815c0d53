"""rejax's PPO on FlyTrack-v0, through the 5-value step."""

import gymnax
import jax
import rejax

from clients.flights import Outcome, mean_gates
from flytrack_env.wrappers import LegacyStep

RETURN_MARGIN, GATE_MARGIN = 8.0, 4.0


def make_ppo(env_id: str = "FlyTrack-v0") -> rejax.PPO:
    """Return rejax's PPO for an environment, not trained yet."""
    env, params = gymnax.make(env_id)
    return rejax.PPO.create(
        env=LegacyStep(env),
        env_params=params,
        agent_kwargs={"activation": "tanh"},
        num_envs=256,
        num_steps=64,
        num_epochs=4,
        num_minibatches=8,
        learning_rate=1e-3,
        ent_coef=0.0,
        total_timesteps=2_000_000,
        eval_freq=500_000,
    )


def measure(seed: int) -> Outcome:
    """Train and return rejax's own first and last evaluation, with the gates on the same starts."""
    ppo = make_ppo()
    key = jax.random.key(seed)
    train_state, (_, returns) = jax.jit(ppo.train)(key)
    act = ppo.make_act(train_state)
    mean_returns = returns.mean(axis=1)
    env, params = gymnax.make("FlyTrack-v0")
    gates_before, gates_after = (
        mean_gates(policy, env, params, int(params.max_steps_in_episode))
        for policy in (ppo.make_act(ppo.init_state(key)), act)
    )
    return Outcome(float(mean_returns[0]), float(mean_returns[-1]), gates_before, gates_after)
