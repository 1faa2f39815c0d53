"""The fastest lap of a flight beside the time-optimal one as an animated GIF."""

import imageio.v3 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flytrack_env import scene
from flytrack_env.flown_race import STEP_S
from flytrack_env.pictures.drawing import escape
from flytrack_env.pictures.flight import Flight
from flytrack_env.pictures.video import fastest_flying_lap
from flytrack_env.references import Reference
from flytrack_env.state import POSITION
from flytrack_env.tracks import build_course

SIZE_IN, DPI = (6.0, 3.75), 80
STEPS_PER_FRAME = 6
LAST_FRAME_MS = 1500
ELEVATION_DEG, AZIMUTH_DEG, ZOOM = 36.0, 20.0, 1.75


def make_gif(flight: Flight, reference: Reference) -> bytes:
    """Return the animation, 480 x 300 pixels, at the speed at which the laps were flown.

    Raises:
        ValueError: a flight without a complete flying lap.
    """
    lap = fastest_flying_lap(flight)
    if lap is None:
        raise ValueError(f"{flight.name}: found no complete flying lap, expected one to animate")
    start, end = (flight.race.passes[place] for place in lap)
    first = round(start.time_s / STEP_S)  # the state nearest to the crossing
    own = flight.states[first : first + round(end.lap_time_s / STEP_S) + 1]
    figure = Figure(SIZE_IN, DPI, facecolor=_rgb(scene.BACKGROUND))
    axes = figure.add_axes((0.0, 0.0, 1.0, 0.95), projection="3d")
    gates = scene.gates_of(build_course(flight.track))
    for corners in (*gates.outer, *gates.inner):
        axes.plot(*np.concatenate([corners, corners[:1]]).T, color=_rgb(scene.NEXT_GATE), linewidth=1.5)
    flown = []
    for left, label, states, time_s, colour in (
        (0.03, escape(flight.name), own, end.lap_time_s, _rgb(scene.FLIGHT_COLOURS[0])),
        (0.53, "time-optimal", reference.states, reference.time_s, _rgb(scene.FLIGHT_COLOURS[2])),
    ):
        (line,) = axes.plot([], [], [], color=colour, markevery=[-1], marker="o", markersize=7)
        text = figure.text(left, 0.93, "", color=colour, fontsize=11)
        flown.append((line, text, label, states[:, POSITION], time_s))
    low, high = np.array(flight.track.bounds_low), np.array(flight.track.bounds_high)
    turned = AZIMUTH_DEG + (0.0 if high[1] - low[1] > high[0] - low[0] else -90.0)
    every = np.concatenate([gates.outer.reshape(-1, 3), *(points for _, _, _, points, _ in flown)])
    limits = np.stack([every.min(axis=0), every.max(axis=0)], axis=1)
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2], facecolor="none")
    axes.set_box_aspect(np.ptp(every, axis=0), zoom=ZOOM)
    axes.view_init(ELEVATION_DEG, turned)
    axes.set_axis_off()
    for line in axes.lines:
        line.set_clip_on(False)  # the axes are a square in the middle of the picture
    canvas, frames = FigureCanvasAgg(figure), []
    last = max(len(points) for _, _, _, points, _ in flown) - 1
    for row in [*range(0, last, STEPS_PER_FRAME), last]:
        for line, text, label, points, time_s in flown:
            line.set_data_3d(*points[: row + 1].T)
            is_over = row >= len(points) - 1
            text.set_text(f"{label}  {time_s:.3f} s" if is_over else f"{label}  {STEP_S * row:.2f} s")
        canvas.draw()
        frames.append(np.array(canvas.buffer_rgba())[..., :3])
    durations_ms = [round(1e3 * STEP_S * STEPS_PER_FRAME)] * (len(frames) - 1) + [LAST_FRAME_MS]
    return imageio.imwrite("<bytes>", frames, extension=".gif", duration=durations_ms, loop=0)


def _rgb(colour: scene.Colour) -> tuple[float, ...]:
    return tuple(part / 255.0 for part in colour)
