"""A page per shipped track, in ``docs/tracks/``."""

import numpy as np

from docs.markdown import code, page, paragraph, table
from flytrack_env.references import KINDS, shipped_path, shipped_reference
from flytrack_env.tracks import Gate, Track, build_course, load_track, way_length
from flytrack_env.tracks.track import TRACK_FOLDER

FLIGHTS = {"flying": "flying lap", "standing": "standing start, every gate once"}
MODELS = {"nominal": "the nominal drone", "black_box": "the shipped black box, as identified"}


def about(name: str) -> str:
    """Return what a track's file says of the course: its first comment, but for the conventions."""
    lines = (TRACK_FOLDER / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    comment = [line.removeprefix("#").strip() for line in lines[: lines.index(f'name = "{name}"')]]
    return " ".join(comment).partition("Units")[0].strip()


def yaw_deg(gate: Gate) -> float:
    """Return a gate's yaw, degrees in [0, 360)."""
    w, _, _, z = gate.quaternion
    return float(np.rad2deg(2.0 * np.arctan2(z, w)) % 360.0)


def flown_towards_deg(gate: Gate) -> float:
    """Return the heading in which a gate is flown, degrees in [0, 360), counter-clockwise from world x."""
    return (yaw_deg(gate) + 90.0 * gate.direction) % 360.0


def gates_section(track: Track) -> list[str]:
    """Return the table of gates in flying order."""
    positions = np.array([gate.position for gate in track.gates])
    onwards = np.linalg.norm(np.roll(positions, -1, axis=0) - positions, axis=1)
    rows = [
        (
            gate.id,
            *(f"{value:g}" for value in gate.position),
            f"{yaw_deg(gate):.0f}",
            f"{flown_towards_deg(gate):.0f}",
            f"{gate.opening:g}",
            f"{gate.frame:g}",
            f"{distance:.1f}",
        )
        for gate, distance in zip(track.gates, onwards, strict=True)
    ]
    text = paragraph(
        "In flying order; laps repeat. Position of the centre in m, world frame. Yaw is the gate's own;",
        "*towards* is the heading of the direction of flight, counter-clockwise from world x. Opening and",
        "frame are the inner and outer edge of the square, m; *to the next* is the distance of centres, m.",
    )
    header = ("id", "x", "y", "z", "yaw (deg)", "towards (deg)", "opening", "frame", "to the next")
    return ["## Gates", "", *text, *table(header, rows)]


def size_section(track: Track) -> list[str]:
    """Return length and scale."""
    low, high = np.array(track.bounds_low), np.array(track.bounds_high)
    rows = [
        ("gates", len(track.gates)),
        ("length of the way on which episodes start (m)", f"{way_length(build_course(track)):.1f}"),
        ("bounds, x (m)", f"{low[0]:g} to {high[0]:g}"),
        ("bounds, y (m)", f"{low[1]:g} to {high[1]:g}"),
        ("bounds, z (m)", f"{low[2]:g} to {high[2]:g}"),
        ("start (m)", ", ".join(f"{value:g}" for value in track.start_position)),
    ]
    return ["## Size", "", *table(("what", "value"), rows)]


def records_section(name: str) -> list[str]:
    """Return the time-optimal flights of a track."""
    rows = []
    for model_name, model in MODELS.items():
        for kind in KINDS:
            if shipped_path(name, kind, model_name).is_file():
                reference = shipped_reference(name, kind, model_name)
                speed = np.linalg.norm(reference.states[:, 3:6], axis=1).max()
                rows.append((model, FLIGHTS[kind], f"{reference.time_s:.3f}", f"{speed:.1f}"))
    if not rows:
        return []
    text = paragraph(
        "Time-optimal flights, which ship as data (`flytrack_env.references`): how they were found, by which",
        "command and how far to trust them is in [time-optimal flights](../results/time_optimal.md). What",
        "trained policies reach: [racing on every track](../results/tracks.md).",
    )
    header = ("drone", "flight", "time (s)", "highest speed (m/s)")
    return ["## Records", "", *text, *table(header, rows)]


def flying_section(name: str) -> list[str]:
    """Return how to make the environment, train on the track and judge a flight."""
    trained = f"runs/{name}/final.msgpack"
    return [
        "## Fly it",
        "",
        *code(
            "import gymnasium",
            "import gymnax",
            "from flytrack_env.references import shipped_reference",
            "",
            f'env, params = gymnax.make("FlyTrack-v0", track="{name}")',
            "envs = gymnasium.make_vec(",
            '    "FlyTrack-v0",',
            "    num_envs=4,",
            f'    track="{name}",',
            '    vectorization_mode="vector_entry_point",',
            ")",
            f'optimum = shipped_reference("{name}", "flying", "nominal")',
            "print(optimum.time_s, optimum.states.shape)",
        ),
        *code(
            f"python -m baselines.purejaxrl_ppo.train_ppo --track {name} --out runs/{name}",
            f"python eval_agent.py --checkpoint {trained} --steps 2000 --ghost --out {name}.npy",
            f"python -m flytrack_env.pictures {name}.npy --track {name} --out pictures",
            language="",
        ),
    ]


def track_page(name: str) -> str:
    """Return the page of a shipped track."""
    track = load_track(name)
    return page(
        f"# {name}",
        "",
        *paragraph(about(name)),
        f"![The track {name}, from above and from the side]({name}.png)",
        "",
        *size_section(track),
        *gates_section(track),
        *records_section(name),
        *flying_section(name),
        *paragraph("All tracks, tracks of your own and random ones: [tracks](../tracks.md)."),
    )
