"""A lap as an MP4, drawn as the Gymnasium environments draw it; and beside the time-optimal one as a GIF."""

import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter

from flytrack_env.files import write_atomically
from flytrack_env.flown_race import STEP_S
from flytrack_env.pictures.flight import Flight
from flytrack_env.references import Reference
from flytrack_env.rendering import FlightLog, make_renderer
from flytrack_env.rendering.animation import Lap
from flytrack_env.rendering.flight_log import LAP_START
from flytrack_env.rendering.views import HEIGHT, WIDTH
from flytrack_env.scene import FLIGHT_COLOURS
from flytrack_env.tracks import build_course

STEPS_PER_FRAME = 2
FRAMES_PER_S = 1.0 / (STEP_S * STEPS_PER_FRAME)
LONGEST_STEPS = 2000  # of a flight without a lap
LEAD_IN_STEPS = 100  # flown before the first frame, for the trail and for the camera, which lags


def fastest_flying_lap(flight: Flight) -> tuple[int, int] | None:
    """Return the pass that begins the fastest flying lap and the one that ends it; None if there is none."""
    ends = [place for place, one in enumerate(flight.race.passes) if one.lap]
    laps = [(flight.race.passes[end].lap_time_s, start, end) for start, end in itertools.pairwise(ends)]
    return min(laps)[1:] if laps else None


def shown_rows(flight: Flight) -> range:
    """Return the rows of the frames: the fastest flying lap, else the first lap, else the flight to 20 s.

    A lap goes from the first state behind the gate that begins it to the first one behind the gate that
    ends it, or the state after that where the number of steps is odd.
    """
    passes = flight.race.passes
    lap, first = fastest_flying_lap(flight), next((one for one in passes if one.lap), None)
    start, end = 0, min(len(flight.states) - 1, LONGEST_STEPS)
    if lap is not None:
        start, end = passes[lap[0]].row, passes[lap[1]].row
    elif first is not None:
        end = first.row
    odd = (end - start) % STEPS_PER_FRAME
    return range(start, min(end + odd, len(flight.states) - 1) + 1, STEPS_PER_FRAME)


def scene_rows(flight: Flight) -> np.ndarray:
    """Return what the renderer draws, a row of ``flytrack_env.rendering.flight_log`` per state, float32."""
    race = flight.race
    numbers = np.stack([race.gate, race.laps, race.lap_start_s, race.lap_time_s], axis=1)
    return np.concatenate([flight.states, numbers], axis=1).astype(np.float32)


def write_video(flight: Flight, path: Path) -> None:
    """Write the MP4, atomically; raises OSError if it cannot be written."""
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / path.name
        _encode(flight, shown_rows(flight), temporary)
        write_atomically(path, temporary.read_bytes())


def _frames(flight: Flight, rows: range) -> Iterator[np.ndarray]:
    """Yield the pictures of these rows."""
    begin = max(rows.start - LEAD_IN_STEPS, 0)
    scenes = scene_rows(flight)[begin : rows[-1] + 1]
    scenes[:, LAP_START] -= STEP_S * begin  # the log's time begins with its first row
    renderer, log = make_renderer(build_course(flight.track)), FlightLog(STEP_S)
    for row, scene in enumerate(scenes, start=begin):
        log.append(scene)
        if row in rows:
            yield renderer.draw(log)


def _encode(flight: Flight, rows: range, path: Path) -> None:
    """Draw and encode the frames of these rows, and count them: moviepy misses failures at the end."""
    fast_start = ["-movflags", "+faststart"]
    with FFMPEG_VideoWriter(str(path), (WIDTH, HEIGHT), FRAMES_PER_S, ffmpeg_params=fast_start) as writer:
        for frame in _frames(flight, rows):
            writer.write_frame(frame)
    try:
        found, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError as error:
        raise OSError(f"{path}: found a video that cannot be read back, expected an MP4: {error}") from error
    if found != len(rows):
        raise OSError(f"{path}: found {found} frames in the video, expected {len(rows)}")


def laps_to_compare(flight: Flight, reference: Reference) -> tuple[Lap, Lap]:
    """Return a flight's fastest flying lap and the time-optimal one, each from its start on.

    Raises:
        ValueError: a flight without a complete flying lap.
    """
    lap = fastest_flying_lap(flight)
    if lap is None:
        raise ValueError(f"{flight.name}: found no complete flying lap, expected one to animate")
    start, end = (flight.race.passes[place] for place in lap)
    first = round(start.time_s / STEP_S)  # the state nearest to the crossing
    own = flight.states[first : first + round(end.lap_time_s / STEP_S) + 1]
    return (
        Lap(flight.name, FLIGHT_COLOURS[0], own, end.lap_time_s),
        Lap("time-optimal", FLIGHT_COLOURS[2], reference.states, reference.time_s),
    )
