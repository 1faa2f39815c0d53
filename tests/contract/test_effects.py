"""The contract of effects, over the whole list, and that of a model that has some."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flytrack_env import effects
from flytrack_env.dynamics import start_rates, step
from flytrack_env.effects import (
    EFFECTS,
    LEARNED_LAW,
    BetaflightLoop,
    CommandDelay,
    ImuLatency,
    LinearDrag,
    Motors,
    ThrustScale,
    Wind,
    check_parameters,
)
from flytrack_env.state import RATES, Action, pack
from tests.support.compiling import quick_jit
from tests.support.simulated_flights import (
    ALL_NEUTRAL,
    DT,
    NOMINAL,
    NUM_STEPS,
    drone_with,
    flown,
    fly,
    held,
    random_commands,
    random_drone,
)
from tests.support.slow import slow_but

OVER_EFFECTS = pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)


# A loop is unstable towards the ends of its ranges, and nothing of it acts without a craft.
SHOWING = {"center_x": 0.05, "center_y": 0.05, "gyro_late_s": 0.002, "d_yaw": 5.0, "d_max_yaw": 8.0}
RACER = BetaflightLoop(
    20.0, 21.0, 2.0, 2.0, 0.02, 0.5, **SHOWING, thrust_linear=20.0, throttle_boost=10.0
)

FRAME = Motors(
    *(0.1, 0.11, 0.09, 0.12, 0.004, 0.003, 0.08, 0.09, 0.1, 0.1, 0.08, 0.05, 0.015, 0.01),
    *(0.03, 0.04, 0.5, 0.6, 0.7, 0.1, 0.9, 1.1, 1.05, 0.95),
)
CRAFTS = {"betaflight_loop": RACER, "motors": FRAME}  # nothing acts without one


def inside_ranges(effect, fraction):
    """Return parameters that lie that far from neutral towards the upper end of their ranges."""
    neutral = effect.parameters()
    if effect.name in CRAFTS and fraction > 0.0:
        return CRAFTS[effect.name]
    values = (
        n + fraction * (r.high - n) for n, r in zip(neutral, effect.ranges.values(), strict=True)
    )
    return effect.parameters(*values)


# A loop takes the place of lags, which are neutral only without it.
GROUPS = {
    "all": EFFECTS,
    "without the loop": [effect for effect in EFFECTS if "respond" not in effect.hooks],
}


@pytest.mark.parametrize("group", slow_but(["all"], GROUPS))
def test_neutral_equals_absent_bit_for_bit(group):
    with_neutral = NOMINAL.with_effects(*(effect.parameters() for effect in GROUPS[group]))
    assert jax.tree.structure(with_neutral) != jax.tree.structure(NOMINAL)
    for seed in range(2):
        drone, commands = random_drone(seed), random_commands(seed, NUM_STEPS)
        assert_array_equal(fly(drone, commands, with_neutral), fly(drone, commands, NOMINAL))


@OVER_EFFECTS
def test_declaration_is_consistent(effect):
    neutral = effect.parameters()
    assert tuple(effect.ranges) == neutral._fields
    assert effect.stages and effect.equation and effect.source
    is_used = "respond" in effect.hooks or (effect.memory and effect.memory.remember)
    assert bool(effect.memory) == bool(is_used)
    assert set(effect.notable) == set(effect.ranges) - set(effect.search.shapes)
    for name, bounds in effect.ranges.items():
        value = getattr(neutral, name)
        assert bounds.low <= value <= bounds.high and bounds.low < bounds.high and bounds.unit
        assert all(
            bounds.low <= probe <= bounds.high for probe in effect.search.probes.get(name, ())
        )
        if name in effect.notable:
            assert effect.notable[name] > 0.0 and value + effect.notable[name] <= bounds.high
    for stage, channel in (("gyro", "w"), ("accelerometer", "f"), ("battery", "v_bat")):
        assert effect.stages != (stage,) or channel in effect.search.needs


def test_every_file_of_the_folder_is_in_the_list():
    files = {path.stem for path in Path(effects.__path__[0]).glob("*.py")}
    files -= {"__init__", "base", "grammar"}
    every = (*EFFECTS, LEARNED_LAW)
    assert files == {effect.name for effect in every} == set(effects.BY_NAME)
    assert len(files) == len(every)


@OVER_EFFECTS
def test_probes_show_the_effect(effect):
    full_stick, drone = np.ones((20, 4)), random_drone(0)
    plain = flown((), full_stick, drone)
    for name, values in effect.search.probes.items():
        for value in values:
            start = CRAFTS.get(effect.name, effect.parameters())
            assert not np.array_equal(
                flown(start._replace(**{name: value}), full_stick, drone), plain
            )


# Components of the state and of the sensors' readings after one step that an effect at this stage
# may change.
GYRO, ACCELEROMETER, POSE = {*range(21, 24)}, {*range(24, 27)}, {*range(27, 37)}
FORCE = {*range(0, 9), *range(27, 33)} | ACCELEROMETER
TURN = {*range(9, 16), *range(33, 37)} | GYRO
BUT_BATTERY = set(range(37)) - {20}
CHANGES = {
    "command": BUT_BATTERY,
    "lag": BUT_BATTERY,
    "respond": BUT_BATTERY,
    "rates": TURN,
    "thrust": FORCE,
    "air": FORCE,
    "force": FORCE,
    "battery": {20},
    "gyro": GYRO,
    "accelerometer": ACCELEROMETER,
    "pose": POSE,
}


@OVER_EFFECTS
def test_changes_what_its_stages_may_and_nothing_else(effect):
    drone = random_drone(0)._replace(applied=Action(0.3, -0.2, 0.1, 0.5))
    # What sensors read never changes the flight; other effects change more in later steps.
    falling = held(
        30 if effect.acts_on == ("sensor",) else 1, roll=0.9, pitch=-0.8, yaw=0.7, thrust=-0.5
    )
    difference = flown(inside_ranges(effect, 0.8), falling, drone) != flown((), falling, drone)
    changed = set(np.flatnonzero(difference.any(axis=0)).tolist())
    allowed = set().union(*(CHANGES[stage] for stage in effect.stages))
    assert changed, "nothing changes; moving air does nothing without drag: it takes another hook"
    assert changed <= allowed


@quick_jit
def final_and_slope(effects, change):
    """Return a short flight's last row, (37,), and its derivative along a parameter change."""
    drone, commands = random_drone(1), 0.9 * random_commands(1, 14)

    def final(effects, drone):
        return fly(drone, commands, NOMINAL._replace(effects=effects))[-1]

    # With the start as an argument, tracing the derivative of the loop takes a sixth of the time.
    return jax.jvp(final, (effects, drone), (change, jax.tree.map(jnp.zeros_like, drone)))


def only(parameters, effect, name):
    """Return a change of one parameter by 1, all others by 0."""
    zeros = list(jax.tree.map(np.zeros_like, parameters))
    index = list(map(type, parameters)).index(effect.parameters)
    zeros[index] = zeros[index]._replace(**{name: np.float32(1.0)})
    return tuple(zeros)


# A craft's laws take most of the compilation: only its own flights have them.
WITHOUT_CRAFT = [effect for effect in EFFECTS if effect.name not in CRAFTS]


@pytest.mark.parametrize("effect", slow_but(WITHOUT_CRAFT, EFFECTS), ids=lambda effect: effect.name)
@pytest.mark.parametrize("fraction", [0.0, 0.8])
def test_gradients_are_finite_and_right(effect, fraction):
    others = EFFECTS if effect.name in CRAFTS else WITHOUT_CRAFT
    model = NOMINAL.with_effects(*(other.parameters() for other in others))
    # With some drag: without any, moving air does nothing.
    model = model.with_effects(LinearDrag(0.1, 0.1, 0.1), inside_ranges(effect, fraction))
    parameters = jax.tree.map(np.float32, model.effects)
    for name, bounds in effect.ranges.items():
        tangent = only(parameters, effect, name)
        here, slope = map(np.asarray, final_and_slope(parameters, tangent))
        assert np.isfinite(slope).all()
        if fraction == 0.0 and (effect.search.probes or "respond" in effect.hooks):
            continue  # no slope there, or not the same on both sides
        if fraction == 0.0 and name in effect.search.shapes:
            assert not slope.any()
            continue
        size = (
            getattr(CRAFTS[effect.name], name, 0.0)
            if effect.name in CRAFTS
            else (bounds.high - bounds.low)
        )
        change = np.float32(2e-3 * size)
        shift = jax.tree.map(partial(np.multiply, change), tangent)
        moved = jax.tree.map(np.add, parameters, shift)
        measured = (np.asarray(final_and_slope(moved, tangent)[0]) - here) / change
        assert np.abs(slope).max() > 0.0
        assert_allclose(slope, measured, atol=0.03 * np.abs(slope).max() + 1e-4 / change)


@pytest.mark.parametrize(
    "effect",
    [effect for effect in EFFECTS if "rates" in effect.hooks],
    ids=lambda effect: effect.name,
)
def test_rates_of_a_start_stay_while_its_sticks_are_held(effect):
    drone, parameters = random_drone(5), inside_ranges(effect, 0.5)
    drone = drone._replace(rates_b=steady_rates(drone, ALL_NEUTRAL.with_effects(parameters)))
    assert np.abs(drone.rates_b).max() > 0.1 and np.isfinite(drone.rates_b).all()
    rates_b = flown(parameters, np.tile(drone.applied, (3, 1)), drone)[:, RATES]
    assert_allclose(rates_b, np.tile(drone.rates_b, (3, 1)), rtol=2e-3, atol=1e-5)


steady_rates = jax.jit(start_rates)


# --- A model with effects -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "dt", "expected"),
    [
        (
            CommandDelay(0.05),
            0.01,
            r"command_delay\.delay_s: found 0.05, expected 0 to 0.04 s at steps of",
        ),
        (CommandDelay(np.nan), 0.01, r"found nan, expected 0 to "),
        (
            ImuLatency(0.03),
            0.005,
            r"imu_latency\.latency_s: found 0.03, expected 0 to 0.02 s at steps",
        ),
    ],
)
def test_parameters_out_of_range_are_refused(parameters, dt, expected):
    check_parameters(type(parameters)(0.02), dt)
    with pytest.raises(ValueError, match=expected):
        check_parameters(parameters, dt)


def test_effects_stand_in_the_order_of_the_list_and_replace_their_like():
    model = NOMINAL.with_effects(LinearDrag(0.1), CommandDelay(0.01)).with_effects(
        Wind(1.0), LinearDrag(0.2)
    )
    assert model.effects == (CommandDelay(0.01), Wind(1.0), LinearDrag(0.2))
    assert model.effect("linear_drag") == LinearDrag(0.2)
    assert model.effect("thrust_scale") == ThrustScale(1.0)  # absent is neutral
    assert NOMINAL.effects == ()


def test_what_is_no_effect_is_refused():
    with pytest.raises(TypeError, match="effect: found float, expected one of CommandDelay, "):
        NOMINAL.with_effects(0.3)
    with pytest.raises(KeyError, match="drag"):
        NOMINAL.effect("drag")


def test_the_packed_step_refuses_a_memory():
    with pytest.raises(
        ValueError, match=r"params\.effects: found one with a memory, expected none"
    ):
        step(pack(drone_with()), jnp.zeros(4), DT, NOMINAL.with_effects(CommandDelay(0.0)))
