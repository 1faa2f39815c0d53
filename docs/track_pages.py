"""A page per shipped track."""

from typing import Any

import numpy as np

from docs.markdown import render
from flytrack_env.references import KINDS, shipped_path, shipped_reference
from flytrack_env.tracks import Gate, Track, build_course, load_track, way_length
from flytrack_env.tracks.track import TRACK_FOLDER

FLIGHTS = {"flying": "flying lap", "standing": "standing start, every gate once"}
MODELS = {"nominal": "nominal drone", "black_box": "shipped black box, as identified"}


def about(name: str) -> str:
    """Return what a track's file says of the course: its first comment, without the conventions."""
    lines = (TRACK_FOLDER / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    comment = [line.removeprefix("#").strip() for line in lines[: lines.index(f'name = "{name}"')]]
    return " ".join(comment).partition("Units")[0].strip()


def gate_rows(track: Track) -> list[tuple[Gate, float, float, float]]:
    """Return gates with yaw and heading, degrees in [0, 360), and distance to the next gate, m."""
    positions = np.array([gate.position for gate in track.gates])
    distances = np.linalg.norm(np.roll(positions, -1, axis=0) - positions, axis=1)
    rows = []
    for gate, distance in zip(track.gates, distances, strict=True):
        w, _, _, z = gate.quaternion
        yaw_deg = float(np.rad2deg(2.0 * np.arctan2(z, w)))
        rows.append(
            (gate, yaw_deg % 360.0, (yaw_deg + 90.0 * gate.direction) % 360.0, float(distance))
        )
    return rows


def record_rows(name: str) -> list[tuple[str, str, dict[str, Any]]]:
    """Return a track's time-optimal flights: drone, kind of flight, time and highest speed."""
    rows = []
    for model_name, model in MODELS.items():
        for kind in KINDS:
            if shipped_path(name, kind, model_name).is_file():
                flight = shipped_reference(name, kind, model_name)
                speed = np.linalg.norm(flight.states[:, 3:6], axis=1).max()
                rows.append((model, FLIGHTS[kind], {"time_s": flight.time_s, "speed": speed}))
    return rows


def track_page(name: str) -> str:
    """Return the page of a shipped track."""
    track = load_track(name)
    return render(
        "track",
        name=name,
        track=track,
        about=about(name),
        length=way_length(build_course(track)),
        gates=gate_rows(track),
        records=record_rows(name),
    )
