"""Programs compiled at lower levels: they compute the same, are replaced by optimised ones, and can
be switched off."""

from __future__ import annotations

import time
from typing import get_args

import chex
import jax
import numpy as np
import pytest
import support
from compilations import Compilations
from support import solve

from jaxba import SceneConfig, SolveOptions, Termination, random_scene, solve_and_retriangulate
from jaxba.cli.solve import run
from jaxba.io import write_problem
from jaxba.lm.step import lm_step, propose, try_step
from jaxba.problem.options import Refinement, StepOptions
from jaxba.runtime.compilation import (
    BREAK_EVEN,
    TYPICAL,
    Kind,
    Level,
    ParallelCompilation,
    Program,
    compiler_options,
    program,
    quick_iterations,
)
from jaxba.runtime.jit import quick_options
from jaxba.solver.stepwise import try_step_by_parts

pytestmark = pytest.mark.step

on_a_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="only a CPU has lower levels")


@pytest.mark.parametrize("kind", get_args(Kind))
def test_more_observations_mean_fewer_quick_iterations(kind):
    even = BREAK_EVEN[kind]
    typical = TYPICAL[kind]
    assert [quick_iterations(kind, count) for count in (1, 100, even // typical)] == [
        even,
        even // 100,
        typical,
    ]
    assert quick_iterations(kind, even // (typical - 1)) == quick_iterations(kind, 10**9) == 0
    assert quick_iterations(kind, 31_843) > 12, "Ladybug-49 converges before that"


@on_a_cpu
def test_this_jaxlib_compiles_at_the_lower_level():
    assert compiler_options("quick")["xla_backend_optimization_level"] == 0
    assert compiler_options("full") == {}


@pytest.mark.fully_compiled
@pytest.mark.parametrize(
    "how",
    [
        {"policy": "ceres"},
        {"policy": "bold", "method": "stba"},
        {"policy": "bold", "linear_solver": "implicit"},
        {"policy": "bold", "pad": True},
    ],
    ids=str,
)
def test_a_solve_compiled_at_level_quick_is_the_same_solve(how):
    full = solve(support.tiny(), **how, max_iterations=8, callback=lambda record: None)
    quick = solve(support.tiny(), **how, max_iterations=8, compilation="quick")
    assert full.quick_iterations == 0
    assert quick.quick_iterations == (quick.iterations if compiler_options("quick") else 0)
    assert (quick.iterations, quick.accepted, quick.termination) == (
        full.iterations,
        full.accepted,
        full.termination,
    )
    np.testing.assert_allclose(quick.history.cost, full.history.cost, rtol=1e-8)
    # Ceres' rule sees the last digits of a decrease
    np.testing.assert_allclose(quick.history.damping, full.history.damping, rtol=1e-4)


@pytest.mark.xla
@pytest.mark.parametrize(
    "how",
    [
        pytest.param({"compilation": "full"}, marks=pytest.mark.slow),
        {"compilation": "quick", "dtype": "float32"},
    ],
    ids=str,
)
def test_every_program_is_compiled_once_before_the_first_iteration(how):
    problem = random_scene(SceneConfig(7, 50, 250), 0)
    late = []
    jax.clear_caches()
    with Compilations() as seen:

        def watch(record):
            return late.append(len(set(seen.names) - {"camera_round"}))

        solved = solve(problem, "bold", **how, max_iterations=4, callback=watch)
    assert solved.iterations == 4
    assert late == [len(set(seen.names) - {"camera_round"})] * 4
    assert {"propose", "take_step", "try_candidate"} <= set(seen.names)
    assert "lm_step" not in seen.names
    assert len(seen.names) == len(set(seen.names))
    assert seen.names.count("_advance_and_pack") == 1


@pytest.mark.fully_compiled
def test_the_two_parts_are_the_step():
    layout, state = support.start(support.tiny())
    options = StepOptions(refinement=Refinement(points=3, camera_rounds=3, trials=4))
    damping = jax.numpy.asarray(1e-6)
    proposal = jax.jit(propose, static_argnums=3)(layout, state, damping, options)
    parts = jax.jit(try_step, static_argnums=4)(layout, state, damping, proposal, options)
    whole = jax.jit(lm_step, static_argnums=3)(layout, state, damping, options)
    assert whole[1].accepted
    chex.assert_trees_all_close(parts, whole, rtol=1e-9, atol=1e-12)  # rounding, divided by lambda


@pytest.mark.slow
@pytest.mark.parametrize("level", ["quick"])
def test_candidates_one_by_one_are_those_of_the_loop(level):
    layout, state = support.start(support.tiny())
    options = StepOptions(
        refinement=Refinement(points=3, camera_rounds=3, trials=4, pattern_moves=1)
    )
    seen = set()
    for damping in (1e-9, 1e-6, 1e-2):
        proposal = propose(layout, state, jax.numpy.asarray(damping), options)
        for length in (1.0, 30.0, -1.0, np.nan):  # a good step, one too long, one uphill and none
            step = proposal.step._replace(
                cameras=length * proposal.step.cameras, points=length * proposal.step.points
            )
            given = (
                layout,
                state,
                jax.numpy.asarray(damping),
                proposal._replace(step=step),
                options,
            )

            def call(function, *arguments):
                return function(*arguments)

            def part(function, *arguments):
                return (
                    program(function, "options", level=level),
                    *arguments,
                )

            parts = try_step_by_parts(call, part, *given, np.asarray(0.0))
            whole = jax.jit(try_step, static_argnums=4)(*given)
            chex.assert_trees_all_close(parts, whole, rtol=1e-7, atol=1e-10)
            seen.add((bool(whole[1].accepted), int(whole[1].repairs) > 0))
    assert {accepted for accepted, _ in seen} == {repaired for _, repaired in seen} == {True, False}


@pytest.mark.slow
@pytest.mark.xla
def test_camera_rounds_are_compiled_where_a_step_has_some():
    jax.clear_caches()
    with Compilations() as seen:
        solved = solve(support.tiny(), "bold", compilation="quick")
        assert "camera_round" not in seen.names
        hard = solve(support.strayed(50.0), "ceres+embedded", compilation="quick")
    assert solved.converged
    assert hard.accepted
    assert seen.names.count("camera_round") == 1


class Failing(Program):
    """A program that cannot be compiled."""

    def __init__(self):
        pass

    def lower(self):
        return self, None

    def compile(self):
        raise RuntimeError("no memory left")


def _compile(functions):
    with ParallelCompilation() as compile_programs:
        for function in functions:
            compile_programs(function)


def test_a_failed_compilation_is_raised_whichever_thread_it_was_in():
    for count in (1, 2, 5):
        with pytest.raises(RuntimeError, match="no memory left"):
            _compile([Failing() for _ in range(count)])


def test_nothing_more_is_compiled_after_an_error():
    def interrupted():  # not by a signal: tests started in the background may ignore it
        raise KeyboardInterrupt

    def slow():  # a program is compiled once, so each is a new one; it only takes its time
        program = Failing()
        program.compile = lambda: compiled.append(time.sleep(0.05))
        return program

    compiled = []
    stop = Failing()
    stop.lower = interrupted
    with pytest.raises(KeyboardInterrupt):
        _compile([*(slow() for _ in range(100)), stop])
    assert len(compiled) < 50


@pytest.mark.fully_compiled
@on_a_cpu
@pytest.mark.parametrize("watched", [True, False])
def test_the_optimised_program_takes_over_and_the_records_go_on(watched, monkeypatch):
    full = solve(support.tiny(), "ceres")
    assert full.iterations > 2
    monkeypatch.setattr("jaxba.solver.stepwise.quick_iterations", lambda kind, _: 2)
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


@pytest.mark.xla
@on_a_cpu
def test_a_second_quick_solve_compiles_nothing_and_each_level_has_its_program():
    assert len({program(propose, "options", level=level) for level in get_args(Level)}) == 2
    solve(support.paper(0), "ceres", max_iterations=3, compilation="quick")
    with Compilations() as seen:
        again = solve(support.paper(1), "ceres", max_iterations=3, compilation="quick")
    assert not seen.names
    assert again.compile_s < 1


def test_a_callback_stops_a_quick_solve():
    stopped = solve(
        support.tiny(), "ceres", compilation="quick", callback=lambda record: record.iteration == 2
    )
    assert stopped.termination == Termination.STOPPED
    assert stopped.iterations == 2


@on_a_cpu
def test_iterations_of_alternating_solves_are_added():
    turns = solve_and_retriangulate(support.tiny(), "ceres", SolveOptions(compilation="quick"))
    assert turns.quick_iterations == turns.iterations


def test_where_the_options_are_unknown_programs_are_optimised(monkeypatch):
    monkeypatch.setattr("jaxba.runtime.jit.QUICK", {"xla_no_such_option": True})
    assert quick_options.__wrapped__() == {}


@on_a_cpu
@pytest.mark.parametrize("unknown_first", [True, False])
def test_an_unknown_option_leaves_those_that_are_known(unknown_first, monkeypatch):
    known = {"xla_backend_optimization_level": 0}
    options = (
        {"xla_no_such_option": True, **known}
        if unknown_first
        else {**known, "xla_no_such_option": True}
    )
    monkeypatch.setattr("jaxba.runtime.jit.QUICK", options)
    assert quick_options.__wrapped__() == known


def test_an_unknown_choice_is_refused_in_one_line(unchecked):
    with pytest.raises(
        ValueError, match="compilation must be one of full, quick, auto, not 'fast'"
    ):
        solve(support.tiny(), compilation="fast")


@pytest.mark.slow
@on_a_cpu
def test_the_command_reports_iterations_of_lower_levels(tmp_path, capsys, monkeypatch):
    path = tmp_path / "tiny.txt"
    write_problem(support.tiny(), path)
    fast = [str(path), "--max-iterations", "3", "--policy", "ceres", "--ftol", "0"]
    assert run(fast) == 0
    assert " (all with quickly compiled programs, see --compilation)\n" in capsys.readouterr().out
    assert run([*fast, "--compilation", "full"]) == 0
    assert "quickly" not in capsys.readouterr().out
    monkeypatch.setattr("jaxba.solver.stepwise.quick_iterations", lambda kind, _: 1)
    assert run(fast) == 0
    assert (
        " (1 of them with quickly compiled programs, see --compilation)\n"
        in capsys.readouterr().out
    )
