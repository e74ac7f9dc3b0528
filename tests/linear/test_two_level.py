"""Preconditioners of the reduced camera system against the same matrices made densely.

The truth is `S = B + D_c - E^T (C + D_p)^-1 E` from the dense Jacobian of `support.linear`, which
shares no code with jaxba's. Only the modes P are taken from jaxba, and those are held against what
a similarity does to the residuals."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from jaxba import BundleProblem, Loss, StepOptions, build_layout, initial_state
from jaxba.linear.preconditioners import diagonal_blocks, preconditioner
from jaxba.linear.schur import DampedSystem
from jaxba.linear.two_level import SIMILARITY, camera_modes, cluster_sum, coarse_system
from jaxba.model.linearize import linearize
from jaxba.problem.options import ConjugateGradients, Coordinates
from jaxba.runtime.compilation import compiler_options
from jaxba.structure import camera_clusters

MODES = SIMILARITY + 3

MANIFOLD = StepOptions(linear_solver="implicit", coordinates=Coordinates(rotation="manifold"))
IDENTITY = Coordinates(rotation="manifold", scaling="identity")


def whitened(problem: BundleProblem) -> BundleProblem:
    """The problem with another covariance for every observation."""
    root = np.random.default_rng(3).normal(size=(problem.num_observations, 2, 2))
    return problem.replace(whitening=root + 1.5 * np.eye(2))


def part(problem: BundleProblem, cameras: int, points: int) -> BundleProblem:
    """The first cameras and points."""
    kept = (problem.camera_index < cameras) & (problem.point_index < points)
    return BundleProblem.create(
        problem.cameras[:cameras],
        problem.points[:points],
        problem.observations[kept],
        problem.camera_index[kept],
        problem.point_index[kept],
    )


# cameras a cluster, problem, options, lambda
CASES = {
    "three-clusters": (2, support.tiny, replace(MANIFOLD, coordinates=IDENTITY), 1000.0),
    "unseen-camera": (
        2,
        lambda: whitened(support.odd()),
        replace(MANIFOLD, loss=Loss("huber", 1.7)),
        0.1,
    ),
    "more-clusters-than-points": (1, lambda: part(support.paper(0), 5, 2), MANIFOLD, 0.1),
    "two-cameras": (8, lambda: part(support.tiny(), 2, 40), MANIFOLD, 0.1),
    "single": (8, support.single, MANIFOLD, 0.1),
}


@dataclass(frozen=True)
class Found:
    """What jaxba makes of a problem; matrices dense, unknowns of a camera or a cluster together."""

    label: np.ndarray
    modes: np.ndarray  # [cameras, 9, MODES]
    coarse_system: np.ndarray  # only its lower triangle
    two_level: np.ndarray
    blocks: np.ndarray  # [cameras, 9, 9]

    @property
    def fine(self) -> np.ndarray:
        """The inverse of the block diagonal."""
        return np.asarray(block_diag(*np.linalg.inv(self.blocks)))


@dataclass(frozen=True)
class Case:
    problem: BundleProblem
    schur: np.ndarray  # S, the truth; a unit block for cameras that nobody uses
    found: Found

    @property
    def prolongation(self) -> np.ndarray:
        """P: the modes of each camera in the columns of its cluster."""
        label = self.found.label
        modes = self.found.modes
        dense = np.zeros((len(label), 9, label.max() + 1, MODES))
        dense[np.arange(len(label)), :, label] = modes
        return dense.reshape(9 * len(label), -1)


# without LLVM's optimisations, which would take half of this file's time: the programs are run once
# or twice
@functools.partial(
    jax.jit, static_argnames=("options",), compiler_options=compiler_options("quick")
)
def everything(layout, problem, damping, more, options: StepOptions):
    """Modes, coarse system, two-level preconditioner and diagonal blocks, with `more` added to the
    camera blocks."""
    state = initial_state(layout, problem, options, jnp.float64)
    linear = linearize(layout, state.cameras, state.points, options.loss)
    system = DampedSystem.of(layout, linear, state.cameras, state.points, damping, options)
    system = system._replace(cameras=system.cameras._replace(blocks=system.cameras.blocks + more))
    modes = camera_modes(layout, state.cameras, 9)
    rule = options.conjugate_gradients.preconditioner
    apply = preconditioner(system, None, rule)
    unit = jnp.eye(9 * layout.num_cameras).reshape(-1, layout.num_cameras, 9)
    return (
        modes,
        coarse_system(system, modes),
        jax.vmap(apply)(unit).reshape(len(unit), -1).T,
        diagonal_blocks(system),
    )


def dense_schur(problem: BundleProblem, options: StepOptions, damping: float) -> np.ndarray:
    _, jacobian = support.linear(problem, options)
    square = jacobian.T @ jacobian
    diagonal = np.diagonal(square)
    clamped = (
        np.clip(diagonal, 1e-6, 1e32)
        if options.coordinates.scaling == "diagonal"
        else np.ones_like(diagonal)
    )
    square = square + np.diag(damping * clamped)
    n = 9 * problem.num_cameras
    schur = square[:n, :n] - square[:n, n:] @ np.linalg.solve(square[n:, n:], square[n:, :n])
    unseen = np.repeat(np.bincount(problem.camera_index, minlength=problem.num_cameras) == 0, 9)
    schur[unseen, unseen] = 1.0
    return schur


@functools.cache
def make(name: str, more: float = 0.0) -> Case:
    """A case, with a matrix that has two eigenvalues `-more` added to the lens of every camera
    block."""
    cluster_cameras, problem, options, damping = CASES[name]
    problem = problem()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_clusters, "CLUSTER_CAMERAS", cluster_cameras)
        layout = build_layout(problem, options)
    assert layout.clusters is not None
    added = np.zeros((problem.num_cameras, 9, 9))
    added[:, 6:, 6:] = more * (2 - np.eye(3))
    found = everything(layout, problem, jnp.asarray(damping), added, options)
    label = np.asarray(layout.clusters.label)
    return Case(
        problem,
        dense_schur(problem, options, damping),
        Found(label, *(np.asarray(x) for x in found)),
    )


@pytest.fixture(params=CASES)
def case(request) -> Case:
    return make(request.param)


@pytest.mark.slow
def test_the_cases_have_the_clusters_that_they_are_named_after():
    def count(name):
        return make(name).found.label.max() + 1

    names = ("three-clusters", "unseen-camera", "two-cameras", "single")
    assert [count(name) for name in names] == [3, 4, 1, 1]
    assert (
        count("more-clusters-than-points")
        == 5
        > make("more-clusters-than-points").problem.num_points
        == 2
    )


# Modes


@pytest.mark.parametrize("name", ["three-clusters", "unseen-camera", "single"])
@pytest.mark.parametrize("mode", range(7))
def test_no_residual_changes_where_cameras_and_points_follow_one_similarity(name, mode):
    """Central differences; the points move by the similarity itself, the cameras along the mode."""
    problem = make(name).problem
    modes = make(name).found.modes[:, :, mode]
    along = np.eye(7)[mode]
    size = 1e-4

    def residual(by: float, points_too: bool = True) -> np.ndarray:
        turn, shift, growth = np.split(by * along, [3, 6])
        points = (1 + growth) * (Rotation.from_rotvec(turn).apply(problem.points) + shift)
        change = np.concatenate([by * modes.ravel(), np.zeros(problem.points.size)])
        there = support.moved(problem, MANIFOLD, change)
        return support.linear(there.replace(points=points) if points_too else there, MANIFOLD)[0]

    slope = (residual(size) - residual(-size)) / (2 * size)
    alone = (residual(size, False) - residual(-size, False)) / (2 * size)
    assert np.abs(alone).max() > 1
    assert np.abs(slope).max() <= 1e-6 * np.abs(alone).max()


def test_the_last_three_modes_are_the_lens_and_unseen_cameras_have_none():
    case = make("unseen-camera")
    modes = case.found.modes
    seen = np.bincount(case.problem.camera_index, minlength=8) > 0
    assert list(np.flatnonzero(~seen)) == [6]
    assert np.array_equal(modes[seen][:, :, 7:], np.broadcast_to(np.eye(9)[:, 6:], (7, 9, 3)))
    assert not modes[~seen].any()
    assert all(np.linalg.matrix_rank(mode) == 9 for mode in modes[seen])


# The coarse system


def test_the_coarse_system_is_the_reduced_camera_system_between_the_modes(case):
    expected = case.prolongation.T @ case.schur @ case.prolongation
    size = np.sqrt(np.diagonal(expected))  # entries in pixels of very different units
    size = np.where(size > 0, size, 1)
    error = (case.found.coarse_system - expected) / np.outer(size, size)
    block = np.arange(len(error)) // MODES
    assert np.abs(error[block[:, None] >= block]).max() <= 1e-9
    assert np.abs(expected).max() > 0
    assert not case.found.coarse_system[block[:, None] < block].any()


def test_clusters_sum_their_cameras():
    problem = support.odd()
    layout = build_layout(problem, MANIFOLD)
    assert layout.clusters is not None
    rows = np.random.default_rng(0).normal(size=(problem.num_cameras, 4))
    expected = np.zeros((len(layout.clusters.members), 4))
    np.add.at(expected, np.asarray(layout.clusters.label), rows)
    np.testing.assert_allclose(
        cluster_sum(layout.clusters, jnp.asarray(rows)), expected, rtol=1e-13, atol=1e-14
    )


def test_a_layout_without_clusters_is_refused():
    problem = support.tiny()
    layout = build_layout(
        problem, replace(MANIFOLD, conjugate_gradients=ConjugateGradients("schur-jacobi"))
    )
    with pytest.raises(ValueError, match="no clusters: build it with the options"):
        everything(layout, problem, jnp.asarray(0.1), np.zeros((6, 9, 9)), MANIFOLD)


# The preconditioners


def scaled(case: Case, matrix: np.ndarray) -> np.ndarray:
    """An approximate inverse of S in coordinates in which the diagonal of S is one."""
    size = np.sqrt(np.diagonal(case.schur))
    return matrix * np.outer(size, size)


def test_the_two_level_preconditioner_is_symmetric_and_positive_definite(case):
    matrix = scaled(case, case.found.two_level)
    assert np.abs(matrix - matrix.T).max() <= 1e-10 * np.abs(matrix).max()
    assert np.linalg.eigvalsh(matrix).min() > 0


def test_the_coarse_level_solves_for_every_motion_of_whole_clusters(case):
    """`P (P^T S P)^-1 P^T S P = P`, also where the modes of a cluster of one camera depend on each
    other."""
    p = case.prolongation
    size = np.sqrt(np.diagonal(case.schur))[:, None]
    unit = np.linalg.norm(p * size, axis=0)
    unit = np.where(unit > 0, unit, 1)
    found = (case.found.two_level - case.found.fine) @ case.schur @ p
    assert np.abs((found - p) * size / unit).max() <= 1e-8
    assert np.linalg.norm(p) > 0


def test_the_coarse_level_answers_with_motions_of_whole_clusters_only(case):
    """Its range is that of P: nine directions a cluster of one camera, ten a larger one, none
    without a camera seen."""
    seen = np.bincount(case.problem.camera_index, minlength=case.problem.num_cameras) > 0
    members = np.bincount(case.found.label, seen)
    rank = int(np.sum(np.minimum(9 * members, MODES)))
    coarse = scaled(case, case.found.two_level - case.found.fine)
    values = np.linalg.eigvalsh(coarse)
    assert values[0] >= -1e-10 * values[-1]
    assert np.count_nonzero(values > 1e-9 * values[-1]) == rank
    p = np.sqrt(np.diagonal(case.schur))[:, None] * case.prolongation
    outside = np.eye(len(p)) - p @ np.linalg.pinv(p, rcond=1e-12)
    assert np.abs(outside @ coarse).max() <= 1e-8 * values[-1]


@pytest.mark.parametrize("more", [1e12, np.nan])
def test_a_coarse_system_that_cannot_be_factored_is_left_out(more):
    """It is indefinite although its diagonal is positive, or no number."""
    found = make("two-cameras", more).found
    lower = np.tril(found.coarse_system)
    if np.isfinite(more):
        assert np.diagonal(lower).min() > 0 > np.linalg.eigvalsh(lower + np.tril(lower, -1).T)[0]
    np.testing.assert_allclose(
        found.two_level, found.fine, rtol=1e-8, atol=1e-12 * np.abs(found.fine).max()
    )


@pytest.mark.parametrize("name", [name for name in CASES if name != "unseen-camera"])
def test_diagonal_blocks_are_those_of_the_reduced_camera_system(name):
    """Where no camera sees a point twice."""
    case = make(name)
    pairs = case.problem.camera_index * case.problem.num_points + case.problem.point_index
    assert len(np.unique(pairs)) == len(pairs)
    for number, block in enumerate(case.found.blocks):
        at = slice(9 * number, 9 * number + 9)
        size = np.sqrt(np.diagonal(case.schur)[at])
        assert (np.abs(block - case.schur[at, at]) / np.outer(size, size)).max() <= 1e-10


def test_diagonal_blocks_leave_out_only_what_a_point_seen_twice_by_one_camera_adds():
    """Cameras that see all their points once have exact blocks, beside others that do not; an
    unseen one a unit."""
    case = make("unseen-camera")
    problem = case.problem
    pairs, counts = np.unique(
        problem.camera_index * problem.num_points + problem.point_index, return_counts=True
    )
    double = set((pairs[counts > 1] // problem.num_points).tolist())
    assert double
    assert np.array_equal(case.found.blocks[6], np.eye(9))
    for number, block in enumerate(case.found.blocks):
        at = slice(9 * number, 9 * number + 9)
        size = np.sqrt(np.diagonal(case.schur)[at])
        error = (np.abs(block - case.schur[at, at]) / np.outer(size, size)).max()
        assert error > 1e-6 if number in double else error <= 1e-10
        assert np.linalg.eigvalsh(block)[0] > 0
