"""What the docs say of the tracks, and their pictures."""

import re
from pathlib import Path

import pytest
from PIL import Image

from docs.draw_tracks import digest, draw_track, drawn_tracks
from flytrack_env.tracks import (
    DEMANDS,
    Limits,
    available_tracks,
    build_course,
    load_track,
    way_length,
)

DOCS = Path(__file__).parents[2] / "docs"


def test_documented_table_is_that_of_the_files() -> None:
    text = (DOCS / "tracks.md").read_text(encoding="utf-8")
    rows = {cells[0].strip("` "): [cell.strip() for cell in cells[1:5]] for cells in table_rows(text)}
    assert set(rows) == set(available_tracks())
    for name, cells in rows.items():
        track = load_track(name)
        heights = [gate.position[2] for gate in track.gates]
        assert cells == [
            str(len(track.gates)),
            f"{track.gates[0].opening:g}",
            f"{way_length(build_course(track)):.1f}",
            f"{min(heights):g} to {max(heights):g}",
        ]


def test_measured_tracks_are_the_shipped_ones_and_those_with_a_picture() -> None:
    lines = (DOCS / "results" / "tracks.md").read_text(encoding="utf-8").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    measured = {row[0]: row[1:3] for row in cells[2:]}
    expected = {
        re.sub(r"random_(\d+)", r"random_track(\1)", name): [
            str(len(track.gates)),
            f"{way_length(build_course(track)):.1f}",
        ]
        for name, track in drawn_tracks().items()
    }
    assert measured == expected, "measure again: python -m benchmarks.tracks"


def test_documented_limits_are_the_checks() -> None:
    text = (DOCS / "tracks.md").read_text(encoding="utf-8")
    table = text[text.index("| demand |") :]
    rows = dict(re.findall(r"^\| ([a-z ]+) \| (.*) \|$", table, re.MULTILINE)[1:])
    limits = Limits()
    numbers = {
        "opening": [f"{limits.min_opening:g} m"],
        "spacing": [f"{limits.min_spacing:g} to {limits.max_spacing:g} m"],
        "turn": [f"{limits.max_turn_deg:g} deg"],
        "own gate": [],
        "path": [f"{limits.clearance:g} m"],
        "frames": [f"{limits.clearance:g} m"],
        "bounds": [f"{limits.clearance:g} m"],
        "ground": [],
        "start": [
            f"{limits.min_start_distance:g} to {limits.max_spacing:g} m",
            f"{limits.max_start_turn_deg:g} deg",
        ],
    }
    assert tuple(rows) == tuple(numbers) == DEMANDS
    assert all(number in rows[demand] for demand in DEMANDS for number in numbers[demand])


def table_rows(text: str) -> list[list[str]]:
    """Return the cells of every row of the table of tracks: the rows that begin with a name in code."""
    return [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| `")]


@pytest.mark.parametrize("name", drawn_tracks())
def test_every_track_has_a_picture_of_itself_in_the_docs(name: str) -> None:
    with Image.open(DOCS / "tracks" / f"{name}.png") as image:
        assert image.text["Track"] == digest(drawn_tracks()[name]), "draw again: python -m docs.draw_tracks"
        assert min(image.size) > 500
    assert f"](tracks/{name}.png)" in (DOCS / "tracks.md").read_text(encoding="utf-8")


def test_pictures_exist_of_shipped_tracks_and_can_be_drawn_of_any(tmp_path: Path) -> None:
    assert set(available_tracks()) < set(drawn_tracks())
    draw_track(tmp_path / "split_s.png", load_track("split_s"))
    with Image.open(tmp_path / "split_s.png") as drawn, Image.open(DOCS / "tracks/split_s.png") as shipped:
        assert drawn.size == shipped.size
