"""Rigs: the step is that of the dense problem of frames, and cameras of a frame stay where their
rig has them."""

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
    Tolerances,
    covariance,
    hold,
    lm_step,
    residuals,
    solve,
    with_gauge,
    with_position_priors,
    with_residual,
    with_rotation_priors,
)
from jaxba.problem import geometry
from jaxba.problem.frames import in_frames, out_of_frames
from jaxba.problem.options import ConjugateGradients, Coordinates
from jaxba.solver.methods import make_method

FRAME = np.array([0, 1, 0, 2, 1, 3], np.int32)
MANIFOLD = Coordinates(rotation="manifold")
EXACT = ConjugateGradients(forcing=0.0, tolerance=1e-13)


def rigged(shared: bool = True) -> BundleProblem:
    """Six cameras in four frames, two of them of two cameras; the second is turned and moved in its
    rig."""
    plain = support.tiny()
    rng = np.random.default_rng(0)
    matrices = geometry.rotation_matrices(plain.cameras[:, :3])
    cameras = np.array(plain.cameras)
    rotation = np.tile(np.eye(3), (6, 1, 1))
    translation = np.zeros((6, 3))
    # also the first may be anywhere
    rotation[0] = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix()
    for second, first in ((2, 0), (4, 1)):
        rotation[second] = matrices[second] @ matrices[first].T @ rotation[first]
        translation[second] = (
            cameras[second, 3:6] - rotation[second] @ rotation[first].T @ cameras[first, 3:6]
        )
    index = np.array([0, 1, 1, 0, 1, 0])
    if shared:
        cameras[:, 6:] = cameras[index, 6:]
    parts = support.arrays(plain)[1:]
    lenses = Lenses(index, np.ones((2, 3), bool)) if shared else None
    problem = BundleProblem.create(
        cameras, *parts, lenses=lenses, rigs=Rigs(FRAME, rotation, translation)
    )
    pixels = geometry.project(problem) + 0.3 * rng.normal(size=problem.observations.shape)
    return problem.replace(observations=pixels)


def stereo() -> BundleProblem:
    """Six cameras in four frames, two of them of two cameras: the second has a lens of its own, and
    is not quite where its rig says it is."""
    plain = support.tiny()
    rng = np.random.default_rng(1)
    cameras = np.array(plain.cameras)
    rotation = np.tile(np.eye(3), (6, 1, 1))
    translation = np.zeros((6, 3))
    index = np.array([0, 0, 1, 0, 1, 0])
    cameras[:, 6:] = cameras[index, 6:]
    matrices = geometry.rotation_matrices(cameras[:, :3])

    def place(turn, moved):
        rotation[[2, 4]], translation[[2, 4]] = Rotation.from_rotvec(turn).as_matrix(), moved
        for second, first in ((2, 0), (4, 1)):
            cameras[second, :3] = Rotation.from_matrix(rotation[2] @ matrices[first]).as_rotvec()
            cameras[second, 3:6] = rotation[2] @ cameras[first, 3:6] + translation[2]

    place([0.1, 0.05, -0.1], [0.3, -0.2, 0.1])
    pixels = geometry.project(plain.replace(cameras=cameras)) + 0.3 * rng.normal(
        size=plain.observations.shape
    )
    place([0.11, 0.04, -0.1], [0.35, -0.2, 0.15])
    rigs = Rigs(FRAME, rotation, translation, index == 1)
    parts = (plain.points, pixels, plain.camera_index, plain.point_index)
    return BundleProblem.create(
        cameras, *parts, lenses=Lenses(index, np.ones((2, 3), bool)), rigs=rigs
    )


def copies_of(problem: BundleProblem) -> tuple[dict, np.ndarray]:
    """The unknowns, and T: the steps of all parameters (rotations on the manifold) for unit steps
    of them."""
    size = 9 * 6 + 3 * problem.num_points
    names = {}
    columns = []
    rigs = problem.rigs
    free = np.zeros(6, bool) if rigs.free is None else rigs.free

    def column(name) -> np.ndarray:
        if name not in names:
            names[name] = len(columns)
            columns.append(np.zeros(size))
        return columns[names[name]]

    for camera in range(6):
        for part in (0, 3):
            for k in range(3):
                rows = slice(9 * camera + part, 9 * camera + part + 3)
                column(("frame", int(FRAME[camera]), part + k))[rows] = problem.rigs.rotation[
                    camera
                ][:, k]
        for k in range(6, 9):
            lens = camera if problem.lenses is None else int(problem.lenses.index[camera])
            column(("lens", lens, k))[9 * camera + k] = 1
        for k in range(3 if free[camera] else 0):
            start = 9 * camera
            axis = np.eye(3)[k]
            column(("place", int(problem.lenses.index[camera]), k))[start + k] = 1
            turned = np.cross(axis, problem.cameras[camera, 3:6] - rigs.translation[camera])
            column(("place", int(problem.lenses.index[camera]), k))[start + 3 : start + 6] = turned
            column(("place", int(problem.lenses.index[camera]), 3 + k))[start + 3 + k] = 1
    for k in range(54, size):
        column(("point", k - 54))[k] = 1
    return names, np.array(columns).T


def unknown_step(problem: BundleProblem, names: dict, before, after) -> np.ndarray:
    """The step of each unknown between two states."""
    old = np.array(before.cameras).T
    new = np.array(after.cameras).T
    change = new - old
    for at in (0, 9):
        turned = (
            Rotation.from_rotvec(new[:, at : at + 3].copy())
            * Rotation.from_rotvec(old[:, at : at + 3].copy()).inv()
        )
        change[:, at : at + 3] = turned.as_rotvec()
    points = (support.back(problem, before, after).points - problem.points).ravel()
    at = {
        "frame": (FRAME, 0),
        "place": (problem.lenses.index if problem.lenses is not None else np.arange(6), 9),
    }
    at["lens"] = (at["place"][0], 0)
    found = []
    for kind, *number in names:
        if kind == "point":
            found.append(points[number[0]])
            continue
        of_camera, first = at[kind]
        same = change[of_camera == number[0], first + number[1]]
        np.testing.assert_array_equal(same, same[0])  # what is one unknown stays one, bit for bit
        found.append(same[0])
    return np.array(found)


RIGGED = {"shared": rigged, "own": lambda: rigged(shared=False), "free": stereo}
QUICK = [
    ("shared", "explicit"),
    ("shared", "implicit"),
    ("own", "sparse"),
    ("free", "explicit"),
    ("free", "sparse"),
]
REST = [("own", "explicit"), ("own", "implicit"), ("shared", "sparse"), ("free", "implicit")]


@pytest.mark.parametrize(
    ("make", "solver"), [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in REST)]
)
def test_a_step_is_that_of_the_dense_problem_of_frames(make, solver):
    problem = RIGGED[make]()
    options = StepOptions(linear_solver=solver, conjugate_gradients=EXACT, coordinates=MANIFOLD)
    layout, before = support.start(problem, options)
    after, _ = support.step(layout, before, 1e-2, options, min_gain=-np.inf)
    residual, jacobian = support.linear(problem, options)
    names, copies = copies_of(problem)
    found = unknown_step(problem, names, before, after)
    small = jacobian @ copies
    stacked = np.vstack(
        [small, np.diag(np.sqrt(1e-2 * np.clip(np.sum(small**2, axis=0), 1e-6, 1e32)))]
    )
    right = np.concatenate([-residual, np.zeros(small.shape[1])])
    wanted = np.linalg.lstsq(stacked, right, rcond=None)[0]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7 * np.abs(wanted).max())


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["ceres", "guarded"])
def test_where_a_camera_is_in_its_rig_is_found(policy):
    problem = stereo()
    found = solve(problem, policy).problem
    parts = (found.cameras, *support.arrays(found)[1:])
    # refuses cameras that are elsewhere
    BundleProblem.create(*parts, lenses=found.lenses, rigs=found.rigs)
    assert geometry.cost(found) < 0.9 * geometry.cost(
        solve(problem.replace(rigs=held(problem)), policy).problem
    )
    assert support.same_bits(found.rigs.rotation[[0, 1, 3, 5]], problem.rigs.rotation[[0, 1, 3, 5]])
    # the truth, but for the scale of the scene and noise
    turn = Rotation.from_matrix(found.rigs.rotation[2]).as_rotvec()
    np.testing.assert_allclose(turn, [0.1, 0.05, -0.1], rtol=0, atol=2e-3)
    # constant poses and constant places come back bit for bit
    kept = solve(hold(problem, poses=[2], extrinsics="all"), policy).problem
    assert support.same_bits(kept.cameras[2, :6], problem.cameras[2, :6])
    assert support.same_bits((kept.rigs.rotation, kept.rigs.translation), problem_places(problem))
    held_pose = solve(hold(problem, poses=[2]), policy).problem
    assert support.same_bits(held_pose.cameras[2, :6], problem.cameras[2, :6])
    BundleProblem.create(held_pose.cameras, *support.arrays(held_pose)[1:], rigs=held(held_pose))


def held(problem: BundleProblem) -> Rigs:
    return Rigs(problem.rigs.frame, problem.rigs.rotation, problem.rigs.translation)


def problem_places(problem: BundleProblem) -> tuple[np.ndarray, np.ndarray]:
    return problem.rigs.rotation, problem.rigs.translation


@pytest.mark.parametrize("policy", ["ceres", "guarded"])
def test_cameras_of_a_frame_stay_where_their_rig_has_them(policy):
    problem = hold(rigged(), poses=[4])
    after = solve(problem, policy).problem
    parts = (after.cameras, *support.arrays(after)[1:])
    BundleProblem.create(*parts, rigs=after.rigs)  # refuses cameras that are elsewhere
    assert geometry.cost(after) < 0.7 * geometry.cost(problem)
    # what is constant of one camera is constant in its frame
    np.testing.assert_allclose(
        after.cameras[[1, 4], :6], problem.cameras[[1, 4], :6], rtol=0, atol=0
    )


@pytest.mark.parametrize("make", [rigged, pytest.param(stereo, marks=pytest.mark.slow)])
def test_covariances_are_those_of_the_dense_inverse_seen_by_each_camera(make):
    problem = with_gauge(solve(make(), "ceres").problem, "two-cameras")
    # constant places in rigs give the scene its scale
    assert problem.constants.poses.any(axis=1).sum() == (1 if problem.rigs.free is None else 2)
    found = covariance(problem)
    _, jacobian = support.linear(problem, StepOptions(coordinates=MANIFOLD))
    _, copies = copies_of(problem)
    held = np.hstack([problem.constants.poses, np.zeros((6, 3), bool)]).ravel()
    held = np.concatenate([held, np.zeros(3 * problem.num_points, bool)])
    of_held = np.abs(copies[held]).any(axis=0)
    small = copies[:, ~of_held]
    whole = small @ np.linalg.inv(small.T @ jacobian.T @ jacobian @ small) @ small.T
    for camera in range(6):
        at = slice(9 * camera, 9 * camera + 6)
        np.testing.assert_allclose(found.poses[camera], whole[at, at], rtol=1e-5, atol=1e-12)
    pair = np.r_[0:6, 18:24]
    np.testing.assert_allclose(
        found.between(0, 2), whole[np.ix_(pair, pair)], rtol=1e-5, atol=1e-12
    )


@pytest.mark.slow
def test_priors_are_of_cameras_and_not_of_their_frames():
    problem = stereo()
    rng = np.random.default_rng(2)
    centers = geometry.camera_centers(problem.cameras) + 0.2 * rng.normal(size=(6, 3))
    known = with_position_priors(problem, centers, np.diag([0.01, 0.02, 0.03]), align=False)
    turned = problem.cameras[:, :3] + 0.05 * rng.normal(size=(6, 3))
    known = with_rotation_priors(known, turned, 0.02 * np.eye(3))

    def cost(at: BundleProblem) -> float:
        away = geometry.camera_centers(at.cameras) - centers
        angles = Rotation.from_rotvec(at.cameras[:, :3].copy()) * Rotation.from_rotvec(turned).inv()
        weighed = np.sum(away**2 / [0.01, 0.02, 0.03]), np.sum(angles.as_rotvec() ** 2) / 0.02
        return geometry.cost(at) + 0.5 * sum(weighed)

    found = solve(known, "ceres", SolveOptions(max_iterations=100))
    np.testing.assert_allclose(found.initial_cost, cost(problem), rtol=1e-9)
    np.testing.assert_allclose(found.final_cost, cost(found.problem), rtol=1e-9)
    # a minimum: small moves of the frames and places raise the cost
    here = in_frames(found.problem)
    for _ in range(20):
        moved = np.array(here.cameras)
        by_frame = 1e-4 * rng.normal(size=(4, 6))
        by_lens = 1e-4 * rng.normal(size=(2, 6)) * [[0], [1]]
        moved[:, :6] += by_frame[FRAME]
        moved[:, -6:] += by_lens[problem.lenses.index]
        cameras, rigs = out_of_frames(found.problem, moved)
        assert cost(found.problem.replace(cameras=cameras, rigs=rigs)) > found.final_cost


def test_what_is_held_of_a_camera_is_held_of_its_frame_and_its_place():
    problem = stereo()
    poses = np.zeros((6, 6), bool)
    poses[2, 3:] = True
    held_translation = problem.replace(
        constants=Constants(poses, np.zeros(problem.num_points, bool))
    )
    unseen = problem.camera_index != 2
    parts = (
        problem.observations[unseen],
        problem.camera_index[unseen],
        problem.point_index[unseen],
    )
    blind = BundleProblem.create(
        problem.cameras, problem.points, *parts, lenses=problem.lenses, rigs=problem.rigs
    )
    for here, numbers in ((held_translation, slice(3, 6)), (hold(blind, poses=[2]), slice(6))):
        found = solve(here, "ceres", SolveOptions(max_iterations=5))
        np.testing.assert_array_equal(
            found.problem.cameras[2, numbers], problem.cameras[2, numbers]
        )
        np.testing.assert_allclose(geometry.cost(found.problem), found.final_cost, rtol=1e-9)
        BundleProblem.create(
            found.problem.cameras, *support.arrays(found.problem)[1:], rigs=held(found.problem)
        )


def test_a_camera_that_nothing_sees_moves_with_its_frame():
    problem = rigged()
    seen = problem.camera_index != 2
    parts = (problem.observations[seen], problem.camera_index[seen], problem.point_index[seen])
    blind = BundleProblem.create(
        problem.cameras, problem.points, *parts, lenses=problem.lenses, rigs=problem.rigs
    )
    after = solve(blind, "ceres").problem
    assert (after.cameras[2, :6] != problem.cameras[2, :6]).any()
    BundleProblem.create(after.cameras, *support.arrays(after)[1:], rigs=after.rigs)


def one_sensor() -> BundleProblem:
    """`rigged`, of which each frame has pixels of one camera alone."""
    problem = rigged()
    return problem.subset(~np.isin(problem.camera_index, [2, 4]))


@pytest.mark.slow
def test_what_is_measured_of_a_camera_without_pixels_moves_its_frame():
    problem = one_sensor()
    images = [2, 4, 3, 5]
    seen = [0, 1, 3, 5]
    measured = geometry.camera_centers(problem.cameras)[images] + np.random.default_rng(0).normal(
        size=(4, 3)
    )
    options = SolveOptions(tolerances=Tolerances(ftol=1e-12), max_iterations=300)
    surveyed = with_position_priors(problem, measured, stddev=0.1, images=images, align=False)
    found = solve(surveyed, "ceres", options)
    after = found.problem
    BundleProblem.create(after.cameras, *support.arrays(after)[1:], rigs=after.rigs)
    # as if the cameras with pixels had the measurements, by lever arms in COLMAP's axes
    turn = np.asarray(problem.rigs.rotation)
    place = np.asarray(problem.rigs.translation)
    arms = place[seen] - np.einsum("nij,nkj,nk->ni", turn[seen], turn[images], place[images])
    rows = residuals.position(
        pose=seen, position=measured, lever_arm=arms * [1, -1, -1], whitening=10 * np.eye(3)
    )
    alone = solve(with_residual(problem.replace(rigs=None), rows), "ceres", options)
    np.testing.assert_allclose(found.initial_cost, alone.initial_cost, rtol=1e-9)
    np.testing.assert_allclose(found.final_cost, alone.final_cost, rtol=1e-6)
    assert found.final_cost > 2 * solve(problem, "ceres").final_cost


def test_a_constant_camera_without_pixels_holds_its_frame():
    problem = hold(one_sensor(), poses=[2])
    found = solve(problem, "ceres")
    after = found.problem
    np.testing.assert_array_equal(after.cameras[2, :6], problem.cameras[2, :6])
    np.testing.assert_allclose(after.cameras[0, :6], problem.cameras[0, :6], rtol=1e-12)
    BundleProblem.create(after.cameras, *support.arrays(after)[1:], rigs=after.rigs)
    direct = hold(one_sensor(), poses=[0])
    assert found.num_parameters == solve(direct, "ceres").num_parameters


def test_rigs_grow_with_their_scene():
    problem = rigged()
    centers = geometry.camera_centers(problem.cameras)
    for larger in (
        with_position_priors(problem, 3 * centers + 1, 1e-4 * np.eye(3)),
        support.at_origin(problem),
    ):
        BundleProblem.create(larger.cameras, *support.arrays(larger)[1:], rigs=larger.rigs)


def test_what_rigs_do_not_support_is_one_line():
    problem = rigged()
    with pytest.raises(ProblemError, match="rigs need plain LM, not deeplm"):
        solve(problem, "ceres", SolveOptions(method=make_method("deeplm")))
    layout, state = support.start(problem, StepOptions())
    with pytest.raises(ValueError, match="rigs need rotation='manifold'"):
        lm_step(layout, state, jnp.asarray(1e-3), StepOptions())
    rigs = problem.rigs
    part = np.zeros((6, 6), bool)
    part[2, 4] = True
    constants = Constants(part, np.zeros(problem.num_points, bool))
    with pytest.raises(
        ProblemError, match="part of the translation of camera 2 is constant, which is turned"
    ):
        solve(problem.replace(constants=constants), "ceres")
    wrong = np.array(rigs.translation)
    wrong[2] += 1.0
    with pytest.raises(
        ProblemError, match="cameras 0 and 2 of one frame are not where their rig has them"
    ):
        BundleProblem.create(*support.arrays(problem), rigs=Rigs(rigs.frame, rigs.rotation, wrong))
    for at, value in (
        (3, np.zeros((3, 3))),
        (3, np.diag([1.0, 1.0, -1.0])),
        (2, np.full((3, 3), np.nan)),
    ):
        bad = np.array(rigs.rotation)
        bad[at] = value
        with pytest.raises(
            ProblemError,
            match=f"the place of camera {at} in its rig is no rotation and translation",
        ):
            BundleProblem.create(
                *support.arrays(problem), rigs=Rigs(rigs.frame, bad, rigs.translation)
            )
    free = Rigs(
        *[getattr(rigs, name) for name in ("frame", "rotation", "translation")], np.ones(6, bool)
    )
    with pytest.raises(ProblemError, match="free extrinsics of rigs need lenses"):
        BundleProblem.create(*support.arrays(problem), rigs=free)
    with pytest.raises(
        ProblemError, match="cameras 1 and 2 share a lens, but are in different places"
    ):
        BundleProblem.create(*support.arrays(problem), lenses=problem.lenses, rigs=free)


def test_arrays_that_cannot_be_written_are_read():
    """As those that come from JAX."""
    problem = rigged()
    cameras = np.array(problem.cameras)
    cameras.flags.writeable = False
    assert support.same_bits(
        in_frames(problem.replace(cameras=cameras)).cameras, in_frames(problem).cameras
    )
