"""The result of a diagnosis, and its JSON."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis.beyond import Learned
from flytrack_sysid.inference.chunks import AXES

TWO_SIDED_95 = 1.959964  # standard deviations of a normal distribution: half of its 95 % interval
SCHEMA = 1  # version of diagnosis.json
TO_LOG = "log "  # begins the recommendation where a channel is missing, in place of a manoeuvre
CONSISTENT, CAUSES_FOUND, UNEXPLAINED = "consistent", "causes_found", "unexplained"
# Not an effect: an equivalent of a thrust curve that depends on the voltage, which falls with the
# time.
DRIFT = "thrust_drift"
# Direct and level channel of each side: rotation, force, battery.
CHANNELS: tuple[tuple[str | None, str], ...] = (
    ("rates", "attitude"),
    ("force", "velocity"),
    (None, "battery"),
)
# Indices into ``Problem.residuals`` by channel: the axes, and 0 for the direct channel, 1 for the
# level channel.
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
        """Return a value with a symmetric interval, clipped to the value's range."""
        return cls(value, (max(value - half, low), min(value + half, high)), unit)

    @property
    def half_width(self) -> float:
        """Half of the interval."""
        return 0.5 * (self.ci95[1] - self.ci95[0])


@dataclass(frozen=True)
class Cause:
    """A named error of the model.

    Attributes:
        effect: name in ``flytrack_env.effects``, or a base parameter (tau_roll ... tau_thrust,
            thrust_curve, thrust_scale, battery_drain).
        equivalent: names that this log cannot distinguish from it, or DRIFT.
        channel: channel with the largest difference: rates, attitude, force, velocity or battery.
        parameters: values by name.
        chi2_gain: decrease of minus twice the log likelihood on the fitted part.
        heldout_gain: the same on the held-out part.
        lambda_: squared size of its signature over the noise, with all other free parameters
            projected out.
        lambda_sep: the same with the closest rival projected out, too.
        closest: the closest rival; base parameters have none.
        beyond: describes a value at the end of its searched range, such as "delay_s at least
            0.04 s": the true cause may be beyond the list.
        family: other laws of the same response, while something in it is unexplained: the log
            shows that the response differs, and not for certain which of its laws.
        by_flight: of several flights the values of each, by parameter; empty for one flight.
        birge_ratio: how many times as far the flights differ as chance has it; 1 if by no more.
        onset_s: when it began, in the log's time (s); None if it acts from the log's first row.
        end_s: when it ended, in the log's time (s); None if it acts until the log's last row.
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
    family: tuple[str, ...] = ()
    by_flight: Mapping[str, tuple[Estimated, ...]] = field(default_factory=dict)
    birge_ratio: float = 1.0
    onset_s: Estimated | None = None
    end_s: Estimated | None = None


@dataclass(frozen=True)
class Unexplained:
    """What no known cause explains.

    Attributes:
        flagged: whether residuals exceed noise, or a value is beyond the list.
        depends_on: what the residuals vary with: position, time, heading, airspeed, attitude,
            command, "periodic at F Hz", or stochastic.
        shares: RMS of each in units of the sensor noise, by "channel: dependence".
    """

    flagged: bool = False
    depends_on: tuple[str, ...] = ()
    shares: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class NotIdentifiable:
    """An effect that this log could not have shown, or could not distinguish from others.

    Attributes:
        effect: name of the effect.
        smallest: smallest detectable size of its least visible parameter.
        unit: unit of ``smallest``.
        confused_with: effects with the same signature in this log.
        fly: the manoeuvre of ``flytrack_sysid.manoeuvres`` that settles it.
    """

    effect: str
    smallest: float
    unit: str
    confused_with: tuple[str, ...]
    fly: str


@dataclass(frozen=True)
class Errors:
    """Errors of one model on the held-out part.

    Attributes:
        one_step_nrmse: by channel; 1 is as bad as predicting the mean.
        position_m: RMS error of position (m), by seconds of free flight.
    """

    one_step_nrmse: Mapping[str, float]
    position_m: Mapping[str, float]


@dataclass(frozen=True)
class Changed:
    """A parameter whose value in the extended model is not the nominal one.

    Attributes:
        name: name in ``flytrack_sysid.inference.parameters``.
        nominal: value in the nominal model.
        value: value in the extended model.
        ci95: 95 % interval; not finite if the log does not determine the parameter.
        unit: unit of the values.
        is_at_bound: whether the value is at the end of its searched range.
    """

    name: str
    nominal: float
    value: float
    ci95: tuple[float, float]
    unit: str
    is_at_bound: bool


@dataclass(frozen=True)
class Joint:
    """Joint uncertainty of those parameters of the extended model that the log was fitted by.

    Attributes:
        names: of the parameters, as in ``flytrack_sysid.inference.parameters``.
        covariance: of their values, (names, names), one standard deviation; large where the log
            determines nothing.
    """

    names: tuple[str, ...] = ()
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True)
class Prediction:
    """Held-out RMS errors of free flights from measured states, and where they are evidence.

    Attributes:
        errors: by model, by quantity with its unit, and by seconds of free flight. Models are
            nominal, refitted_base, extended and placebo. If it was fitted, refitted_to_flights is
            the base alone, fitted as the extended model. If a law was learnt, without_learned is
            the extended model without it.
        evidence: by quantity, the horizons (s) at which a model predicts better than the placebo,
            which knows the state at the start and no commands.
        removal_costs: relative increase of these errors without an effect, by effect.
    """

    errors: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    evidence: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    removal_costs: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class HalfResponse:
    """Time from a step of a stick to half of the response (s), as ``response`` measures it.

    Times are NaN where there is no response.

    Attributes:
        time: time for a small step.
        full_stick: time for a step to full stick.
        ci95: 95 % interval of ``time``, to infinity if the log does not limit it; None if the model
            was not fitted.
    """

    time: float
    full_stick: float
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True)
class Lift:
    """What a model's thrust carries. Only the extended model's values have an interval of a width.

    Attributes:
        full_v: voltage of the full battery.
        thrust_to_weight: at full stick and that voltage.
        middle_v: voltage between the empty and the full battery.
        hover: thrust command that carries the weight at that voltage.
    """

    full_v: float
    thrust_to_weight: Estimated
    middle_v: float
    hover: Estimated


@dataclass(frozen=True)
class RateLoop:
    """The loop of rates of one axis: ``flytrack_sysid.diagnosis.controller`` has its law.

    Attributes:
        axis: its name.
        explained: share of the held-out variance of the demand; NaN without such rows.
        full_stick: rate that full stick asks for, deg/s.
        gain: P, in hundredths of the motors' range per 100 deg/s.
        integral: I over P, 1/s.
        derivative: D over P, s.
        feedforward: F over P and the rate of full stick, s.
        stick_delay_s: from the sticks to the motors; up to 0.048 s are searched.
        gyro_delay_s: from the gyro to the motors.
    """

    axis: str
    explained: float
    full_stick: Estimated
    gain: Estimated
    integral: Estimated
    derivative: Estimated
    feedforward: Estimated
    stick_delay_s: float
    gyro_delay_s: float


@dataclass(frozen=True)
class Controller:
    """What a log shows of a controller.

    Attributes:
        loops: of the axes that the log shows.
        faults: what is wrong with them, a sentence each.
    """

    loops: tuple[RateLoop, ...]
    faults: tuple[str, ...]


@dataclass(frozen=True)
class Outliers:
    """The number of outliers in a channel, and the number of rows."""

    rows: int
    of: int


@dataclass(frozen=True)
class Diagnosis:
    """The errors of a model, according to a log.

    Attributes:
        verdict: consistent, causes_found, unexplained, or "causes_found+unexplained".
        causes: the errors that the log shows, by name.
        unexplained: what no known cause explains.
        not_identifiable: effects that the log could not have shown.
        error: errors by model: nominal, refitted_base, extended, noise_floor, and without_learned
            as in ``Prediction``.
        nominal: the model that is diagnosed, with the motion that the log shows.
        base: the refitted base, with that motion.
        extended: the extended model, with that motion.
        noise: fitted standard deviations of the sensors, by channel and axis.
        source: file of the log.
        sha256: hash of the log's content.
        voltages: lowest and highest battery voltage (V) of the training rows; None if it was not
            measured.
        warnings: what a reader must know before trusting the causes.
        negligible: causes that are significant, but too small to matter.
        beyond: causes that are not named since a value is at the end of its searched range.
        unsettled: effects and base parameters that the log suggests, and does not settle; warnings
            say why.
        prediction: errors of free flight.
        changed: parameters whose value in the extended model differs from the nominal one.
        half_response_s: by model (nominal, refitted_base, extended) and by stick.
        lift: by model, if the log shows the thrust.
        outliers: by channel, if any.
        learned: a law for what is unexplained, part of the extended model.
        joint: how uncertain the extended model's parameters are together.
        controller: between sticks and motors, if the log has both.
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
    unsettled: tuple[str, ...] = ()
    prediction: Prediction = Prediction()
    changed: tuple[Changed, ...] = ()
    half_response_s: Mapping[str, Mapping[str, HalfResponse]] = field(default_factory=dict)
    lift: Mapping[str, Lift] = field(default_factory=dict)
    outliers: Mapping[str, Outliers] = field(default_factory=dict)
    learned: Learned | None = None
    joint: Joint = field(default_factory=Joint)
    controller: Controller | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the content of diagnosis.json, with the names of its schema and six digits."""
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
            "unsettled": list(self.unsettled),
            "unexplained": unexplained,
            "not_identifiable": limits,
            "motion": self.extended.motion.value,
            "error": _plain(self.error),
            "learned": None if self.learned is None else _plain(self.learned.as_json()),
            "prediction": _plain(self.prediction),
            "changed": _plain(self.changed),
            "half_response_s": _plain(self.half_response_s),
            "lift": _plain(self.lift),
            "controller": None if self.controller is None else _plain(self.controller),
            "noise": self.noise,
            "outliers": _plain(self.outliers),
            "data": {"file": self.source, "sha256": self.sha256, "voltages": self.voltages},
            "warnings": list(self.warnings),
        }


def _plain(value: Any) -> Any:
    """Return dataclasses as JSON values: numbers with six digits, None for non-finite ones."""
    if is_dataclass(value):
        value = {item.name: getattr(value, item.name) for item in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value
