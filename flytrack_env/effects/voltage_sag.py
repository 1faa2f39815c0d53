"""Battery voltage that drops under load and comes back: the internal resistance of the cells."""

from typing import NamedTuple

from flytrack_env.effects.base import BatteryContext, Effect, Range, Search
from flytrack_env.quaternion import Scalar


class VoltageSag(NamedTuple):
    """Voltage lost at full thrust, V."""

    at_full_v: Scalar = 0.0


def load_of(thrust_action: Scalar) -> Scalar:
    """Return the load of a thrust action in [-1, 1] as a share of the full load.

    Assumption: the current goes with the square of the stick above idle, as thrust does at first
    order.
    """
    stick = 0.5 * (1.0 + thrust_action)
    return stick * stick


def _battery(sag: VoltageSag, memory: None, battery_v: Scalar, context: BatteryContext) -> Scalar:
    # The state has the voltage under load: only what the load changed in the step counts.
    change = load_of(context.applied.thrust) - load_of(context.first.thrust)
    return battery_v - sag.at_full_v * change


VOLTAGE_SAG = Effect(
    name="voltage_sag",
    parameters=VoltageSag,
    ranges={"at_full_v": Range(-3.0, 6.0, "V")},
    notable={"at_full_v": 0.3},
    equation=r"V = V_\text{open} - \text{at full} \cdot \left( \frac{1 + u}{2} \right)^2",
    source="assumption: a resistance without dynamics, current with the square of the stick",
    hooks={"battery": _battery},
    search=Search(needs=("v_bat",)),
)
