"""Plants that a policy is tried on: drawn around its model; what of them breaks it."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.checkpoint import load_checkpoint
from baselines.purejaxrl_ppo.race_env import (
    RANGES,
    by_thirds,
    draw_plants,
    simulated_env,
    with_model_as_given,
)
from flytrack_env import make, nominal_parameters
from flytrack_env.effects import CommandDelay, LinearDrag, QuadraticDrag, ThrustScale
from flytrack_env.wrappers import DomainRandomization
from flytrack_env.wrappers.domain_randomization import sample_model
from tests.support.evaluated import write_checkpoint
from tests.support.trees import assert_close


def test_plants_are_drawn_from_the_ranges_around_the_model() -> None:
    known = (LinearDrag(0.4, 0.4, 0.2), CommandDelay(0.03), ThrustScale(0.9), QuadraticDrag(0.01, shared=0.0))
    model = nominal_parameters().with_effects(*known)
    plants = draw_plants(3, 200, model)
    for name, bounds in RANGES.items():
        drawn = plants.drawn[name]
        assert bounds[0] <= drawn.min() and drawn.max() <= bounds[1] and np.ptp(drawn) > 0.5 * np.ptp(bounds)
    found = plants.models
    np.testing.assert_allclose(found.effect("thrust_scale").factor, 0.9 * plants.drawn["thrust_scale"], 1e-6)
    np.testing.assert_allclose(found.effect("linear_drag").d_x, np.float32(0.4))
    np.testing.assert_allclose(
        found.effect("command_delay").delay_s, 0.03 + plants.drawn["command_delay_s"], 1e-6
    )
    quadratic, wind = found.effect("quadratic_drag"), found.effect("wind")
    assert quadratic.k_x.min() >= 0.01 and (quadratic.shared == 0.0).all()
    np.testing.assert_allclose(np.hypot(wind.v_x, wind.v_y), plants.drawn["wind_m_s"], atol=1e-6)
    assert (wind.v_x < 0).any() and (wind.v_y < 0).any() and not np.any(wind.v_z)
    fewer = draw_plants(3, 5, model)
    np.testing.assert_array_equal(fewer.models.effect("wind").v_x, wind.v_x[:5])
    assert not np.array_equal(draw_plants(4, 5, model).drawn["wind_m_s"], fewer.drawn["wind_m_s"])


def test_what_breaks_the_policy_shows_in_its_thirds() -> None:
    drawn = draw_plants(0, 90, nominal_parameters()).drawn
    is_good = drawn["command_delay_s"] < np.quantile(drawn["command_delay_s"], 2.0 / 3.0)
    rows = by_thirds(drawn, np.stack([is_good, np.ones(90, bool)], axis=1))
    shares = {name: [r["plants"]["share"] for r in rows if r["quantity"] == name] for name in drawn}
    assert shares["command_delay_s"] == [1.0, 1.0, 0.0]
    assert all(min(shares[name]) > 0.3 for name in set(drawn) - {"command_delay_s"})
    assert {row["flights_share"] for row in rows if row["quantity"] == "command_delay_s"} == {1.0, 0.5}
    assert len(by_thirds(drawn, np.ones((90, 1), bool))) == 12
    assert len(by_thirds({"wind_m_s": np.ones(1)}, np.ones((1, 1), bool))) == 1


def test_ids_that_draw_models_fly_the_one_that_is_given(tmp_path: Path) -> None:
    env = simulated_env(load_checkpoint(write_checkpoint(tmp_path / "policy.safetensors")))
    params = with_model_as_given(env.default_params)
    env.check_params(params)
    ranges, given = params.wrappers[DomainRandomization.key], env.default_params.model
    found = sample_model(jnp.uint32(5), given, ranges)
    assert type(found.effects[0]) is LinearDrag and len(found.effects) == 1
    assert_close(found._replace(tau=np.stack(found.tau)), given, 1e-6)
    plain = make("FlyTrackNoisy-v0").default_params
    assert with_model_as_given(plain) is plain
