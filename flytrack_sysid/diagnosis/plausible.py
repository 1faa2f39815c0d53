"""Models that a diagnosed log leaves possible, drawn from the extended one's joint uncertainty.

A log says little about thrust at sticks that it does not hold, and a fit leaves the thrust curve
anywhere there. There the model that was diagnosed decides: a curve is the less likely, the more it
differs from a multiple of that model's. Nor do seconds of flight show how fast a battery drains:
unless a cause names it, the drain is that model's, too. The voltage that a load takes is about that
model's; drawn models have as much of it as a log may fail to show.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME
from flytrack_env.thrust import collective_thrust
from flytrack_sysid.diagnosis.result import TWO_SIDED_95, Diagnosis
from flytrack_sysid.inference.parameters import (
    DRAIN,
    THRUST_COEFFS,
    as_float32,
    from_vector,
    names_of,
    range_of,
    to_vector,
    with_neutral_effects,
)
from flytrack_sysid.log_voltage import voltages_of

# Standard deviation of a thrust curve's shape, in shares of full thrust. Voltage lost under load,
# up to 0.95 V in 34 of 60 plants of benchmarks.loop (seed 2026), bends it by 2 % at most.
SHAPE_STD = 0.05
NUM_STICKS, NUM_VOLTAGES = 7, 3  # at which thrust is compared
BATTERY_DRAIN = "battery_drain"  # the cause
# Flights at full thrust show the voltage that a load takes at their start only: 10 s of two hidden
# plants (suite v1, plants 2 and 5) left 2.4 +- 0.5 V of 0.44 V, and 0.9 +- 0.2 V of 0.25 V.
SAG, SAG_FIELD, SAG_STD = "voltage_sag", "voltage_sag.at_full_v", 0.5  # V
UNKNOWN_V = 10.0  # where the log sets no limit; what is far above SAG_STD does the same
SPREAD = "learned_law.spread"  # in standard errors of a learnt law's coefficients


class PlausibleModels(NamedTuple):
    """Models as likely as the log and the diagnosed model make them: normal in their numbers.

    Attributes:
        like: the extended model, for structure and battery.
        mean: its numbers, made plausible where the log determines nothing, (num_parameters,).
        root: of their covariance, (num_parameters, num_drawn).
        low, high: ranges of the numbers, (num_parameters,).
    """

    like: ModelParameters
    mean: np.ndarray
    root: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def model(self) -> ModelParameters:
        """The most plausible model."""
        return as_float32(from_vector(self.mean, self.like))

    def draw_vector(self, key: jax.Array) -> jax.Array:
        """Draw the numbers of a model, (num_parameters,); traced by JAX."""
        normal = jax.random.normal(key, (self.root.shape[1],))
        return jnp.clip(self.mean + self.root @ normal, self.low, self.high)

    def draw(self, key: jax.Array) -> ModelParameters:
        """Draw a model; traced by JAX."""
        return from_vector(self.draw_vector(key), self.like)


def find_plausible_models(diagnosis: Diagnosis) -> PlausibleModels:
    """Return the models that a diagnosed log leaves possible."""
    like = with_neutral_effects(diagnosis.extended, [SAG])
    names, vector = names_of(like), to_vector(like)
    sag = names.index(SAG_FIELD)
    fitted = set(diagnosis.joint.names) & set(names)
    if all(cause.effect != BATTERY_DRAIN for cause in diagnosis.causes):
        vector[names.index(DRAIN)] = float(diagnosis.nominal.battery_drain_v_per_min)
        fitted -= {DRAIN}
    covariance = np.zeros((len(names), len(names)))
    rows = [row for row, name in enumerate(diagnosis.joint.names) if name in fitted]
    indices = [names.index(diagnosis.joint.names[row]) for row in rows]
    covariance[np.ix_(indices, indices)] = diagnosis.joint.covariance[np.ix_(rows, rows)]
    if SPREAD in names:
        covariance[names.index(SPREAD), names.index(SPREAD)] = 1.0
    if SAG_FIELD not in fitted:
        # A larger one would have been named: two standard deviations.
        smallest = {limit.effect: limit.smallest for limit in diagnosis.not_identifiable}
        shown_v = smallest.get(SAG, BY_NAME[SAG].notable["at_full_v"])
        covariance[sag, sag] = min(0.5 * shown_v, UNKNOWN_V) ** 2
    for cause in diagnosis.causes:
        if cause.effect == SAG:
            # As uncertain as reported, which counts how much parts of the log disagree.
            told = cause.parameters["at_full_v"]
            std_v = min((told.value - told.ci95[0]) / TWO_SIDED_95, UNKNOWN_V)
            more = std_v**2 - covariance[sag, sag]
            along = covariance[:, sag] / covariance[sag, sag]  # what changes with a volt of it
            covariance += max(more, 0.0) * np.outer(along, along)
    known, targets = _known_before(diagnosis, names)
    spread = covariance @ known.T
    gain = spread @ np.linalg.inv(np.eye(len(known)) + known @ spread)
    covariance = covariance - gain @ spread.T
    mean = vector + gain @ (targets - known @ vector)
    ranges = [range_of(name) for name in names]
    low, high = (np.array([getattr(one, end) for one in ranges]) for end in ("low", "high"))
    # A load takes voltage, and gives none.
    low[sag] = min(0.0, mean[sag])
    return PlausibleModels(like, np.clip(mean, low, high), _root(covariance), low, high)


def _known_before(diagnosis: Diagnosis, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return what is known without the log, in standard deviations.

    Returns:
        Combinations of the numbers, (rows, names), and their values, (rows,).
    """
    shapes = _thrust_shapes(diagnosis.nominal)
    rows = np.zeros((len(shapes) + 1, len(names)))
    targets = np.zeros(len(rows))
    rows[:-1, [names.index(name) for name in THRUST_COEFFS]] = shapes
    rows[-1, names.index(SAG_FIELD)] = 1.0 / SAG_STD
    targets[-1] = float(diagnosis.nominal.effect(SAG).at_full_v) / SAG_STD
    return rows, targets


def _thrust_shapes(nominal: ModelParameters) -> np.ndarray:
    """Return by how many standard deviations coefficients bend the thrust curve, (rows, 6).

    Multiples of the nominal curve are not bent.
    """
    sticks, volts = np.meshgrid(
        np.linspace(-1.0, 1.0, NUM_STICKS),
        np.linspace(*voltages_of(nominal.battery), NUM_VOLTAGES),
    )
    by_coefficient = np.stack(
        [collective_thrust(sticks.ravel(), volts.ravel(), one) for one in np.eye(6)], axis=1
    )
    curve = by_coefficient @ np.asarray(nominal.thrust_coeffs, float)
    share = np.sqrt(by_coefficient.shape[1] / by_coefficient.shape[0])  # as if so few were compared
    scaled = by_coefficient * share / (SHAPE_STD * curve.max())
    along = curve / np.linalg.norm(curve)
    return scaled - np.outer(along, along @ scaled)


def _root(covariance: np.ndarray) -> np.ndarray:
    """Return a root of a covariance, with a column for each direction that varies."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))  # lags vary by 1e-6, thrust by N
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    is_varied = values > 1e-9
    return scale[:, None] * vectors[:, is_varied] * np.sqrt(values[is_varied])
