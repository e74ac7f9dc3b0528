"""Rigs: the step is that of the dense problem of frames, and cameras of a frame stay where their rig has them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import support
from scipy.spatial.transform import Rotation

from jaxba import (
    BundleProblem,
    Constants,
    Lenses,
    ProblemError,
    Rigs,
    SolveOptions,
    StepOptions,
    covariance,
    hold,
    lm_step,
    normalize,
    solve,
    with_gauge,
    with_position_priors,
)
from jaxba.methods.registry import make_method
from jaxba.problem import geometry
from jaxba.problem.options import ConjugateGradients, Coordinates

FRAME = np.array([0, 1, 0, 2, 1, 3], np.int32)
MANIFOLD = Coordinates(rotation="manifold")
EXACT = ConjugateGradients(forcing=0.0, tolerance=1e-13)


def rigged(shared: bool = True) -> BundleProblem:
    """Six cameras in four frames, two of them of two cameras; the second is turned and moved in its rig."""
    plain, rng = support.tiny(), np.random.default_rng(0)
    matrices = geometry.rotation_matrices(plain.cameras[:, :3])
    cameras, rotation, translation = np.array(plain.cameras), np.tile(np.eye(3), (6, 1, 1)), np.zeros((6, 3))
    rotation[0] = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix()  # also the first may be anywhere
    for second, first in ((2, 0), (4, 1)):
        rotation[second] = matrices[second] @ matrices[first].T @ rotation[first]
        translation[second] = cameras[second, 3:6] - rotation[second] @ rotation[first].T @ cameras[first, 3:6]
    index = np.array([0, 1, 1, 0, 1, 0])
    if shared:
        cameras[:, 6:] = cameras[index, 6:]
    parts = support.arrays(plain)[1:]
    lenses = Lenses(index, np.ones((2, 3), bool)) if shared else None
    problem = BundleProblem.create(cameras, *parts, lenses=lenses, rigs=Rigs(FRAME, rotation, translation))
    pixels = geometry.project(problem) + 0.3 * rng.normal(size=problem.observations.shape)
    return problem.replace(observations=pixels)


def copy_matrix(problem: BundleProblem) -> np.ndarray:
    """T: the steps of all parameters (rotations on the manifold) for unit steps of the unknowns."""
    size, names, columns = 9 * 6 + 3 * problem.num_points, {}, []

    def column(name) -> np.ndarray:
        if name not in names:
            names[name] = len(columns)
            columns.append(np.zeros(size))
        return columns[names[name]]

    for camera in range(6):
        for part in (0, 3):
            for k in range(3):
                rows = slice(9 * camera + part, 9 * camera + part + 3)
                column(("frame", int(FRAME[camera]), part + k))[rows] = problem.rigs.rotation[camera][:, k]
        for k in range(6, 9):
            lens = camera if problem.lenses is None else int(problem.lenses.index[camera])
            column(("lens", lens, k))[9 * camera + k] = 1
    for k in range(54, size):
        column(k)[k] = 1
    return np.array(columns).T


@pytest.mark.parametrize(
    ("solver", "shared"), [("explicit", True), ("explicit", False), ("sparse", False), ("implicit", True)]
)
def test_a_step_is_that_of_the_dense_problem_of_frames(solver, shared):
    problem = rigged(shared)
    options = StepOptions(linear_solver=solver, conjugate_gradients=EXACT, coordinates=MANIFOLD)
    layout, before = support.start(problem, options)
    after, _ = support.step(layout, before, 1e-2, options, min_gain=-np.inf)
    found = support.difference(problem, support.back(problem, before, after), options)
    residual, jacobian = support.linear(problem, options)
    copies = copy_matrix(problem)
    small = jacobian @ copies
    stacked = np.vstack([small, np.diag(np.sqrt(1e-2 * np.clip(np.sum(small**2, axis=0), 1e-6, 1e32)))])
    right = np.concatenate([-residual, np.zeros(small.shape[1])])
    wanted = copies @ np.linalg.lstsq(stacked, right, rcond=None)[0]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7 * np.abs(wanted).max())


@pytest.mark.parametrize("policy", ["ceres", "guarded"])
def test_cameras_of_a_frame_stay_where_their_rig_has_them(policy):
    problem = hold(rigged(), poses=[4])
    after = solve(problem, policy).problem
    parts = (after.cameras, *support.arrays(after)[1:])
    BundleProblem.create(*parts, rigs=after.rigs)  # refuses cameras that are elsewhere
    assert geometry.cost(after) < 0.7 * geometry.cost(problem)
    # what is constant of one camera is constant in its frame
    np.testing.assert_allclose(after.cameras[[1, 4], :6], problem.cameras[[1, 4], :6], rtol=0, atol=0)


def test_covariances_are_those_of_the_dense_inverse_seen_by_each_camera():
    problem = with_gauge(solve(rigged(), "ceres").problem, "two-cameras")
    assert problem.constants.poses.all(axis=1).sum() == 1  # the rigs give the scene its scale
    found = covariance(problem)
    _, jacobian = support.linear(problem, StepOptions(coordinates=MANIFOLD))
    copies = copy_matrix(problem)
    held = np.repeat(problem.constants.poses.any(axis=1), 9)
    held = np.concatenate([held & np.tile(np.arange(9) < 6, 6), np.zeros(3 * problem.num_points, bool)])
    of_held = np.abs(copies[held]).any(axis=0)
    small = copies[:, ~of_held]
    whole = small @ np.linalg.inv(small.T @ jacobian.T @ jacobian @ small) @ small.T
    for camera in range(6):
        at = slice(9 * camera, 9 * camera + 6)
        np.testing.assert_allclose(found.poses[camera], whole[at, at], rtol=1e-5, atol=1e-12)
    pair = np.r_[0:6, 18:24]
    np.testing.assert_allclose(found.between(0, 2), whole[np.ix_(pair, pair)], rtol=1e-5, atol=1e-12)


def test_a_camera_that_nothing_sees_moves_with_its_frame():
    problem = rigged()
    seen = problem.camera_index != 2
    parts = (problem.observations[seen], problem.camera_index[seen], problem.point_index[seen])
    blind = BundleProblem.create(problem.cameras, problem.points, *parts, lenses=problem.lenses, rigs=problem.rigs)
    after = solve(blind, "ceres").problem
    assert (after.cameras[2, :6] != problem.cameras[2, :6]).any()
    BundleProblem.create(after.cameras, *support.arrays(after)[1:], rigs=after.rigs)


def test_rigs_grow_with_their_scene():
    problem = rigged()
    centers = geometry.camera_centers(problem.cameras)
    for larger in (with_position_priors(problem, 3 * centers + 1, np.eye(3)), normalize(problem)):
        BundleProblem.create(larger.cameras, *support.arrays(larger)[1:], rigs=larger.rigs)


def test_what_rigs_do_not_support_is_one_line():
    problem = rigged()
    with pytest.raises(ProblemError, match="rigs need plain LM, not poba"):
        solve(problem, "ceres", SolveOptions(method=make_method("poba")))
    layout, state = support.start(problem, StepOptions())
    with pytest.raises(ValueError, match="rigs need rotation='manifold'"):
        lm_step(layout, state, jnp.asarray(1e-3), StepOptions())
    rigs = problem.rigs
    part = np.zeros((6, 6), bool)
    part[2, 4] = True
    constants = Constants(part, np.zeros(problem.num_points, bool))
    with pytest.raises(ProblemError, match="part of the translation of camera 2 is constant, which is turned"):
        solve(problem.replace(constants=constants), "ceres")
    wrong = np.array(rigs.translation)
    wrong[2] += 1.0
    with pytest.raises(ProblemError, match="cameras 0 and 2 of one frame are not where their rig has them"):
        BundleProblem.create(*support.arrays(problem), rigs=Rigs(rigs.frame, rigs.rotation, wrong))
