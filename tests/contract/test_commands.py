"""The commands a user types: training, evaluating, the demo; and what they refuse."""

import contextlib
import io
import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

import demo
import eval_agent
from baselines.purejaxrl_ppo import Config, load_checkpoint, train_ppo
from baselines.purejaxrl_ppo.density import count_positions, draw_position_density
from benchmarks.champion import CHAMPION
from flytrack_env import blackbox, load_model, load_track
from flytrack_env.rollout import load_rollout

ROOT = Path(__file__).parents[2]


class Demo(NamedTuple):
    """A demo that ran: its folder and what it printed."""

    out: Path
    said: str


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory):
    """The whole demo, of a minute of flight, one update, few evaluation flights; run once for all tests."""
    pytest.importorskip("rerun")
    out = tmp_path_factory.mktemp("demo") / "demo"
    arguments = ["demo.py", "--out", str(out), "--total-timesteps", str(Config().batch_size)]
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patched, contextlib.redirect_stdout(said):
        patched.setattr(demo, "NUM_STEPS", 100)
        patched.setattr(demo, "NUM_EPISODES", 4)
        patched.setattr(demo, "collect", partial(demo.collect, minutes=1.0))
        patched.setattr(sys, "argv", arguments)
        demo.main()
    return Demo(out, said.getvalue())


@pytest.fixture(scope="module")
def checkpoint_path(small_demo):
    """A checkpoint as training writes it."""
    return small_demo.out / "final.msgpack"


def run(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=300)


def refused(main: Callable[[], None], monkeypatch, capsys, *arguments: str) -> str:
    """Call a command, which must end with status 2 and no other error; return what it says of it."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    return capsys.readouterr().err


def test_eval_agent_writes_the_rollout(checkpoint_path, tmp_path):
    out = tmp_path / "rollout.npy"
    done = run("eval_agent.py", "--checkpoint", str(checkpoint_path), "--steps", "50", "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert "gates: 0" in done.stdout and "ended:" in done.stdout
    states, actions = load_rollout(out)
    assert np.load(out).shape == (len(states), 25) and 1 <= len(states) <= 50
    # Row after row is what the black box makes of the row before.
    step = jax.jit(blackbox.load(eval_agent.SHIPPED_BLACK_BOX).step_vector)
    for before, action, after in zip(states[:-1], actions[:-1], states[1:], strict=True):
        np.testing.assert_allclose(step(before, action), after, atol=1e-5)
    np.testing.assert_allclose(states[0, :2], [18.6, 2.0], atol=0.31)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--checkpoint", "missing.msgpack", "--steps", "5"], "missing.msgpack"),
        (["--checkpoint", "CHECKPOINT", "--steps", "0"], "--steps"),
        (["--checkpoint", "CHECKPOINT", "--steps", "5", "--black-box", "no.bin"], "no.bin"),
    ],
)
def test_eval_agent_refuses(checkpoint_path, tmp_path, monkeypatch, capsys, arguments, message):
    arguments = [str(checkpoint_path) if a == "CHECKPOINT" else a for a in arguments]
    out = tmp_path / "rollout.npy"
    assert message in refused(eval_agent.main, monkeypatch, capsys, *arguments, "--out", str(out))
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--track", "nowhere"], "nowhere"),
        (["--reward", "speed=1"], "reward: found 'speed', expected one of progress"),
        (["--reward", "progress"], "found 'progress', expected TERM=WEIGHT"),
        (["--model", "missing.json"], "missing.json"),
        (["--total-timesteps", "10"], "total_timesteps"),
        (["--env-id", "FlyTrack-v9"], "FlyTrack-v9"),
        (["--total-timesteps", "inf"], "infinity"),
        (["--seed", "99999999999999"], "--seed"),
    ],
)
def test_training_refuses_before_any_work(tmp_path, monkeypatch, capsys, arguments, message):
    out = tmp_path / "out"
    assert message in refused(train_ppo.main, monkeypatch, capsys, *arguments, "--out", str(out))
    assert not out.exists()


@pytest.mark.parametrize(
    "command",
    [
        ["-m", "baselines.purejaxrl_ppo.train_ppo", "--track", "nowhere"],
        ["eval_agent.py", "--checkpoint", "nowhere.msgpack", "--steps", "5"],
    ],
)
def test_a_refusal_is_one_message_in_a_shell(tmp_path, command):
    out = tmp_path / "out"
    done = run(*command, "--out", str(out))
    assert done.returncode == 2 and "nowhere" in done.stderr and "Traceback" not in done.stderr
    assert not out.exists()


def test_demo_writes_everything(small_demo):
    out = small_demo.out
    names = {"final.msgpack", "model.json", "position_density.png", "rollout.npy", "rollout.rrd"}
    names |= {"rollout_top.png", "rollout_side.png", "rollout_commands.png"}
    assert {path.name for path in out.iterdir()} == names | {"flight_log.npz", "summary.json"}
    summary = json.loads((out / "summary.json").read_text())
    assert summary["noisy_starts"]["episodes"] == 4
    assert set(summary["validation"]["minimal"]["one_step"]["channels"]) == {"p", "v", "q", "w", "a"}
    assert load_model(out / "model.json").tau.shape == (4,)
    assert "noisy starts finish 3 laps" in small_demo.said


def test_demo_refuses_before_any_work(tmp_path, monkeypatch, capsys):
    out = tmp_path / "demo"
    for arguments in (["--total-timesteps", "10"], ["--black-box", "nope.bin"]):
        monkeypatch.setattr(sys, "argv", ["demo.py", "--out", str(out), *arguments])
        with pytest.raises(SystemExit):
            demo.main()
        assert arguments[1] in capsys.readouterr().err
    assert not any(out.glob("*"))
    (out / "final.msgpack").touch()
    monkeypatch.setattr(sys, "argv", ["demo.py", "--out", str(out)])
    with pytest.raises(SystemExit):
        demo.main()
    assert f"--out: {out} holds the run of an earlier demo" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["final.msgpack"]


def test_density_counts_positions_in_bins(tmp_path):
    positions = np.array([[10.02, 10.03, 1.0]] * 50 + [[10.02, 10.13, 2.0]] * 7 + [[1e3, 0.0, 1.0]])
    density, x_edges, y_edges = count_positions(positions, load_track("flytrack"))
    assert np.allclose(np.diff(x_edges), 0.1) and np.allclose(np.diff(y_edges), 0.1)
    column, row = np.searchsorted(x_edges, 10.02) - 1, np.searchsorted(y_edges, 10.03) - 1
    assert (density[column, row], density[column, row + 1], density.sum()) == (50, 7, 57)
    draw_position_density(tmp_path / "density.png", positions, load_track("flytrack"), 4)
    assert (tmp_path / "density.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_lap_times_and_reason_of_a_flight():
    champion = load_checkpoint(CHAMPION)
    flight = eval_agent.fly_on_black_box(champion, eval_agent.SHIPPED_BLACK_BOX, 850, seed=1)
    first_s, second_s = eval_agent.lap_times(flight)
    crossings_s = np.flatnonzero(flight.lap_completed) * blackbox.DT
    np.testing.assert_allclose([first_s, first_s + second_s], crossings_s, atol=blackbox.DT)
    assert eval_agent.reason_ended(flight) == "all steps flown"
    assert eval_agent.reason_ended(flight, 2) == "laps complete"
