"""Tables against numbers worked out by hand, and their renderings."""

import io
import math
import re

import pytest
from rich.console import Console

from jaxba.bench.summary import summarize
from jaxba.bench.tables import number, print_summary
from jaxba.game.statistics import geometric_mean
from jaxba.runtime.atomic import write_text
from jaxba.solver.record import Record, TracePoint


def make_record(
    problem,
    solver,
    iterations,
    *,
    per_iteration_s=1.0,
    end=100.0,
    repeat=0,
    termination="ftol",
    failed=0,
):
    """A run that falls to `end` in its last iteration; the first `failed` iterations are failed
    linear solves."""
    trace = [TracePoint(0, 0.0, 1000.0, math.nan, True, 0, math.nan)]
    for i in range(1, iterations + 1):
        cost, ok = (end, True) if i == iterations else (1000.0, False)
        trace.append(
            TracePoint(i, i * per_iteration_s, cost, 1e-3, ok, 0, math.nan if i <= failed else 0.5)
        )
    counts = (iterations, 1, 0, termination)
    times = (0.25, 3.0, 3.25 + trace[-1].time_s)
    start = (problem, "f", 2, 3, 4, solver, "jax", "cpu", "float64", 2, repeat)
    return Record(*start, *times, 1000.0, trace[-1].cost, *counts, tuple(trace))


@pytest.fixture
def records():
    """Three problems. learned: 2, 8 iterations, fails on c; classic: 16, 4, 25; ceres was not run
    on c."""
    return [
        make_record("a", "classic", 16),
        make_record("b", "classic", 4),
        make_record("c", "classic", 25),
        make_record("a", "ceres", 4),
        make_record("b", "ceres", 4),
        make_record("a", "learned", 2, per_iteration_s=2.0, end=100.5),
        make_record("b", "learned", 8, per_iteration_s=2.0, failed=3),
        make_record(
            "c", "learned", 100, per_iteration_s=2.0, end=400.0, termination="max_iterations"
        ),
    ]


def solver(summary, name):
    return next(s for s in summary.solvers if s.solver == name)


def test_means_over_reached_problems_come_with_their_counts(records):
    summary = summarize(records)
    end = solver(summary, "learned").targets["converged"]
    assert (end.reached, end.total) == (2, 3)
    assert end.iterations == pytest.approx(4.0)  # sqrt(2 * 8)
    assert end.iterations_capped == pytest.approx((2 * 8 * 100) ** (1 / 3))
    assert end.seconds == pytest.approx(8.0)  # sqrt(4 * 16)
    relative = solver(summary, "learned").targets["relative_0.001"]  # misses a by 0.5 %
    assert (relative.reached, relative.iterations) == (1, pytest.approx(8.0))
    assert solver(summary, "learned").targets["relative_0.01"].reached == 2


def test_unrun_problems_count_as_unreached_and_are_reported(records):
    summary = summarize(records)
    end = solver(summary, "ceres").targets["converged"]
    assert (solver(summary, "ceres").run, end.reached, end.total) == (2, 2, 3)
    assert end.iterations_capped == pytest.approx((4 * 4 * 100) ** (1 / 3))
    assert summary.warnings == ["ceres was run on 2 of 3 problems; the others count as not reached"]


def test_the_worst_end_and_all_compilation(records):
    learned = solver(summarize(records), "learned")
    assert learned.final_ratio_worst == pytest.approx(4.0)
    assert learned.compile_s == 9.0


def test_cells_hold_medians_over_repeats():
    records = [make_record("a", "x", n, repeat=i, end=100.0 + i) for i, n in enumerate((9, 3, 5))]
    (cell,) = summarize(records).cells
    assert (cell.repeats, cell.iterations, cell.final_cost, cell.seconds) == (3, 5, 101.0, 5.0)
    assert cell.converged
    assert cell.reach["converged"].iterations == 5
    assert summarize(records).problems[0].best_solver == "x"


def test_solver_that_fails_everywhere_has_no_mean_but_a_capped_one():
    records = [
        make_record("a", "x", 100, end=900.0, termination="max_iterations"),
        make_record("a", "classic", 5),
    ]
    end = solver(summarize(records), "x").targets["converged"]
    assert (end.reached, end.iterations_capped) == (0, pytest.approx(100.0))
    assert math.isnan(end.iterations)
    assert math.isnan(end.seconds)


def test_geometric_mean_of_special_values():
    assert geometric_mean([1.0, 100.0]) == pytest.approx(10.0)
    assert math.isnan(geometric_mean([]))
    assert geometric_mean([0.0, 4.0]) == 0.0
    assert geometric_mean([0.0, 4.0], floor=1.0) == pytest.approx(2.0)
    assert geometric_mean([1.0, math.inf]) == math.inf


def test_formatting_of_numbers():
    assert [number(x) for x in (math.nan, math.inf, 0.0, 1234.4, 0.012345, 12.345)] == [
        "-", "∞", "0", "1234", "0.0123", "12.3",
    ]  # fmt: skip


def test_failed_write_keeps_the_old_file_and_leaves_nothing_behind(tmp_path):
    path = tmp_path / "x.txt"
    write_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "\ud800")
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def printed(summary):
    stream = io.StringIO()
    print_summary(summary, Console(file=stream, width=100))
    return stream.getvalue()


def test_what_is_printed_holds_every_solver_under_its_own_name(records):
    odd = make_record("a|[b]", "p|[red]*", 3)
    summary = summarize([*records, odd])
    assert "\n p|[red]* " in printed(summary)
    assert re.search(r"\n learned +53.2 +16 +1/4 +20 +2/4 +4 +9\.0", printed(summary))


def test_no_records_make_an_empty_summary():
    summary = summarize([])
    assert summary.solvers == []
    assert "converged" in printed(summary)
