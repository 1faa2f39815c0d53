"""Errors of models on held-out rows: one step by channel, and where free flight ends up."""

from collections.abc import Mapping

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.causes import CHANNELS
from flytrack_sysid.diagnosis.lanes import SIZES
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.result import Errors
from flytrack_sysid.log import FlightLog
from flytrack_sysid.open_loop import rollout_errors
from flytrack_sysid.parameters import from_vector
from flytrack_sysid.prediction import predict
from flytrack_sysid.record import fill_gaps

HORIZONS_S = (0.5, 1.0, 2.0)
NOISE_FLOOR = "noise_floor"


def _scales(problem: Problem, vector: np.ndarray) -> np.ndarray:
    """Return what errors are measured against, (NUM_AXES, 2): the spread of what a model of no motion leaves.

    That is a model whose rates, thrust and drain are none: what it leaves is the measured channel itself.
    """
    still = vector.copy()
    for name in problem.names:
        if (
            name.startswith("max_rate_")
            or name == "battery_drain_v_per_min"
            or name in ("c0", "c1", "c2", "c3", "c4", "c5")
        ):
            still[problem.names.index(name)] = 0.0
    left = _summed_up(problem.left(still[None])[0], problem.counts)
    return _rms(left, problem.counts, is_centred=True)


def _summed_up(left: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return residuals with those of the battery summed up, less their mean in each lane.

    A voltage changes by less in a step than its last digit, so that one step says nothing of it.
    """
    found = left.copy()
    counting = counts[..., -1, 1]
    level = np.cumsum(left[..., -1, 1], axis=0)
    mean = np.where(counting, level, 0.0).sum(axis=0) / np.maximum(counting.sum(axis=0), 1)
    found[..., -1, 1] = level - mean
    return found


def _rms(left: np.ndarray, counts: np.ndarray, is_centred: bool = False) -> np.ndarray:
    count = np.maximum(counts.sum(axis=(0, 1)), 1)
    mean = np.where(counts, left, 0.0).sum(axis=(0, 1)) / count if is_centred else 0.0
    return np.sqrt(np.where(counts, (left - mean) ** 2, 0.0).sum(axis=(0, 1)) / count)


def _by_channel(errors: np.ndarray, scales: np.ndarray, problem: Problem) -> dict[str, float]:
    edges = np.cumsum([0, *SIZES])
    found = {}
    for side, names in enumerate(CHANNELS):
        axes = slice(edges[side], edges[side + 1])
        for channel, name in enumerate(names):
            if name is not None and problem.counts[..., axes, channel].any():
                size = np.sqrt(np.sum(scales[axes, channel] ** 2))
                found[name] = float(np.sqrt(np.sum(errors[axes, channel] ** 2)) / max(size, 1e-12))
    return found


def _positions(model: ModelParameters, log: FlightLog, rows: np.ndarray) -> dict[str, float]:
    """Return rms position errors of free flight, m, by horizon.

    A model has all effects, so that one program flies every one.
    """
    if not {"p", "v", "q"} <= set(log.channels):
        return {}
    filled = fill_gaps(log)
    prediction = predict(model, filled)
    found = rollout_errors(model, filled.log, prediction, rows[filled.behind])
    return {
        f"{one.horizon_s:g}": one.errors["position"].rms
        for one in found
        if one.horizon_s in HORIZONS_S and "position" in one.errors
    }


def _start_errors(problem: Problem, log: FlightLog, gravity: float) -> dict[str, float]:
    """Return how far free flight ends up off only because its start was measured with noise, m."""
    if not {"p", "v", "q"} <= set(log.channels):
        return {}
    noise = noises.noise_of(problem.noise)
    speed = np.sqrt(np.sum(np.asarray(noise.level)[3:6] ** 2))
    tilt = np.sqrt(np.sum(np.asarray(noise.level)[:2] ** 2))
    return {
        f"{horizon:g}": float(np.hypot(speed * horizon, 0.5 * gravity * tilt * horizon**2))
        for horizon in HORIZONS_S
    }


def errors_of(
    held_out: Problem, vectors: Mapping[str, np.ndarray], log: FlightLog, rows: np.ndarray
) -> dict[str, Errors]:
    """Return errors on the held-out rows of models by name, and what the sensors' noise alone would be."""
    left = held_out.left(np.stack(list(vectors.values())))
    scales = _scales(held_out, held_out.start)
    result = {}
    for (name, vector), one in zip(vectors.items(), left, strict=True):
        model = from_vector(vector, held_out.like)
        one_step = _by_channel(_rms(_summed_up(one, held_out.counts), held_out.counts), scales, held_out)
        result[name] = Errors(one_step, _positions(model, log, rows))
    noise = noises.noise_of(held_out.noise)
    floor = np.stack([noise.direct, np.sqrt(2.0) * noise.level], axis=-1)
    floor[-1, 1] = noise.level[-1]  # summed up, not a difference of two
    positions = _start_errors(held_out, log, float(held_out.like.g))
    result[NOISE_FLOOR] = Errors(_by_channel(floor, scales, held_out), positions)
    return result
