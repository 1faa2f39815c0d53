"""docs/results/misspec.md, from the results of all methods in docs/results/misspec.

``python -m benchmarks.misspec.page`` reads what ``flytrack bench --suite misspec-v1`` wrote. Of
each plant whose names the diagnosis missed, it computes what the log could show at all
(benchmarks.hidden.oracle), and keeps that in docs/results/misspec/misses.jsonl.
"""

import json

from scipy.stats import binomtest

from benchmarks import report
from benchmarks.diagnosis import MOTION_OF
from benchmarks.hidden.oracle import known
from benchmarks.report import Line
from flytrack_bench.misspec import LogSuite, load_log_suite, summarize
from flytrack_bench.misspec.scores import NAMED_ROWS
from flytrack_bench.misspec.suite import ROWS
from flytrack_sysid import held_out_rows

FOLDER, OURS = report.RESULTS / "misspec", "diagnosis"
MISSES = FOLDER / "misses.jsonl"
NAMING = {"exact": "exact set", "in_class": "truth in class", "no_false_name": "no false name"}
OTHERS = {
    "silent": "clean: no name",
    "quiet": "clean: no alarm",
    "detected": "fault detected",
    "left_open": "outside: flagged, no name",
}


def results() -> dict[str, Line]:
    """Return the results by method, that of the diagnosis first."""
    paths = sorted(FOLDER.glob("*.json"), key=lambda path: (path.stem != OURS, path.stem))
    found = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}
    for result in found.values():
        result["summary"] = summarize(list(result["logs"].values()))
    return found


def counted(one: Line) -> str:
    """Return a share with its interval in percent; of none, a dash."""
    if not one["n"]:
        return "-"
    low, high = (100.0 * end for end in one["ci95"])
    return f"{one['k']} of {one['n']} ({low:.0f} to {high:.0f})"


def measured(one: Line | None, unit: float = 1.0, digits: str = ".3g") -> str:
    """Return a median with its interval, in a unit."""
    if one is None:
        return "-"
    middle, low, high = (
        "failed" if value is None else f"{unit * value:{digits}}"
        for value in (one["median"], *one["ci95"])
    )
    return f"{middle} ({low} to {high})"


def shares_table(found: dict[str, Line], columns: dict[str, str]) -> str:
    """Return shares of each method."""
    rows = []
    for name, result in found.items():
        rows.append([name, *(counted(result["summary"][column]) for column in columns)])
    return report.table(["method", *columns.values()], rows)


def figures_table(found: dict[str, Line]) -> str:
    """Return coverage, errors and CPU seconds of each method."""
    rows = []
    for name, result in found.items():
        summary = result["summary"]
        errors = [measured(summary["error_m"][row], 1e3) for row in ("named", "clean", "outside")]
        size = "-" if summary["class_size"] is None else f"{summary['class_size']:.2f}"
        coverage = counted(summary["coverage"])
        cpu_s = measured(summary["cpu_s"], 1.0, ".1f")
        rows.append([name, size, coverage, *errors, cpu_s, summary["no_answer"]])
    heads = (
        "method | mean class | intervals that cover | error, named, mm | error, clean, mm | "
        "error, outside, mm | CPU s a log | no answer"
    )
    return report.table(heads, rows)


def missed(lines: dict[str, Line]) -> dict[str, Line]:
    """Return the lines on which not everything is right that could be."""
    result = {}
    for log_id, line in lines.items():
        right = {"clean": "quiet", "outside": "left_open"}.get(line["row"], "exact")
        right = "silent" if (line["row"], line["noise"]) == ("clean", "gusts") else right
        if not line[right]:
            result[log_id] = line
    return result


def visibility(suite: LogSuite, log_id: str) -> str:
    """Return what a log could show of each hidden effect: lambda, and beside its closest rival."""
    stored = report.select(report.lines_in(MISSES), id=log_id)
    if not stored:
        plant = suite.plant(log_id)
        if not plant.truth.effects or plant.truth.onset_s is not None:
            return ""
        model = plant.model._replace(motion=MOTION_OF[plant.drawn.motion])
        is_scored = ~held_out_rows(plant.log)
        shown = known(plant.clean, plant.log, is_scored, model, plant.truth.effects)
        stored = [{"id": log_id, "known": {name: list(one) for name, one in shown.items()}}]
        report.append_line(MISSES, stored[0])
    return "; ".join(
        f"{name} {size:.3g}, {beside:.3g} beside {rival or 'nothing'}"
        for name, (size, beside, rival) in stored[0]["known"].items()
    )


def misses_table(lines: dict[str, Line]) -> str:
    """Return every log on which the diagnosis was not right."""
    suite = load_log_suite("misspec-v1")
    rows = []
    for log_id, line in missed(lines).items():
        classes = line.get("classes", {})
        names = [
            f"{name} (or {', '.join(classes[name])})" if name in classes else name
            for name in line.get("names", ())
        ]
        said = line.get("reason") or ", ".join(names) or "no name"
        flag = ", flagged" if line["flagged"] else ""
        conditions = f"{line['row']}, {line['motion']}, {line['noise']}"
        rows.append([log_id, conditions, line["truth"], said + flag, visibility(suite, log_id)])
    return report.table("log | what | truth | said | lambda, lambda_sep", rows)


def against_best(found: dict[str, Line]) -> str:
    """Return how the diagnosis differs from the rival with the most exact sets, plant by plant."""
    ours = found[OURS]["logs"]
    rivals = {name: result for name, result in found.items() if name != OURS}
    best = max(rivals, key=lambda name: rivals[name]["summary"]["exact"]["k"])
    theirs, sentences = rivals[best]["logs"], []
    for score, rows in (("exact", NAMED_ROWS), ("no_false_name", tuple(ROWS))):
        pairs = [
            (line[score], theirs[log_id][score])
            for log_id, line in ours.items()
            if line["row"] in rows and log_id in theirs
        ]
        points = 100.0 * sum(one - other for one, other in pairs) / max(len(pairs), 1)
        alone, other = (pairs.count(pair) for pair in ((True, False), (False, True)))
        p = binomtest(alone, alone + other).pvalue if alone + other else 1.0
        sentences.append(
            f"{NAMING[score].capitalize()}: {points:+.0f} points for the diagnosis; right by it "
            f"alone on {alone} of {len(pairs)} plants, by `{best}` alone on {other} (p = {p:.2g}, "
            "sign test)."
        )
    return f"Against the best rival in exact sets, `{best}`. {' '.join(sentences)}"


def main() -> None:
    """Write the page."""
    found = results()
    suites = {result["digest"] for result in found.values()}
    assert len(suites) == 1, "results of several suites"
    logs = {name: len(result["logs"]) for name, result in found.items()}
    source = report.provenance()
    report.fill_page(
        report.RESULTS / "misspec.md",
        "misspec",
        commit=source["commit"],
        date=source["date"],
        digest=suites.pop()[:12],
        logs=", ".join(f"{name} {count}" for name, count in logs.items()),
        against_best=against_best(found),
        naming=shares_table(found, NAMING),
        others=shares_table(found, OTHERS),
        figures=figures_table(found),
        misses=misses_table(found[OURS]["logs"]),
    )


if __name__ == "__main__":
    report.command(main)
