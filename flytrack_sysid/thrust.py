"""The error of a model's thrust by applied action and voltage."""

from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters, advance
from flytrack_env.effects import start_memories
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import BATTERY_EMPTY_V, BATTERY_FULL_V, Action, Drone
from flytrack_sysid.forces import ForceSamples
from flytrack_sysid.prediction import in_float64

NUM_ACTION_BINS = 10
NUM_VOLTAGE_BINS = 4
NUM_CURVES = 3
NUM_CURVE_POINTS = 21
# A pack that never changes its voltage still gets a bin.
LEAST_VOLTAGE_RANGE = 0.1


class ThrustCurve(NamedTuple):
    """Thrust against the applied action, N, at one voltage; measured in a range around it.

    modelled_action, modelled_n: the model at rest. measured_action, measured_n: means of the bins flown.
    """

    voltage_v: float
    modelled_action: np.ndarray
    modelled_n: np.ndarray
    measured_action: np.ndarray
    measured_n: np.ndarray


class ThrustError(NamedTuple):
    """Measured minus modelled thrust; maps are (voltage bins, action bins), NaN where nothing flew, N."""

    source: str
    action_edges: np.ndarray
    voltage_edges: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # hides tuple.count
    mean_n: np.ndarray
    rms_n: np.ndarray
    curves: tuple[ThrustCurve, ...]
    total_mean_n: float
    total_rms_n: float

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values; null where nothing flew."""
        maps = {
            name: [[None if np.isnan(n) else n for n in row] for row in values.tolist()]
            for name, values in (("mean_n", self.mean_n), ("rms_n", self.rms_n))
        }
        return {
            "what": "mass times specific force along body z, measured minus modelled, N; "
            "rows by voltage, columns by applied thrust action",
            "measured_with": self.source,
            "total_mean_n": self.total_mean_n,
            "total_rms_n": self.total_rms_n,
            "action_edges": self.action_edges.tolist(),
            "voltage_edges_v": self.voltage_edges.tolist(),
            "count": self.count.tolist(),
            **maps,
            "curves": [
                {
                    name: values.tolist() if isinstance(values, np.ndarray) else values
                    for name, values in curve._asdict().items()
                }
                for curve in self.curves
            ],
        }


@jax.jit
def _force_at_rest(action: jax.Array, battery_v: jax.Array, dt: Any, model: ModelParameters) -> jax.Array:
    """Return the specific force along body z of a drone at rest, all (num_points,), m/s^2."""

    def one(action: jax.Array, battery_v: jax.Array) -> Any:
        zero = jnp.zeros_like(action)
        still, upright = Vec3(zero, zero, zero), Quaternion(zero + 1.0, zero, zero, zero)
        command = Action(zero, zero, zero, action)
        drone = Drone(still, still, still, upright, still, command, battery_v)
        after, _ = advance(drone, start_memories(model.effects, drone), command, dt, model)
        return after.acc_w.z + model.g

    return jax.vmap(one)(action, battery_v)


def thrust_at_rest(
    model: ModelParameters, action: np.ndarray, battery_v: np.ndarray, dt: float
) -> np.ndarray:
    """Return the force along body z of a hovering drone by the simulator's own step, N, shape of action.

    action: applied and commanded, 1. battery_v: V, the same shape. dt: s.
    """
    with jax.enable_x64(True):
        force = _force_at_rest(np.asarray(action, float), np.asarray(battery_v, float), dt, in_float64(model))
        return float(model.m) * np.asarray(force)


def _voltage_range(battery_v: np.ndarray) -> tuple[float, float]:
    """Return the handout's range of voltage, or the log's where it leaves that."""
    low, high = float(battery_v.min()), float(battery_v.max())
    if low >= BATTERY_EMPTY_V and high <= BATTERY_FULL_V:
        return BATTERY_EMPTY_V, BATTERY_FULL_V
    return low, max(high, low + LEAST_VOLTAGE_RANGE)


def _bin_of(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the bins that values are in; what is beyond the ends belongs to the last bin there."""
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def thrust_error(model: ModelParameters, samples: ForceSamples, dt: float) -> ThrustError:
    """Return the error of thrust by applied action and voltage; dt: s, of the model's step at rest."""
    measured_n = float(model.m) * samples.measured_b[:, 2]
    error_n = measured_n - float(model.m) * samples.modelled_b[:, 2]
    action_edges = np.linspace(-1.0, 1.0, NUM_ACTION_BINS + 1)
    low, high = _voltage_range(samples.battery_v)
    voltage_edges = np.linspace(low, high, NUM_VOLTAGE_BINS + 1)
    by_action = _bin_of(samples.action, action_edges)

    def means(by_voltage: np.ndarray, num_voltages: int, values: np.ndarray) -> np.ndarray:
        place, shape = by_voltage * NUM_ACTION_BINS + by_action, (num_voltages, NUM_ACTION_BINS)
        count = np.bincount(place, minlength=num_voltages * NUM_ACTION_BINS)
        total = np.bincount(place, weights=values, minlength=len(count))
        return np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0).reshape(shape)

    by_voltage = _bin_of(samples.battery_v, voltage_edges)
    mean = partial(means, by_voltage, NUM_VOLTAGE_BINS)
    count = np.zeros((NUM_VOLTAGE_BINS, NUM_ACTION_BINS), int)
    np.add.at(count, (by_voltage, by_action), 1)

    thirds = np.linspace(low, high, NUM_CURVES + 1)
    by_third = _bin_of(samples.battery_v, thirds)
    measured, at = (means(by_third, NUM_CURVES, values) for values in (measured_n, samples.action))
    grid = np.linspace(-1.0, 1.0, NUM_CURVE_POINTS)
    curves = []
    for index, (start, end) in enumerate(pairwise(thirds.tolist())):
        middle, is_flown = 0.5 * (start + end), np.isfinite(measured[index])
        modelled = thrust_at_rest(model, grid, np.full_like(grid, middle), dt)
        curves.append(ThrustCurve(middle, grid, modelled, at[index][is_flown], measured[index][is_flown]))
    return ThrustError(
        source=samples.source,
        action_edges=action_edges,
        voltage_edges=voltage_edges,
        count=count,
        mean_n=mean(error_n),
        rms_n=np.sqrt(mean(error_n**2)),
        curves=tuple(curves),
        total_mean_n=float(np.mean(error_n)),
        total_rms_n=float(np.sqrt(np.mean(error_n**2))),
    )
