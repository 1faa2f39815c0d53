"""Diagnoses from motors, of rigid bodies that share no code with the model: see docs/motors.md.

``python -m benchmarks.motors --count 20`` flies crafts of ``benchmarks.motor_craft`` with one thing
wrong each, or nothing, diagnoses each from its nominal model, and appends a line per craft to
docs/results/motors.jsonl; lines that are there are not computed again. It ends with a table of all.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks import report
from benchmarks.motor_craft import Crafts, Flight, Pilot, fly
from flytrack_env import Motion, nominal_parameters
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import Motors
from flytrack_sysid import diagnose
from flytrack_sysid.log import FlightLog

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


class Case(NamedTuple):
    """A craft of a seed: what is wrong, its model before that, and its log."""

    fault: str
    model: ModelParameters
    log: FlightLog


def cases(seed: int) -> list[Case]:
    """Return a craft of each fault; all of them fly at once."""
    rng = np.random.default_rng(seed)
    drawn = [draw(rng) for _ in FAULTS]
    changed = [change(craft) for craft, (change, _) in zip(drawn, FAULTS.values(), strict=True)]
    together = Crafts(*map(np.concatenate, zip(*changed, strict=True)))
    flight = fly(together, Pilot(rng, len(changed), DURATION_S, REACH), DURATION_S)
    return [
        Case(fault, nominal_model(craft), log_of_flight(flight, index, rng, 1.0))
        for index, (fault, craft) in enumerate(zip(FAULTS, drawn, strict=True))
    ]


def examined(case: Case) -> dict[str, Any]:
    """Return what a diagnosis says of a craft."""
    began = time.process_time()
    found = diagnose(case.log, case.model)
    named: set[str] = set()
    for cause in found.causes:
        named |= set(cause.parameters) if cause.effect == "motors" else {cause.effect}
    expected = FAULTS[case.fault][1]
    return {
        "fault": case.fault,
        "named": sorted(named),
        "parameters": {
            cause.effect: {
                name: [value.value, *value.ci95] for name, value in cause.parameters.items()
            }
            for cause in found.causes
        },
        "is_exact": bool(named) and named <= expected if expected else not named,
        "flagged": found.unexplained.flagged,
        "cpu_s": time.process_time() - began,
    }


def table_of(lines: list[dict[str, Any]]) -> str:
    """Return how many crafts of each fault were named exactly."""
    rows = []
    for fault in FAULTS:
        found = [line for line in lines if line["fault"] == fault]
        exact = sum(line["is_exact"] for line in found)
        others = sorted({", ".join(line["named"]) for line in found if not line["is_exact"]})
        rows.append([fault, f"{exact} of {len(found)}", "; ".join(others)])
    return report.table("fault | exact | named otherwise", rows)


def main(count: int = 20, out: Path = Path("docs/results/motors.jsonl")) -> None:
    """Diagnose ``count`` crafts of each fault; those that the file has are left out."""
    commit = report.commit_of_checkout()
    known = {(line["fault"], line["seed"]) for line in report.lines_in(out)}
    for seed in range(count):
        if all((fault, seed) in known for fault in FAULTS):
            continue
        for case in cases(seed):
            if (case.fault, seed) in known:
                continue
            result = {"seed": seed, "commit": commit, **examined(case)}
            report.append_line(out, result)
            print(seed, case.fault, result["named"], f"{result['cpu_s']:.0f} CPU s", flush=True)
    print(table_of(report.lines_in(out)))


if __name__ == "__main__":
    tyro.cli(main)
