"""The pictures of the effects' and the environments' pages, drawn when the site is built."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import flytrack_env
from flytrack_env import ModelParameters, load_track, nominal_parameters
from flytrack_env.dynamics import move, nominal_motor_parameters, read_sensors, sensed
from flytrack_env.effects import Effect, start_memories, takes_motors
from flytrack_env.flown_race import STEP_S
from flytrack_env.motors import NAMES
from flytrack_env.pictures import drawing
from flytrack_env.references import shipped_reference
from flytrack_env.scene import BLUE, GREEN, ORANGE
from flytrack_env.state import unpack, unpack_action

FLIGHT = shipped_reference("flytrack", "standing", "nominal")
NUM_STEPS, NUM_NOTABLE = 150, 3.0  # of the flight; sizes of an effect from which on it matters
PULSE_STEPS, PULSE = (
    25,
    0.8,
)  # the time-optimal throttle is always full, and hides what its changes do
SMALLEST = 0.01  # in a panel's unit: less is none
WIDTHS = (5.0, 3.0, 1.5)  # of lines: where they lie on each other, all are seen
NUM_EPISODES, EPISODE_STEPS = 40, 130
PANELS = (
    "turns, by the gyro (deg/s)",
    "force, by the accelerometer (m/s²)",
    "velocity (m/s)",
    "position (m)",
)


def strong(effect: Effect) -> dict[str, float]:
    """Return ``NUM_NOTABLE`` times what matters of each parameter, within its range."""
    neutral = effect.parameters()._asdict()
    sizes = {name: neutral[name] + NUM_NOTABLE * step for name, step in effect.notable.items()}
    ranges = effect.ranges
    return {
        name: float(np.clip(size, ranges[name].low, ranges[name].high))
        for name, size in sizes.items()
    }


def measured(model: ModelParameters) -> np.ndarray:
    """Return what the model's sensors read on the flight, (NUM_STEPS, 4, 3), as in ``PANELS``."""

    def fly(state, command):  # type: ignore[no-untyped-def]
        moved = move(*state, unpack_action(command), STEP_S, model)
        drone, memories, _ = moved
        reading, seen = read_sensors(moved, model), sensed(drone, memories, STEP_S, model)
        rows = (
            *(jnp.rad2deg(rate) for rate in reading.rates_b),
            *reading.force_b,
            *seen.vel_w,
            *seen.pos_w,
        )
        return (drone, memories), jnp.stack([jnp.asarray(value, jnp.float32) for value in rows])

    drone = jax.tree.map(jnp.float32, unpack(jnp.asarray(FLIGHT.states[0], jnp.float32)))
    start = (drone, start_memories(model.effects, drone))
    commands = np.array(FLIGHT.commands[:NUM_STEPS], np.float32)
    commands[np.arange(NUM_STEPS) // PULSE_STEPS % 2 == 1, 3] -= PULSE
    if takes_motors(model.effects):  # all motors alike
        commands = np.repeat(commands[:, 3:], 4, axis=1)
    rows = jax.jit(lambda commands: jax.lax.scan(fly, start, commands)[1])(commands)
    return np.asarray(rows).reshape(NUM_STEPS, 4, 3)


def nominal(is_of_motors: bool) -> ModelParameters:
    """Return the drone that effects are added to."""
    return nominal_motor_parameters() if is_of_motors else nominal_parameters()


@cache
def without(is_of_motors: bool) -> np.ndarray:
    """Return what the sensors of a nominal drone say: of any effect that is neutral, the same."""
    return measured(nominal(is_of_motors))


def draw_effect(effect: Effect) -> Figure:
    """Return by how much an effect changes what is measured on a flight with given commands."""
    model, changes = nominal(effect.takes_motors), strong(effect)
    title_of_all = f"A flight with {effect.name} minus one without, same commands"
    if effect.takes_motors:  # together they hardly turn the craft
        changes = {NAMES[0]: changes[NAMES[0]]}
        title_of_all = "A flight with a stronger rear right motor minus one without"
    parameters = model.effect(effect.name)._replace(**changes)
    differences = measured(model.with_effects(parameters)) - without(effect.takes_motors)
    figure = drawing.new_figure(8.0, 4.6)
    times_s = STEP_S * np.arange(1, NUM_STEPS + 1)
    for axes, title, values in zip(
        figure.subplots(2, 2, sharex=True).flat, PANELS, differences.swapaxes(0, 1), strict=True
    ):
        most = float(np.abs(values).max())
        if most < SMALLEST:
            title = f"{title}: unchanged"
        drawing.plain(axes).set_title(title, fontsize="medium", loc="left")
        for axis, colour, width, line in zip(
            "xyz", (ORANGE, BLUE, GREEN), WIDTHS, values.T, strict=True
        ):
            axes.plot(times_s, line, color=colour, linewidth=width, label=axis)
        reach = 1.15 * most if most >= SMALLEST else 1.0
        axes.set_ylim(-reach, reach)
    for axes in figure.axes[2:]:
        axes.set_xlabel("time (s)")
    axes_names = figure.axes[0].get_legend_handles_labels()
    figure.legend(*axes_names, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(title_of_all, fontweight="bold")
    return figure


def draw_env(env_id: str) -> Figure:
    """Return many episodes' drones from above, from standing starts and with the same commands."""
    env = flytrack_env.make(env_id)
    params = env.default_params
    params = params.replace(reset=params.reset._replace(course_fraction=0.0))
    commands = jnp.asarray(FLIGHT.commands[:EPISODE_STEPS], jnp.float32)

    def fly(key: jax.Array) -> jax.Array:
        start = env.reset(key, params)[1]

        def step(state, command):  # type: ignore[no-untyped-def]
            after = env.step_env(key, state, command, params)[1]
            return after, jnp.stack(env.drone(after).pos_w)

        return jax.lax.scan(step, start, commands)[1]

    paths = np.asarray(jax.jit(jax.vmap(fly))(jax.random.split(jax.random.key(0), NUM_EPISODES)))
    track, view = load_track("flytrack"), [0, 1]
    figure = drawing.new_figure(8.0, 5.0)
    axes = drawing.plain(figure.subplots())
    for path in paths:
        axes.plot(*path[:, view].T, color=BLUE, linewidth=1.0, alpha=0.6)
        axes.plot(*path[-1, view], "o", color=BLUE, markersize=4)
    drawing.draw_gates(axes, track, view)
    drawing.label_from_above(axes, track)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    seconds = EPISODE_STEPS * STEP_S
    axes.set_title(f"{NUM_EPISODES} episodes of {env_id}, the same commands for {seconds:.1f} s")
    return figure
