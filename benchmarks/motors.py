"""Diagnoses from motors, of rigid bodies that share no code with the model: see docs/motors.md.

``python -m benchmarks.motors --count 20`` flies crafts of ``benchmarks.motor_craft`` with one thing
wrong each, or nothing, diagnoses each from its nominal model, and appends a line per craft to
docs/results/motors.jsonl; a later run of the same commit resumes there. It ends with a table of the
last commit's lines.
"""

import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import report
from benchmarks.motor_craft import Crafts, Flight, Pilot, fly
from flytrack_env import Motion, nominal_parameters
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import Motors
from flytrack_sysid import diagnose
from flytrack_sysid.log import FlightLog

LINES = report.RESULTS / "motors.jsonl"
DURATION_S, DT = 60.0, 0.01
VOLTS = (23.0, 25.0)  # stated; thrust does not depend on it here
# Standard deviations of the sensors: attitude rad, position m, velocity m/s, gyro rad/s,
# accelerometer m/s^2.
NOISE = {"q": 0.002, "p": 0.002, "v": 0.02, "w": 0.02, "f": 0.2}
REACH = 6.0  # m/s^2, of the pilot


def log_of_flight(flight: Flight, index: int, rng: np.random.Generator, noise: float) -> FlightLog:
    """Return the log of one craft of a flight, with noise as a share of common sensors'."""
    states, num_rows = flight.states, len(flight.commands)

    def noisy(name: str, values: np.ndarray) -> np.ndarray:
        return values + noise * NOISE[name] * rng.normal(size=values.shape)

    attitude = Rotation.from_matrix(states.turn[:, index])
    attitude = attitude * Rotation.from_rotvec(noisy("q", np.zeros((num_rows, 3))))
    channels = {
        "u": 2.0 * flight.commands[:, index] - 1.0,
        "p": noisy("p", states.pos[:, index]),
        "v": noisy("v", states.vel[:, index]),
        "q": attitude.as_quat(scalar_first=True),
        "w": noisy("w", states.rates[:, index]),
        "f": noisy("f", flight.force[:, index]),
    }
    return FlightLog(
        time=np.arange(num_rows) * DT,
        channels=channels,
        segment=np.zeros(num_rows, int),
        source="craft",
        origin="measured",
        stated_voltage_v=VOLTS,
        has_motors=True,
    )


def draw(rng: np.random.Generator) -> Crafts:
    """Return a craft of 0.1 to 1.5 kg, drawn around a frame that scales with its mass."""
    mass = float(np.exp(rng.uniform(np.log(0.1), np.log(1.5))))
    arm = 0.09 * (mass / 0.6) ** (1.0 / 3.0)
    front, rear = arm * rng.uniform(0.85, 1.15, (2, 2))
    places = np.array(
        [[-rear[0], -rear[1], 0.0], [front[0], -front[1], 0.0], [-rear[0], rear[1], 0.0],
         [front[0], front[1], 0.0]]
    )  # fmt: skip
    radii = arm * np.array([0.62, 0.68, 0.95]) * rng.uniform(0.85, 1.15, 3)
    full = mass * 9.80665 * rng.uniform(2.5, 4.5) / 4.0
    up_s = rng.uniform(0.015, 0.045)
    one: dict[str, Any] = {
        "mass": mass,
        "inertia": np.diag(mass * radii**2),
        "places": places,
        "thrust": np.full(4, full),
        "linear": rng.uniform(0.05, 0.35),
        "yaw_arm": arm * rng.uniform(0.1, 0.2),
        "up_s": up_s,
        "down_s": up_s * rng.uniform(1.1, 1.6),
    }
    return Crafts(**{name: np.asarray(value, float)[None] for name, value in one.items()})


def nominal_model(craft: Crafts) -> ModelParameters:
    """Return the model of a craft before anything is wrong with it."""
    mass, places, linear = craft.mass[0], craft.places[0], craft.linear[0]
    radii = np.sqrt(np.diag(craft.inertia[0]) / mass)
    total = craft.thrust[0].sum()
    square, slope = 0.25 * total * (1.0 - linear), 0.5 * total * linear
    motors = Motors(
        front_x=places[1, 0],
        front_y=-places[1, 1],
        rear_x=-places[0, 0],
        rear_y=-places[0, 1],
        radius_x=radii[0],
        radius_y=radii[1],
        radius_z=radii[2],
        yaw_arm=craft.yaw_arm[0],
        rotor_momentum=craft.momentum[0] / mass,
        up_s=craft.up_s[0],
        down_s=craft.down_s[0],
    )
    coeffs = np.array([slope + square, slope + 2.0 * square, square, 0.0, 0.0, 0.0])
    model = nominal_parameters()._replace(
        m=mass, thrust_coeffs=coeffs, motion=Motion.CONTINUOUS, battery_drain_v_per_min=0.0
    )
    return model.with_effects(motors)


def _scaled(name: str, factor: Any) -> Callable[[Crafts], Crafts]:
    return lambda craft: craft._replace(**{name: getattr(craft, name) * factor})


def _moved(craft: Crafts) -> Crafts:
    return craft._replace(places=craft.places - np.array([0.005, 0.0, 0.0]))


def _slower(craft: Crafts) -> Crafts:
    return craft._replace(up_s=1.2 * craft.up_s, down_s=1.2 * craft.down_s)


def _draggy(craft: Crafts) -> Crafts:
    return craft._replace(drag=0.25 * craft.mass[:, None] * np.ones((1, 3)))


WEAK = np.array([1.0, 1.0, 0.9, 1.0])
INERTIA = np.diag([1.1, 1.0, 1.0])
# What is wrong: the change of the craft, and the names that a diagnosis may give it. Of the causes
# of the effect motors the name is the parameter.
FAULTS: dict[str, tuple[Callable[[Crafts], Crafts], set[str]]] = {
    "clean": (lambda craft: craft, set()),
    "weak motor": (_scaled("thrust", WEAK), {"rear_left"}),
    "center of mass": (_moved, {"center_of_mass"}),
    "inertia": (_scaled("inertia", INERTIA), {"inertia_x"}),
    "drag": (_draggy, {"linear_drag"}),
    "motor lag": (_slower, {"motor_lag"}),
    "thrust curve": (
        lambda craft: craft._replace(linear=craft.linear + 0.3),
        {"thrust_curve", "thrust_scale"},
    ),
    "mass": (_scaled("mass", 1.1), {"load"}),
}


class Trial(NamedTuple):
    """What is wrong with a craft of a seed."""

    fault: str
    seed: int


@lru_cache(1)
def fly_crafts(seed: int) -> dict[str, tuple[FlightLog, ModelParameters]]:
    """Return by fault the log of a craft, and its model before that; all crafts fly at once."""
    rng = np.random.default_rng(seed)
    drawn = [draw(rng) for _ in FAULTS]
    changed = [change(craft) for craft, (change, _) in zip(drawn, FAULTS.values(), strict=True)]
    together = Crafts(*map(np.concatenate, zip(*changed, strict=True)))
    flight = fly(together, Pilot(rng, len(changed), DURATION_S, REACH), DURATION_S)
    return {
        fault: (log_of_flight(flight, index, rng, 1.0), nominal_model(craft))
        for index, (fault, craft) in enumerate(zip(FAULTS, drawn, strict=True))
    }


def measure(trial: Trial) -> report.Line:
    """Return what a diagnosis names of a craft."""
    flight = fly_crafts(trial.seed)[trial.fault]
    began_s = time.process_time()
    diagnosis = diagnose(*flight)
    named: set[str] = set()
    for cause in diagnosis.causes:
        named |= set(cause.parameters) if cause.effect == "motors" else {cause.effect}
    expected = FAULTS[trial.fault][1]
    return {
        "named": sorted(named),
        "parameters": {
            cause.effect: {
                name: [value.value, *value.ci95] for name, value in cause.parameters.items()
            }
            for cause in diagnosis.causes
        },
        "is_exact": bool(named) and named <= expected if expected else not named,
        "flagged": diagnosis.unexplained.flagged,
        "cpu_s": time.process_time() - began_s,
    }


def summarize(lines: list[report.Line]) -> str:
    """Return a table of how many crafts of each fault were named exactly."""
    rows = []
    for fault in FAULTS:
        of_fault = report.select(lines, fault=fault)
        others = [line for line in of_fault if not line["is_exact"]]
        names = sorted({", ".join(line["named"]) for line in others})
        exact = f"{len(of_fault) - len(others)} of {len(of_fault)}"
        rows.append([fault, exact, "; ".join(names)])
    return report.table("fault | exact | named otherwise", rows)


def main(count: int = 20) -> None:
    """Diagnose ``count`` crafts of each fault; those that this commit has are left out."""
    trials = [Trial(fault, seed) for seed in range(count) for fault in FAULTS]
    report.record_trials(LINES, trials, measure)
    print(summarize(report.good_lines(report.lines_of_commit(LINES))))


if __name__ == "__main__":
    report.command(main)
