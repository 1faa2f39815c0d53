"""What an effect is: something that the minimal model leaves out, in one file.

A file of this folder has a ``NamedTuple`` of parameters (numbers in SI units unless its range has
another unit, each with its **neutral** value as default) and one ``Effect`` that defines how they
act. A model carries the parameters of the effects that it has; the simulator folds them, in the
order of ``flytrack_env.effects.EFFECTS``, at the stages of a step, and then of reading the sensors:

=============  ====================================  ========  ====================================
stage          value                                 acts on   context: what a hook may look at
=============  ====================================  ========  ====================================
command        ``Action``: what rate loop, motors    command   ``CommandContext``
               get
lag            ``Action``, s: time constants of the  actuator  ``CommandContext``
               first-order lag
respond        ``Action``: the applied action, in    actuator  ``CommandContext``
               place of the lagged one
air            ``Vec3``, m/s, world: velocity of     force     ``Drone`` of the moment
               the air
thrust         scalar, N: collective thrust along    actuator  ``ForceContext``
               body z
rates          ``Vec3``, rad/s: body rates of the    actuator  ``RatesContext``
               lagged action
force          ``Vec3``, m/s^2, body: specific       force     ``ForceContext``
               force beside thrust; starts at 0
battery        scalar, V: voltage after the step     battery   ``BatteryContext``
gyro           ``Vec3``, rad/s: the gyro's reading   sensor    time between readings, s
accelerometer  ``Vec3``, m/s^2, body: the reading    sensor    ``AccelerometerContext``
               of the specific force
pose           ``Pose``, world: position, velocity   sensor    time between readings, s
               and attitude as reported
=============  ====================================  ========  ====================================

A step of continuous motion folds the stages at several moments; the context is that of the moment.
Readings do not change the flight. ``flytrack_env.dynamics.read_sensors`` and ``sensed`` compute
them after the step, with the memories after it.

A hook takes the effect's parameters, its memory, the value so far and the stage's context, and
returns the value. At neutral parameters it returns the value bit for bit, so that neutral equals
absent.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np

from flytrack_env.motion import Motion
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import Action, Drone

Effects = tuple[Any, ...]  # the parameters of a model's effects, in the order of ``EFFECTS``
Memories = tuple[Any, ...]  # what each of these effects remembers, None for most
Rates = tuple[Vec3, ...]  # the stage rates: before each of these effects, and after all of them

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


class Pose(NamedTuple):
    """Position, m, velocity, m/s, and attitude, body to world."""

    pos_w: Vec3
    vel_w: Vec3
    quat: Quaternion

    @staticmethod
    def of(drone: Drone) -> "Pose":
        """Return the pose of a drone."""
        return Pose(drone.pos_w, drone.vel_w, drone.quat)


class CommandContext(NamedTuple):
    """What acts before the lag: a command in a span of the step.

    Attributes:
        drone: at the beginning of the span.
        command: as given; at the stages lag and respond, as it acts.
        dt: length of the step, s.
        span: shares of the step between which the command acts. The value of the stage command is
            its mean there.
        motion: of the model.
        full_stick_b: body rates of full sticks, rad/s.
        thrust_coeffs: of the model's thrust map.
        mass: of the model, kg.
    """

    drone: Drone
    command: Action
    dt: Scalar
    span: tuple[float, float]
    motion: Motion
    full_stick_b: Vec3
    thrust_coeffs: jax.Array | np.ndarray
    mass: Scalar


class ForceContext(NamedTuple):
    """What pushes the drone at a moment.

    Attributes:
        drone: at the moment; its applied action is that before the step.
        applied: the lagged action at the moment.
        body_axes_w: the body's x, y, z axes.
        airspeed_b: velocity through the air, body frame, m/s.
        thrust_acc: collective thrust over mass, m/s^2; at the stage thrust, before its effects.
        thrust_coeffs: of the model's thrust map.
    """

    drone: Drone
    applied: Action
    body_axes_w: tuple[Vec3, Vec3, Vec3]
    airspeed_b: Vec3
    thrust_acc: Scalar
    thrust_coeffs: jax.Array | np.ndarray


class RatesContext(NamedTuple):
    """What turns the drone at a moment.

    Attributes:
        force: what pushes it.
        applied_slope: change of the applied action, 1/s.
        dt: time since the beginning of the step, s.
        motion: of the model.
        first_input_b: what the effect was given at the beginning of the step, rad/s.
    """

    force: ForceContext
    applied_slope: Action
    dt: Scalar
    motion: Motion
    first_input_b: Vec3


class BatteryContext(NamedTuple):
    """The applied action at the beginning of the step, and at the moment."""

    first: Action
    applied: Action


class AccelerometerContext(NamedTuple):
    """The motion that an accelerometer reads after a step, in the body frame.

    Attributes:
        dt: length of the step, s.
        rates_b: at its end; of a simulator that takes each quantity once, the step's mean, rad/s.
        angular_acc_b: at its end, or the step's mean, rad/s^2.
        force_b: specific force: thrust and all else but gravity, m/s^2.
    """

    dt: Scalar
    rates_b: Vec3
    angular_acc_b: Vec3
    force_b: Vec3


class StepContext(NamedTuple):
    """What an effect may remember of a step.

    Attributes:
        drone: before the step.
        command: as given.
        acting: the command after the stage command; of a continuous step, in its second half.
        dt: length of the step, s.
        motion: of the model.
        rates_b: after the step, rad/s.
        force_b: specific force of the step, of a continuous one at its end, body frame, m/s^2.
        middle_b: rates and specific force in the middle of a continuous step.
        rate_inputs_b: what the effect was given at the stage rates, at the beginning and the end.
    """

    drone: Drone
    command: Action
    acting: Action
    dt: Scalar
    motion: Motion
    rates_b: Vec3
    force_b: Vec3
    middle_b: tuple[Vec3, Vec3] | None
    rate_inputs_b: tuple[Vec3, Vec3]


class Range(NamedTuple):
    """Where a parameter may lie, and its unit: a bound for files, fits and randomisation.

    Both signs where the equation allows them, so that a fit can show the opposite of what physics
    expects.
    """

    low: float
    high: float
    unit: str


Hook = Callable[[Any, Any, Any, Any], Any]


def on_rate_sticks(curve: Callable[..., Scalar]) -> Hook:
    """Return the hook that applies a curve to each rate stick.

    The effect's parameters are the curve's other arguments, three axes of each.
    """

    def command(parameters: Any, memory: None, sticks: Action, context: CommandContext) -> Action:
        thirds = (parameters[start : start + 3] for start in range(0, len(parameters), 3))
        roll, pitch, yaw = map(curve, sticks[:3], *thirds)
        return sticks._replace(roll=roll, pitch=pitch, yaw=yaw)

    return command


def scaled(factors: Any, memory: None, vector: Vec3, context: Any) -> Vec3:
    """Return a vector times a factor per axis: the hook of an effect that has these factors."""
    return Vec3(*(factor * part for factor, part in zip(factors, vector, strict=True)))


def shifted(offsets: Any, memory: None, vector: Vec3, context: Any) -> Vec3:
    """Return a vector plus an offset per axis: the hook of an effect that has these offsets."""
    return vector + Vec3(*offsets)


@dataclass(frozen=True)
class Memory:
    """What an effect remembers from step to step.

    Attributes:
        start: (parameters, drone) -> memory at the beginning of an episode. An effect with
            ``max_steps`` also takes the number of steps to remember.
        remember: (parameters, memory, context) -> memory after a step.
        observe: (parameters, memory, offset_b, dt) -> memory corrected by measured body rates, and
            the part of the offset that it does not explain; offset_b is measured minus modelled
            rates, rad/s, and dt the time since the last measurement, s.
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
        base_causes: of those, which a diagnosis names when they differ from the given model's, by
            the name of the cause.
    """

    needs: tuple[str, ...] = ()
    probes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    groups: tuple[tuple[str, ...], ...] = ()
    shapes: tuple[str, ...] = ()
    follows_sticks: bool = False
    is_setting: bool = False
    fitted: tuple[str, ...] = ()
    base_causes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


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
        takes_motors: a model with it is commanded by the outputs of four motors, not by sticks, and
            its rates follow from torques.
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
    takes_motors: bool = False
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
