"""The suite of logs: 60 plants drawn by a seed, their flights, and the digests that freeze them.

A plant flies equations of its own (``flytrack_bench.hidden``, NumPy). Its nominal model has the
true base parameters, and lacks what is hidden. Logs are not stored: each is drawn again from the
seed, and its digest shows whether it is the one that the suite froze. All logged numbers are
rounded to the resolution of the sensors, so that the last bits of another machine's mathematical
library do not change a digest, unless a value lies on the edge of two roundings.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flytrack_bench.hidden import Truth
from flytrack_bench.hidden.draws import (
    DRAGS,
    NAMES,
    draw_base,
    draw_effect,
    draw_gust,
    draw_larger_size,
    draw_onset,
    log_uniform,
)
from flytrack_bench.hidden.flights import fly
from flytrack_bench.hidden.noise import measure
from flytrack_bench.hidden.outside import KINDS, draw_outside
from flytrack_bench.hidden.truth import MOTIONS
from flytrack_bench.suite import FOLDER, MAX_BYTES, SuiteError, digest_of, read_suite
from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import read_at_most
from flytrack_env.validation import Fields, Positive, Text
from flytrack_sysid.log import FlightLog

NAME = "misspec-v1"
ROWS = {"clean": 16, "one": 22, "two": 10, "outside": 8, "onset": 4}
NOISES = ("sensors", "heavy", "coloured", "gusts")  # all the same standard deviations
AMPLITUDES = (1.0, 3.0)  # of laws outside the list, times the noise
COMMAND_DIGIT = 1e-6
TRIES = 8  # draws of a plant until one flies within the envelope
LEAD_S, HORIZON_S, EVERY_S = 1.0, 0.5, 0.25  # of flights that are predicted, s


class Drawn(NamedTuple):
    """What the seed draws of a plant before its parameters.

    Attributes:
        number: of the plant, by which its parameters are drawn.
        row: of ``ROWS``.
        noise: of ``NOISES``.
        motion: of ``flytrack_bench.hidden.MOTIONS``.
        names: hidden effects, or the kind of law outside the list; drawn later for "onset".
    """

    number: int
    row: str
    noise: str
    motion: str
    names: tuple[str, ...]


class Flights(NamedTuple):
    """Beginnings of unseen flights, whose ends are to be predicted.

    Attributes:
        step_s: time between rows (s).
        past: channels of a flight log by name, (num_flights, num_past, size), without noise.
        commands: (num_flights, num_past - 1 + num_steps, 4), beginning with the first row of the
            past; each is held from its row to the next.
    """

    step_s: float
    past: dict[str, np.ndarray]
    commands: np.ndarray

    @property
    def num_steps(self) -> int:
        """Steps from the last row of the past to the row that is predicted."""
        return self.commands.shape[1] + 1 - self.past["p"].shape[1]


@dataclass(frozen=True)
class Plant:
    """A plant of the suite, flown.

    Attributes:
        id: of its log.
        drawn: what was drawn first.
        truth: what is hidden.
        clean: the flight as it was, of which no method is told.
        log: the flight that a method is shown.
        model: the nominal model that a method is shown.
        flights: beginnings of unseen flights.
        ends_w: positions at their ends (m), (num_flights, 3).
        is_frozen: whether the log has the digest of the suite.
    """

    id: str
    drawn: Drawn
    truth: Truth
    clean: FlightLog
    log: FlightLog
    model: ModelParameters
    flights: Flights
    ends_w: np.ndarray
    is_frozen: bool


class LogSuite(Fields):
    """A suite of logs, as its file has it.

    Attributes:
        name: of the suite.
        digest: of its file.
        seed: from which plants and flights are drawn.
        seconds: of a log.
        unseen_seconds: of the flight that is predicted.
        sha256: of each log, by its id.
    """

    name: Text
    digest: Text
    seed: int
    seconds: Positive
    unseen_seconds: Positive
    sha256: dict[str, str]

    def chosen(self, ids: tuple[str, ...]) -> tuple[str, ...]:
        """Return ids of logs, all without any; raises SuiteError for an unknown one."""
        for one in ids:
            if one not in self.sha256:
                known = f"some of {min(self.sha256)} to {max(self.sha256)}"
                raise SuiteError(f"tasks: found {one!r}, expected {known}")
        return ids or tuple(self.sha256)

    def plant(self, log_id: str) -> Plant:
        """Draw and fly a plant again."""
        drawn = draw_all(self.seed)[int(log_id)]
        for attempt in range(TRIES):
            rng = np.random.default_rng([self.seed, drawn.number, attempt])
            truth = draw_truth(drawn, self.seconds, rng)
            try:
                clean = fly(truth, self.seconds, rng)
                log = measured(clean, drawn.noise, rng)
                # Gusts cannot be predicted, and what began in flight has begun.
                unseen = fly(replace(truth, gust=None, onset_s=None), self.unseen_seconds, rng)
            except RuntimeError:  # this plant leaves the envelope
                continue
            log = replace(log, source=f"{self.name}/{log_id}")
            flights, ends_w = cut_flights(unseen)
            is_frozen = log.sha256 == self.sha256.get(log_id)
            model = nominal_model(truth)
            return Plant(log_id, drawn, truth, clean, log, model, flights, ends_w, is_frozen)
        raise SuiteError(f"{self.name}: log {log_id}: none of {TRIES} plants can be flown")


@cache
def draw_all(seed: int) -> tuple[Drawn, ...]:
    """Return what is drawn of all plants, in the order of their ids, which tells nothing."""
    rng = np.random.default_rng(seed)
    singles, plants = rng.permutation(NAMES), []
    for row, count in ROWS.items():
        motions = rng.permutation(np.resize(MOTIONS, count))
        noisy = NOISES if row == "clean" else ("sensors",) * 3 + NOISES[1:]
        noises = rng.permutation(np.resize(noisy, count))
        for index in range(count):
            names: Any = {
                "one": singles[index : index + 1],
                "two": rng.choice(NAMES, 2, replace=False),
                "outside": KINDS[index % len(KINDS) :][:1],
            }.get(row, ())
            plants.append((row, str(noises[index]), str(motions[index]), tuple(map(str, names))))
    order = rng.permutation(len(plants))
    return tuple(Drawn(int(number), *plants[number]) for number in order)


def draw_truth(drawn: Drawn, seconds: float, rng: np.random.Generator) -> Truth:
    """Return a plant. Effects have the larger half of sizes, so that a minute shows each."""
    truth = draw_onset(rng, seconds) if drawn.row == "onset" else draw_base(rng)
    if drawn.row == "outside":
        amplitude = log_uniform(*AMPLITUDES, rng)
        truth = replace(truth, outside=draw_outside(rng, drawn.names[0], amplitude))
    elif drawn.names:
        has_drag = any(name in DRAGS for name in drawn.names)
        effects = {
            name: draw_effect(name, rng, draw_larger_size(name, rng), has_drag)
            for name in drawn.names
        }
        truth = replace(truth, effects=effects)
    gust = draw_gust(rng) if drawn.noise == "gusts" else None
    return replace(truth, gust=gust, motion=drawn.motion)


def measured(clean: FlightLog, noise: str, rng: np.random.Generator) -> FlightLog:
    """Return a flight as it is logged, all of its numbers rounded."""
    log = measure(clean, "sensors" if noise == "gusts" else noise, rng)
    commands = COMMAND_DIGIT * np.round(log["u"] / COMMAND_DIGIT)
    return replace(log, channels={**log.channels, "u": commands})


def nominal_model(truth: Truth) -> ModelParameters:
    """Return the model that a plant's team believes in; they do not know how the plant moves."""
    return ModelParameters(
        tau=np.array(truth.tau, np.float32),
        thrust_coeffs=np.array(truth.coeffs, np.float32),
        max_rate=np.array(truth.max_rate, np.float32),
        m=truth.mass,
        g=truth.gravity,
        battery_drain_v_per_min=truth.drain,
    )


def cut_flights(unseen: FlightLog) -> tuple[Flights, np.ndarray]:
    """Return beginnings of flights, one each ``EVERY_S``, and the positions at their ends."""
    step_s = float(np.median(np.diff(unseen.time)))
    lead, steps, every = (round(time_s / step_s) for time_s in (LEAD_S, HORIZON_S, EVERY_S))
    starts = np.arange(lead, len(unseen) - steps, every)
    before = starts[:, None] + np.arange(-lead, 1)
    past = {name: unseen[name][before] for name in ("p", "v", "q", "w", "f", "v_bat")}
    commands = unseen["u"][starts[:, None] + np.arange(-lead, steps)]
    return Flights(step_s, past, commands), unseen["p"][starts + steps]


def is_log_suite(name_or_path: str) -> bool:
    """Return whether a name or a file is that of a suite of logs."""
    path = _path_of(name_or_path)
    return path.exists() and b'"unseen_seconds"' in read_at_most(path, MAX_BYTES)


def load_log_suite(name_or_path: str) -> LogSuite:
    """Return a suite of logs by its name, or that of a ``.json`` file.

    Raises:
        SuiteError: a file that cannot be read, or one that was changed since it was written.
    """
    return read_suite(_path_of(name_or_path), LogSuite)


def _path_of(name_or_path: str) -> Path:
    path = Path(name_or_path)
    return path if path.suffix == ".json" else FOLDER / f"{name_or_path}.json"


def freeze(seed: int, seconds: float, unseen_seconds: float) -> dict[str, Any]:
    """Return a new suite as the JSON values of its file, from flights of all its plants."""
    ids = [f"{number:02}" for number in range(sum(ROWS.values()))]
    suite = LogSuite(NAME, "", seed, seconds, unseen_seconds, {})
    content = {
        "name": NAME,
        "seed": seed,
        "seconds": seconds,
        "unseen_seconds": unseen_seconds,
        "sha256": {log_id: suite.plant(log_id).log.sha256 for log_id in ids},
    }
    return content | {"digest": digest_of(content)}
