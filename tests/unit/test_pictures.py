"""Pictures of recorded flights: what is drawn is what was flown."""

import io

import numpy as np
import pytest

from flytrack_env.pictures import make_flight, write_animation
from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.tracks import load_track

TRACK = load_track("flytrack")
REFERENCES = shipped_references(TRACK, ("nominal",))
STATES, COMMANDS = (np.asarray(part, np.float32) for part in ghost_rollout(REFERENCES, 820))


def test_animation_shows_the_flying_lap_beside_the_time_optimal_one(tmp_path, monkeypatch):
    """Of two laps of the time-optimal flight, from standstill: 3.880 s and 3.833 s."""
    image = pytest.importorskip("PIL.Image")
    animation = pytest.importorskip("flytrack_env.rendering.animation")
    monkeypatch.setattr(animation, "STEPS_PER_FRAME", 60)
    path = write_animation(make_flight("ghost", STATES, COMMANDS, TRACK), REFERENCES["flying"], tmp_path)
    assert path == tmp_path / "ghost.gif" and path.stat().st_size < 900 * 2**10
    with image.open(io.BytesIO(path.read_bytes())) as gif:
        assert gif.size == (840, 480) and gif.n_frames == 8
        gif.seek(7)
        last = np.array(gif.convert("RGB"), int)
    for colour in animation.scene.FLIGHT_COLOURS[0], animation.scene.FLIGHT_COLOURS[2]:
        assert (np.abs(last - colour).max(axis=-1) < 40).sum() > 50
    short = make_flight("short", STATES[:50], COMMANDS[:50], TRACK)
    with pytest.raises(ValueError, match="short: found no complete flying lap"):
        write_animation(short, REFERENCES["flying"], tmp_path)
