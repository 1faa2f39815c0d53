"""evosax's OpenAI evolution strategy on FlyTrack-v0, through its own problem class."""

from typing import Any

import jax
import optax
from evosax.algorithms import Open_ES
from evosax.problems import GymnaxProblem
from evosax.problems.networks import MLP, tanh_output_fn

import flytrack_env  # noqa: F401  registers the ids, which evosax looks up by name
from clients.flights import EVALUATION_SEED, NUM_FLIGHTS, Outcome, mean_gates

RETURN_MARGIN, GATE_MARGIN = 0.8, 0.3


def make_problem(env_id: str = "FlyTrack-v0") -> GymnaxProblem:
    """Return evosax's problem: the return of a small network's first 2 s, mean over some starts."""
    policy = MLP((16, 4), output_fn=tanh_output_fn)
    return GymnaxProblem(env_id, policy, episode_length=200, num_rollouts=8)


def evaluate(problem: GymnaxProblem, network: Any, problem_state: Any) -> tuple[float, float]:
    """Return the mean return and gates of a network's first 2 s on the same starts.

    Args:
        network: the policy's variables.
        problem_state: how observations are normalised.
    """
    num_steps = problem.episode_length
    many = GymnaxProblem(
        problem.env_name, problem.policy, episode_length=num_steps, num_rollouts=NUM_FLIGHTS
    )
    key = jax.random.key(EVALUATION_SEED)
    returns, _, _ = many.eval(key, jax.tree.map(lambda leaf: leaf[None], network), problem_state)

    def act(observation: jax.Array, key: jax.Array) -> jax.Array:
        return problem.policy.apply(network, problem.normalize_obs(observation, problem_state), key)

    return float(returns[0]), mean_gates(act, problem.env, problem.env_params, num_steps)


def evolve(seed: int, num_generations: int = 200) -> tuple[GymnaxProblem, Any, Any]:
    """Return the problem, the strategy's mean and the normalisation of observations."""
    problem = make_problem()
    key, init_key = jax.random.split(jax.random.key(seed))
    solution = problem.sample(init_key)
    std_schedule = optax.constant_schedule(0.05)
    strategy = Open_ES(64, solution, optimizer=optax.adam(0.05), std_schedule=std_schedule)
    params = strategy.default_params
    state, problem_state = strategy.init(init_key, solution, params), problem.init(init_key)
    for _ in range(num_generations):
        key, ask_key, eval_key, tell_key = jax.random.split(key, 4)
        population, state = strategy.ask(ask_key, state, params)
        fitness, problem_state, _ = problem.eval(eval_key, population, problem_state)
        state, _ = strategy.tell(tell_key, population, -fitness, state, params)
    return problem, strategy.get_mean(state), problem_state


def measure(seed: int) -> Outcome:
    """Evolve networks and return the evaluations of the strategy's mean before and after."""
    return_before, gates_before = evaluate(*evolve(seed, num_generations=0))
    return_after, gates_after = evaluate(*evolve(seed))
    return Outcome(return_before, return_after, gates_before, gates_after)
