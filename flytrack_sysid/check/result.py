"""The check of a log: what its channels contradict, and how they were logged instead."""

from dataclasses import dataclass, replace
from itertools import islice, product

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters
from flytrack_env.thrust import hover_action
from flytrack_sysid.check.battery import battery_changes, compare_battery
from flytrack_sysid.check.commands import (
    after_rate_curve,
    curve_changes,
    mean_delay,
    responses,
    thinned,
)
from flytrack_sysid.check.explain import Change, Explanation, explain
from flytrack_sysid.check.frames import FRAMES, IDENTITY, READINGS
from flytrack_sysid.check.motion import MARGIN, RATE_FLOOR, compare
from flytrack_sysid.check.pairs import CONTRADICTS, STILL, Pair, compare_pairs
from flytrack_sysid.check.samples import describe_stuck, sample_changes
from flytrack_sysid.check.scales import scale_changes
from flytrack_sysid.check.thrust import hover_command, motor_changes, thrust_changes
from flytrack_sysid.check.timing import late_sensors
from flytrack_sysid.kinematics import GRAVITY, continuous, read_at, summed_turns
from flytrack_sysid.log import FlightLog

MAX_ALTERNATIVES = 8
# The pairs of a log, the frames that explain them, and the scales with these frames.
Framed = tuple[tuple[Pair, ...], list[Explanation], list[tuple[Change, ...]]]
ALIKE = 0.8  # of the log-likelihood of another reading
# Rates that come before their command by more than this were not caused by it: it was logged late.
LATE_S = 0.018  # beyond a model's lag; the lag of a craft is known to some 15 ms
# Rates that follow later: with a model, beyond its lag (a dead time below is a matter for the
# diagnosis); without, beyond what radios, filters and motors take (measured flights: 90 ms).
LATER_S, LATEST_S = 0.05, 0.15
PAIRS_OF = {  # that compare the size of a channel
    "w": ("q and w",),
    "f": ("v, f and q",),
    "v": ("v, f and q", "p and v"),
    "p": ("p and v",),
    "v_bat": ("v_bat and t",),
}
STICKS = ("roll", "pitch", "yaw")
MAX_HOVER_ERROR = 0.15  # thrust command: voltage and drag move it by less
CLEAR, MAX_RATE_ERROR = 0.995, 0.1  # correlation, and relative error, of a full-stick rate


@dataclass(frozen=True)
class Check:
    """The check of a log.

    Attributes:
        source: the log.
        pairs: of channels that were compared.
        explanations: alternatives by which all pairs would agree, simplest first; each lists the
            changes of the log. Empty if nothing contradicts; one empty explanation if something
            does that no known change explains.
        corrected: the log by the first explanation's axes, scales and clocks, its rate sticks after
            the model's rate curve.
        after: the pairs of the corrected log; empty if nothing contradicts.
        remarks: on columns that never change, and constants of the model that the log contradicts.
    """

    source: str
    pairs: tuple[Pair, ...]
    explanations: tuple[tuple[Change, ...], ...]
    corrected: FlightLog
    after: tuple[Pair, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def contradicts(self) -> bool:
        """Whether something in the log contradicts something else."""
        return bool(self.explanations)


def corrected(log: FlightLog, found: Explanation) -> FlightLog:
    """Return a log with the axes that an explanation says it should have."""
    channels = dict(log.channels)
    if "q" in log:
        quat = READINGS[found.reading].correct(log["q"])
        world = Rotation.from_matrix(FRAMES[found.world].T)
        body = Rotation.from_matrix(FRAMES[found.body])
        attitude = world * Rotation.from_quat(quat, scalar_first=True) * body
        channels["q"] = continuous(attitude.as_quat(scalar_first=True))
    for name, frame in found.frames.items():
        if name == "u_rates":
            rates = log["u"][:, :3] @ FRAMES[frame]
            channels["u"] = np.column_stack([rates, log["u"][:, 3]])
        elif name in log:
            channels[name] = log[name] @ FRAMES[frame]
    return replace(log, channels=channels)


def rescaled(log: FlightLog, changes: tuple[Change, ...]) -> FlightLog:
    """Return a log with the scales that changes say it should have."""
    channels = dict(log.channels)
    for channel, _, factor in changes:
        name, _, axis = channel.partition("_")
        if channel == "v_bat":
            name, axis = channel, ""
        scale = np.ones(channels[name].shape[1])
        scale["xyz".index(axis) if axis else slice(None)] = float(factor)
        channels[name] = channels[name] / scale
    return replace(log, channels=channels)


def command_changes(log: FlightLog, model: ModelParameters | None) -> list[tuple[Change, ...]]:
    """Return what differs in the rate commands, as alternatives; [()] if nothing does.

    Args:
        log: with right axes and scales.
        model: whose lags and full-stick rates are expected; None if they are unknown.
    """
    if "w" not in log or not np.ptp(log["u"][:, :3], axis=0).any():
        return [()]
    log = thinned(log)
    found = responses(log)
    curves = curve_changes(log, found)
    if curves:  # what the rates follow, and so how late they are, is not known then
        return [(curve,) for curve in curves]
    expected = np.zeros(3) if model is None else np.asarray(model.tau, float)[:3]
    delay_s = mean_delay(log, found, expected)
    if -LATE_S <= delay_s <= (LATEST_S if model is None else LATER_S):
        return [()]
    half = np.arange(len(log)) < len(log) // 2
    halves = [log.select(half), log.select(~half)]
    by_half = [mean_delay(part, responses(part), expected) for part in halves]
    # A late command is as late in both halves.
    is_late = all(abs(one - delay_s) < max(LATE_S, 0.3 * abs(delay_s)) for one in by_half)
    return [(Change("u", "delay", -delay_s),) if is_late else ()]


def check_log(
    log: FlightLog, model: ModelParameters | None = None, motors: np.ndarray | None = None
) -> Check:
    """Return whether the channels of a log agree, and the conventions under which they would.

    Args:
        log: a flight.
        model: whose rate curve and lags are expected between commands and rates; None if they are
            unknown.
        motors: outputs of four motors in Betaflight's order, (num_rows, 4); by default the
            commands of a log that has those of motors.
    """
    if log.has_motors:
        motors = 0.5 * (log["u"] + 1.0) if motors is None else motors
        found = check_log(with_throttle_alone(log), model, motors)
        pairs, after = (
            tuple(pair for pair in part if pair.name != "u and w")  # there are no sticks
            for part in (found.pairs, found.after)
        )
        return replace(found, pairs=pairs, after=after)
    log = after_rate_curve(log, model)
    samples = sample_changes(log)
    held = {change.channel for change in samples if change.kind == "held"}
    # Rates about the world's axes also look like an inverted attitude: the simpler one counts.
    readings = [((), log), *with_body_rates(log)]
    framed = [(turned, one, *explain_frames(one)) for turned, one in readings]
    explained = [one for one in framed if one[3]]
    battery = compare_battery(log)
    pairs = (*framed[0][2], *battery)
    if not explained:
        return Check(log.source, pairs, ((),), log)
    turned, right, compared, frames, scales = min(
        explained, key=lambda one: len(one[0]) + len(one[3][0].changes())
    )
    right = rescaled(corrected(right, frames[0]), scales[0])
    late = late_sensors(right.without(*held))
    right = on_time(right, late)
    others = [*turned, *samples, *late, *thrust_changes(right)]
    others += [Change("v_bat", "axes", "-") for pair in battery if pair.verdict == CONTRADICTS]
    parts = product(
        [one.changes() for one in frames],
        scales,
        battery_changes(log),
        [()] if "w" in held else command_changes(right, model),
        [()] if motors is None else motor_changes(right, motors),
    )
    explanations = [
        (*(change for part in one for change in part), *others)
        for one in islice(parts, MAX_ALTERNATIVES)
    ]
    contradicted = any(pair.verdict == CONTRADICTS for pair in (*compared, *battery))
    remarks = describe_stuck(log)
    remarks += () if model is None else constants_that_differ(right, model)
    if not any(explanations) and not contradicted:
        return Check(log.source, (*compared, *battery), (), right, (), remarks)
    pairs = with_wrong_sizes(pairs, explanations[0])
    after, _ = compare_pairs(right)
    return Check(log.source, pairs, tuple(dict.fromkeys(explanations)), right, after, remarks)


def with_throttle_alone(log: FlightLog) -> FlightLog:
    """Return a log of motors as one of sticks that stay centred and a throttle, their mean."""
    command = np.pad(log.throttle[:, None], ((0, 0), (3, 0)))
    return replace(log, channels={**log.channels, "u": command}, has_motors=False)


def with_wrong_sizes(pairs: tuple[Pair, ...], changes: tuple[Change, ...]) -> tuple[Pair, ...]:
    """Return pairs, of which those with a channel of wrong size contradict."""
    wrong = {
        name
        for change in changes
        if change.kind == "scale"
        for name in PAIRS_OF[change.channel if change.channel == "v_bat" else change.channel[:1]]
    }
    return tuple(
        pair._replace(verdict=CONTRADICTS) if pair.name in wrong and pair.verdict != STILL else pair
        for pair in pairs
    )


def constants_that_differ(log: FlightLog, model: ModelParameters) -> tuple[str, ...]:
    """Return sentences on the constants of a model that a log contradicts.

    Args:
        log: with right axes and scales.
        model: a model of the craft.
    """
    sentences = []
    is_turning = "w" in log and np.ptp(log["u"][:, :3], axis=0).any()
    found_rates = responses(thinned(log)) if is_turning else []
    for name, response, stated in zip(STICKS, found_rates, model.max_rate, strict=False):
        found = float(np.rad2deg(response.full_stick))
        if response.correlation > CLEAR and abs(found / float(stated) - 1.0) > MAX_RATE_ERROR:
            sentences.append(
                f"full stick of {name} gives {found:.0f} deg/s in this log, the model says "
                f"{float(stated):.0f}"
            )
    battery = model.battery
    middle_v = 0.5 * (battery.empty_v + battery.full_v)
    volts = float(np.median(log["v_bat"])) if "v_bat" in log else float(middle_v)
    expected = hover_action(model.thrust_coeffs, float(model.m) * GRAVITY, volts)
    hover = hover_command(log)
    if hover is not None and abs(hover - expected) > MAX_HOVER_ERROR:
        sentences.append(
            f"the hover is at a thrust command of {hover:+.2f} in this log, the model says "
            f"{expected:+.2f} at {volts:.1f} V"
        )
    if "v_bat" in log and not battery.empty_v * 0.9 < volts < battery.full_v * 1.1:
        sentences.append(
            f"the battery has {volts:.1f} V in this log, the model's {battery.empty_v:.1f} to "
            f"{battery.full_v:.1f}"
        )
    return tuple(sentences)


def explain_frames(log: FlightLog) -> Framed:
    """Return the pairs of a log, the frames that explain them, and the scales with these frames.

    Motion that is slower than a sensor's errors shows nothing. This depends on the scales, so pairs
    are compared again where scales are wrong.
    """
    channels = frozenset(log.channels) | {"u_rates"}

    def explained(scaled: FlightLog) -> Framed:
        pairs, edges = compare_pairs(scaled)
        frames = explain(channels, edges)
        return pairs, frames, scale_changes(corrected(log, frames[0])) if frames else [()]

    found = explained(log)
    whole = tuple(change for change in found[2][0] if "_" not in change.channel)
    return explained(rescaled(log, whole)) if whole else found


def with_body_rates(log: FlightLog) -> list[tuple[tuple[Change, ...], FlightLog]]:
    """Return what changed, and the log with body rates, if its rates may be about world axes."""
    if "q" not in log or "w" not in log:
        return []
    nats, readings = [], []
    for reading in READINGS:
        attitude = Rotation.from_quat(reading.correct(log["q"]), scalar_first=True)
        turns, body_rates = summed_turns(attitude), attitude.inv().apply(log["w"])
        as_body = compare(log, turns, log["w"], RATE_FLOOR)
        as_world = compare(log, turns, body_rates, RATE_FLOOR)
        if as_body is None or as_world is None:
            return []
        nats.append(as_body.values.sum(axis=0))
        readings.append((float(as_world.values.sum(axis=0)[IDENTITY]), body_rates))
    after, rates = max(readings, key=lambda one: one[0])
    # An inverted attitude with opposite rates is as likely but for how samples are integrated.
    if after - nats[0][IDENTITY] < MARGIN or after < ALIKE * np.max(nats):
        return []
    changed = replace(log, channels={**log.channels, "w": rates})
    return [((Change("w", "frame", "world"),), changed)]


def on_time(log: FlightLog, late: list[Change]) -> FlightLog:
    """Return a log with late sensors read later."""
    channels = dict(log.channels)
    for channel, _, seconds in late:
        channels[channel] = read_at(log, log[channel], float(seconds))
    return replace(log, channels=channels)
