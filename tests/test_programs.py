"""Quickly compiled programs: they compute the same, give way to optimised ones, and can be switched off."""

from __future__ import annotations

import importlib

import jax
import numpy as np
import pytest
import support

from jaxba import StepOptions, Termination, programs, solve, solve_and_retriangulate
from jaxba.cli.solve import run
from jaxba.io import write_problem
from jaxba.programs import FEWEST, REPAID, program, quick_iterations, quick_options

on_a_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="only a CPU has a quick way")


def test_many_observations_are_compiled_with_all_optimisation_at_once():
    sizes = [1, 100, 31_843, REPAID // FEWEST, REPAID // FEWEST + 1, 10**7]
    counts = [quick_iterations(size) for size in sizes]
    assert counts == sorted(counts, reverse=True)
    assert all(count == 0 or count >= FEWEST for count in counts)
    assert all(count * size <= REPAID for count, size in zip(counts, sizes, strict=True))
    assert counts[-2:] == [0, 0]
    assert counts[2] > 60, "Ladybug-49 converges before that"


@on_a_cpu
def test_this_jaxlib_knows_the_quick_way():
    assert quick_options() == programs.QUICK


@pytest.mark.parametrize(
    "how",
    [
        {"damping": "ceres"},
        {"damping": "learned"},
        {"damping": "learned", "method": "stba"},
        {"damping": "learned", "method": "ddlm"},
        {"damping": "learned", "method": "deeplm"},
        {"damping": "learned", "linear_solver": "sparse"},
        {"damping": "learned", "linear_solver": "implicit"},
        {"damping": "ceres", "method": "poba"},
        {"damping": "learned", "pad": True},
    ],
    ids=str,
)
def test_a_quickly_compiled_solve_is_the_same_solve(how):
    full = solve(support.tiny(), **how, max_iterations=8, callback=lambda record: None)
    quick = solve(support.tiny(), **how, max_iterations=8, compilation="quick")
    assert full.quick_iterations == 0
    assert quick.quick_iterations == (quick.iterations if quick_options() else 0)
    assert (quick.iterations, quick.accepted, quick.termination) == (full.iterations, full.accepted, full.termination)
    np.testing.assert_allclose(quick.history.cost, full.history.cost, rtol=1e-8)
    # a network of, among others, the last digits of a decrease
    np.testing.assert_allclose(quick.history.damping, full.history.damping, rtol=1e-4)


@on_a_cpu
@pytest.mark.parametrize("watched", [True, False])
def test_the_optimised_program_takes_over_without_a_trace(watched, monkeypatch):
    full = solve(support.tiny(), "ceres")
    assert full.iterations > 2
    monkeypatch.setattr(importlib.import_module("jaxba.solve"), "quick_iterations", lambda observations: 2)
    records = []
    callback = records.append if watched else None
    mixed = solve(support.tiny(), "ceres", compilation="auto", callback=callback)
    assert mixed.quick_iterations == 2
    assert (mixed.iterations, mixed.termination) == (full.iterations, full.termination)
    np.testing.assert_allclose(mixed.history.cost, full.history.cost, rtol=1e-8)
    if watched:
        assert [r.iteration for r in records] == list(range(1, mixed.iterations + 1))
        times = [r.time_s for r in records]
        assert times == sorted(times)
        assert times[-1] <= mixed.total_s


@on_a_cpu
def test_a_second_quick_solve_compiles_nothing_and_the_whole_step_is_compiled_once_each_way():
    solve(support.paper(0), "ceres", max_iterations=2, compilation="quick")
    steps = [program(importlib.import_module("jaxba.lm").lm_step, "options", quick=quick) for quick in (True, False)]
    assert steps[0] is not steps[1]
    before = [step._cache_size() for step in steps]
    again = solve(support.paper(1), "classic", max_iterations=3, compilation="quick")
    assert [step._cache_size() for step in steps] == before
    assert again.compile_s < 1


def test_a_callback_stops_a_quick_solve():
    stopped = solve(support.tiny(), "ceres", compilation="quick", callback=lambda record: record.iteration == 2)
    assert stopped.termination == Termination.STOPPED
    assert stopped.iterations == 2


@on_a_cpu
def test_iterations_of_solves_in_turns_are_added():
    turns = solve_and_retriangulate(support.tiny(), "ceres", StepOptions(refine_points=3), compilation="quick")
    assert turns.quick_iterations == turns.iterations


def test_where_the_options_are_unknown_programs_are_optimised(monkeypatch):
    monkeypatch.setattr(programs, "QUICK", {"xla_no_such_option": True})
    assert quick_options.__wrapped__() is None


def test_an_unknown_way_is_refused_in_one_line(unchecked):
    with pytest.raises(ValueError, match="compilation must be one of full, quick, auto, not 'fast'"):
        solve(support.tiny(), compilation="fast")


@on_a_cpu
def test_the_command_says_where_iterations_were_slow_by_design(tmp_path, capsys, monkeypatch):
    path = tmp_path / "tiny.txt"
    write_problem(support.tiny(), path)
    fast = [str(path), "--max-iterations", "3", "--damping", "ceres", "--ftol", "0"]
    assert run(fast) == 0
    assert " (all by a quickly compiled program, see --compilation)\n" in capsys.readouterr().out
    assert run([*fast, "--compilation", "full"]) == 0
    assert "quickly" not in capsys.readouterr().out
    monkeypatch.setattr(importlib.import_module("jaxba.solve"), "quick_iterations", lambda observations: 1)
    assert run(fast) == 0
    assert " (1 of them by a quickly compiled program, see --compilation)\n" in capsys.readouterr().out
