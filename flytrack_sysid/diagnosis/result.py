"""The result of a diagnosis, and its JSON."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis.beyond import Learned
from flytrack_sysid.diagnosis.chunks import AXES

SCHEMA = 1
TO_LOG = "log "  # what comes instead of a manoeuvre where a channel is missing
CONSISTENT, CAUSES_FOUND, UNEXPLAINED = "consistent", "causes_found", "unexplained"
# no effect: what a curve that depends on the voltage may be, which falls with the time
DRIFT = "thrust_drift"
# Direct and level channel of each side: rotation, force, battery.
CHANNELS: tuple[tuple[str | None, str], ...] = (
    ("rates", "attitude"),
    ("force", "velocity"),
    (None, "battery"),
)
# By channel, of ``Problem.residuals``: the axes, and 0 for the direct channel, 1 for the level.
PLACES = {
    name: (axes, number)
    for axes, names in zip(AXES, CHANNELS, strict=True)
    for number, name in enumerate(names)
    if name is not None
}


@dataclass(frozen=True)
class Estimated:
    """A parameter's value, 95 % interval and unit."""

    value: float
    ci95: tuple[float, float]
    unit: str

    @classmethod
    def around(
        cls, value: float, half: float, unit: str, low: float = -np.inf, high: float = np.inf
    ) -> "Estimated":
        """Return a value with a symmetric interval, cut at the ends of the value's range."""
        return cls(value, (max(value - half, low), min(value + half, high)), unit)

    @property
    def half_width(self) -> float:
        """Half of the interval."""
        return 0.5 * (self.ci95[1] - self.ci95[0])


@dataclass(frozen=True)
class Cause:
    """Something that the model has wrong, by name.

    effect: of ``flytrack_env.effects``, or a base parameter (tau_roll ... tau_thrust, thrust_curve,
    thrust_scale, battery_drain). equivalent: names that this log cannot tell from it, or DRIFT.
    channel: rates, attitude, force, velocity or battery: where it shows most. parameters: by name.
    chi2_gain: what it gains on the part that was fitted, heldout_gain: on the part held out, of
    minus twice the log likelihood. lambda_: squared size of its signature over the noise, all else
    that is free taken out. lambda_sep: the same with the closest rival taken out too, and closest
    which that is; base parameters have none. beyond: where a value lies at the end of what is
    searched, "delay_s at least 0.04 s": the true cause may be beyond the list. onset_s, end_s: when
    it began and ended, in the log's time; None where the log begins and ends with it.
    """

    effect: str
    equivalent: tuple[str, ...]
    channel: str
    parameters: Mapping[str, Estimated]
    chi2_gain: float
    heldout_gain: float
    lambda_: float
    lambda_sep: float
    closest: str = ""
    beyond: str = ""
    onset_s: Estimated | None = None
    end_s: Estimated | None = None


@dataclass(frozen=True)
class Unexplained:
    """What no known cause explains.

    flagged: something is left, or has a value beyond the list. depends_on: what is left varies with
    position, time, heading, airspeed, attitude, command, "periodic at F Hz" or is stochastic.
    shares: of each, how many times the sensor noise it is (rms), by "channel: dependence".
    """

    flagged: bool = False
    depends_on: tuple[str, ...] = ()
    shares: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class NotIdentifiable:
    """An effect that this log could not have shown, or not apart from others.

    smallest: of its parameter that is seen worst, what the log would show for sure. confused_with:
    what looks alike in this log. fly: what to fly to settle it, one of
    ``flytrack_sysid.manoeuvres``.
    """

    effect: str
    smallest: float
    unit: str
    confused_with: tuple[str, ...]
    fly: str


@dataclass(frozen=True)
class Errors:
    """Errors of one model on the held-out part.

    one_step_nrmse: by channel, 1 is as bad as saying the mean. position_m: by seconds of free
    flight, rms.
    """

    one_step_nrmse: Mapping[str, float]
    position_m: Mapping[str, float]


@dataclass(frozen=True)
class Changed:
    """A parameter whose value in the extended model is not the nominal one.

    name: as in ``flytrack_sysid.parameters``. ci95: not finite where the log does not determine it.
    is_at_bound: it lies at the end of what is searched.
    """

    name: str
    nominal: float
    value: float
    ci95: tuple[float, float]
    unit: str
    is_at_bound: bool


@dataclass(frozen=True)
class Prediction:
    """Held-out errors of free flights from measured states, rms, and where they tell anything.

    errors: by model (nominal, refitted_base, extended, placebo; refitted_to_flights, the base alone
    fitted as the extended model was, where that was done; without_learned, the extended model
    without what was learnt beyond the list), by quantity with its unit, and by seconds. evidence:
    by quantity, the horizons, s, at which a model predicts better than the placebo, which knows the
    state at the start and no commands. removal_costs: by effect, by which share these errors grow
    without it.
    """

    errors: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    evidence: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    removal_costs: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class HalfResponse:
    """Time from a step of a stick to half of the response, s.

    time: of a small step. full_stick: of a step to full stick.

    ci95: 95 % interval of the small step's; None where the model was not fitted. As in
    ``flytrack_sysid.response``; not a number where there is no response.
    """

    time: float
    full_stick: float
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True)
class Outliers:
    """How many rows of a channel are outliers, and of how many."""

    rows: int
    of: int


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a model, according to a log.

    verdict: consistent, causes_found, unexplained, or "causes_found+unexplained". error: by model:
    nominal, refitted_base, extended, noise_floor, and without_learned as in ``Prediction``.
    nominal, base, extended: the models, with the motion that the log shows. negligible: what is
    significant and too small to matter. beyond: what has a value at the end of what is searched, so
    that it is not named. source, sha256: of the log. noise: by channel and axis, fitted standard
    deviations of the sensors. voltages: the lowest and the highest of the battery that were learnt
    from, V; None where it was not measured. prediction: how far ahead the models predict. changed:
    every parameter of the extended model that is not as in the nominal one. learned: a law for what
    is unexplained, part of the extended model. half_response_s: by model (nominal, refitted_base,
    extended) and by stick. outliers: by channel, if any.
    """

    verdict: str
    causes: tuple[Cause, ...]
    unexplained: Unexplained
    not_identifiable: tuple[NotIdentifiable, ...]
    error: Mapping[str, Errors]
    nominal: ModelParameters
    base: ModelParameters
    extended: ModelParameters
    noise: Mapping[str, list[float]]
    source: str
    sha256: str
    voltages: tuple[float, float] | None = None
    warnings: tuple[str, ...] = ()
    negligible: tuple[Cause, ...] = ()
    beyond: tuple[Cause, ...] = ()
    prediction: Prediction = Prediction()
    changed: tuple[Changed, ...] = ()
    half_response_s: Mapping[str, Mapping[str, HalfResponse]] = field(default_factory=dict)
    outliers: Mapping[str, Outliers] = field(default_factory=dict)
    learned: Learned | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the content of diagnosis.json: fields by the names of its schema, six digits."""
        causes, negligible, beyond = _plain((self.causes, self.negligible, self.beyond))
        limits, unexplained = _plain((self.not_identifiable, self.unexplained))
        unexplained["times_sensor_noise"] = unexplained.pop("shares")
        for cause in (*causes, *negligible, *beyond):
            cause |= {"lambda": cause.pop("lambda_"), "closest_rival": cause.pop("closest")}
        for limit in limits:
            limit["smallest_detectable"] = {
                "value": limit.pop("smallest"),
                "unit": limit.pop("unit"),
            }
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "causes": causes,
            "negligible": negligible,
            "beyond_the_list": beyond,
            "unexplained": unexplained,
            "not_identifiable": limits,
            "motion": self.extended.motion.value,
            "error": _plain(self.error),
            "learned": None if self.learned is None else _plain(self.learned.as_json()),
            "prediction": _plain(self.prediction),
            "changed": _plain(self.changed),
            "half_response_s": _plain(self.half_response_s),
            "noise": self.noise,
            "outliers": _plain(self.outliers),
            "data": {"file": self.source, "sha256": self.sha256, "voltages": self.voltages},
            "warnings": list(self.warnings),
        }


def _plain(value: Any) -> Any:
    """Return dataclasses as JSON values: numbers with six digits, None for non-finite ones."""
    if is_dataclass(value):
        value = {one.name: getattr(value, one.name) for one in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value
