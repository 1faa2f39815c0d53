"""The result of a diagnosis, and its JSON."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flytrack_env.dynamics import ModelParameters

SCHEMA = 1
TO_LOG = "log "  # what comes instead of a manoeuvre where a channel is missing
CONSISTENT, CAUSES_FOUND, UNEXPLAINED = "consistent", "causes_found", "unexplained"
# Direct and level channel of each side: rotation, force, battery.
CHANNELS: tuple[tuple[str | None, str], ...] = (
    ("rates", "attitude"),
    ("force", "velocity"),
    (None, "battery"),
)


@dataclass(frozen=True)
class Estimated:
    """A parameter's value, 95 % interval and unit."""

    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Cause:
    """Something that the model has wrong, by name.

    effect: of ``flytrack_env.effects``, or a base parameter (tau_roll ... tau_thrust, thrust_curve,
    thrust_scale, battery_drain). equivalent: names that this log cannot tell from it. channel: rates,
    attitude, force, velocity or battery: where it shows most. parameters: by name. chi2_gain: what it gains
    on the part that was fitted, heldout_gain: on the part held out, of minus twice the log likelihood.
    lambda_: squared size of its signature over the noise, all else that is free taken out. lambda_sep: the
    same with the closest rival taken out too, and closest which that is; base parameters have none.
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


@dataclass(frozen=True)
class Unexplained:
    """What no known cause explains.

    depends_on: position, time, heading, airspeed, attitude, command, "periodic at F Hz", stochastic.
    shares: of each, how many times the sensor noise it is (rms), by "channel: dependence".
    """

    flagged: bool = False
    depends_on: tuple[str, ...] = ()
    shares: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class NotIdentifiable:
    """An effect that this log could not have shown, or not apart from others.

    smallest: of its parameter that is seen worst, what the log would show for sure. confused_with: what
    looks alike in this log. fly: what to fly to settle it, one of ``flytrack_sysid.manoeuvres``.
    """

    effect: str
    smallest: float
    unit: str
    confused_with: tuple[str, ...]
    fly: str


@dataclass(frozen=True)
class Errors:
    """Errors of one model on the held-out part.

    one_step_nrmse: by channel, 1 is as bad as saying the mean. position_m: by seconds of free flight, rms.
    """

    one_step_nrmse: Mapping[str, float]
    position_m: Mapping[str, float]


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a model, according to a log.

    verdict: consistent, causes_found, unexplained, or "causes_found+unexplained". error: by model: nominal,
    refitted_base, extended, noise_floor. nominal, base, extended: the models. source, sha256: of the log.
    noise: by channel and axis, fitted standard deviations of the sensors. voltages: the lowest and the
    highest of the battery that were learnt from, V; None where it was not measured.
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
    seconds: float
    voltages: tuple[float, float] | None = None
    warnings: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the content of diagnosis.json."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "causes": [_cause(cause) for cause in self.causes],
            "unexplained": {
                "flagged": self.unexplained.flagged,
                "depends_on": list(self.unexplained.depends_on),
                "times_sensor_noise": {
                    name: _rounded(share) for name, share in self.unexplained.shares.items()
                },
            },
            "not_identifiable": [
                {
                    "effect": one.effect,
                    "smallest_detectable": {"value": _rounded(one.smallest), "unit": one.unit},
                    "confused_with": list(one.confused_with),
                    "fly": one.fly,
                }
                for one in self.not_identifiable
            ],
            "error": {
                name: {
                    "one_step_nrmse": {key: _rounded(value) for key, value in one.one_step_nrmse.items()},
                    "position_m": {key: _rounded(value) for key, value in one.position_m.items()},
                }
                for name, one in self.error.items()
            },
            "noise": self.noise,
            "data": {"file": self.source, "sha256": self.sha256, "voltages": self.voltages},
            "warnings": list(self.warnings),
        }


def _rounded(value: float) -> float | None:
    """Return six digits; None for what there is no number of."""
    return float(f"{value:.6g}") if np.isfinite(value) else None


def _cause(cause: Cause) -> dict[str, Any]:
    return {
        "effect": cause.effect,
        "equivalent": list(cause.equivalent),
        "channel": cause.channel,
        "parameters": {
            name: {
                "value": _rounded(one.value),
                "ci95": [_rounded(end) for end in one.ci95],
                "unit": one.unit,
            }
            for name, one in cause.parameters.items()
        },
        "chi2_gain": _rounded(cause.chi2_gain),
        "heldout_gain": _rounded(cause.heldout_gain),
        "lambda": _rounded(cause.lambda_),
        "lambda_sep": _rounded(cause.lambda_sep),
        "closest_rival": cause.closest,
    }
