"""Cameras that share a lens, or keep some of it: steps, solves and refusals.

The truth is the dense least squares problem in which a shared number is one unknown, and a held one
none."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import support
from scipy.optimize import least_squares
from support import solve

from jaxba import (
    BundleProblem,
    Lenses,
    ProblemError,
    SceneConfig,
    StepOptions,
    build_layout,
    lm_step,
    make_method,
    random_scene,
    random_scene_with_truth,
)
from jaxba.cli.solve import run
from jaxba.paper.subproblem import sub_problem
from jaxba.problem import geometry
from jaxba.problem.options import ConjugateGradients, Coordinates, Refinement

INDEX = np.array([0, 1, 0, 2, 1, 0])
FREE = np.array([[1, 1, 0], [1, 1, 1], [0, 0, 0]], bool)


def with_lenses(problem: BundleProblem, index: np.ndarray, free: np.ndarray) -> BundleProblem:
    """The problem with the numbers of each lens those of its first camera."""
    cameras = np.array(problem.cameras)
    first = np.array([np.flatnonzero(index == lens)[0] for lens in index])
    cameras[:, 6:] = cameras[first, 6:]
    parts = support.arrays(problem)[1:]
    whole = BundleProblem.create(cameras, *parts, lenses=Lenses(index, free))
    return whole.replace(whitening=problem.whitening)


def shared() -> BundleProblem:
    """Six cameras and three lenses: two of each kind of freedom and one that stays."""
    return with_lenses(support.tiny(), INDEX, FREE)


def unseen() -> BundleProblem:
    """`shared` with two cameras that nobody observes, one of them with a lens of others."""
    problem = shared()
    cameras = np.vstack([problem.cameras, problem.cameras[:1], problem.cameras[:1]])
    cameras[7, 6:] = 400, 0.1, 0.2
    lenses = Lenses(np.append(INDEX, [0, 3]), np.vstack([FREE, [1, 1, 1]]).astype(bool))
    return BundleProblem.create(cameras, *support.arrays(problem)[1:], lenses=lenses)


def grid() -> BundleProblem:
    """Ten cameras that see all points, so that the system is formed as one product."""
    return with_lenses(support.paper(0), np.arange(10) % 2, np.array([[1, 1, 1], [1, 0, 0]], bool))


def copy_matrix(problem: BundleProblem) -> np.ndarray:
    """T: a column for every number that is optimised, with a one where a parameter is that
    number."""
    assert problem.lenses is not None
    columns = []
    names = {}
    for parameter in range(problem.cameras.size + problem.points.size):
        camera, k = divmod(parameter, 9)
        name: tuple = (parameter,)
        if parameter < problem.cameras.size and k >= 6:
            lens = int(problem.lenses.index[camera])
            if not problem.lenses.free[lens, k - 6]:
                continue
            name = (lens, k)
        if name not in names:
            names[name] = len(columns)
            columns.append(np.zeros(problem.cameras.size + problem.points.size))
        columns[names[name]][parameter] = 1
    return np.array(columns).T


def dense_step(problem: BundleProblem, options: StepOptions, damping: float) -> np.ndarray:
    """The damped step of the problem with shared lenses."""
    residual, jacobian = support.linear(problem, options)
    copies = copy_matrix(problem)
    small = jacobian @ copies
    diagonal = np.ones(small.shape[1])
    if options.coordinates.scaling == "diagonal":
        diagonal = np.clip(np.sum(small**2, axis=0), 1e-6, 1e32)
    stacked = np.vstack([small, np.diag(np.sqrt(damping * diagonal))])
    scale = 1 / np.linalg.norm(stacked, axis=0)
    right = np.concatenate([-residual, np.zeros(len(diagonal))])
    return copies @ (scale * np.linalg.lstsq(stacked * scale, right, rcond=None)[0])


@pytest.mark.parametrize("make", [shared, unseen, grid])
@pytest.mark.parametrize(
    "options",
    [
        StepOptions(),
        StepOptions(coordinates=Coordinates(rotation="manifold")),
        pytest.param(
            StepOptions(coordinates=Coordinates(scaling="identity")), marks=pytest.mark.slow
        ),
    ],
    ids=["diagonal", "manifold", "identity"],
)
@pytest.mark.parametrize("damping", [1e-4, 1.0])
def test_a_step_is_that_of_the_dense_problem_with_shared_lenses(make, options, damping):
    problem = make()
    layout, before = support.start(problem, options)
    after, info = support.step(layout, before, damping, options, min_gain=-np.inf)
    assert info.accepted
    found = support.difference(problem, support.back(problem, before, after), options)
    wanted = dense_step(problem, options, damping)
    # the lens of a camera that nobody uses is set when a solve is over
    seen = np.ones(len(wanted), bool)
    observed = np.isin(np.arange(problem.num_cameras), problem.camera_index)
    seen[: problem.cameras.size] = np.repeat(observed, 9)
    np.testing.assert_allclose(found[seen], wanted[seen], rtol=0, atol=1e-8 * np.abs(wanted).max())


def test_the_promised_decrease_and_the_gradient_are_those_of_the_problem_with_shared_lenses():
    problem = shared()
    options = StepOptions(coordinates=Coordinates(rotation="manifold"))
    layout, before = support.start(problem, options)
    _, info = support.step(layout, before, 1e-2, options)
    residual, jacobian = support.linear(problem, options)
    change = dense_step(problem, options, 1e-2)
    model = 0.5 * np.sum(residual**2) - 0.5 * np.sum((residual + jacobian @ change) ** 2)
    np.testing.assert_allclose(info.predicted, model, rtol=1e-9)
    gradient = np.abs(copy_matrix(problem).T @ (jacobian.T @ residual)).max()
    np.testing.assert_allclose(info.gradient_max, gradient, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["ceres", "bold"])
def test_a_solve_ends_in_the_minimum_that_scipy_finds(policy):
    problem = shared()
    copies = copy_matrix(problem)
    start = np.concatenate([problem.cameras.ravel(), problem.points.ravel()])

    def residuals(unknowns):
        every = start + copies @ unknowns
        cameras = every[: problem.cameras.size].reshape(-1, 9)
        points = every[problem.cameras.size :].reshape(-1, 3)
        return geometry.residuals(problem.replace(cameras=cameras, points=points)).ravel()

    truth = least_squares(
        residuals, np.zeros(copies.shape[1]), x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-12
    )
    solution = solve(problem, policy)
    assert solution.converged
    np.testing.assert_allclose(solution.final_cost, truth.cost, rtol=2e-6)
    np.testing.assert_allclose(solution.final_cost, geometry.cost(solution.problem), rtol=1e-10)


@pytest.mark.parametrize("policy", ["ceres", pytest.param("bold", marks=pytest.mark.slow)])
def test_cameras_of_one_lens_end_with_equal_numbers_and_what_stays_stays_bit_by_bit(policy):
    problem = unseen()
    after = solve(problem, policy).problem
    lens = after.cameras[:, 6:]
    for camera, other in ((2, 0), (5, 0), (6, 0), (4, 1)):
        assert lens[camera].tobytes() == lens[other].tobytes()
    assert lens[0, 0] != problem.cameras[0, 6]
    held = ~FREE[problem.lenses.index[:6]]
    assert (lens[:6][held] == problem.cameras[:6, 6:][held]).all()
    assert (after.cameras[7] == problem.cameras[7]).all()
    assert (after.cameras[6, :6] == problem.cameras[6, :6]).all()


@pytest.mark.slow
def test_lenses_of_their_own_that_are_free_are_as_no_lenses():
    problem = support.tiny()
    own = with_lenses(problem, np.arange(6), np.ones((6, 3), bool))
    plain = solve(problem, "bold")
    same = solve(own, "bold")
    np.testing.assert_allclose(same.history.cost, plain.history.cost, rtol=1e-9)  # two programs


@pytest.mark.slow
def test_a_long_sequence_with_one_lens_is_solved():
    # so long that its reduced camera system is factored as a band, which the lens breaks
    scene, truth = random_scene_with_truth(
        SceneConfig(cameras=100, points=500, mean_track=4.0), seed=0
    )
    one_lens = np.zeros(100, int), np.ones((1, 3), bool)
    true = with_lenses(truth, *one_lens)
    noise = np.random.default_rng(0).normal(scale=0.5, size=true.observations.shape)
    scene = scene.replace(observations=geometry.project(true) + noise)
    layout = build_layout(scene)
    assert layout.pairs is not None
    assert layout.pairs.band is not None
    solution = solve(with_lenses(scene, *one_lens), "bold", linear_solver="explicit")
    assert solution.converged
    assert solution.final_cost < geometry.cost(true.replace(observations=scene.observations))
    assert np.ptp(solution.problem.cameras[:, 6:], axis=0).max() == 0
    # nothing is left to win: the undamped linear model promises next to nothing
    residual, jacobian = support.linear(solution.problem, StepOptions())
    small = jacobian @ copy_matrix(solution.problem)
    best = np.linalg.lstsq(small / np.linalg.norm(small, axis=0), -residual, rcond=1e-12)[0]
    rest = residual + (small / np.linalg.norm(small, axis=0)) @ best
    assert np.sum(residual**2) - np.sum(rest**2) < 1e-5 * np.sum(residual**2)


def test_fixed_intrinsics_are_fixed_whoever_shares_them():
    problem = shared()
    after = solve(
        problem, "bold", StepOptions(intrinsics="fixed", refinement=Refinement(points=3))
    ).problem
    assert (after.cameras[:, 6:] == problem.cameras[:, 6:]).all()


def test_a_part_of_a_problem_keeps_its_lenses():
    part = sub_problem(shared(), np.array([0, 2, 3]))
    assert part.lenses is not None
    assert part.lenses.index.tolist() == [0, 0, 2]
    assert solve(part, "ceres").final_cost > 0


@pytest.mark.parametrize(
    ("lenses", "message"),
    [
        (Lenses(np.zeros(5, int), FREE), "the lens of cameras must be a vector of 6 integers"),
        (
            Lenses(np.array([0, 1, 2, 3, 0, 0]), FREE),
            r"the lens of cameras\[3\] is 3, outside 0..2",
        ),
        (Lenses(INDEX, FREE), "cameras 0 and 2 share lens 0, but differ in f, k1 or k2"),
    ],
)
def test_lenses_that_make_no_sense_are_refused(lenses, message):
    with pytest.raises(ProblemError, match=message):
        BundleProblem.create(*support.arrays(support.tiny()), lenses=lenses)


@pytest.mark.parametrize("method", ["stba", "deeplm"])
def test_other_methods_refuse_shared_lenses(method):
    with pytest.raises(ProblemError, match=f"shared lenses need plain LM, not {method}"):
        solve(shared(), "ceres", method=method)


@pytest.mark.parametrize(
    ("solver", "preconditioner"),
    [
        ("sparse", "two-level"),
        ("implicit", "two-level"),
        ("implicit", "schur-jacobi"),
        ("cg", "jacobi"),
    ],
)
def test_conjugate_gradients_find_the_step_of_the_dense_problem_with_shared_lenses(
    solver, preconditioner
):
    rule = ConjugateGradients(preconditioner, forcing=0.0, tolerance=1e-13, budget=200)
    problem = unseen()
    options = StepOptions(linear_solver=solver, conjugate_gradients=rule)
    layout, before = support.start(problem, options)
    after, info = support.step(layout, before, 1e-2, options, min_gain=-np.inf)
    assert info.cg_iterations > 0
    found = support.difference(problem, support.back(problem, before, after), options)
    wanted = dense_step(problem, options, 1e-2)
    seen = np.ones(len(wanted), bool)
    seen[: problem.cameras.size] = np.repeat(
        np.isin(np.arange(problem.num_cameras), problem.camera_index), 9
    )
    np.testing.assert_allclose(found[seen], wanted[seen], rtol=0, atol=1e-7 * np.abs(wanted).max())


@pytest.mark.slow
def test_clusters_are_split_by_shared_lenses_whose_columns_they_have_in_common():
    scene = random_scene(SceneConfig(cameras=64, points=300, mean_track=5.0), seed=0)
    problem = with_lenses(scene, np.arange(64) % 2, np.ones((2, 3), bool))
    layout = build_layout(problem, StepOptions(linear_solver="implicit"))
    assert layout.clusters is not None
    assert layout.clusters.ties[1].several
    of_cluster = np.asarray(layout.clusters.ties[1].members)[np.asarray(layout.clusters.label)]
    np.testing.assert_array_equal(of_cluster, np.asarray(layout.unknowns.lenses.members))
    # the two changes that all cameras of a lens have in common cost few iterations
    rules = (ConjugateGradients(name) for name in ("two-level", "schur-jacobi"))
    two_level, plain = (
        solve(
            problem, "ceres", linear_solver="implicit", conjugate_gradients=rule, max_iterations=5
        )
        for rule in rules
    )
    assert two_level.history.cg_iterations.sum() < plain.history.cg_iterations.sum()


def test_padding_changes_neither_what_lenses_share_nor_what_they_hold():
    exact = solve(shared(), "ceres", pad=False)
    padded = solve(shared(), "ceres", pad=True)
    assert padded.capacity is not None
    np.testing.assert_allclose(padded.final_cost, exact.final_cost, rtol=1e-9)
    lenses = padded.problem.cameras[:, 6:]
    assert (lenses[~FREE[INDEX]] == shared().cameras[:, 6:][~FREE[INDEX]]).all()
    assert np.ptp(lenses[INDEX == 0], axis=0).max() == 0


@pytest.mark.parametrize("method", ["deeplm", "stba"])
def test_a_step_by_a_method_is_refused_as_it_would_let_cameras_of_a_lens_part(method):
    layout, state = support.start(shared())
    with pytest.raises(ValueError, match=f"shared lenses need plain LM, not {method}"):
        lm_step(layout, state, jnp.asarray(1e-3), StepOptions(method=make_method(method)))


def test_a_factorisation_that_needs_more_than_memory_is_refused(monkeypatch):
    monkeypatch.setattr("os.sysconf", lambda name: 1000 if name == "SC_PHYS_PAGES" else 1)
    with pytest.raises(ProblemError, match="6 cameras take some 0 GB"):
        solve(shared(), "ceres", linear_solver="explicit")


@pytest.mark.parametrize("dtype", ["float32", "mixed"])
def test_other_types_end_at_the_cost_of_float64_and_hold_what_is_held(dtype):
    problem = shared()
    exact = solve(problem, "ceres")
    rough = solve(problem, "ceres", dtype=dtype)
    np.testing.assert_allclose(geometry.cost(rough.problem), exact.final_cost, rtol=1e-5)
    held = ~FREE[INDEX]
    assert (rough.problem.cameras[:, 6:][held] == problem.cameras[:, 6:][held]).all()
    assert np.ptp(rough.problem.cameras[INDEX == 0, 6:], axis=0).max() == 0


def test_fixed_intrinsics_are_no_unknowns_and_leave_a_band_a_band():
    scene = random_scene(SceneConfig(cameras=100, points=500, mean_track=4.0), seed=0)
    one = with_lenses(scene, np.zeros(100, int), np.ones((1, 3), bool))
    layout = build_layout(one, StepOptions(intrinsics="fixed"))
    assert not layout.unknowns.shared
    assert layout.pairs is not None
    assert layout.pairs.band is not None


def test_the_command_refuses_a_folder_without_a_model(tmp_path, capsys):
    assert run([str(tmp_path)]) == 2
    assert (
        capsys.readouterr().err
        == f"error: {tmp_path}: no directory with a COLMAP model (cameras.bin or cameras.txt)\n"
    )
