"""Many problems at once end as each alone, in order, whatever becomes of the others."""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxba
from jaxba import Loss, ProblemError, SolveOptions, solve_many
from jaxba.lm.termination import Tolerances
from jaxba.problem import geometry
from jaxba.problem.intrinsics import Lenses
from jaxba.problem.rigs import Rigs
from jaxba.runtime.numerics import numerics
from jaxba.solver import many
from jaxba.solver.lanes import Starts, solve_rows
from jaxba.solver.prepare import set_up
from jaxba.structure import cells
from jaxba.structure.cells import NO_CELL, Sizes, cell_for, choose_cells, work

QUICK = SolveOptions(compilation="quick", max_iterations=12, pad=True)


def scene(cameras: int, points: int, seed: int):
    """A random scene of that size."""
    size = {"cameras": cameras, "points": points, "observations": 0, "mean_track": 3.0}
    return jaxba.random_scene(replace(jaxba.scene_like("tiny"), **size), seed)


def mixed(count: int) -> list:
    """Scenes of different sizes."""
    rng = np.random.default_rng(count)
    return [scene(int(rng.integers(4, 9)), int(rng.integers(20, 60)), k) for k in range(count)]


@pytest.fixture
def small(monkeypatch):
    """Few problems are worth a program."""
    monkeypatch.setattr(many, "WORTH", 3)
    monkeypatch.setattr(many, "BANK", 4)
    monkeypatch.setattr(many, "SEEN", 6)
    monkeypatch.setattr(many, "SEEN_S", np.inf)  # whatever the clock says


def assert_as_alone(found, problems, policy, options):
    alone = [jaxba.solve(problem, policy, options) for problem in problems]
    assert [one.iterations for one in found] == [one.iterations for one in alone]
    assert [one.termination for one in found] == [one.termination for one in alone]
    np.testing.assert_allclose(
        [x.final_cost for x in found], [x.final_cost for x in alone], rtol=1e-8
    )
    for one, other in zip(found, alone, strict=True):
        np.testing.assert_allclose(one.problem.cameras, other.problem.cameras, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(one.problem.points, other.problem.points, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(one.history.damping, other.history.damping, rtol=1e-6)


def test_problems_of_many_sizes_end_as_each_alone_in_order(small):
    problems = mixed(11)
    found = list(solve_many(iter(problems), "ceres", QUICK))
    assert_as_alone(found, problems, "ceres", QUICK)
    assert sum(one.capacity.fixed for one in found) >= many.SEEN  # two at the end may fit no cell


def test_one_that_cannot_be_solved_says_why_and_touches_no_other(small):
    problems = mixed(9)
    broken = problems[0].replace(points=np.full_like(problems[0].points, np.inf))
    found = list(
        solve_many(
            [problems[0], broken, *problems[1:4], OSError("no problem"), *problems[4:]],
            "ceres",
            QUICK,
        )
    )
    with pytest.raises(ProblemError) as alone:
        jaxba.solve(broken, "ceres", QUICK)
    assert isinstance(found[1], ProblemError)
    assert str(found[1]) == str(alone.value)
    assert str(found[5]) == "no problem"  # as a reader of files may say
    good = [one for one in found if isinstance(one, jaxba.Solution)]
    assert_as_alone(good, problems, "ceres", QUICK)


def general() -> dict:
    """Problems with what cannot be padded, or with other residuals, four of each kind."""
    scenes = [scene(5, 30 + 3 * k, k) for k in range(4)]

    def shared(p):
        return p.replace(lenses=Lenses(np.zeros(p.num_cameras, np.int32), np.ones((1, 3), bool)))

    def held(p):
        return jaxba.hold(p, poses=[0], points=[1, 2])

    def placed(p):
        return jaxba.with_position_priors(
            p,
            -np.einsum(
                "cji,cj->ci",
                support.Rotation.from_rotvec(p.cameras[:, :3]).as_matrix(),
                p.cameras[:, 3:6],
            ),
            stddev=0.1,
            align=False,
        )

    return {
        "shared lens": list(map(shared, scenes)),
        "constants": list(map(held, scenes)),
        "priors": list(map(placed, scenes)),
        "rigs": list(map(in_pairs, scenes)),
    }


def in_pairs(problem):
    """The problem with its first two cameras in one frame, where they are."""
    matrices = geometry.rotation_matrices(problem.cameras[:, :3])
    shifts = np.array(problem.cameras[:, 3:6])
    rotation = np.tile(np.eye(3), (problem.num_cameras, 1, 1))
    translation = np.zeros((problem.num_cameras, 3))
    rotation[1] = matrices[1] @ matrices[0].T
    translation[1] = shifts[1] - rotation[1] @ shifts[0]
    frame = np.maximum(np.arange(problem.num_cameras) - 1, 0).astype(np.int32)
    return problem.replace(rigs=Rigs(frame, rotation, translation))


@pytest.mark.slow  # a fast one, with constants: test_every_way.py
@pytest.mark.parametrize("kind", ["shared lens", "constants", "priors", "rigs"])
def test_what_a_problem_may_hold_it_may_hold_among_many(small, kind):
    problems = general()[kind]
    options = replace(QUICK, loss=Loss("huber", 1.0))
    found = list(solve_many(problems, "ceres", options))
    assert_as_alone(found, problems, "ceres", options)
    assert all(one.capacity.fixed for one in found[1:])


def test_an_endless_stream_is_read_no_further_than_it_must_be(small, monkeypatch):
    monkeypatch.setattr(many, "AHEAD", 10)
    read = itertools.count()
    every = mixed(5)
    stream = (every[next(read) % 5] for _ in itertools.count())
    results = solve_many(stream, "ceres", QUICK)
    assert isinstance(next(results), jaxba.Solution)
    assert next(read) == 1
    for taken in range(2, 40):
        assert isinstance(next(results), jaxba.Solution)
        assert next(read) <= 2 * taken + 12  # each look at the counter counts
    results.close()


def test_a_program_that_fails_ends_nothing_but_its_problems(small, monkeypatch):
    def fail(*_):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(many._Program, "run", fail)
    first, *others = solve_many(mixed(8), "ceres", QUICK)
    assert isinstance(first, jaxba.Solution)
    assert sum(str(one) == "out of memory" for one in others) >= many.SEEN


@pytest.mark.slow
def test_other_linear_solvers_solve_one_by_one(small):
    problems = mixed(2)
    options = SolveOptions(linear_solver="implicit", max_iterations=4, compilation="quick")
    found = list(solve_many(problems, "ceres", options))
    assert {one.linear_solver for one in found} == {"implicit"}
    assert_as_alone(found, problems, "ceres", options)


def test_bad_options_are_refused_before_the_first_result():
    with pytest.raises(ValueError, match="nosuch"):
        solve_many([], "nosuch")
    assert list(solve_many([])) == []


@pytest.mark.slow
def test_lanes_that_are_refilled_end_as_one_problem_after_the_other():
    sizes = [Sizes.of(problem) for problem in mixed(7)]
    capacity = choose_cells(sizes, 1.0)[0].capacity
    with numerics("float64"):
        setups = [set_up(problem, "ceres", QUICK, capacity=capacity) for problem in mixed(7)]
        rows = [Starts(one.layout, *one.start) for one in setups]
        starts = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        run = jax.jit(solve_rows, static_argnames=("options", "length", "lanes"))
        given = (
            starts,
            setups[0].policy,
            Tolerances(),
            np.int32(12),
            np.int32(6),
            setups[0].options,
            16,
        )
        one, several = (run(*given, lanes=lanes) for lanes in (1, 3))
    np.testing.assert_array_equal(one.iterations[:6], several.iterations[:6])
    np.testing.assert_array_equal(one.termination[:6], several.termination[:6])
    np.testing.assert_allclose(one.state.cost[:6], several.state.cost[:6], rtol=1e-9)
    np.testing.assert_allclose(one.initial_cost[:6], several.initial_cost[:6], rtol=1e-12)
    for first, second in zip(one.history, several.history, strict=True):
        assert first.shape == second.shape
    np.testing.assert_allclose(one.history.cost[:6], several.history.cost[:6], rtol=1e-9)


SIZES = st.builds(
    Sizes,
    st.integers(2, 40),
    st.integers(10, 400),
    st.integers(10, 2000).map(lambda n: 2 * n),
    st.integers(10, 20_000),
    st.sampled_from([0, 0, 7]),
)


@given(st.lists(SIZES, min_size=1, max_size=9), st.floats(1, 1e4))
@settings(deadline=None)
def test_every_problem_fits_its_cell_and_no_division_in_order_takes_less_time(seen, times):
    chosen = choose_cells(seen, times)
    placed = [cell_for(sizes, chosen) for sizes in seen]
    assert all(sizes.fits(cell) for sizes, cell in zip(seen, placed, strict=True))

    def time(rows):
        return work(np.array([cell[:4] for cell in rows])).sum() * times * cells.ITERATIONS

    for kind in {sizes.exactly for sizes in seen}:
        own = [sizes for sizes in seen if sizes.exactly == kind]
        mine = [cell for cell in chosen if cell.exactly == kind]
        predicted = time([cell_for(sizes, mine) for sizes in own]) + cells.COMPILE_S * len(mine)
        alone = choose_cells(own[:1], times)
        assert len(alone) == 1
        largest = np.max(
            [-(-np.array(sizes[:4]) // cells.ROUNDED) * cells.ROUNDED for sizes in own], axis=0
        )
        together = Sizes(*map(int, largest), kind)
        assert predicted <= time([together] * len(own)) + cells.COMPILE_S + 1e-9


def test_a_problem_too_large_for_all_cells_has_none():
    assert cell_for(Sizes(9, 9, 9, 9, 0), [Sizes(8, 9, 10, 9, 0), Sizes(9, 9, 10, 9, 9)]) == NO_CELL
    assert choose_cells([Sizes(1000, 9, 10, 9, 0)], 1.0) == []
