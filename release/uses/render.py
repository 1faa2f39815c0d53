"""Rendering, the window and a video with the extra ``[render]`` alone. Run by ``release.check_wheel``."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import RecordVideo

from flytrack_env import load_track, pictures
from flytrack_env.references import ghost_rollout, shipped_references

NUM_STEPS = 60


def fly(env: gymnasium.Env[Any, Any]) -> None:
    """Take a few steps."""
    env.reset(seed=0)
    for _ in range(NUM_STEPS):
        env.step(env.action_space.sample())


def main() -> None:
    """Draw a step, film an episode, open a window that nobody sees, write a lap as a video."""
    env = gymnasium.make("flytrack_env:FlyTrack-v0", render_mode="rgb_array")
    filmed = RecordVideo(env, "videos", episode_trigger=lambda number: True, video_length=NUM_STEPS)
    fly(filmed)
    picture = np.asarray(env.render())
    assert picture.dtype == np.uint8 and picture.std() > 0.0
    filmed.close()
    assert list(Path("videos").glob("*.mp4"))
    window = gymnasium.make("FlyTrack-v0", render_mode="human")
    fly(window)
    window.close()
    track = load_track("flytrack")
    states, actions = ghost_rollout(shipped_references(track, ("nominal",)), NUM_STEPS)
    flight = pictures.make_flight("lap", np.asarray(states), np.asarray(actions), track)
    assert pictures.write_video(flight, ".").stat().st_size > 0


if __name__ == "__main__":
    main()
