"""Flying by hand: keys and axes, laps and gaps, the ghost, the rollout, and refusals."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("pygame", reason="the extra [fly] is not installed")
pytest.importorskip("PIL", reason="the extra [fly] is not installed")

import pygame

from flytrack.cli import main
from flytrack_env import load_track, scene
from flytrack_env.quaternion import Quaternion
from flytrack_env.references import shipped_references
from flytrack_env.rendering import make_renderer
from flytrack_env.rendering.views import TOP_VIEW_WIDTH
from flytrack_env.rollout import load_rollout
from flytrack_env.state import BATTERY, POSITION, QUATERNION, RATES
from flytrack_env.thrust import hover_action
from flytrack_fly import play
from flytrack_fly.ghost import cut_laps, make_ghost
from flytrack_fly.session import Session, steps_due
from flytrack_fly.sticks import Gamepad, move_by_keys
from tests.support.tables import table

TRACK = load_track("flytrack")
STANDING = shipped_references(TRACK, ("nominal",))["standing"]
GHOST, MODEL = make_ghost("reference", TRACK, None)
UP, SIDE = np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])


@pytest.fixture
def display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.quit()


@pytest.fixture
def pad(monkeypatch):
    joystick = SimpleNamespace(
        get_axis=lambda number: 0.0,
        get_numaxes=lambda: 6,
        get_instance_id=lambda: 7,
        get_name=lambda: "Pad",
    )
    monkeypatch.setattr(pygame.joystick, "get_count", lambda: 1)
    monkeypatch.setattr(pygame.joystick, "Joystick", lambda number: joystick)


@pytest.fixture(scope="module")
def session():
    return Session(TRACK, MODEL, GHOST)


def post(kind, **fields):
    pygame.event.post(pygame.event.Event(kind, **fields))


def test_keys_fly_and_the_rollout_is_written_beside_an_old_file(
    display, tmp_path, monkeypatch, capsys
):
    frames = iter(range(100))
    script = {1: pygame.K_w, 31: pygame.K_RIGHT, 36: pygame.K_h, 37: pygame.K_ESCAPE}

    def tick():
        if key := script.get(next(frames)):
            post(pygame.KEYDOWN, key=key)
        return 0.02

    monkeypatch.setattr(play, "tick_of_clock", lambda: tick)
    old, new = tmp_path / "mine.npy", tmp_path / "mine_2.npy"
    old.write_text("old")
    main(["fly", "--out", str(old)])
    assert old.read_text() == "old"
    assert f"{new}: 0.74 s, 0 gates, laps: none; ended: quit" in capsys.readouterr().out
    states, commands = load_rollout(new)
    assert states.shape == (74, 21) and commands.shape == (74, 4)
    assert states[59, 2] > states[0, 2] + 0.2 and (np.abs(states[:60, RATES]) < 1e-6).all()
    left_w = Quaternion(*states[-1, QUATERNION]).axes()[1]
    assert states[-1, RATES][0] > 1.0 and left_w.z > 0.05, "its right side goes down"


def test_a_gamepad_that_replays_the_optimum_times_its_lap(session, display, pad, monkeypatch):
    commands, seen = iter([None, *STANDING.commands, "over"]), []

    class Renderer:
        def draw(self, log, ghost, follows_nose, notes):
            seen.append(notes)
            if session.now.num_gates < 8:
                assert_allclose(ghost[POSITION], log.rows[-1, POSITION], atol=1e-3)

    def tick():
        command = next(commands)
        if isinstance(command, str):
            post(pygame.QUIT)
        elif command is not None:  # the throttle has to be down at first
            battery_v = float(session.now.log.rows[-1, BATTERY])
            hover = hover_action(MODEL.thrust_coeffs, MODEL.m * MODEL.g, battery_v)
            throttle = (command[3] - hover) / (1.0 - hover if command[3] > hover else 1.0 + hover)
            values = {3: command[0], 4: -command[1], 0: -command[2], 1: -throttle}
            for axis, value in values.items():
                post(pygame.JOYAXISMOTION, instance_id=7, axis=axis, value=value)
        return 0.01

    monkeypatch.setattr(play, "make_renderer", lambda course, gate_ids: Renderer())
    pygame.display.init()
    controls = play.Controls(Gamepad(0, deadzone=0.0, expo=0.0))
    play.play(session, controls, lambda picture: None, tick)
    flight = session.now
    assert flight.num_gates == 8
    assert flight.lap_times_s == pytest.approx([STANDING.time_s], abs=1e-3)
    assert seen[0].startswith("W, or throttle up") and "best 3.88 s" in seen[-1]
    for gate in TRACK.gates:
        gap = f"gate {gate.id}: .0.00 s to the time-optimal"
        assert any(re.search(gap, notes) for notes in seen)
    (lap,) = cut_laps(np.asarray(flight.rollout()[0], float), TRACK)
    assert_allclose(lap.gate_times_s, GHOST.first.gate_times_s, atol=1e-3)


def test_a_crash_goes_back_to_the_start_where_the_throttle_must_come_down(session):
    session.restart()
    for sticks in (-UP, *[UP + SIDE] * 300):
        session.advance(sticks)
    assert session.flights[-2].commands and not session.now.commands
    assert re.search(r"ended: (ground|out of bounds)\nW, or throttle", session.notes())
    for sticks in (-UP, UP):
        session.advance(sticks)
    assert len(session.now.commands) == 1


def test_in_a_race_the_opponent_goes_its_own_way_and_is_hit(session):
    early = GHOST.first._replace(state_at=lambda time_s: GHOST.first.state_at(time_s + 0.5))
    race = Session(TRACK, MODEL, GHOST._replace(first=early), is_race=True)
    start_w = race.now.log.rows[-1, POSITION]
    assert_allclose(start_w, GHOST.state_at(0, 0.0)[POSITION] + (0.5, 0.5, 0.0), atol=1e-5)
    session.restart()
    race.state = session.state  # on the optimum itself, half a second behind the opponent
    for command in STANDING.commands:
        race.fly(command)
    flight = race.now
    assert flight.num_gates == 8 and flight.gap == (7, pytest.approx(0.0, abs=1e-3))
    assert_allclose(race.ghost_state(), GHOST.flying.state_at(flight.log.time_s - STANDING.time_s))
    assert "to the time-optimal opponent" in race.notes()
    assert GHOST.lap_begin_s(2) == STANDING.time_s + GHOST.flying.gate_times_s[-1]
    hovering = GHOST.first._replace(state_at=lambda time_s: np.r_[start_w, np.zeros(18)])
    race = Session(TRACK, MODEL, GHOST._replace(first=hovering), is_race=True)
    race.fly(UP)
    assert race.flights[0].ended == "collision"


def test_the_picture_shows_the_ghost_and_looks_where_the_nose_points(session):
    session.restart()
    renderer, log = make_renderer(session.params.course, session.gate_ids), session.now.log
    for ghost in (GHOST.state_at(0, 0.6), None):
        picture = renderer.draw(log, ghost, follows_nose=True, notes="best")
        is_ghost = np.abs(picture.astype(int) - scene.CAMERA).max(axis=-1) < 40
        for part in (is_ghost[:, :TOP_VIEW_WIDTH], is_ghost[:, TOP_VIEW_WIDTH:]):
            assert part.any() == (ghost is not None)
    forward_w = renderer.chase_view.camera(log.rows, follows_nose=True).forward_w
    assert_allclose(forward_w[:2], (-1.0, 0.0), atol=0.02)


def test_keys_move_sticks_steadily_and_gamepads_by_their_curve():
    pulls, sticks = np.array([-1.0, 0.0, 1.0, 0.0]), np.zeros(4)
    gentle = [-0.4, 0.0, 1.0, 0.0]
    for is_full, pulled, expected in ((0, pulls, gentle), (1, pulls, pulls), (0, 0 * UP, 0 * UP)):
        for _ in range(50):
            before, sticks = sticks, move_by_keys(sticks, pulled, bool(is_full), 0.01)
            assert np.abs(sticks - before).max() < 0.07
        assert_allclose(sticks, expected, atol=1e-9)
    pad = Gamepad(expo=0.5, deadzone=0.1)
    for value, expected in (
        (0.1, np.zeros(4)),
        (-0.55, [-0.3125, 0.3125, 0.3125, 0.5]),
        (1.0, [1.0, -1.0, -1.0, -1.0]),
    ):
        assert_allclose(pad.sticks(np.full(4, value)), expected)


def test_steps_and_ghosts_follow_the_clock():
    assert steps_due(0.004, 0.017, 0.01) == (2, pytest.approx(0.001))
    assert steps_due(0.0, 5.0, 0.01)[0] == 10, "a late picture is not made up for"
    assert_allclose(GHOST.state_at(0, 1.0), STANDING.states[100], atol=1e-6)
    later_s = 2.0 * GHOST.flying.gate_times_s[-1] + 0.5
    for laps, time_s in ((0, STANDING.time_s + 0.5), (1, later_s)):
        assert_allclose(GHOST.state_at(laps, time_s), GHOST.state_at(1, 0.5), atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    table("refused_flying")["refused"],
)
def test_what_cannot_be_flown_is_one_sentence(
    arguments, message, display, pad, monkeypatch, capsys
):
    for name in () if arguments else ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(SystemExit):
        main(["fly", *arguments.split()])
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "compiling" not in line]
    assert re.search(f"error: .*{message}", line), line


@pytest.mark.slow
def test_the_champion_is_a_ghost_on_its_own_track_and_model():
    ghost, model = make_ghost("champion", TRACK, None)
    assert ghost.first.gate_times_s[-1] < 4.2 and ghost.flying.gate_times_s[-1] < 4.0
    with pytest.raises(ValueError, match="--ghost champion: 0 laps of split_s, expected 2"):
        make_ghost("champion", load_track("split_s"), model)
