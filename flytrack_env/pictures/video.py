"""A lap as an MP4, drawn as the Gymnasium environments draw it, at the speed at which it was flown."""

import itertools
import os
import secrets
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from moviepy import VideoClip
from proglog import TqdmProgressBarLogger

from flytrack_env.flown_race import STEP_S
from flytrack_env.pictures.flight import Flight
from flytrack_env.rendering import FlightLog, make_renderer
from flytrack_env.rendering.scene import LAP_START
from flytrack_env.tracks import build_course

STEPS_PER_PICTURE = 2
PICTURES_PER_S = 1.0 / (STEP_S * STEPS_PER_PICTURE)
LONGEST_STEPS = 2000  # of a flight without a lap
LEAD_IN_STEPS = 100  # flown before the first picture, for the trail and for the camera, which lags


def shown_rows(flight: Flight) -> range:
    """Return the rows of the pictures: the fastest flying lap, else the first lap, else the flight to 20 s.

    A lap goes from the first state behind the gate that begins it to the first one behind the gate that
    ends it, or the state after that where the number of steps is odd.
    """
    ends = [(one.row, one.lap_time_s) for one in flight.race.passes if one.lap]
    last = min(len(flight.states) - 1, LONGEST_STEPS)
    rows = (0, ends[0][0]) if ends else (0, last)
    if len(ends) > 1:
        flown = [(lap_time_s, before, row) for (before, _), (row, lap_time_s) in itertools.pairwise(ends)]
        rows = min(flown)[1:]
    odd = (rows[1] - rows[0]) % STEPS_PER_PICTURE
    return range(rows[0], min(rows[1] + odd, len(flight.states) - 1) + 1, STEPS_PER_PICTURE)


def scene_rows(flight: Flight) -> np.ndarray:
    """Return what the renderer draws, a row of ``flytrack_env.rendering.scene`` per state, float32."""
    race = flight.race
    numbers = np.stack([race.gate, race.laps, race.lap_start_s, race.lap_time_s], axis=1)
    return np.concatenate([flight.states, numbers], axis=1).astype(np.float32)


def make_clip(flight: Flight, rows: range) -> VideoClip:
    """Return the clip of these rows; every picture is drawn when it is asked for, in order."""
    renderer = make_renderer(build_course(flight.track))
    begin = max(rows.start - LEAD_IN_STEPS, 0)
    scenes = scene_rows(flight)[begin : rows[-1] + 1]
    scenes[:, LAP_START] -= STEP_S * begin  # the log's time begins with its first row
    log = FlightLog(STEP_S)
    picture = np.empty(0)

    def draw(time_s: float) -> np.ndarray:
        nonlocal picture
        wanted = rows[round(time_s * PICTURES_PER_S)] - begin + 1
        if wanted > len(log.rows):
            for scene in scenes[len(log.rows) : wanted]:
                log.append(scene)
            picture = renderer.draw(log)
        return picture

    # Half a picture more, as the number of pictures is rounded down.
    return VideoClip(draw, duration=(len(rows) + 0.5) / PICTURES_PER_S)


def write_video(flight: Flight, path: Path, has_bar: bool = False) -> None:
    """Write the MP4 under a temporary name and rename it; makes missing folders.

    has_bar: show moviepy's progress.

    Raises:
        OSError: the file cannot be written; nothing half-written is left.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(8)}.mp4")  # ffmpeg goes by the ending
    temporary.touch(exist_ok=False)
    try:
        rows = shown_rows(flight)
        with make_clip(flight, rows) as clip:
            logger = TqdmProgressBarLogger(print_messages=False) if has_bar else None
            _encode(clip, temporary, path, logger)
        _check(temporary, path, len(rows))
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _encode(clip: VideoClip, temporary: Path, path: Path, logger: TqdmProgressBarLogger | None) -> None:
    """Draw and encode all pictures; ffmpeg's own words are in the error."""
    try:
        clip.write_videofile(
            str(temporary), PICTURES_PER_S, "libx264", audio=False, logger=logger,
            ffmpeg_params=["-movflags", "+faststart"],
        )  # fmt: skip
    except OSError as error:
        said = str(error).split("\n\n")[-1].strip().split("\n")[0]
        raise OSError(
            f"{path}: found a video that cannot be written, expected room for it: {said}"
        ) from error


def _check(written: Path, path: Path, num_pictures: int) -> None:
    """Count the pictures in a file: moviepy does not notice where ffmpeg fails at the end."""
    try:
        found, _ = imageio_ffmpeg.count_frames_and_secs(str(written))
    except RuntimeError as error:
        raise OSError(f"{path}: found a video that cannot be read back, expected an MP4: {error}") from error
    if found != num_pictures:
        raise OSError(f"{path}: found {found} pictures in the video, expected {num_pictures}")
