"""The report: files, names, consistency of styles, odd inputs. Warnings are errors."""

import html
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from jaxba.bench import charts
from jaxba.bench.profile import Target
from jaxba.bench.report import run_metadata, to_html, write_report
from jaxba.bench.summary import summarize
from jaxba.problem.bundle_problem import ProblemError
from jaxba.solver.record import Record, TracePoint

pytestmark = pytest.mark.filterwarnings("error")


def make_record(
    problem, solver, iterations, *, rate=0.3, floor=100.0, damping=0.25, termination="ftol"
):
    """A run that approaches `floor` geometrically; every fourth iteration is rejected."""
    cost = 1000.0
    points = [TracePoint(0, 0.0, 1000.0, math.nan, True, 0, math.nan)]
    for i in range(1, iterations + 1):
        ok = i % 4 != 0
        cost = floor + (cost - floor) * rate if ok else cost
        points.append(TracePoint(i, 0.1 * i, cost, damping / i, ok, 0, 0.9 if ok else -0.1))
    counts = (iterations, sum(p.accepted for p in points[1:]), 0, termination)
    start = (
        problem,
        "f",
        2,
        3,
        4,
        solver,
        "jax",
        "cpu",
        "float64",
        2,
        0,
        0.1,
        1.0,
        0.1 * iterations,
    )
    return Record(*start, 1000.0, cost, *counts, tuple(points))


def names(folder):
    return {path.name for path in folder.iterdir()}


class Tags(HTMLParser):
    """Collects scripts and sources of loaded content, and checks that tags close."""

    def __init__(self):
        super().__init__()
        self.stack = []
        self.sources = []
        self.scripts = []

    def handle_starttag(self, tag, attrs):
        self.sources += [value for key, value in attrs if key in ("src", "href")]
        if tag not in ("meta", "img"):
            self.stack.append(tag)

    def handle_data(self, data):
        if self.stack and self.stack[-1] == "script":
            self.scripts.append(data)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag


def page_of(records, tolerance=1e-3, **metadata):
    """The report: its text, its tags, and the data of its charts."""
    text = to_html(records, summarize(records, tolerance), tolerance, metadata)
    parser = Tags()
    parser.feed(text)
    assert parser.stack == []
    return text, parser, json.loads(parser.scripts[0])


def test_write_report_writes_one_file(tmp_path):
    records = [
        make_record("a", "classic", 30),
        make_record("a", "ceres", 14),
        make_record("dir/b c", "classic", 12),
    ]
    path = write_report(records, tmp_path / "out", 1e-3, metadata={"device": "<cpu>", "threads": 2})
    assert names(tmp_path / "out") == {"report.html"} == {path.name}


def test_report_is_self_contained_well_formed_and_escaped():
    hostile = "<script>alert(1)</script>&\"'"
    text, parser, book = page_of(
        [make_record(hostile, hostile, 3)], **{hostile: hostile, "command": hostile}
    )
    assert "<script>alert" not in text
    assert parser.sources == []
    assert len(parser.scripts) == 3
    assert "default-src 'none'" in text
    styles = text[text.index("<style>") : text.index("</style>")]
    assert not re.search(r"url\(|@import", styles)
    assert {trace["name"] for chart in book["charts"] for trace in chart["data"]} == {
        html.escape(hostile)
    }


def test_charts_of_the_report_have_the_numbers_of_the_records():
    records = [
        make_record(p, s, n, rate=r)
        for p in "ab"
        for s, n, r in (("x", 12, 0.1), ("y", 12, 0.37), ("z", 12, 0.37))
    ]
    text, _, book = page_of(records, 1e-2)
    titles = re.findall("<h3>(.*?)</h3>", text)
    assert titles[:6] == [
        "τ = 0.1",
        "τ = 0.01",
        "τ = 0.001",
        "f*(1+0.01)",
        "f*(1+0.001)",
        "f*(1+0.0001)",
    ]
    charts = dict(zip(titles[:9], book["charts"][:9], strict=True))
    x, y, _ = charts["f*(1+0.01)"]["data"]
    # x needs 3 accepted steps to 1e-2 of its best cost, y and z 9 iterations with two rejections
    assert [x["x"]["iterations"][0], x["y"]["iterations"][0]] == [1.0, 100.0]
    assert [3.0, 100.0] in [
        list(p) for p in zip(y["x"]["iterations"], y["y"]["iterations"], strict=True)
    ]
    cost = charts["Accepted cost (pixels²)"]["data"][1]
    rows = np.array([row[:4] for row in cost["customdata"]], float)
    trace = records[1].trace
    np.testing.assert_allclose(rows[:, 0], [p.iteration for p in trace])
    np.testing.assert_allclose(rows[:, 1], [p.time_s for p in trace], rtol=1e-6)
    np.testing.assert_allclose(cost["y"], [p.cost for p in trace], rtol=1e-6)
    damping = charts["Damping λ"]["data"][1]
    np.testing.assert_allclose(damping["y"][1:], [p.damping for p in trace[1:]], rtol=1e-6)
    assert [symbol.endswith("-open") for symbol in damping["marker"]["symbol"]] == [
        not p.accepted for p in trace
    ]
    heights = [shape["y0"] for shape in charts["Accepted cost (pixels²)"]["layout"]["shapes"]]
    best = records[0].final_cost
    assert heights == pytest.approx(
        [best + tau * (1000 - best) for tau in (0.1, 0.01, 0.001)], rel=1e-6
    )


def test_a_solver_has_one_colour_in_all_charts():
    records = [make_record(p, s, 12) for p in "ab" for s in ("q", "classic", "learned", "r")]
    _, _, book = page_of(records)
    colours = {
        (trace["meta"], trace["line"]["color"])
        for chart in book["charts"]
        for trace in chart["data"]
    }
    styles = charts.solver_styles(["q", "classic", "learned", "r"])
    assert colours == {(name, style.color) for name, style in styles.items()}


@pytest.mark.parametrize(
    "records",
    [
        [make_record("a", "x", 0)],
        [
            make_record("a", s, 100, rate=0.9999, termination="max_iterations")
            for s in ("classic", "x")
        ],
        [
            *(
                make_record("zero residual", "x", 12, rate=1e-3, floor=0.0),
                make_record("zero residual", "y", 30),
            ),
            *(
                make_record("zero damping", "gauss-newton", 15, damping=0.0),
                make_record("zero damping", "y", 15),
            ),
        ],
        [
            make_record("a", "slow", 100),
            replace(make_record("a", "fast", 2), trace=make_record("a", "f", 1).trace),
        ],
    ],
    ids=["no iteration", "all failed", "zeros", "log time"],
)
def test_unusual_results_still_make_a_report(tmp_path, records):
    write_report(records, tmp_path)
    assert "report.html" in names(tmp_path)


def test_run_that_produced_no_numbers_still_makes_a_report(tmp_path):
    nothing = {
        "initial_cost": math.nan,
        "final_cost": math.nan,
        "iterations": 0,
        "accepted": 0,
        "trace": (),
    }
    crashed = replace(make_record("$x_1$ \u6f22", "_$policy$", 1, termination="error"), **nothing)
    write_report([crashed], tmp_path / "alone")
    write_report([crashed, make_record(crashed.problem, "x", 12)], tmp_path / "beside")
    text = (tmp_path / "alone" / "report.html").read_text(encoding="utf-8")
    assert "no solver has a finite initial cost" in text


def test_many_solvers_have_different_styles_and_yardsticks_always_the_same():
    solvers = [f"s{i}" for i in range(20)] + ["ceres", "classic"]
    styles = charts.solver_styles(solvers)
    assert len({(s.color, s.dash) for s in styles.values()}) == len(solvers)
    assert styles["classic"] == charts.solver_styles(["x", "classic"])["classic"]
    alone = charts.solver_styles(["mine", "ceres", "bold"])
    assert alone["bold"] == charts.solver_styles(["bold"])["bold"]
    assert len({style.color for style in alone.values()}) == 3
    assert list(styles) == solvers


def test_convergence_charts_have_dashed_lines_at_the_tolerances():
    cost, distance, _ = charts.problem_charts(
        [make_record("a", "x", 30)], "a", 1e-2, charts.solver_styles("x")
    )

    def heights(chart):
        return sorted(shape["y0"] for shape in chart["layout"]["shapes"])

    assert heights(cost) == pytest.approx([100.9, 109.0, 190.0])
    assert heights(distance) == pytest.approx([1e-4, 1e-3, 1e-2])


def test_labels_of_dashed_lines_stand_beside_the_chart():
    cost = charts.problem_charts([make_record("a", "x", 30)], "a", 1e-2, charts.solver_styles("x"))[
        0
    ]["layout"]
    assert [note["text"] for note in cost["annotations"]] == ["τ = 0.001<br>τ = 0.01", "τ = 0.1"]
    assert {(note["x"], note["xanchor"]) for note in cost["annotations"]} == {(1, "left")}
    assert cost["margin"]["r"] > 50


def test_a_single_problem_has_no_performance_profile():
    records = [make_record("a", "x", 30), make_record("a", "y", 12)]
    assert "Performance profiles" not in page_of(records)[0]
    chart = charts.profile_chart(records, Target("tau", 0.1), charts.solver_styles(["x", "y"]))
    assert chart["layout"]["yaxis"]["range"] == [0.0, 100.0]


def test_metadata_come_from_the_records_if_none_are_given():
    metadata = run_metadata(
        [make_record("a", "x", 2), replace(make_record("a", "y", 2), device="gpu", repeat=2)]
    )
    assert metadata["device"] == "cpu, gpu"
    assert metadata["repeats"] == "3"


def test_nothing_to_report_and_bad_tolerance_are_refused(tmp_path):
    with pytest.raises(ProblemError, match="no results"):
        write_report([], tmp_path / "out")
    with pytest.raises(ProblemError, match="between 0 and 1"):
        write_report([make_record("a", "x", 2)], tmp_path / "out", 1.5)
    assert not (tmp_path / "out").exists()
