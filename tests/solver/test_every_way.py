"""A problem with rows of any residual ends in the same way however it is solved: alone, among many,
padded, in parts, on several devices, and from a checkpoint."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
import row_examples
from row_examples import OWN, READY_MADE

import jaxba
from jaxba import BundleProblem, Solution, SolveOptions, solve_many
from jaxba.lm.termination import Tolerances
from jaxba.problem.options import ConjugateGradients
from jaxba.problem.preprocess import shift
from jaxba.runtime.numerics import numerics
from jaxba.solver import checkpoint, many, sharded
from jaxba.solver.lanes import Starts, solve_rows
from jaxba.solver.prepare import set_up
from jaxba.structure.cells import Sizes

OPTIONS = SolveOptions(compilation="quick", max_iterations=4)
EXACT = ConjugateGradients(forcing=0.0, tolerance=1e-12)
"""To the solution of the linear system: steps that stop before it differ by up to 1e-5 with the
order of sums."""

DEVICES = 3  # of the tests (conftest.py)
ALIKE = 1e-9  # largest relative difference of costs


@pytest.fixture
def small(monkeypatch):
    """Few problems are worth a program."""
    monkeypatch.setattr(many, "WORTH", 2)
    monkeypatch.setattr(many, "BANK", 4)


@pytest.fixture
def in_parts(monkeypatch):
    """A device computes small problems in parts."""
    monkeypatch.setattr(sharded, "LARGE", 1)
    monkeypatch.setattr(sharded, "PART", row_examples.CAMERAS * row_examples.POINTS // 3)
    monkeypatch.setattr(sharded, "PART_OF_CAMERA", 0)


def problems_of(names: list[str], count: int) -> list[BundleProblem]:
    """Problems of one shape with other scenes and other data."""
    return [
        row_examples.with_rows_of(row_examples.scene(seed), names, seed) for seed in range(count)
    ]


def assert_alike(found: Solution, alone: Solution) -> None:
    """That two solutions have the same costs and unknowns, to rounding."""
    assert found.termination == alone.termination
    np.testing.assert_allclose(found.initial_cost, alone.initial_cost, rtol=ALIKE)
    np.testing.assert_allclose(found.history.cost, alone.history.cost, rtol=ALIKE)
    ours = found.problem
    theirs = alone.problem
    np.testing.assert_allclose(ours.cameras, theirs.cameras, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(ours.points, theirs.points, rtol=1e-6, atol=1e-7)
    for block, other in zip(ours.residuals.blocks, theirs.residuals.blocks, strict=True):
        np.testing.assert_allclose(block, other, rtol=1e-6, atol=1e-8)


def assert_as_alone(problems: list[BundleProblem], policy: str) -> None:
    """That problems end among many as each alone."""
    alone = [jaxba.solve(problem, policy, OPTIONS) for problem in problems]
    first, *others = solve_many(problems, policy, OPTIONS)
    assert_alike(first, alone[0])
    for found, other in zip(others, alone[1:], strict=True):
        assert_alike(found, other)
        assert found.capacity.fixed


@pytest.mark.slow("another file has a sample of it")
def test_rows_and_constants_of_each_of_many_problems_are_its_own(small):
    problems = problems_of(["distance", "baseline"], 4)
    assert_as_alone([jaxba.hold(problem, poses=[0]) for problem in problems], "ceres")


@pytest.mark.slow
@pytest.mark.parametrize("name", [*READY_MADE, OWN])
def test_rows_of_any_residual_are_solved_among_many_as_alone(name, small):
    assert_as_alone(problems_of([name], 7 if name == OWN else 4), "ceres")


@pytest.mark.slow
def test_rows_of_scenes_in_map_coordinates_are_each_in_its_own_frame(small):
    """These are solved near the origin, from which each was moved by another way."""
    near = problems_of(["control_point", "position"], 4)
    assert_as_alone(
        [shift(one, np.array([4e3 * (1 + k), -5e3, 300.0])) for k, one in enumerate(near)], "ceres"
    )


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["guarded", "ceres+embedded", "nielsen+refine2"])
def test_rows_are_solved_among_many_as_alone_by_any_policy(policy, small):
    assert_as_alone(problems_of(["control_point", "baseline"], 4), policy)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*READY_MADE, OWN])
def test_rows_of_any_residual_end_the_same_on_several_lanes(name):
    """As on a GPU, where lanes are batched."""
    problems = problems_of([name], 9)

    def function(problem):
        return problem.residuals.rows[0].residual

    kept = [problem for problem in problems if function(problem) == function(problems[0])]
    sizes = [Sizes.of(set_up(problem, "ceres", OPTIONS).placed.here) for problem in kept]
    cell = Sizes(*np.max([one[:4] for one in sizes], axis=0).tolist(), 0)
    with numerics("float64"):
        setups = [set_up(problem, "ceres", OPTIONS, capacity=cell.capacity) for problem in kept]
        starts = jax.tree.map(
            lambda *leaves: np.stack(leaves), *[Starts(one.layout, *one.start) for one in setups]
        )
        run = jax.jit(solve_rows, static_argnames=("options", "length", "lanes"))
        count = len(kept)
        given = (
            starts,
            setups[0].policy,
            Tolerances(),
            np.int32(4),
            np.int32(count),
            setups[0].options,
            4,
        )
        one, several = (run(*given, lanes=lanes) for lanes in (1, 2))
    np.testing.assert_allclose(several.initial_cost, one.initial_cost, rtol=ALIKE)
    np.testing.assert_allclose(several.history.cost, one.history.cost, rtol=ALIKE)


@pytest.mark.slow
@pytest.mark.parametrize("linear_solver", ["explicit", "implicit"])
@pytest.mark.parametrize("name", [*READY_MADE, OWN])
def test_rows_of_any_residual_are_solved_on_several_devices_as_on_one(name, linear_solver):
    (problem,) = problems_of([name], 1)
    options = replace(OPTIONS, linear_solver=linear_solver, conjugate_gradients=EXACT)
    several = jaxba.solve(problem, "ceres", replace(options, devices=DEVICES))
    assert_alike(several, jaxba.solve(problem, "ceres", options))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*READY_MADE, OWN])
def test_rows_of_any_residual_are_solved_in_parts_as_whole(name, monkeypatch, request):
    (problem,) = problems_of([name], 1)
    options = replace(OPTIONS, linear_solver="implicit", conjugate_gradients=EXACT)
    whole = jaxba.solve(problem, "ceres", options)
    request.getfixturevalue("in_parts")
    shards = set_up(problem, "ceres", options, in_parts=True).shards
    assert shards is not None
    assert shards.in_parts
    assert_alike(jaxba.solve(problem, "ceres", options), whole)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*READY_MADE, OWN])
def test_a_solve_with_rows_of_any_residual_goes_on_from_a_checkpoint(name, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "EVERY_S", 0.0)
    (problem,) = problems_of([name], 1)
    file = tmp_path / "solve.npz"
    jaxba.solve(problem, "ceres", replace(OPTIONS, max_iterations=2), checkpoint=file)
    found = jaxba.solve(problem, "ceres", OPTIONS, checkpoint=file)
    assert_alike(found, jaxba.solve(problem, "ceres", OPTIONS))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*READY_MADE, OWN])
def test_asking_for_padding_changes_nothing(name):
    (problem,) = problems_of([name], 1)
    padded = jaxba.solve(problem, "ceres", replace(OPTIONS, pad=True))
    assert_alike(padded, jaxba.solve(problem, "ceres", replace(OPTIONS, pad=False)))
