"""Commands and benchmarks on a Ray cluster of two nodes, simulated on this machine."""

import json

import pytest

from benchmarks import report
from flytrack.cli import main
from flytrack_env.jobs import ClusterError, run_jobs
from tests.support.jobs import Trial, end_as, measure
from tests.support.refusals import refused
from tests.support.small_suite import CENTRED, write_small_suite

# Ray's own, of forks and of sockets that it leaves to the garbage collector.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]


@pytest.fixture(scope="module")
def address():
    """The address of a cluster of two nodes of a core each."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    yield cluster.address
    cluster.shutdown()


def test_a_policy_is_flown_on_a_cluster_as_here(address, tmp_path):
    small, results = write_small_suite(tmp_path / "small.json"), []
    for where in ([], ["--address", address]):
        out = tmp_path / f"result{len(where)}.json"
        main(["bench", "--policy", CENTRED, "--suite", str(small), "--out", str(out), *where])
        results.append(json.loads(out.read_text()))
    here, there = results
    assert there | {"cpu_s": 0.0} == here | {"cpu_s": 0.0}


def test_trials_are_recorded_once_wherever_they_are_measured(address, tmp_path):
    path = tmp_path / "lines.jsonl"
    trials = [Trial("a"), Trial("crash"), Trial("raise"), Trial("b")]
    for jobs in (report.IN_THIS_PROCESS, report.Jobs(workers=1), report.Jobs(address=address)):
        of_here = [one for one in trials if one.kind != "crash" or jobs != report.IN_THIS_PROCESS]
        report.record_trials(path, of_here, measure, jobs=jobs)
        report.record_trials(path, of_here, measure, jobs=jobs)
        lines = {line["kind"]: line for line in report.lines_in(path)}
        assert len(report.lines_in(path)) == len(lines) == len(of_here)
        assert lines["a"]["found"] == "a" and lines["b"]["found"] == "b"
        assert lines["raise"]["error"] == "ValueError: no such thing"
        if "crash" in lines:
            assert lines["crash"]["error"] == "its process crashed, with exit status 3"
        path.unlink()


def test_a_cluster_of_another_ray_is_refused(address, monkeypatch):
    import ray

    monkeypatch.setattr(ray, "__version__", "2.0.0")
    with pytest.raises(ClusterError, match=r"no Ray cluster that can be used: .*2\.0\.0") as error:
        list(run_jobs(end_as, {"a": ("a",)}, 60.0, address))
    assert "\n" not in str(error.value)


def test_a_fleet_without_a_cluster_says_so_and_one_with_it_is_read(address, tmp_path, capsys):
    folder, out = tmp_path / "season", tmp_path / "out"
    (folder / "red").mkdir(parents=True)
    words = ["diagnose", folder, "--fleet", "--out", out]
    (folder / "red" / "readme.txt").write_text("hello")
    message = refused(capsys, *words, "--address", "127.0.0.1:9")
    assert "--address 127.0.0.1:9: no Ray cluster that can be used" in message
    main([*map(str, words), "--address", address])
    shown = capsys.readouterr().out
    assert "1 logs of 1 craft: 0 diagnosed" in shown
    assert "| red/readme.txt | unreadable | readme.txt: found text, expected a flight" in shown
