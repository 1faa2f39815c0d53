"""The part of the reliability page on determinism: the same bytes pass, another one is seen."""

from pathlib import Path

import numpy as np
import pytest

from baselines.purejaxrl_ppo import Config
from benchmarks.reliability.determinism import (
    CONDITIONS,
    REFERENCE,
    SECTION,
    Condition,
    compare,
    measure_conditions,
)

BATCH = 16 * 24
CONFIG = Config(total_timesteps=4 * BATCH, num_envs=16, num_steps=24, num_minibatches=4, hidden_sizes=(8,))
# The random numbers of before JAX 0.5.
OTHER_DRAWS = (("JAX_THREEFRY_PARTITIONABLE", "0"),)


def test_the_same_again_is_the_same_and_other_random_numbers_are_seen(tmp_path: Path) -> None:
    conditions = (
        CONDITIONS[0],
        CONDITIONS[1],
        Condition("planted", True, variables=OTHER_DRAWS),
        Condition("more cores than there are", True, cores=10_000),
    )
    result = measure_conditions(conditions, CONFIG, 1, tmp_path)
    same, planted, untried = result["rows"]
    assert same["differing"] == 0 and same["farthest_param"] == 0.0 and same["arrays"] > 50
    assert planted["differing"] > 10 and planted["farthest_param"] > 1e-3
    assert "differing" not in untried and result["steps"] == 4 * BATCH
    assert not SECTION.is_held(result) and SECTION.is_held({**result, "rows": [same, untried]})
    assert SECTION.is_held({**result, "rows": [same, {**planted, "is_promised": False}]})
    text = SECTION.as_markdown(result)
    assert f"| planted | yes | {planted['differing']} of {planted['arrays']} | " in text
    assert "| more cores than there are | yes | not tried: there are no other cores |  |" in text


@pytest.mark.slow
def test_every_condition_can_be_tried_and_what_is_promised_holds(tmp_path: Path) -> None:
    result = measure_conditions(CONDITIONS, CONFIG, 1, tmp_path)
    assert len(result["rows"]) == len(CONDITIONS) - 1 and SECTION.is_held(result)


def test_a_process_that_fails_says_why(tmp_path: Path) -> None:
    broken = Condition(REFERENCE, True, variables=(("JAX_PLATFORMS", "abacus"),))
    with pytest.raises(RuntimeError, match=rf"(?s){REFERENCE}: the process ended with 1: .*abacus"):
        measure_conditions((broken,), CONFIG, 1, tmp_path)


def test_a_single_bit_is_a_difference() -> None:
    values = {"params.w": np.zeros(3, np.float32), "key": np.arange(2, dtype=np.uint32)}
    other = {"params.w": np.array([0.0, -0.0, 0.0], np.float32), "key": np.array([0, 2], np.uint32)}
    assert compare(values, values) == {"arrays": 2, "differing": 0, "farthest_param": 0.0}
    assert compare(values, other) == {"arrays": 2, "differing": 2, "farthest_param": 0.0}
    with pytest.raises(RuntimeError, match=r"key: found None, expected \(\(2,\), dtype\('uint32'\)\)"):
        compare({"params.w": values["params.w"]}, values)


def test_every_run_is_compared_with_one_before_it() -> None:
    names = [condition.name for condition in CONDITIONS]
    assert names[0] == REFERENCE and len(set(names)) == len(names)
    for index, condition in enumerate(CONDITIONS[1:], start=1):
        assert condition.against in names[:index]
