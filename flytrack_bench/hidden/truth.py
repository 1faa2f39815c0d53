"""What a hidden drone is: its parameters, and what is hidden in it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from flytrack_bench.hidden.vectors import Number

GRAVITY = 9.80665  # m/s^2
DT_S = 0.01  # between commands
STICKS = ("roll", "pitch", "yaw")  # those of body rates
MOTIONS = ("handout", "semi_implicit", "fine")


@dataclass(frozen=True)
class Outside:
    """An effect outside the package's list.

    Attributes:
        kind: of ``flytrack_bench.hidden.laws``.
        channel: what it changes, of ``laws.SCALES``.
        amplitude: its largest size in that unit.
        shape: parameters of the kind.
    """

    kind: str
    channel: str
    amplitude: float
    shape: Mapping[str, float]


@dataclass(frozen=True)
class Gust:
    """Gusts as a first-order random process per world axis, felt by the accelerometer.

    Attributes:
        std: m/s^2, specific force.
        time_constant: s.
        rate_std: rad/s, the same of body rates; 0 for none.
    """

    std: float
    time_constant: float
    rate_std: float = 0.0


@dataclass(frozen=True)
class Truth:
    """A plant; the handout's if it has no effects.

    Attributes:
        tau: s.
        coeffs: N, of 1, u, u^2, u^3, V, u V.
        max_rate: deg/s.
        drain: V/min.
        mass: kg.
        gravity: m/s^2.
        effects: name -> parameter -> value, of ``flytrack_bench.hidden.drone``, SI.
        onset_s: time in the log at which all effects begin; None: before it.
        motion: of ``MOTIONS``, see ``flytrack_bench.hidden.drone``.
        step_s: between rows of the log.
        mocap_late_s: by which position, velocity and attitude are logged late.
    """

    tau: tuple[float, ...]
    coeffs: tuple[float, ...]
    max_rate: tuple[float, ...] = (618.0, 618.0, 120.0)
    drain: float = 1.0
    mass: float = 1.0
    gravity: float = GRAVITY
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    outside: Outside | None = None
    gust: Gust | None = None
    onset_s: float | None = None
    motion: str = "handout"
    step_s: float = DT_S
    mocap_late_s: float = 0.0

    def thrust(self, stick: Number, battery_v: Number) -> Number:
        """Return thrust without effects, N, of an applied thrust stick at a voltage."""
        one, linear, square, cube, volt, both = self.coeffs
        return (
            one
            + stick * (linear + stick * (square + stick * cube))
            + battery_v * (volt + stick * both)
        )

    def text(self) -> str:
        """Return the hidden effects in one line."""
        parts = [f"{name}({_values(values)})" for name, values in self.effects.items()]
        if self.outside is not None:
            out = self.outside
            parts.append(f"outside {out.kind} on {out.channel} x{out.amplitude:.3g}")
        if self.gust is not None:
            parts.append(f"gust({self.gust.std:.3g} m/s^2, {self.gust.time_constant:.3g} s)")
        if self.mocap_late_s:
            parts.append(f"motion capture {1e3 * self.mocap_late_s:.3g} ms late")
        when = "" if self.onset_s is None else f" from {self.onset_s:.1f} s on"
        return (" + ".join(parts) or "no effects") + when


def _values(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items())
