"""Pictures of a flight: what they show, that they keep up, and the errors where they cannot."""

import io
import logging
import sys
import time

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo

from flytrack_env import scene
from flytrack_env.pictures import make_flight, write_animation
from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.rendering import FlightLog, make_renderer, open_window
from flytrack_env.rendering.flight_log import GATE_INDEX, SCENE_SIZE
from flytrack_env.state import BATTERY, POSITION, QUATERNION, VELOCITY
from flytrack_env.tracks import build_course, load_track

pytest.importorskip("PIL", reason="the extra [render] is not installed")

from PIL import Image

from flytrack_env.rendering import animation
from flytrack_env.rendering.views import HEIGHT, PIXEL, WIDTH
from flytrack_env.rendering.views import TOP_VIEW_WIDTH as SPLIT

BASE = "FlyTrack-v0"
SHAPE = (HEIGHT, WIDTH, 3)
COURSE = build_course(load_track("flytrack"))


def distance_to(picture, colour):
    """Return how far each pixel is from a colour, largest channel."""
    return abs(picture.astype(int) - np.array(colour)).max(axis=-1)


def top_view_pixel(renderer, position):
    """Return row and column of a position, world, on the picture."""
    x, y = renderer.top_view.pixels(np.array(position)) / PIXEL
    return round(float(y)), round(float(x))


def test_top_view_shows_trail_drone_and_the_next_gate_where_they_are():
    renderer = make_renderer(COURSE, range(COURSE.num_gates))
    log, share = FlightLog(0.01), np.linspace(0.0, 1.0, 60)
    rows = np.zeros((60, SCENE_SIZE), np.float32)
    rows[:, 0], rows[:, 1], rows[:, 2] = 18.6 - 9.0 * share, 2.0, 0.3 + share  # through gate 0
    rows[:, VELOCITY.start] = -20.0 * share
    rows[:, QUATERNION.stop - 1], rows[:, BATTERY], rows[:, GATE_INDEX] = 1.0, 23.5, share > 0.7
    for row in rows:
        log.append(row)
    picture = renderer.draw(log)
    assert distance_to(picture[top_view_pixel(renderer, rows[-1][POSITION])], scene.DRONE) < 40
    for row in (rows[18], rows[35]):
        line, column = top_view_pixel(renderer, row[POSITION])
        colour = scene.speed_colours(np.array([np.linalg.norm(row[VELOCITY])]))[0]
        assert distance_to(picture[line - 1 : line + 2, column], colour).min() < 40
    for index, centre in enumerate(scene.gates_of(COURSE).centres):
        line, column = top_view_pixel(renderer, centre)
        beside = slice(line - 34, line + 35), slice(column - 34, column + 35)
        around = distance_to(picture[:, :SPLIT], scene.NEXT_GATE)[beside]
        assert ((around < 20).sum() > 30) == (index == 1)


def test_animation_shows_the_flying_lap_beside_the_time_optimal_one(tmp_path, monkeypatch):
    """Of two laps of the time-optimal flight, from standstill: 3.880 s and 3.833 s."""
    monkeypatch.setattr(animation, "STEPS_PER_FRAME", 60)
    track = load_track("flytrack")
    references = shipped_references(track, ("nominal",))
    states, commands = (np.asarray(part, np.float32) for part in ghost_rollout(references, 820))
    path = write_animation(
        make_flight("ghost", states, commands, track), references["flying"], tmp_path
    )
    assert path == tmp_path / "ghost.gif" and path.stat().st_size < 900 * 2**10
    with Image.open(io.BytesIO(path.read_bytes())) as gif:
        assert gif.size == (840, 480) and gif.n_frames == 8
        gif.seek(7)
        last = np.array(gif.convert("RGB"))
    for colour in scene.FLIGHT_COLOURS[0], scene.FLIGHT_COLOURS[2]:
        assert (distance_to(last, colour) < 40).sum() > 50
    short = make_flight("short", states[:50], commands[:50], track)
    with pytest.raises(ValueError, match="short: found no complete flying lap"):
        write_animation(short, references["flying"], tmp_path)


def test_single_environment_renders_its_own_flight_and_record_video_every_step(tmp_path):
    pytest.importorskip("moviepy", reason="RecordVideo needs it")
    from imageio_ffmpeg import count_frames_and_secs

    env = RecordVideo(gymnasium.make(BASE, render_mode="rgb_array"), str(tmp_path / "video"))
    with pytest.raises(gymnasium.error.ResetNeeded, match="expected a reset"):
        env.unwrapped.render()
    env.reset(seed=0, options={"gate_index": 0})
    first = env.unwrapped.render()
    assert first.shape == SHAPE
    for _ in range(24):
        env.step(np.array([0.0, 0.0, 0.0, 0.6]))
    assert (env.unwrapped.render() != first).any()
    env.unwrapped.reset(options={"gate_index": 0})
    np.testing.assert_array_equal(env.unwrapped.render(), first)
    env.close()
    (path,) = (tmp_path / "video").glob("*.mp4")
    assert count_frames_and_secs(str(path)) == (25, pytest.approx(0.25, abs=0.02))


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_window_without_a_display_warns_and_draws_at_its_frame_rate(monkeypatch, caplog):
    pytest.importorskip("pygame", reason="the extra [render] is not installed")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    with caplog.at_level(logging.WARNING):
        window, drawn = open_window(0.005), []
    assert "no display was found" in caplog.text and "dummy" in caplog.text
    assert window.pygame.display.get_driver() == "dummy"

    def draw():
        drawn.append(time.monotonic())
        return np.full(SHAPE, 99, np.uint8)

    for index in range(60):
        window.show(draw, is_first=index == 0)
    assert 2 <= len(drawn) <= 15 and min(np.diff(drawn)) > 0.03
    assert window.pygame.display.get_surface().get_at((5, 5))[:3] == (99, 99, 99)
    window.close()


@pytest.mark.parametrize(("package", "mode"), [("PIL", "rgb_array"), ("pygame", "human")])
def test_missing_packages_are_named_with_the_remedy(package, mode, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("flytrack_env.rendering.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=r"pip install 'flytrack\[render\]'"):
        gymnasium.make(BASE, render_mode=mode)
