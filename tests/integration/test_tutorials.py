"""The tutorials, the quick start and the FAQ run as they are written, and end where they say."""

from pathlib import Path
from typing import Any

import pytest

from flytrack_env import find_problems, load_model, load_track
from flytrack_env.rollout import load_rollout
from tests.contract.test_docs import DOCS, examples


def run(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch, until: str = "") -> dict[str, Any]:
    """Run a page's Python in a folder, up to a heading if one is given, and return its names."""
    (folder / "blackbox").symlink_to(DOCS.parent / "blackbox")
    monkeypatch.chdir(folder)
    code, names = examples(page), {}
    if until:
        line = (DOCS / page).read_text(encoding="utf-8").splitlines().index(until)
        code = "\n".join(code.splitlines()[:line])
    exec(compile(code, page, "exec"), names)
    return names


def test_quick_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("quick_start.md", tmp_path, monkeypatch)
    assert names["rewards"].shape == (100, 256) and int(names["terminated"].sum()) > 0


def test_faq(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("faq.md", tmp_path, monkeypatch)  # it asserts what it claims


def test_algorithm_improves_what_it_earns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("tutorials/algorithm.md", tmp_path, monkeypatch)
    assert names["after"] > names["before"] + 0.3


def test_algorithm_is_short() -> None:
    lines = [line for line in examples("tutorials/algorithm.md").splitlines() if line.strip()]
    assert len(lines) < 80


def test_track_is_mended_and_flown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("tutorials/track.md", tmp_path, monkeypatch)
    assert [problem.demand for problem in names["problems"]] == ["ground"]
    assert not find_problems(load_track(tmp_path / "square.toml"))
    states, _ = load_rollout(tmp_path / "square.npy")
    assert len(states) == 100 and states[-1, 2] > states[0, 2] + 0.5
    assert (tmp_path / "square_top.png").stat().st_size > 10_000


def test_black_box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("tutorials/black_box.md", tmp_path, monkeypatch)
    assert "signature: found" in capture(names) and names["rewards"].shape == (8,)
    assert len(names["log"]) > 4000


def capture(names: dict[str, Any]) -> str:
    """Return what loading the tutorial's wrong file says."""
    with pytest.raises(names["blackbox"].BlackBoxError) as refused:
        names["blackbox"].load("wrong.bin")
    return str(refused.value)


def test_flight_log_is_imported_and_fitted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("tutorials/flight_log.md", tmp_path, monkeypatch, until="## Diagnose")
    assert len(names["log"]) > 2500 and set(names["log"].channels) == {"u", "q", "v", "w", "f", "v_bat"}
    assert load_model(tmp_path / "model.json").tau[:3] == pytest.approx([0.04] * 3, rel=0.02)
    assert names["errors"].one_step.channels["f"].nrmse > 0.2  # the drag that it lacks


@pytest.mark.slow
def test_flight_log_is_diagnosed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("tutorials/flight_log.md", tmp_path, monkeypatch)
    causes = {cause.effect: cause for cause in names["diagnosis"].causes}
    assert set(causes) == {"linear_drag", "thrust_curve"}
    drag = load_model(tmp_path / "diagnosis" / "extended_model.json").effect("linear_drag")
    assert drag == pytest.approx((0.4, 0.4, 0.2), rel=0.05)


@pytest.mark.slow
def test_better_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("tutorials/better_policy.md", tmp_path, monkeypatch)
    loop, errors = names["loop"], names["errors_of"](names["found"].extended, names["loop"].held_out)
    assert errors.position_m["0.5"] < loop.before.errors.position_m["0.5"]
    assert loop.after.errors.position_m["0.5"] < loop.before.errors.position_m["0.5"]
    files = {path.name for path in (tmp_path / "loop").iterdir()}
    assert {"loop.json", "comparison_top.png", "after_plant.npy", "race.npz", "history"} <= files
