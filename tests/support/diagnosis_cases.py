"""Plants for the tests of the diagnosis, drawn from a seed, and what a diagnosis of each has to say.

Where a plant hides effects of the list, it is graded by what its log could show of them
(``benchmarks.hidden.oracle``): from a lambda of CERTAIN on a class that contains the effect has to be named,
and the effect itself where no rival comes near (SEPARATE).
"""

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import signal

from benchmarks.hidden import (
    CHANGES,
    EFFECTS,
    NAMES,
    Truth,
    draw_base,
    draw_change,
    draw_effect,
    draw_gust,
    draw_outside,
    fly,
    measure,
)
from flytrack_env.plants import Simulator
from flytrack_sysid import collect
from flytrack_sysid.log import FlightLog

SEED = int(os.environ.get("FLYTRACK_TEST_SEED", "11"))
SECONDS = 40.0  # all logs have as many lanes, so that all share one compiled program
DT_S = 0.01
CERTAIN, SEPARATE = 30.0, 20.0  # lambda of an effect, and beside its closest rival
SIGNED = {"thrust_tilt": -1.0, "wind": -1.0, "yaw_reaction": -1.0}  # what mirrors each parameter
SEGMENT_ROWS, HELD_OUT_EVERY = 330, 4  # twelve segments, each short enough to be a block
OUTSIDE_AMPLITUDE = 2.0
HOVER_WIND = 0.25  # m/s^2; corrections of a few degrees tell a stronger one from a tilt
Rng = np.random.Generator


class Case(NamedTuple):
    """A plant, what its team believes in, its clean log, and the one that is measured."""

    truth: Truth
    believed: Truth
    clean: FlightLog
    log: FlightLog


def rng_of(name: str, seed: int = SEED) -> Rng:
    """Return the random numbers of a case."""
    return np.random.default_rng([seed, *name.encode()])


def _flown(truth: Truth, rng: Rng, noise: str = "sensors", kind: str = "scripted") -> Case:
    clean = fly(truth, kind, SECONDS, rng)
    return Case(truth, truth, clean, measure(clean, noise, rng))


def _large(name: str, rng: Rng) -> dict[str, float]:
    """Return an effect of a size in the upper half of its range."""
    drawn = EFFECTS[name]
    middle = np.log(drawn.low * drawn.high) / 2.0
    return draw_effect(name, rng, float(np.exp(rng.uniform(middle, np.log(drawn.high)))))


def _with(truth: Truth, names: Sequence[str], rng: Rng) -> Truth:
    return replace(truth, effects={str(name): _large(str(name), rng) for name in names})


def _signed(rng: Rng, sign: float = 1.0) -> Case:
    """Return a plant with a signed effect, or its mirror image; both are drawn and flown alike."""
    truth = _with(draw_base(rng), [rng.choice(list(SIGNED))], rng)
    effects = {
        name: {field: sign * value for field, value in values.items()}
        for name, values in truth.effects.items()
    }
    return _flown(replace(truth, effects=effects), rng)


def _drawn(rng: Rng, count: int) -> Case:
    return _flown(_with(draw_base(rng), rng.choice(NAMES, count, replace=False), rng), rng)


def _in_training_only(rng: Rng) -> Case:
    """Return a plant with drag that is absent from the last of every four segments."""
    still = draw_base(rng)
    dragged = replace(still, effects={"linear_drag": draw_effect("linear_drag", rng, 0.4)})
    parts = [fly(truth, "scripted", SECONDS, rng) for truth in (dragged, still)]
    rows = np.arange(len(parts[0]))
    segment = rows // SEGMENT_ROWS
    is_still = segment % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    channels = {
        name: np.where(is_still[:, None], parts[1][name], values)
        for name, values in parts[0].channels.items()
    }
    clean = FlightLog(parts[0].time, channels, segment).select(segment < len(rows) // SEGMENT_ROWS)
    return Case(still, still, clean, measure(clean, "sensors", rng))


def residuals_of(truth: Truth, log: FlightLog) -> tuple[np.ndarray, np.ndarray]:
    """Return a clean log's accelerometer and gyro less what the plant without effects says, (num_rows, 3)."""
    sticks = np.vstack([log["u"][:1], log["u"][:-1]])
    keep = np.exp(-DT_S / np.array(truth.tau))
    applied = np.stack(
        [
            signal.lfilter([1.0 - k], [1.0, -k], column, zi=[k * column[0]])[0]
            for k, column in zip(keep, sticks.T, strict=True)
        ],
        axis=1,
    )
    volt = np.append(log["v_bat"][0], log["v_bat"][:-1, 0])
    force_b = log["f"].copy()
    force_b[:, 2] -= truth.thrust(applied[:, 3], volt) / truth.mass
    return force_b, log["w"] - np.radians(truth.max_rate) * applied[:, :3]


def _shuffled(rng: Rng) -> Case:
    """Return a clean flight that carries residuals of another plant in a random order of time.

    Less their means, which no order hides: they are a bias of the sensors, which has a name.
    """
    truth = draw_base(rng)
    effects = {name: draw_effect(name, rng, EFFECTS[name].high) for name in ("linear_drag", "rate_expo")}
    other = replace(truth, effects=effects)
    residuals = residuals_of(truth, fly(other, "scripted", SECONDS, rng))
    clean = fly(truth, "scripted", SECONDS, rng)
    order = rng.permutation(len(clean))
    added = {
        name: clean[name] + (left - left.mean(axis=0))[order]
        for name, left in zip(("f", "w"), residuals, strict=True)
    }
    carrying = replace(clean, channels={**clean.channels, **added})
    return Case(truth, truth, carrying, measure(carrying, "sensors", rng))


def _wind_in_hover(rng: Rng) -> Case:
    truth = draw_base(rng)
    way = rng.uniform(-np.pi, np.pi)
    wind = {"a_x": HOVER_WIND * float(np.cos(way)), "a_y": HOVER_WIND * float(np.sin(way)), "a_z": 0.0}
    return _flown(replace(truth, effects={"wind": wind}), rng, kind="hover")


def _outside(rng: Rng, kinds: Sequence[str] = ("periodic", "heading")) -> Case:
    kind = str(rng.choice(kinds))
    return _flown(replace(draw_base(rng), outside=draw_outside(rng, kind, OUTSIDE_AMPLITUDE)), rng)


def _changed(name: str, rng: Rng) -> Case:
    """Return a plant of which the team believes an older base, flown as it is now."""
    believed = draw_base(rng)
    low, high = CHANGES[name].low, CHANGES[name].high
    size = float(np.exp(rng.uniform(np.log(low * high) / 2.0, np.log(high))))
    return _flown(draw_change(believed, name, rng, size), rng)._replace(believed=believed)


def _simulated(rng: Rng) -> Case:
    """Return flights of the simulator itself, without noise; all kinds, as many rows as the other logs."""
    log = collect(Simulator(), 1.0, int(rng.integers(2**31)))
    log = log.select(log.segment % 3 != 2)
    nominal = Truth((0.03,) * 4, (0.0,) * 6)  # not looked at: the model is the simulator's own
    return Case(nominal, nominal, log, log)


def _broken(rng: Rng, channel: str, value: float) -> Case:
    """Return a flight with one channel stuck at a value from the first row to the last."""
    case = _flown(draw_base(rng), rng)
    stuck = np.full_like(case.log[channel], value)
    return case._replace(log=replace(case.log, channels={**case.log.channels, channel: stuck}))


CASES: Mapping[str, Callable[[Rng], Case]] = {
    "clean": lambda rng: _flown(draw_base(rng), rng),
    "heavy": lambda rng: _flown(draw_base(rng), rng, "heavy"),
    "coloured": lambda rng: _flown(draw_base(rng), rng, "coloured"),
    "gusts": lambda rng: _flown(replace(draw_base(rng), gust=draw_gust(rng)), rng),
    "one_signed": _signed,
    "one_mirrored": lambda rng: _signed(rng_of("one_signed"), -1.0),
    "one": lambda rng: _drawn(rng, 1),
    "raced": lambda rng: _flown(_with(draw_base(rng), rng.choice(NAMES, 1), rng), rng, kind="race"),
    "two": lambda rng: _drawn(rng, 2),
    # Without a slope where there is none of it, and with fits that go astray.
    "loop": lambda rng: _flown(_with(draw_base(rng), ["second_order_rates"], rng), rng),
    "training_only": _in_training_only,
    "shuffled": _shuffled,
    "wind_in_hover": _wind_in_hover,
    "outside": _outside,
    "thermal": lambda rng: _outside(rng, ["position"]),
    "tau": lambda rng: _changed("tau", rng),
    "mass": lambda rng: _changed("mass", rng),
    "simulated": _simulated,
    "stuck_gyro": lambda rng: _broken(rng, "w", 0.0),
    "stuck_commands": lambda rng: _broken(rng, "u", -0.3),
}


def names_of(found: Mapping[str, Any]) -> set[str]:
    """Return what a diagnosis (or a line of the benchmark) names."""
    return {cause["effect"] for cause in found["causes"]}


def faults(
    there: Collection[str], hidden: Mapping[str, Sequence], causes: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Return what is wrong with causes, a line each.

    there: the plant's hidden effects. hidden: by effect what the log could show: lambda, lambda beside the
    closest rival, and that rival.
    """
    classes = {cause["effect"]: {cause["effect"], *cause["equivalent"]} for cause in causes}
    result = []
    for effect, (lambda_, beside, rival) in hidden.items():
        how = f"{effect} (lambda {lambda_:.3g}, {beside:.3g} beside {rival})"
        if lambda_ > CERTAIN and not any(effect in one for one in classes.values()):
            result.append(f"{how} is in no class")
        elif lambda_ > CERTAIN and beside > SEPARATE and effect not in classes:
            result.append(f"{how} is not named itself")
    rivals = {rival for _, beside, rival in hidden.values() if beside <= SEPARATE}
    for name, alike in classes.items():
        if not alike & set(there) and name not in rivals:
            result.append(f"{name} is named and is not there")
    return result
