"""What is left where no law is found: an ensemble of small networks of what it depends on.

Hyperbolic tangents of the quantities, the best of many random ones, and linear outputs: so the whitened,
robust score test of the diagnosis gives the weights beside all that the model may change. How much they are
shrunk is decided on folds of blocks, the ensemble is a bootstrap over blocks, and the interval of a measured
row is conformal: the share of held-out rows that it has to hold.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flytrack_env.effects.grammar import XYZ, Factor
from flytrack_env.effects.learned_residual import Input, Network
from flytrack_sysid.diagnosis.law_search import Found, Side, bare_term, directions_of, held_out, power
from flytrack_sysid.diagnosis.noise import step_to
from flytrack_sysid.diagnosis.problem import blocks_of
from flytrack_sysid.diagnosis.score_test import solve
from flytrack_sysid.diagnosis.unexplained import SIDES, whitened

HIDDEN, POOL, MEMBERS, FOLDS = 24, 160, 16, 4
STEEPEST = 8.0  # of a tangent, over the range of its inputs
SHRINKAGES = np.array([1.0, 10.0, 100.0, 1e3, 1e4])  # prior information about each weight
COVERED = 0.9
FEWEST_ROWS = 50  # of which an interval can be told
MARGIN_SHARE = 0.01  # of a quantity's range beyond that of 98 % of the rows
# What a dependence is a function of, by side.
INPUTS = {
    "position": ("x", "y", "height"),
    "time": ("time",),
    "heading": ("heading_cosine", "heading_sine"),
    "airspeed": ("airspeed", "airspeed_x", "airspeed_y", "airspeed_z"),
    "attitude": ("tilt",),
}
STICKS = {"rate": ("roll", "pitch", "yaw"), "force": ("throttle",)}
IN_WORLD = ("position", "time")


def inputs_of(side: Side, names: Sequence[str]) -> tuple[Input, ...]:
    """Return the quantities that dependences are functions of, with the ranges that were flown."""
    quantities = [one for name in names for one in INPUTS.get(name, STICKS[side.name])]
    found = []
    for quantity in dict.fromkeys(quantities):
        low, high = np.quantile(side.spread(quantity), [0.01, 0.99])
        if high - low > 1e-6:
            margin = MARGIN_SHARE * (high - low)
            found.append(Input(quantity, float(low - margin), float(high + margin)))
    return tuple(found)


def _white(side: Side, network: Network) -> np.ndarray:
    """Return what unit weights add, whitened, (3 * units, rows, lanes, 3, 2); units of an axis in a row."""
    term = bare_term(side, network.frame, (power("time"),))
    directions = directions_of(term, side.moment, side.flight.body_to_world)
    signals = np.stack([np.broadcast_to(one, directions.shape[1:3]) for one in network.units(side.moment)])
    features = np.concatenate([signals[..., None] * one for one in directions])
    return whitened(side.problem, features, side.name)


def _random_units(rng: np.random.Generator, number: int) -> tuple[tuple[float, ...], ...]:
    """Return tangents of so many inputs in random directions, gentle and steep, each about a random place."""
    ways = rng.normal(size=(POOL, number))
    steep = np.exp(rng.uniform(0.0, np.log(STEEPEST), size=(POOL, 1)))
    weights = steep * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    places = rng.uniform(-1.0, 1.0, size=(POOL, number))
    return _rows(np.concatenate([weights, -(weights * places).sum(axis=1, keepdims=True)], axis=1))


def _best_units(side: Side, network: Network) -> tuple[tuple[float, ...], ...]:
    """Return the units that explain most, one after the other, beside what the model may change."""
    number = len(network.hidden) + 1
    columns = blocks_of(_white(side, network) * side.test.root)
    by_axis = columns.reshape(len(columns), XYZ, number, -1)
    columns = np.moveaxis(by_axis, 2, 1).reshape(columns.shape)  # the axes of a unit in a row
    _, own, score, _ = side.test.projected(columns)
    own = own + np.eye(len(own))
    parts = [slice(XYZ * unit, XYZ * (unit + 1)) for unit in range(number)]
    chosen = [number - 1]  # the constant is there anyway
    while True:
        part = parts[chosen[-1]]
        share = solve(own[part, part], own[part])
        own, score = own - own[:, part] @ share + 1e-9 * np.eye(len(own)), score - share.T @ score[part]
        if len(chosen) == HIDDEN + 1:
            break
        gains = [score[one] @ solve(own[one, one] + np.eye(XYZ), score[one]) for one in parts]
        gains = [-np.inf if unit in chosen else gain for unit, gain in enumerate(gains)]
        chosen.append(int(np.argmax(gains)))
    return tuple(network.hidden[unit] for unit in chosen[1:])


class _Blocks(NamedTuple):
    """By block of a second: information about weights and given numbers, and their score."""

    information: np.ndarray
    score: np.ndarray
    num_given: int

    def solved(self, weights: np.ndarray, shrinkage: float) -> np.ndarray:
        """Return numbers given and weights for blocks that count so many times."""
        total = np.tensordot(weights, self.information, axes=1)
        prior = np.full(len(total), shrinkage)
        prior[: self.num_given] = 1e-6 * np.maximum(np.diag(total)[: self.num_given], 1.0)
        return solve(total + np.diag(prior), weights @ self.score)

    def misfit(self, weights: np.ndarray, numbers: np.ndarray) -> float:
        """Return the change of the sum of squares of blocks with these numbers."""
        total = np.tensordot(weights, self.information, axes=1)
        return float(numbers @ total @ numbers - 2.0 * numbers @ (weights @ self.score))


def _blocks(side: Side, columns: np.ndarray) -> _Blocks:
    joined = np.concatenate([side.test.given, columns], axis=1)
    information = joined @ np.swapaxes(joined, 1, 2)
    score = np.einsum("bfn,bn->bf", joined, side.test.rest, optimize=True)
    return _Blocks(information, score, side.test.given.shape[1])


def fit_residual(side: Side, held: Side, names: Sequence[str]) -> Found | None:
    """Return the ensemble of what a side depends on; None where held-out rows do not gain from it.

    names: of dependences.
    """
    inputs = inputs_of(side, names)
    if not inputs:
        return None
    rng = np.random.default_rng(0)  # of the random layer and the bootstrap
    frame = "world" if side.name == "force" and any(name in IN_WORLD for name in names) else "body"
    none = ((0.0,) * (HIDDEN + 1),) * XYZ
    network = Network(side.name, frame, inputs, _random_units(rng, len(inputs)), none, none, (0.0,) * XYZ)
    network = replace(network, hidden=_best_units(side, network))
    blocks = _blocks(side, blocks_of(_white(side, network) * side.test.root))
    numbers, members = _ensemble(blocks, rng)
    given, mean = numbers[: blocks.num_given], numbers[blocks.num_given :]
    vector = side.vector_beside(given)
    outputs, deviations = (
        _rows(one.reshape(XYZ, HIDDEN + 1)) for one in (mean, _main_spread(members[:, blocks.num_given :]))
    )
    network = replace(network, outputs=outputs, deviations=deviations)
    gain, expected = held_out(side, held, np.tensordot(mean, _white(held, network), axes=1), vector)
    if gain <= 0.0:
        return None
    network = _with_interval(held, network, vector)
    learnt_gain = -blocks.misfit(np.ones(len(blocks.score)), numbers)
    return Found((), (network,), vector, learnt_gain, gain, expected)


def _ensemble(blocks: _Blocks, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers of all blocks, and of the bootstrap's members, with the shrinkage that folds prefer."""
    number = len(blocks.score)
    fold = np.arange(number) * FOLDS // max(number, 1)
    misfits = [
        sum(
            blocks.misfit(fold == one, blocks.solved((fold != one).astype(float), shrinkage))
            for one in range(FOLDS)
        )
        for shrinkage in SHRINKAGES
    ]
    shrinkage = float(SHRINKAGES[int(np.argmin(misfits))])
    draws = rng.multinomial(number, np.full(number, 1.0 / number), size=MEMBERS)
    members = np.stack([blocks.solved(draw.astype(float), shrinkage) for draw in draws])
    return blocks.solved(np.ones(number), shrinkage), members


def _main_spread(members: np.ndarray) -> np.ndarray:
    """Return the first principal component of members about their mean, one standard deviation long."""
    centred = members - members.mean(axis=0)
    _, sizes, rows = np.linalg.svd(centred, full_matrices=False)
    return rows[0] * sizes[0] / np.sqrt(max(len(members) - 1, 1))


def _rows(values: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in values.tolist())


def direct_residuals(held: Side, vector: np.ndarray, network: Network) -> tuple[np.ndarray, np.ndarray]:
    """Return what a row measures beyond the model and the network's mean, body frame, and where it counts.

    (rows, lanes, 3) each; of the direct channel, or without one of the change of the level over its step.
    """
    axes = SIDES[held.name]
    problem = held.problem
    left, counts = problem.residuals(vector[None])[0][..., axes, :], problem.counts[..., axes, :]
    has_direct = bool(counts[..., 0].any())
    step_s = step_to(problem.lanes)
    world = left[..., 0] if has_direct else left[..., 1] / np.maximum(step_s, 1e-6)[..., None]
    body = np.einsum("rlji,rlj->rli", held.flight.body_to_world, world)
    mean = network.at(held.moment, 0.0)
    added = np.stack([np.broadcast_to(np.asarray(one), body.shape[:2]) for one in mean], axis=-1)
    return body - added, counts[..., 0 if has_direct else 1]


def _with_interval(held: Side, network: Network, vector: np.ndarray) -> Network:
    """Return the network with the interval that holds COVERED of held-out rows (split conformal)."""
    left, counts = direct_residuals(held, vector, network)
    widths = []
    for axis in range(XYZ):
        size = np.sort(np.abs(left[..., axis][counts[..., axis]]))
        place = int(np.ceil(COVERED * (len(size) + 1))) - 1
        widths.append(float(size[min(place, len(size) - 1)]) if len(size) >= FEWEST_ROWS else 0.0)
    return replace(network, half_width_90=tuple(widths))


def is_within_range(side: Side, network: Network) -> np.ndarray:
    """Return where all inputs of a network are within the range that was flown, (rows, lanes) bool."""
    inside = np.ones(side.flight.time_s.shape, bool)
    for one in network.inputs:
        value = np.asarray(Factor(one.quantity, "power", (1.0, 0.0)).at(side.moment))
        inside &= (value >= one.low) & (value <= one.high)
    return inside
