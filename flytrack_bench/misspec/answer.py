"""What a method says of a log, checked, and as JSON values."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flytrack_bench.hidden.draws import NAMES
from flytrack_bench.misspec.suite import Flights
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME
from flytrack_sysid.inference.free_flight import fly_freely
from flytrack_sysid.inference.parameters import TAUS, with_neutral_effects
from flytrack_sysid.inference.record import fill_gaps
from flytrack_sysid.log import BETWEEN_S, FlightLog

# What can be named: an effect of the package's list, or something of the base.
BASE_NAMES = (*TAUS, "thrust_curve", "thrust_drift", "battery_drain")
KNOWN = frozenset(BY_NAME) | frozenset(BASE_NAMES)
LOG, MODEL, FLIGHTS = "log.npz", "model.json", "flights.npz"  # what a method's process is given
Predict = Callable[[Flights], np.ndarray]


class AnswerError(ValueError):
    """An answer that cannot be scored; the message says what was found and what was expected."""


@dataclass(frozen=True)
class Answer:
    """What a method says of a log.

    Attributes:
        names: of what the model gets wrong, of ``KNOWN``; none where nothing is.
        classes: by name, others that the log cannot tell from it.
        values: by ``effect.parameter``, the value and the ends of its 95 % interval.
        flagged: whether something is wrong that has no name.
        model: predicts unseen flights, if there is no function that does.
        predict: returns positions at the ends of flights (m), (num_flights, 3).
    """

    names: tuple[str, ...] = ()
    classes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    values: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    flagged: bool = False
    model: ModelParameters | None = None
    predict: Predict | None = None

    def as_json(self, flights: Flights) -> dict[str, Any]:
        """Return the answer as JSON values, with its predictions.

        Raises:
            AnswerError: names that nobody knows, or predictions of another shape.
        """
        names = [str(name) for name in self.names]
        classes = {str(name): [*map(str, others)] for name, others in self.classes.items()}
        for name in (*names, *classes, *(other for others in classes.values() for other in others)):
            if name not in KNOWN:
                raise AnswerError(f"names: found {name!r}, expected some of {sorted(KNOWN)}")
        if len(set(names)) < len(names):
            raise AnswerError(f"names: found {names}, expected each once")
        values = {str(name): [*map(float, value)] for name, value in self.values.items()}
        for name, numbers in values.items():
            if len(numbers) != 3:
                raise AnswerError(f"values: {name}: found {numbers}, expected value, low, high")
        return {
            "names": names,
            "classes": classes,
            "values": values,
            "flagged": bool(self.flagged),
            "ends_w": self._ends(flights),
        }

    def _ends(self, flights: Flights) -> list[list[float]] | None:
        if self.predict is None and self.model is None:
            return None
        if self.predict is not None:
            ends_w = np.asarray(self.predict(flights), float)
        else:
            assert self.model is not None
            ends_w = fly_model(self.model, flights)
        expected = (len(flights.commands), 3)
        if ends_w.shape != expected or not np.isfinite(ends_w).all():
            raise AnswerError(
                f"predict: found shape {ends_w.shape}, expected finite numbers of shape {expected}"
            )
        # A tenth of a millimetre is nothing, and keeps the file small.
        return np.round(ends_w, 4).tolist()


def fly_model(model: ModelParameters, flights: Flights) -> np.ndarray:
    """Return positions at the ends of flights that a model flies (m), (num_flights, 3).

    Effects that it lacks are put in at their neutral values, where they do nothing, so that models
    of all answers share a compiled program.
    """
    log, starts = log_of(flights)
    flown = fly_freely(
        with_neutral_effects(model, NAMES), fill_gaps(log), starts, flights.num_steps
    )
    return np.asarray(flown["p"][:, -1])


def log_of(flights: Flights) -> tuple[FlightLog, np.ndarray]:
    """Return flights as a log, a segment each, and the rows at which their ends begin.

    After these rows the log repeats their values: what is to be predicted is not in it.
    """
    count, num_rows = len(flights.commands), flights.commands.shape[1] + 1
    repeated = ((0, 0), (0, flights.num_steps), (0, 0))
    channels = {name: np.pad(past, repeated, mode="edge") for name, past in flights.past.items()}
    channels["u"] = np.pad(flights.commands, ((0, 0), (0, 1), (0, 0)), mode="edge")
    flat = {name: values.reshape(-1, values.shape[-1]) for name, values in channels.items()}
    segment = np.repeat(np.arange(count), num_rows)
    row = np.tile(np.arange(num_rows), count)
    between_s = num_rows * flights.step_s + BETWEEN_S
    log = FlightLog(segment * between_s + row * flights.step_s, flat, segment, origin="simulated")
    return log, np.arange(count) * num_rows + num_rows - 1 - flights.num_steps


def diagnose_log(log: FlightLog, model: ModelParameters) -> Answer:
    """Return what ``flytrack_sysid.diagnose`` says of a log."""
    from flytrack_sysid.diagnosis import diagnose

    found = diagnose(log, model)
    return Answer(
        names=tuple(cause.effect for cause in found.causes),
        classes={cause.effect: cause.equivalent for cause in found.causes if cause.equivalent},
        values={
            f"{cause.effect}.{name}": (value.value, *value.ci95)
            for cause in found.causes
            for name, value in cause.parameters.items()
        },
        flagged=found.unexplained.flagged,
        model=found.extended,
    )
