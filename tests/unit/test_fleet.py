"""A fleet: how logs are sorted and stored, and when a change is told."""

from functools import partial
from pathlib import Path

import fsspec
import numpy as np
import pytest

from flytrack.flags import Diagnose
from flytrack.identification import run_diagnose
from flytrack_env.jobs import Outcome
from flytrack_sysid import collect, fleet, save_log
from flytrack_sysid.fleet import (
    FleetError,
    Flight,
    Store,
    diagnose_flight,
    expand,
    find_beginning,
    find_changes,
    find_flights,
)
from flytrack_sysid.fleet_page import format_page


def touched(path, text=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_logs_are_sorted_into_craft_in_the_order_of_their_numbers(tmp_path):
    logs = ("red/flight10.npz", "red/flight9.npz", "blue/2026/a.bbl", "white/2026/a.bbl")
    for name in (*logs, "red/.hidden", "red/model.json", "out/logs/a.json"):
        touched(tmp_path / name)
    touched(tmp_path / "red" / "notes.toml", '"flight10.npz" = "new motor"')
    touched(tmp_path / "blue" / "2026" / "mapping.toml")
    again = tmp_path / "red" / ".." / "red"
    flights = find_flights([tmp_path, again], None, tmp_path / "out")
    assert [flight.name for flight in flights] == [
        "blue/2026/a.bbl",
        "red/flight9.npz",
        "red/flight10.npz",
        "white/2026/a.bbl",
    ]
    assert [flight.note for flight in flights] == ["", "", "new motor", ""]
    assert flights[0].mapping.endswith("blue/2026/mapping.toml")
    assert flights[0].model is None
    assert flights[1].model.endswith("red/model.json")


@pytest.fixture
def memory():
    """A file system of fsspec in the memory, empty."""
    system = fsspec.filesystem("memory")
    yield system
    system.store.clear()


def test_urls_are_copied_each_into_a_folder_of_its_own(tmp_path, memory):
    for team in ("a", "b"):
        memory.pipe(f"/{team}/season/red/flight1.npz", team.encode())
    touched(tmp_path / "here" / "blue" / "flight1.npz", "c")
    urls = ["memory://a/season", "memory://b/season", f"file://{tmp_path / 'here'}"]
    out = tmp_path / "out"
    flights = find_flights(expand(map(Path, urls), out), None, out)
    assert sorted(Path(flight.path).read_bytes() for flight in flights) == [b"a", b"b", b"c"]
    assert len({flight.name for flight in flights}) == 3
    assert "blue/flight1.npz" in {flight.name for flight in flights}


def test_a_name_that_leads_out_of_the_copy_is_refused(tmp_path, memory):
    memory.pipe("/season/../../../../evil.txt", b"1")
    with pytest.raises(FleetError, match=r"evil\.txt: found a name that leads out"):
        expand([Path("memory://season")], tmp_path / "out")
    assert not list(tmp_path.rglob("evil*"))


def test_folders_that_are_no_fleet_are_refused(tmp_path):
    with pytest.raises(FleetError, match="found nothing there"):
        expand([tmp_path / "nowhere" / "*.npz"], tmp_path)
    touched(tmp_path / "red" / "a.npz")
    touched(tmp_path / "red" / "notes.toml", "a = 3")
    with pytest.raises(FleetError, match=r"notes\.toml: a: expected text"):
        find_flights([tmp_path], None)
    touched(tmp_path / "red" / "notes.toml", '"b.npz" = "new motor"')
    with pytest.raises(FleetError, match=r"notes\.toml: b\.npz: found no such file"):
        find_flights([tmp_path], None)


def test_a_log_that_is_none_says_why(tmp_path):
    text = diagnose_flight(Flight("red", str(touched(tmp_path / "readme.txt", "hello"))))
    assert text["state"] == fleet.UNREADABLE
    assert "readme.txt: found text, expected a flight log" in text["reason"]
    cut = diagnose_flight(Flight("red", str(touched(tmp_path / "cut.npz", "PK"))))
    assert "cut.npz" in cut["reason"]
    with pytest.raises(FileNotFoundError):  # not a result that is kept
        diagnose_flight(Flight("red", str(tmp_path / "gone.npz")))


@pytest.mark.parametrize(
    ("named", "first"),
    [
        ("0000011111", 5),
        ("0000010111", 5),  # one diagnosis misses it
        ("0100000000111111", 10),  # one early name does not hide the change
        ("0000000011", None),  # too few flights after
        ("0011111111", None),  # too few before
        ("0101010101", None),
    ],
)
def test_a_beginning_is_told_only_where_flights_before_and_after_agree(named, first):
    assert find_beginning([flag == "1" for flag in named]) == first


def test_no_beginning_is_told_of_names_by_chance():
    rng = np.random.default_rng(5)
    beginnings = [find_beginning(list(rng.random(16) < 0.1)) for _ in range(2000)]
    assert sum(first is not None for first in beginnings) <= 20


def result_of(*effects):
    causes = [{"effect": name, "equivalent": [], "parameters": {}} for name in effects]
    diagnosis = {"causes": causes, "unexplained": {"flagged": False}}
    return {"state": fleet.DIAGNOSED, "settings": {}, "diagnosis": diagnosis}


def test_single_diagnoses_and_the_comparison_must_agree(tmp_path):
    flights = [Flight("red", str(tmp_path / f"flight{number}.npz")) for number in range(1, 11)]
    flights[8] = flights[8]._replace(note="new battery")
    results = {
        flight.name: result_of(*["wind"] * (number >= 5), *["rotor_drag"] * (number < 6))
        for number, flight in enumerate(flights)
    }
    compared = []

    def run(function, jobs):
        for name, (later, earlier) in jobs.items():
            compared.append((name, len(later), len(earlier)))
            effects = ("wind", "gyro_bias") if "begun at flight6" in name else ()
            yield name, Outcome({"causes": result_of(*effects)["diagnosis"]["causes"]})

    store = Store(tmp_path / "out", run)
    changes = find_changes(flights, results, store, silent)
    assert compared == [
        ("red/begun at flight6.npz", 4, 4),
        ("red/begun at flight9.npz", 2, 4),
        ("red/ended at flight7.npz", 4, 4),
    ]
    wind, battery = changes
    assert (wind.flight, wind.since, list(wind.causes)) == (6, "flight6.npz", ["wind"])
    assert (battery.flight, battery.note, battery.causes) == (9, "new battery", {})
    page = format_page(flights, results, changes)
    assert "- **red**: wind () begins with flight 6, flight6.npz (before: flight5.npz)" in page
    assert "no cause begins with flight 9" in page
    assert "gyro_bias" not in page
    find_changes(flights, results, store, silent)
    assert len(compared) == 3, "a second call compares nothing again"


def silent(done, total):
    """Report nothing."""


def test_results_are_kept_and_a_changed_log_is_done_again(tmp_path):
    path, calls = touched(tmp_path / "a.npz", "1"), []

    def run(function, jobs):
        for name in jobs:
            calls.append(name)
            yield name, Outcome({"state": fleet.DIAGNOSED, "settings": {"rates": (1, 2)}})

    results = partial(Store(tmp_path / "out", run).results, diagnose_flight)
    jobs = {"red/a.npz": (Flight("red", str(path)),)}
    new = results(jobs, silent)
    assert results(jobs, silent) == new  # lists in place of tuples in both
    assert calls == ["red/a.npz"]
    touched(path, "22")
    results(jobs, silent)
    assert len(calls) == 2
    assert not [path for path in (tmp_path / "out").rglob(".*") if path.is_file()]


def test_notes_move_to_the_next_diagnosed_flight_and_all_flights_count(tmp_path):
    notes = {1: "new frame", 3: "new motor", 4: "new props"}
    flights = [Flight("red", f"{n}.npz", note=notes.get(n, "")) for n in range(1, 6)]
    results = {flight.name: result_of() for flight in flights}
    results |= {f"red/{n}.npz": {"state": fleet.CONTRADICTS, "reason": "no"} for n in (1, 3)}

    def run(function, jobs):
        for name in jobs:
            yield name, Outcome({"causes": []})

    changes = find_changes(flights, results, Store(tmp_path / "out", run), silent)
    assert [(change.flight, change.before, change.note) for change in changes] == [
        (2, "", "new frame"),
        (4, "2.npz", "new motor; new props"),
    ]
    assert "with flight 2, 2.npz (before: no diagnosed flight); noted: new frame" in format_page(
        flights, results, changes
    )


def test_a_failure_is_told_and_run_again_by_the_next_call(tmp_path):
    flights = [Flight("red", str(tmp_path / f"{number}.npz")) for number in (1, 2, 3)]
    flights[1] = flights[1]._replace(note="new motor")
    outcomes = [Outcome(None, "it hung"), Outcome({"causes": []})]

    def run(function, jobs):
        for name in jobs:
            yield name, outcomes.pop(0)

    results = {flight.name: result_of() for flight in flights}
    changes = []
    for _ in range(2):
        changes += find_changes(flights, results, Store(tmp_path / "out", run), silent)
    assert [change.failure for change in changes] == ["it hung", ""]
    results["red/3.npz"] = {"state": fleet.FAILED, "reason": "it crashed"}
    page = format_page(flights, results, changes)
    assert "unknown what begins with flight 2, 2.npz (before: 1.npz); the comparison failed" in page
    assert "1 whose diagnosis failed" in page and "| red/3.npz | failed | it crashed |" in page


@pytest.mark.slow
def test_a_folder_becomes_a_page_and_a_second_call_does_nothing_again(tmp_path, black_box, capsys):
    season, out = tmp_path / "season", tmp_path / "out"
    touched(season / "red" / "readme.txt", "hello")
    save_log(season / "red" / "flight1.npz", collect(black_box, 1.0, seed=0))
    run_diagnose(Diagnose((season,), out, fleet=True))
    shown = capsys.readouterr().out
    result = (out / "logs" / "red" / "flight1.npz.json").stat().st_mtime_ns
    assert "2 logs of 1 craft: 1 diagnosed" in shown
    assert "| red/readme.txt | unreadable | readme.txt: found text" in shown
    assert (out / "fleet.md").read_text() in shown
    assert (out / "fleet.png").read_bytes().startswith(b"\x89PNG")
    run_diagnose(Diagnose((season,), out, fleet=True))
    assert (out / "logs" / "red" / "flight1.npz.json").stat().st_mtime_ns == result
