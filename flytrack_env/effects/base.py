"""What an effect is: something that the minimal model leaves out, in one file.

A file of this folder has a ``NamedTuple`` of parameters (numbers in SI units unless its range has
another unit, each with its **neutral** value as default) and one ``Effect`` that defines how they
act. A model carries the parameters of the effects that it has; the simulator folds them, in the
order of ``flytrack_env.effects.EFFECTS``, at the stages of a step, and then of reading the sensors:

=============  =====================  ====================================================  ========
stage          value                  what it is                                            acts on
=============  =====================  ====================================================  ========
command        ``Action``             the command that the rate loop and motors get         command
lag            ``Action``, s          time constants of the first-order lag                 actuator
respond        ``Action``             the applied action, in place of the lagged one        actuator
air            ``Vec3``, m/s, world   velocity of the air                                   force
thrust         scalar, N              collective thrust along body z                        actuator
rates          ``Vec3``, rad/s        body rates of the lagged action                       actuator
force          ``Vec3``, m/s^2, body  specific force beside thrust; starts at 0             force
battery        scalar, V              battery voltage after the step                        battery
gyro           ``Vec3``, rad/s        what the gyro reads of the body rates                 sensor
accelerometer  ``Vec3``, m/s^2, body  what the accelerometer says of the specific force     sensor
pose           ``Pose``, world        position, velocity and attitude as they are reported  sensor
=============  =====================  ====================================================  ========

Readings do not change the flight. ``flytrack_env.dynamics.read_sensors`` and ``sensed`` compute
them after the step, with the memories after it.

A hook takes the effect's parameters, its memory, the value so far and the ``StepContext``, and
returns the value. At neutral parameters it returns the value bit for bit, so that neutral equals
absent.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from flytrack_env.motion import Motion
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import Action, Drone

# The stages in the order in which a step passes them, and where an effect that hooks in there acts.
STAGES = {
    "command": "command",
    "lag": "actuator",
    "respond": "actuator",
    "air": "force",
    "thrust": "actuator",
    "rates": "actuator",
    "force": "force",
    "battery": "battery",
    "gyro": "sensor",
    "accelerometer": "sensor",
    "pose": "sensor",
}

NOT_YET: Any = None  # in place of a value that a later stage of the step computes


class Pose(NamedTuple):
    """Position, m, velocity, m/s, and attitude, body to world."""

    pos_w: Vec3
    vel_w: Vec3
    quat: Quaternion


class StepContext(NamedTuple):
    """What an effect may look at; a field is ``NOT_YET`` before the stage that fills it.

    drone: before the step. command: as given, before any effect. dt: s. motion: of the model.
    acting: the command after the stage command. full_stick_b: body rates of full sticks, rad/s.
    thrust_coeffs: of the model's thrust map. applied: the lagged action after the step.
    body_axes_w: the body's x, y, z axes before the step. air_w: after the stage air, m/s.
    thrust_acc: collective thrust over mass, after the stage thrust, m/s^2. rates_b: after the stage
    rates, rad/s. force_b: specific force of the step, thrust and all else but gravity, in the body
    frame before it, after the stage force, m/s^2. At the stages gyro and pose only dt, applied and
    rates_b are those of the step; drone is the one after it.

    A step of continuous motion folds the stages at several moments; applied, rates_b and force_b
    are those of the moment, and dt is the time since the beginning of the step at the stages rates
    and battery. span: shares of the step between which the command acts; the value of the stage
    command is its mean there. applied_slope: change of the applied action at the moment, 1/s.
    angular_acc_b: rad/s^2, at the end. middle_rates_b, middle_force_b: as rates_b and force_b, in
    the middle of the step. first_input_b, input_b: what the effect is given at the stage rates at
    the beginning of the step, and at its end where it remembers the step, rad/s.
    """

    drone: Drone
    command: Action
    dt: Scalar
    motion: Motion = Motion.HANDOUT
    acting: Action = NOT_YET
    full_stick_b: Vec3 = NOT_YET
    thrust_coeffs: Any = NOT_YET
    applied: Action = NOT_YET
    body_axes_w: tuple[Vec3, Vec3, Vec3] = NOT_YET
    air_w: Vec3 = NOT_YET
    thrust_acc: Scalar = NOT_YET
    rates_b: Vec3 = NOT_YET
    force_b: Vec3 = NOT_YET
    span: tuple[float, float] = (0.0, 1.0)
    applied_slope: Action = NOT_YET
    angular_acc_b: Vec3 = NOT_YET
    middle_rates_b: Vec3 = NOT_YET
    middle_force_b: Vec3 = NOT_YET
    first_input_b: Vec3 = NOT_YET
    input_b: Vec3 = NOT_YET

    def airspeed_b(self) -> Vec3:
        """Return the velocity through the air, body frame, m/s; from the stage thrust on."""
        airspeed_w = self.drone.vel_w - self.air_w
        return Vec3(*(axis.dot(airspeed_w) for axis in self.body_axes_w))


class Range(NamedTuple):
    """Where a parameter may lie, and its unit: a bound for files, fits and randomisation.

    Both signs where the equation allows them, so that a fit can show the opposite of what physics
    expects.
    """

    low: float
    high: float
    unit: str


Hook = Callable[[Any, Any, Any, StepContext], Any]


def on_rate_sticks(curve: Callable[..., Scalar]) -> Hook:
    """Return the hook that applies a curve to each rate stick.

    The effect's parameters are the curve's other arguments, three axes of each.
    """

    def command(parameters: Any, memory: None, sticks: Action, context: StepContext) -> Action:
        thirds = (parameters[start : start + 3] for start in range(0, len(parameters), 3))
        roll, pitch, yaw = map(curve, sticks[:3], *thirds)
        return sticks._replace(roll=roll, pitch=pitch, yaw=yaw)

    return command


def scaled(factors: Any, memory: None, vector: Vec3, context: StepContext) -> Vec3:
    """Return a vector times a factor per axis: the hook of an effect that has these factors."""
    return Vec3(*(factor * part for factor, part in zip(factors, vector, strict=True)))


def shifted(offsets: Any, memory: None, vector: Vec3, context: StepContext) -> Vec3:
    """Return a vector plus an offset per axis: the hook of an effect that has these offsets."""
    return vector + Vec3(*offsets)


@dataclass(frozen=True)
class Memory:
    """What an effect remembers from step to step.

    Attributes: start: (parameters, drone) -> memory at the beginning of an episode. An effect with
            ``max_steps`` also takes the number of steps to remember. remember: (parameters, memory,
            context) -> memory after a step. observe: (parameters, memory, offset_b, dt) -> memory
            corrected by measured body rates, and the part of the offset that it does not explain.
            offset_b: measured minus modelled rates, rad/s. dt: time since the last measurement, s.
    """

    start: Callable[..., Any]
    remember: Callable[[Any, Any, StepContext], Any] | None = None
    observe: Callable[[Any, Any, Vec3, Scalar], tuple[Any, Vec3]] | None = None


@dataclass(frozen=True)
class Search:
    """How identification and diagnosis look for an effect in a log.

    Attributes:
        needs: channels that the log must have: p position, v velocity, q attitude, w gyro,
            f accelerometer, v_bat voltage.
        probes: values of parameters whose slope at neutral is 0 or one-sided; the first values of
            all parameters are tried together, then the second ones.
        groups: parameters that are looked for together; all of them if empty.
        shapes: parameters that change nothing while the others are neutral.
        follows_sticks: a law of the rate sticks without memory, neutral while they are centred.
        is_setting: comes with the settings of a craft, so that a model has it from the start or not
            at all; fits free only the parameters in ``fitted``.
        fitted: parameters that a fit of the craft frees.
    """

    needs: tuple[str, ...] = ()
    probes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    groups: tuple[tuple[str, ...], ...] = ()
    shapes: tuple[str, ...] = ()
    follows_sticks: bool = False
    is_setting: bool = False
    fitted: tuple[str, ...] = ()


@dataclass(frozen=True)
class Effect:
    """One effect: its parameters, how they act, and how a log shows them.

    Attributes:
        name: as in model files.
        parameters: NamedTuple class whose defaults are neutral.
        ranges: bounds of each parameter.
        notable: smallest departure from neutral that shows in a lap or a reading, a judgement.
        equation: LaTeX.
        source: a publication, or the assumption.
        hooks: by stage (``STAGES``). The hook of the stage respond is (parameters, memory, lagged
            action, context) -> applied action and memory at the end of the span.
        memory: None if the effect has none.
        search: how identification looks for it.
        max_steps: of parameters that are delays, the number of time steps that each may last.
        static: the last field, if it is a structure and no number. Such an effect is learnt, not
            looked for.
        written: static field -> its JSON values.
        read: JSON values -> static field; raises ValueError that begins with the field.
    """

    name: str
    parameters: Any
    ranges: Mapping[str, Range]
    notable: Mapping[str, float]
    equation: str
    source: str
    hooks: Mapping[str, Hook]
    memory: Memory | None = None
    search: Search = Search()
    max_steps: Mapping[str, int] = field(default_factory=dict)
    static: str = ""
    written: Callable[[Any], Any] | None = None
    read: Callable[[Any], Any] | None = None

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages at which the effect acts."""
        return tuple(stage for stage in STAGES if stage in self.hooks)

    @property
    def acts_on(self) -> tuple[str, ...]:
        """Where the effect acts: command, actuator, force, battery or sensor."""
        return tuple(dict.fromkeys(STAGES[stage] for stage in self.stages))
