"""Constants, gauge and priors: the step is that of the dense problem, and what is constant stays
bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import support
from scipy.optimize import least_squares

from jaxba import (
    BundleProblem,
    Constants,
    Loss,
    ProblemError,
    ProblemWarning,
    SolveOptions,
    StepOptions,
    covariance,
    hold,
    release,
    retriangulate,
    solve,
    with_gauge,
    with_lens_priors,
    with_position_priors,
    with_rotation_priors,
)
from jaxba.methods.deeplm import GlobalConjugateGradients
from jaxba.problem import geometry
from jaxba.problem.options import ConjugateGradients, Coordinates
from jaxba.solver.methods import make_method
from jaxba.solver.prepare import prepare

EXACT = ConjugateGradients(forcing=0.0, tolerance=1e-13)
NORMAL = StepOptions(method=GlobalConjugateGradients(replace(EXACT, max_iterations=20000)))


def held() -> BundleProblem:
    """Two constant poses, a constant rotation, a constant number of every lens, a constant lens and
    two points."""
    problem = hold(
        support.tiny(), poses=[0, 3], rotations=[1], points=[2, 5], lenses=[2], numbers=["k2"]
    )
    return problem


def constant_numbers(problem: BundleProblem) -> np.ndarray:
    """Which of all parameters, cameras first, are constant."""
    cameras = np.zeros(problem.cameras.shape, bool)
    cameras[:, :6] = problem.constants.poses
    cameras[:, 6:] = ~problem.lenses.free[problem.lenses.index]
    return np.concatenate([cameras.ravel(), np.repeat(problem.constants.points, 3)])


@pytest.mark.parametrize(
    "solver",
    [
        "explicit",
        "implicit",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("sparse", "deeplm")),
    ],
)
def test_a_step_is_that_of_the_dense_problem_without_the_columns_of_constants(solver):
    problem = held()
    options = (
        StepOptions(linear_solver=solver, conjugate_gradients=EXACT)
        if solver != "deeplm"
        else NORMAL
    )
    layout, before = support.start(problem, options)
    after, _ = support.step(layout, before, 1e-3, options, min_gain=-np.inf)
    found = support.difference(problem, support.back(problem, before, after), options)
    residual, jacobian = support.linear(support.tiny(), options)
    moves = ~constant_numbers(problem)
    small = jacobian[:, moves]
    stacked = np.vstack(
        [small, np.diag(np.sqrt(1e-3 * np.clip(np.sum(small**2, axis=0), 1e-6, 1e32)))]
    )
    right = np.concatenate([-residual, np.zeros(small.shape[1])])
    wanted = np.zeros(len(moves))
    wanted[moves] = np.linalg.lstsq(stacked, right, rcond=None)[0]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7 * np.abs(wanted).max())
    assert (found[~moves] == 0).all()


@pytest.mark.parametrize("policy", ["ceres", "guarded"])
def test_what_is_constant_comes_back_bit_for_bit_and_the_rest_moves(policy):
    problem = held()
    far = problem.replace(points=problem.points + 1e5)  # solved in a frame of its own
    cameras = np.array(problem.cameras)
    cameras[:, 3:6] -= geometry.rotation_matrices(cameras[:, :3]) @ np.full(3, 1e5)
    for start in (problem, far.replace(cameras=cameras)):
        after = solve(start, policy).problem
        same = after.cameras == start.cameras
        constant = constant_numbers(problem)
        assert same.ravel()[constant[: same.size]].all()
        assert (after.points == start.points).all(axis=1)[[2, 5]].all()
        assert not same.ravel()[~constant[: same.size]].any()


@pytest.mark.parametrize("gauge", ["two-cameras", "three-points"])
def test_a_gauge_leaves_the_cost_that_is_found_without_it(gauge):
    problem = support.tiny()
    fixed = with_gauge(problem, gauge)
    numbers = fixed.constants.poses.sum() + 3 * fixed.constants.points.sum()
    assert numbers == (7 if gauge == "two-cameras" else 9)
    options = SolveOptions(max_iterations=300)
    free = solve(problem, "ceres", options)
    found = solve(fixed, "ceres", options)
    if gauge == "two-cameras":
        np.testing.assert_allclose(found.final_cost, free.final_cost, rtol=1e-5)
    else:
        assert found.final_cost >= free.final_cost * (1 - 1e-5)
    covariance(found.problem)
    with pytest.raises(ProblemError, match="7 directions of the cameras are not determined"):
        covariance(free.problem)


def moves(problem: BundleProblem) -> np.ndarray:
    """Which of all parameters, cameras first, are optimised, of lenses of their own."""
    if problem.constants is None:
        return np.ones(problem.cameras.size + problem.points.size, bool)
    cameras = np.hstack([~problem.constants.poses, np.ones((problem.num_cameras, 3), bool)])
    return np.concatenate([cameras.ravel(), np.repeat(~problem.constants.points, 3)])


@pytest.mark.parametrize(
    ("fixed", "numbers"),
    [
        (lambda p: p, 7),
        (lambda p: hold(p, poses=[3]), 1),
        (lambda p: hold(p, rotations="all"), 4),
        (lambda p: hold(p, rotations=[1]), 4),
        (lambda p: hold(p, points=[0]), 4),
        (lambda p: hold(p, points=[0, 1]), 1),
        (lambda p: hold(p, poses=[0, 3]), 0),
        (lambda p: hold(p, poses="all"), 0),
        (lambda p: hold(p, points=[0, 1, 2]), 0),
        (
            lambda p: with_position_priors(
                p, geometry.camera_centers(p.cameras), stddev=1.0, align=False
            ),
            0,
        ),
    ],
)
def test_a_gauge_holds_what_constants_and_priors_leave_free(fixed, numbers):
    """Counted by hand: a pose is six numbers; a similarity has seven."""
    problem = fixed(support.tiny())

    def held(p):
        return 0 if p.constants is None else p.constants.poses.sum() + 3 * p.constants.points.sum()

    if numbers:
        found = with_gauge(problem, "two-cameras")
    else:
        with pytest.warns(ProblemWarning, match="the gauge two-cameras is not needed"):
            found = with_gauge(problem, "two-cameras")
    assert held(found) - held(problem) == numbers
    # pixels determine as much of what is left as before, and nothing of it is free
    _, jacobian = support.linear(
        support.tiny(), StepOptions(coordinates=Coordinates(rotation="manifold"))
    )
    columns = [jacobian[:, moves(p)] for p in (problem, found)]
    ranks = [np.linalg.matrix_rank(x / np.linalg.norm(x, axis=0)) for x in columns]
    if not problem.residuals:
        assert ranks[0] == ranks[1] == columns[1].shape[1]


WRONG = [
    5,
    None,
    "x",
    [[0], [1, 2]],
    [[1, 2]],
    [None],
    [float("nan")],
    [-1],
    [99],
    {"a": 1},
    object(),
]


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: repr(wrong)[:12])
def test_wrong_values_are_one_line_in_our_own_words(wrong, unchecked):
    problem = support.tiny()
    centers = geometry.camera_centers(problem.cameras)
    eye = np.eye(3)
    calls = [
        *(
            lambda name=name: hold(problem, **{name: wrong})
            for name in ("poses", "rotations", "points", "lenses")
        ),
        lambda: hold(problem, numbers=wrong),
        lambda: release(problem, numbers=wrong),
        lambda: with_gauge(problem, wrong),
        lambda: with_position_priors(problem, wrong, eye),
        lambda: with_position_priors(problem, centers, wrong if wrong is not None else "none"),
        lambda: with_position_priors(
            problem, centers, stddev=wrong if wrong not in (5, None) else -1
        ),
        lambda: with_position_priors(problem, centers, eye, loss=wrong if wrong is not None else 3),
        lambda: with_position_priors(problem, centers[:1], eye, images=wrong),
        lambda: with_rotation_priors(problem, wrong, eye),
        lambda: with_rotation_priors(problem, centers, wrong),
        lambda: with_lens_priors(problem, wrong),
        lambda: with_lens_priors(problem, {"k1": wrong if wrong != 5 else 0}),
        lambda: Loss(wrong),
        lambda: Loss("huber", wrong if wrong != 5 else -5),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
            call()
        text = str(caught.value)
        assert len(text) < 300
        foreign = (
            "object is not",
            "could not convert",
            "inhomogeneous",
            "broadcast",
            "unhashable",
            "array(",
            "ufunc",
        )
        assert not any(words in text for words in foreign), text


def whitening(problem: BundleProblem) -> np.ndarray:
    """Of the positions that were given last."""
    return problem.residuals.rows[-1].data[1]


def test_standard_deviations_are_one_number_three_or_those_of_each_image():
    problem = support.tiny()
    centers = geometry.camera_centers(support.tiny().cameras)
    each = np.array([0.1, 2.0, 0.1, 2.0, 0.1, 2.0])
    axes = np.array([0.1, 0.2, 0.3])
    for stddev, wanted in [
        (0.5, np.full((6, 3), 0.5)),
        (axes, np.tile(axes, (6, 1))),
        (each, np.tile(each[:, None], (1, 3))),
        (each[:, None], np.tile(each[:, None], (1, 3))),
        (each[:, None] * axes, each[:, None] * axes),
    ]:
        found = with_position_priors(problem, centers, stddev=stddev, align=False)
        np.testing.assert_allclose(whitening(found), np.eye(3) / wanted[:, None, :])
    three = with_position_priors(problem, centers[:3], stddev=axes, images=[0, 1, 2], align=False)
    np.testing.assert_allclose(whitening(three)[1].diagonal(), 1 / axes)
    with pytest.raises(ValueError, match="either a covariance or a stddev"):
        with_position_priors(problem, centers, np.eye(3), stddev=1.0)
    with pytest.raises(ValueError, match="image 1 has more than one measurement"):
        with_position_priors(problem, centers[:2], stddev=1.0, images=[1, 1])


def test_names_of_groups_and_numbers_say_what_of_lenses_is_constant():
    problem = hold(support.tiny(), numbers=["distortion"])
    assert problem.lenses.free.tolist() == [[True, False, False]] * 6
    assert release(problem, numbers=["k1"]).lenses.free.tolist() == [[True, True, False]] * 6
    with pytest.raises(
        ValueError, match="no lens has a number 'k9'; there are focal, principal_point"
    ):
        hold(problem, numbers=["k9"])
    with pytest.raises(ValueError, match="there is no image 6: there are 6"):
        hold(problem, poses=[6])
    with pytest.raises(ValueError, match=r"each point is given by its position, not by 1.7"):
        hold(problem, points=np.array([1.7]))
    mask = [False, False, True, False, False, False]
    assert hold(support.tiny(), poses=mask).constants.poses.all(axis=1).tolist() == mask
    assert hold(support.tiny(), numbers="focal").lenses.free[0].tolist() == [False, True, True]


def test_methods_refuse_what_they_do_not_support():
    known = with_lens_priors(support.tiny(), {"k1": 0.1})
    with pytest.raises(
        ProblemError, match="priors and residuals of your own need plain LM, not stba"
    ):
        solve(known, "ceres", SolveOptions(method=make_method("stba")))


# Priors


SPREAD = np.array([0.01, 0.02, 0.03])


def measurements() -> tuple[np.ndarray, np.ndarray]:
    """Positions of four images and rotations of all, with noise."""
    problem = support.tiny()
    rng = np.random.default_rng(3)
    centers = geometry.camera_centers(problem.cameras)
    return centers[:4] + 0.3 * rng.normal(size=(4, 3)), problem.cameras[:, :3] + 0.05 * rng.normal(
        size=(6, 3)
    )


def known() -> BundleProblem:
    """Positions of four images under a robust loss, rotations of all, and lenses that are
    believed."""
    centers, turned = measurements()
    given = {"images": [0, 1, 2, 3], "align": False}
    # of which nothing stays
    before = with_position_priors(support.tiny(), centers + 1, stddev=1.0, **given)
    problem = with_position_priors(before, centers, np.diag(SPREAD), loss=Loss("huber"), **given)
    return with_lens_priors(
        with_rotation_priors(problem, turned, 0.01 * np.eye(3)), {"focal": 20.0, "k1": 0.05}
    )


def prior_residuals(problem: BundleProblem) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    (centers, turned) = measurements()
    cameras = np.asarray(problem.cameras)
    position = (geometry.camera_centers(cameras)[:4] - centers) / np.sqrt(SPREAD)
    rotation = (
        10 * (Rotation.from_rotvec(cameras[:, :3]) * Rotation.from_rotvec(turned).inv()).as_rotvec()
    )
    lens = (cameras - support.tiny().cameras)[:, 6:8] / [20.0, 0.05]
    norms = np.sum(position**2, axis=1)
    huber = np.sqrt(np.where(norms > 1, 2 * np.sqrt(norms) - 1, norms))
    return np.concatenate([huber, rotation.ravel(), lens.ravel()])


def whole_residuals(problem: BundleProblem) -> np.ndarray:
    return np.concatenate([geometry.residuals(problem).ravel(), prior_residuals(problem)])


@pytest.mark.parametrize(
    ("policy", "solver"),
    [("ceres", "explicit"), pytest.param("guarded", "implicit", marks=pytest.mark.slow)],
)
def test_scipy_finds_nothing_below_the_end_of_a_solve_with_priors(policy, solver):
    problem = known()
    solution = solve(problem, policy, SolveOptions(linear_solver=solver, max_iterations=200))
    np.testing.assert_allclose(
        solution.initial_cost, 0.5 * np.sum(whole_residuals(problem) ** 2), rtol=1e-9
    )
    np.testing.assert_allclose(
        solution.final_cost, 0.5 * np.sum(whole_residuals(solution.problem) ** 2), rtol=1e-9
    )
    end = solution.problem

    def residuals(x):
        cameras = x[: end.cameras.size].reshape(end.cameras.shape)
        return whole_residuals(
            end.replace(cameras=cameras, points=x[end.cameras.size :].reshape(-1, 3))
        )

    start = np.concatenate([end.cameras.ravel(), end.points.ravel()])
    truth = least_squares(residuals, start, x_scale="jac", max_nfev=5)
    np.testing.assert_allclose(solution.final_cost, truth.cost, rtol=2e-6)


def test_a_scene_is_aligned_with_measured_positions_of_which_some_are_wrong():
    problem = support.tiny()
    centers = geometry.camera_centers(problem.cameras)
    turn = geometry.rotation_matrices(np.array([[0.3, -0.5, 1.1]]))[0]
    measured = 2.5 * centers @ turn.T + [10.0, -20.0, 5.0]
    wrong = measured.copy()
    wrong[1] += 100.0
    with pytest.warns(ProblemWarning, match="do not fit the others: camera 1 is 173 from there"):
        aligned = with_position_priors(problem, wrong, 0.01 * np.eye(3))
    np.testing.assert_allclose(
        np.delete(geometry.camera_centers(aligned.cameras), 1, 0), np.delete(measured, 1, 0)
    )
    np.testing.assert_allclose(geometry.cost(aligned), geometry.cost(problem), rtol=1e-9)
    with pytest.raises(ProblemError, match="an alignment would move what is constant or measured"):
        with_position_priors(hold(problem, poses=[0]), measured, np.eye(3))
    with pytest.raises(
        ProblemError,
        match="covariance of the position of image 0 is not symmetric positive definite",
    ):
        with_position_priors(problem, measured, -np.eye(3))


# Covariance


def test_covariances_are_those_of_the_dense_inverse():
    problem = solve(held(), "ceres").problem
    found = covariance(problem)
    _, jacobian = support.linear(problem, StepOptions(coordinates=Coordinates(rotation="manifold")))
    moves = ~constant_numbers(problem)
    whole = np.zeros((len(moves), len(moves)))
    whole[np.ix_(moves, moves)] = np.linalg.inv(jacobian[:, moves].T @ jacobian[:, moves])
    cameras = problem.cameras.size
    for camera in range(6):
        at = slice(9 * camera, 9 * camera + 6)
        np.testing.assert_allclose(found.poses[camera], whole[at, at], rtol=1e-5, atol=1e-14)
        lens = slice(9 * camera + 6, 9 * camera + 9)
        np.testing.assert_allclose(found.lenses[camera], whole[lens, lens], rtol=1e-5, atol=1e-14)
    for point in range(problem.num_points):
        at = slice(cameras + 3 * point, cameras + 3 * point + 3)
        np.testing.assert_allclose(found.points[point], whole[at, at], rtol=1e-5, atol=1e-14)
        own = jacobian[:, at].T @ jacobian[:, at]
        wanted = np.zeros((3, 3)) if problem.constants.points[point] else np.linalg.inv(own)
        np.testing.assert_allclose(found.points_given_cameras[point], wanted, rtol=1e-7, atol=1e-14)
    pair = np.r_[9:15, 36:42]
    np.testing.assert_allclose(
        found.between(1, 4), whole[np.ix_(pair, pair)], rtol=1e-5, atol=1e-14
    )


def test_covariances_far_from_the_origin_are_those_near_it():
    near = solve(support.tiny(), "ceres", SolveOptions(max_iterations=300)).problem
    near = hold(near, poses=[0, 3])
    cameras = np.array(near.cameras)
    cameras[:, 3:6] -= geometry.rotation_matrices(cameras[:, :3]) @ np.full(3, 1e5)
    far = near.replace(cameras=cameras, points=near.points + 1e5)
    here = covariance(near)
    there = covariance(far)
    np.testing.assert_allclose(there.points, here.points, rtol=1e-3)
    np.testing.assert_allclose(there.poses[1, :3, :3], here.poses[1, :3, :3], rtol=1e-3)
    np.testing.assert_allclose(
        there.relative_pose(1, 4), here.relative_pose(1, 4), rtol=1e-2, atol=1e-6
    )
    fixed = covariance(hold(near, poses="all", lenses="all"))
    assert (fixed.points == fixed.points_given_cameras).all()


def test_the_covariance_of_a_relative_pose_does_not_depend_on_the_gauge():
    solved = solve(support.tiny(), "ceres", SolveOptions(max_iterations=300)).problem

    def fixed(whole: int, part: int) -> BundleProblem:
        poses = np.zeros((6, 6), bool)
        poses[whole], poses[part, 3] = True, True
        return solved.replace(constants=Constants(poses, np.zeros(solved.num_points, bool)))

    first = covariance(fixed(0, 5))
    second = covariance(fixed(3, 2))
    scale = first.relative_pose(1, 4)[:3, :3], second.relative_pose(1, 4)[:3, :3]
    np.testing.assert_allclose(*scale, rtol=1e-4, atol=1e-12)  # of the rotation, whatever the scale


def test_prepare_takes_what_is_constant_and_known():
    assert [len(rows.points[0]) for rows in prepare(known()).layout.residuals] == [4, 6, 6]
    assert not prepare(held()).layout.unknowns.free.everywhere


def test_constant_points_stay_when_points_are_looked_for_anew():
    problem = support.strayed(3.0)
    free = retriangulate(problem)
    assert free.moved > 0
    where = np.flatnonzero((free.problem.points != problem.points).any(axis=1))[:1]
    found = retriangulate(hold(problem, points=where))
    assert (found.problem.points[where] == problem.points[where]).all()
    assert found.moved == free.moved - 1
