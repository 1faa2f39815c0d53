"""Identify a model from a flight log: lags, thrust map, battery drain, and chosen effects."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import signal

from flytrack_env import __version__
from flytrack_env.dynamics import ModelParameters, collective_thrust, nominal_parameters
from flytrack_env.effects import BY_NAME, effect_of
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis.result import TWO_SIDED_95
from flytrack_sysid.estimate import Estimate, FitError, Report, estimate
from flytrack_sysid.inference.parameters import (
    DRAIN,
    TAU_RANGE,
    TAUS,
    THRUST_COEFFS,
    as_float32,
    base_of,
    fields_of_sticks,
    names_of,
    neutral_value,
    parameter_values,
    range_of,
    with_neutral_effects,
    with_values,
)
from flytrack_sysid.inference.torque import torque_notes, unseen_in_log
from flytrack_sysid.log import CHANNELS, FlightLog, usual_step
from flytrack_sysid.log_motion import check_commands, motion_notes, required_motion
from flytrack_sysid.log_voltage import (
    fitted_battery,
    flown_voltages,
    is_within,
    voltage_notes,
    voltages_of,
    with_voltage,
)
from flytrack_sysid.plausibility import check_plausible
from flytrack_sysid.split import HELD_OUT_EVERY, held_out_rows

# Half-widths of 95 % intervals above which there is a warning: relative to a time constant, and to
# full thrust.
UNCERTAIN_TAU, UNCERTAIN_THRUST = 0.2, 0.02
BOX_ACTIONS, BOX_VOLTAGES = 41, 9
NEVER_MOVED = 1e-3  # of a stick's travel from -1 to 1
# correlation of a rate with its lagged command; a minute of noise gives less
MIN_RESPONSE = 0.1
AT_BOUND = 1.01
AT_END = 1e-3  # of the range of an effect's parameter


class Interval(NamedTuple):
    """An estimate and its 95 % interval."""

    value: float
    low: float
    high: float


class MapUncertainty(NamedTuple):
    """The largest uncertainty of the thrust map, and where it is.

    Attributes:
        half_width_n: half-width of the 95 % interval (N).
        share: the same relative to full thrust.
        action: action with this uncertainty.
        battery_v: voltage with this uncertainty (V).
    """

    half_width_n: float
    share: float
    action: float
    battery_v: float


@dataclass(frozen=True)
class Fit:
    """An identified model.

    Attributes:
        model: the model in float32, as the environment takes it.
        estimate: the same in float64, with covariance and residuals of each channel.
        intervals: estimates and intervals by name.
        map_uncertainty: None if the thrust map was not fitted.
        warnings: sentences on what the data do not determine.
        every: which part was held out (``flytrack_sysid.split``), 0 for none.
        source: file of the log.
        sha256: hash of the log's content.
    """

    model: ModelParameters
    estimate: Estimate
    intervals: Mapping[str, Interval]
    map_uncertainty: MapUncertainty | None
    warnings: tuple[str, ...]
    every: int
    source: str
    sha256: str

    def provenance(self) -> dict[str, Any]:
        """Return the origin of the parameters, as JSON values for the model file."""
        names = list(self.intervals)
        deviation = np.sqrt(np.diag(self.estimate.covariance))
        scale = np.outer(deviation, deviation)
        return {
            "tool": f"flytrack_sysid.fit {__version__}",
            "data": {"file": Path(self.source).name, "sha256": self.sha256},
            "split": {
                "held_out_every": self.every,
                "rule": "the last of every so many blocks of at most 5 s",
            },
            "intervals_95": {
                name: {**interval._asdict(), "unit": range_of(name).unit}
                for name, interval in self.intervals.items()
            },
            "correlation": {
                "of": names,
                "matrix": np.round(
                    self.estimate.covariance / np.where(scale > 0.0, scale, 1.0), 4
                ).tolist(),
            },
            "thrust_map_worst": None
            if self.map_uncertainty is None
            else self.map_uncertainty._asdict(),
            "left_rms": {name: rms.tolist() for name, rms in self.estimate.noise.items()},
            "warnings": list(self.warnings),
        }

    def describe(self) -> str:
        """Return the result as a table in text."""
        lines = [f"{'parameter':28} {'estimate':>12} {'95 % interval':>27}  unit"]
        for name, (value, low, high) in self.intervals.items():
            lines.append(
                f"{name:28} {value:12.6g} {low:12.6g} to {high:11.6g}  {range_of(name).unit}"
            )
        if self.map_uncertainty is not None:
            worst = self.map_uncertainty
            lines.append(
                f"thrust map: known to {worst.half_width_n:.3g} N ({worst.share:.2%} of full "
                f"thrust) or better; worst at action {worst.action:.2g}, {worst.battery_v:.3g} V"
            )
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)


def _free_names(
    model: ModelParameters, log: FlightLog, fixed: Mapping[str, float]
) -> tuple[str, ...]:
    """Return the names of lags, thrust map, drain and effects that the log's channels determine."""
    names, unused = names_of(model), fields_of_sticks(model)
    unknown = [name for name in fixed if name not in names]
    if unknown:
        raise FitError(f"fixed: {unknown[0]}: unknown; expected of {', '.join(names)}")
    for name, value in fixed.items():
        if name in unused or (name in TAUS and name not in base_of(model)):
            responds = next(
                effect.name for effect in map(effect_of, model.effects) if "respond" in effect.hooks
            )
            raise FitError(
                f"fixed: {name}: found {value:g}, expected none: it does nothing in a model with "
                f"the effect {responds}"
            )
        low, high, unit = range_of(name)
        if not (np.isfinite(value) and low <= value <= high):
            raise FitError(f"fixed: {name}: found {value}, expected {low:g} to {high:g} {unit}")
    of_effects = [
        name for name in names if "." in name and not BY_NAME[name.split(".")[0]].search.is_setting
    ]
    unused |= {*unseen_in_log(log, model)}
    candidates = [name for name in (*base_of(model), *of_effects) if name not in unused]
    if "v_bat" not in log:
        candidates = [name for name in candidates if name not in (*THRUST_COEFFS[4:], DRAIN)]
    return tuple(name for name in candidates if name not in fixed)


def _intervals(result: Estimate) -> dict[str, Interval]:
    values, intervals = parameter_values(result.model), {}
    for name, deviation in zip(result.free, np.sqrt(np.diag(result.covariance)), strict=True):
        value, half = values[name], float(TWO_SIDED_95 * deviation)
        if name in TAUS:  # symmetric in the logarithm, so that no time is negative
            factor = np.exp(min(half / value, np.log(TAU_RANGE.high / TAU_RANGE.low)))
            intervals[name] = Interval(value, float(value / factor), float(value * factor))
        else:
            intervals[name] = Interval(value, value - half, value + half)
    return intervals


def _map_uncertainty(result: Estimate, log: FlightLog) -> MapUncertainty | None:
    """Return the largest uncertainty over all actions and voltages.

    Voltages are those of the battery, or those of the log if it was flown outside of them.
    """
    indices = [index for index, name in enumerate(result.free) if name in THRUST_COEFFS]
    if not indices:
        return None
    low, high = flown_voltages(log)
    if is_within((low, high), result.model.battery):
        low, high = voltages_of(result.model.battery)
    action, battery_v = np.meshgrid(
        np.linspace(-1, 1, BOX_ACTIONS), np.linspace(low, high, BOX_VOLTAGES)
    )
    units: Any = np.eye(len(THRUST_COEFFS))
    coeffs: Any = np.asarray(result.model.thrust_coeffs)
    terms = np.stack(
        [np.asarray(collective_thrust(action, battery_v, unit)) for unit in units], axis=-1
    )
    terms = terms[..., [THRUST_COEFFS.index(result.free[index]) for index in indices]]
    covariance = result.covariance[np.ix_(indices, indices)]
    half = TWO_SIDED_95 * np.sqrt(np.einsum("...i,ij,...j->...", terms, covariance, terms))
    full = np.abs(collective_thrust(action, battery_v, coeffs)).max()
    worst = np.unravel_index(np.argmax(half), half.shape)
    width = float(half[worst])
    return MapUncertainty(width, width / float(full), float(action[worst]), float(battery_v[worst]))


def _warnings(
    intervals: Mapping[str, Interval], uncertainty: MapUncertainty | None, log: FlightLog
) -> list[str]:
    """Return sentences on what the data do not determine."""
    warnings = []
    for name, (value, low, high) in intervals.items():
        if name in TAUS and 0.5 * (high - low) > UNCERTAIN_TAU * value:
            warnings.append(f"{name} is not determined by the data: {low:.3g} to {high:.3g} s")
        elif "." in name and low <= (neutral := neutral_value(name)) <= high:
            warnings.append(
                f"{name} cannot be told from {neutral:g}: {low:.3g} to {high:.3g} "
                f"{range_of(name).unit}"
            )
    if uncertainty is not None and uncertainty.share > UNCERTAIN_THRUST:
        half_width_n, share, action, battery_v = uncertainty
        thrust = log.throttle
        volts = (
            f" at {log['v_bat'].min():.4g} to {log['v_bat'].max():.4g} V" if "v_bat" in log else ""
        )
        warnings.append(
            f"the thrust map is not determined by the data everywhere: +-{half_width_n:.3g} N "
            f"({share:.0%} of full thrust) at action {action:.2g}, {battery_v:.4g} V; the log "
            f"commands {thrust.min():.2g} to {thrust.max():.2g}{volts}"
        )
    if "v_bat" not in log:
        warnings.append(
            "v_bat is absent: how thrust depends on the voltage, and the drain, are taken as they "
            "were"
        )
    return warnings


def what_is_fitted(
    log: FlightLog,
    start: ModelParameters | None = None,
    fixed: Mapping[str, float] | None = None,
    effects: Iterable[str] = (),
    every: int = HELD_OUT_EVERY,
    motion: Motion | None = None,
    accept: bool = False,
) -> tuple[ModelParameters, tuple[str, ...], np.ndarray]:
    """Return the model a fit starts from, the names that it estimates and the rows that it uses.

    Arguments and exceptions are those of ``fit``, which calls this first.
    """
    fixed, effects = dict(fixed or {}), tuple(effects)
    try:
        model = with_neutral_effects(nominal_parameters() if start is None else start, effects)
    except KeyError as error:
        raise FitError(f"effects: {error.args[0]}: no effect of that name") from error
    for name in (name for name in effects if BY_NAME[name].search.is_setting):
        raise FitError(
            f"effects: {name}: known from settings and not fitted; start from a model that has it"
        )
    for name in effects:
        if fields_of_sticks(model).issuperset(f"{name}.{field}" for field in BY_NAME[name].ranges):
            raise FitError(
                f"effects: {name}: acts on sticks, and the model's commands are those of motors"
            )
    check_plausible(log, accept, start)
    check_commands(log, model)
    free = _free_names(model, log, fixed)
    model = with_values(model, fixed)
    model = model._replace(motion=required_motion(log, motion) or model.motion)
    scored_rows = ~held_out_rows(log, every)
    _check_data(log, scored_rows, free)
    _check_response(log, model)
    return model, free, scored_rows


def fit(
    log: FlightLog,
    start: ModelParameters | None = None,
    fixed: Mapping[str, float] | None = None,
    effects: Iterable[str] = (),
    every: int = HELD_OUT_EVERY,
    report: Report = lambda done, rounds: None,
    motion: Motion | None = None,
    accept: bool = False,
) -> Fit:
    """Identify lags, thrust map and battery drain from a log.

    Mass, gravity and full-stick rates are given.

    Args:
        log: the flight log.
        start: initial values, also of parameters that are not estimated; nominal if None.
        fixed: values of parameters that are not estimated, by name (``tau_yaw``, ``c4``,
            ``linear_drag.d_x``, ...).
        effects: names of effects whose parameters are estimated too.
        every: which rows are held out (``flytrack_sysid.split``), 0 for none.
        report: called with the number of finished rounds and of all rounds.
        motion: motion of the drone within a step. If None, it is continuous for a measured log, and
            that of ``start`` otherwise.
        accept: fit the log although its channels contradict each other (``flytrack_sysid.check``).

    Raises:
        LogError: the log is implausible.
        FitError: channels or motion are missing, or the fit diverged.
    """
    model, free, scored_rows = what_is_fitted(log, start, fixed, effects, every, motion, accept)
    notes = motion_notes(log, start, motion, f"replayed as {model.motion.value}")
    given = model.battery
    notes += torque_notes(log, model) + voltage_notes(log, given)
    log = with_voltage(log, model)
    try:
        result = estimate(log, scored_rows, model, free, report)
    except FitError as error:
        raise FitError(f"{log.source}: {error}") from error
    _check_result(result, log, scored_rows)
    intervals = _intervals(result)
    uncertainty = _map_uncertainty(result, log)
    battery = given
    if any(name in THRUST_COEFFS for name in free):
        battery = fitted_battery(log, given)
    if (battery.empty_v, battery.full_v) != (given.empty_v, given.full_v):
        notes.append(f"the model's battery is that of the log: {battery.describe()}")
    return Fit(
        model=as_float32(result.model)._replace(battery=battery),
        estimate=result,
        intervals=intervals,
        map_uncertainty=uncertainty,
        warnings=(*notes, *_warnings(intervals, uncertainty, log)),
        every=every,
        source=log.source,
        sha256=log.sha256,
    )


def _check_data(log: FlightLog, scored_rows: np.ndarray, free: tuple[str, ...]) -> None:
    """Raise FitError if the log lacks channels or motion to estimate the free parameters."""
    if not free:
        raise FitError("fixed: found every parameter, expected one to estimate at least")
    has_turns = "w" in log or "q" in log
    if not has_turns and any(name in free for name in TAUS[:3]):
        raise FitError(
            f"{log.source}: w and q are absent; the lags of the body rates need one of them"
        )
    has_forces = "f" in log or ("q" in log and any(name in log for name in ("a", "v", "p")))
    if not has_forces and any(name in free for name in (TAUS[3], *THRUST_COEFFS)):
        raise FitError(
            f"{log.source}: thrust needs f, or q with one of a, v and p; found "
            f"{', '.join(log.channels)}"
        )
    for axis, (column, tau) in enumerate(zip(CHANNELS["u"], TAUS, strict=True)):
        stick = log["u"][scored_rows, axis]
        if tau in free and np.ptp(stick) < NEVER_MOVED:
            raise FitError(
                f"{log.source}: {column}: stuck at {stick[0]:.4g}; {tau} cannot be identified: "
                f"move it, or fix {tau} (--fix {tau}=VALUE)"
            )


def _check_response(log: FlightLog, start: ModelParameters) -> None:
    """Raise FitError if no body rate follows its command.

    Possible reasons: motors that are off, a drone on the ground, rates of another log.
    """
    if "w" not in log or log.has_motors:
        return
    correlations = []
    for axis, decay in enumerate(np.exp(-usual_step(log)[0] / np.asarray(start.tau, float)[:3])):
        expected = signal.lfilter([1.0 - decay], [1.0, -decay], log["u"][:, axis])
        if np.ptp(expected) > NEVER_MOVED and np.ptp(log["w"][:, axis]) > 0.0:
            correlations.append(abs(np.corrcoef(expected, log["w"][:, axis])[0, 1]))
    if correlations and max(correlations) < MIN_RESPONSE:
        raise FitError(
            f"{log.source}: w: found no body rate that follows its command (correlation at most "
            f"{max(correlations):.2g}), expected a drone in flight; is it motionless?"
        )


def _likely_cause(log: FlightLog, tau: str) -> str:
    """Return questions on possible reasons why the fit of a lag ends at a bound."""
    column = CHANNELS["u"][TAUS.index(tau)]
    if tau != TAUS[3]:
        return f"do sign and order of {column} and of the rates agree, and is full stick right?"
    frames = "f" if "f" in log else "attitude or velocity"
    ground = "is it on the ground in a part of the log"
    return f"{ground}, is {frames} in another frame, or does {column} not drive it?"


def _check_result(result: Estimate, log: FlightLog, scored_rows: np.ndarray) -> None:
    """Raise FitError if the best model is not plausible for a drone."""
    values = parameter_values(result.model)
    for name in TAUS:
        if (
            name in result.free
            and not TAU_RANGE.low * AT_BOUND < values[name] < TAU_RANGE.high / AT_BOUND
        ):
            raise FitError(
                f"{log.source}: {name}: the fit ended at {values[name]:.3g} s, expected "
                f"{TAU_RANGE.low} to {TAU_RANGE.high} s; {_likely_cause(log, name)}; --fix "
                f"{name}=VALUE holds it"
            )
    for name in (name for name in result.free if "." in name):
        low, high, unit = range_of(name)
        ends = [end for end in (low, high) if end != neutral_value(name)]
        if np.isclose(values[name], ends, rtol=0.0, atol=AT_END * (high - low)).any():
            raise FitError(
                f"{log.source}: {name}: the fit ended at {values[name]:.3g} {unit}, expected it "
                f"within {low:g} to {high:g}"
            )
    if "w" in result.noise:
        for axis, column in enumerate(CHANNELS["w"]):
            rms, measured = (
                result.noise["w"][axis],
                np.sqrt(np.mean(np.square(log["w"][scored_rows, axis]))),
            )
            if TAUS[axis] in result.free and rms > AT_BOUND * measured:
                raise FitError(
                    f"{log.source}: {column}: the model leaves more ({rms:.3g} rad/s rms) than "
                    f"was measured ({measured:.3g}); do sign and order of {CHANNELS['u'][axis]} "
                    f"and {column} agree?"
                )
