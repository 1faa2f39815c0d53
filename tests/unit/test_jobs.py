"""Jobs in processes of their own: those that crash, hang or raise cost themselves only."""

import os
import time
from pathlib import Path

import pytest

from flytrack_env.jobs import (
    ClusterError,
    Outcome,
    Worker,
    describe_code,
    run_as_task,
    run_jobs,
    share_cores,
)
from tests.support.jobs import end_as, start_child


def test_a_job_that_crashes_or_raises_costs_itself_only():
    ends = list(run_jobs(end_as, {kind: (kind,) for kind in ("crash", "raise", "a")}, 300.0))
    assert ends == [
        ("crash", Outcome(None, "its process crashed, with exit status 3")),
        ("raise", Outcome(None, "no such thing")),
        ("a", Outcome("a")),
    ]


def test_a_job_that_hangs_is_ended_with_what_it_has_started(tmp_path, capfd):
    worker = Worker()
    assert worker.call(end_as, ("a",), 300.0) == Outcome("a")
    outcome = worker.call(start_child, (tmp_path / "pid",), 2.0)
    assert outcome == Outcome(None, "found no result after 2 s, the limit of a job")
    status = Path("/proc") / (tmp_path / "pid").read_text() / "stat"
    for _ in range(100):  # a killed process is gone, or a zombie
        if not status.exists() or ") Z " in status.read_text():
            break
        time.sleep(0.1)
    else:
        pytest.fail("the job's child runs on")
    shown = capfd.readouterr()
    assert "a job may print" in shown.err and shown.out == ""


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="needs sched_getaffinity")
def test_processes_share_the_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2, 5})
    assert share_cores(1) == [[0, 1, 2, 5]]
    assert share_cores(2) == [[0, 2], [1, 5]]
    assert share_cores(6) == [[0], [1], [2], [5], [0], [1]]


@pytest.mark.slow
def test_jobs_on_a_cluster_end_as_they_do_here():
    jobs = {kind: (kind,) for kind in ("hang", "crash", "raise", "a")}
    ends = dict(run_jobs(end_as, jobs, 30.0, "local"))
    assert ends == {
        "hang": Outcome(None, "found no result after 30 s, the limit of a job"),
        "crash": Outcome(None, "its process crashed, with exit status 3"),
        "raise": Outcome(None, "no such thing"),
        "a": Outcome("a"),
    }


@pytest.mark.parametrize("address", ["127.0.0.1:9", "127.0.0.1:port"])
def test_a_cluster_that_is_none_is_refused(address):
    with pytest.raises(ClusterError, match=f"--address {address}: no Ray cluster") as error:
        list(run_jobs(end_as, {"a": ("a",)}, 9.0, address))
    assert "\n" not in str(error.value)


def test_a_node_of_other_code_is_told():
    outcome = run_as_task(end_as, ("a",), 9.0, "another")
    assert outcome.value is None and outcome.error.endswith(", expected another")
    assert describe_code(end_as) != describe_code(run_jobs)
