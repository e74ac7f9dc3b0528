"""Methods against dense algebra, and what each of them promises."""

from __future__ import annotations

import functools
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from support import DAMPINGS, bal_file, check_step, needs_data, solve, start, step

from jaxba import METHODS, BundleProblem, StepOptions, make_method, make_policy, read_bal
from jaxba.linear.schur import DampedSystem, apply_reduced, lift_to_cameras
from jaxba.methods.deeplm import GlobalConjugateGradients
from jaxba.methods.stba import (
    StochasticClusters,
    clustered_step,
    consensus_gradient,
    eliminate_replicas,
    richardson,
    solve_clusters,
)
from jaxba.model.linearize import linearize
from jaxba.problem.options import ConjugateGradients, Coordinates
from jaxba.runtime.compilation import CompileClock
from jaxba.typing import InputError

CLUSTERED = StepOptions(method=StochasticClusters(cluster_cameras=2))
ONE_CLUSTER = StepOptions(method=StochasticClusters(cluster_cameras=100))
MANIFOLD = replace(CLUSTERED, coordinates=Coordinates(rotation="manifold"))
NORMAL = StepOptions(
    method=GlobalConjugateGradients(
        ConjugateGradients(forcing=0.0, tolerance=1e-15, max_iterations=20000)
    )
)
THREE_ITERATIONS = StepOptions(
    method=GlobalConjugateGradients(ConjugateGradients(forcing=0.0, max_iterations=3))
)


def pieces(problem: BundleProblem, label: np.ndarray) -> BundleProblem:
    """The problem in which every point has been split into one per cluster that sees it."""
    key = np.asarray(problem.point_index) * (label.max() + 1) + label[problem.camera_index]
    names, index = np.unique(key, return_inverse=True)
    points = np.asarray(problem.points)[names // (label.max() + 1)]
    return BundleProblem.create(
        problem.cameras, points, problem.observations, problem.camera_index, index
    )


def systems(problem: BundleProblem, options: StepOptions, damping: float, iteration: int = 0):
    """Everything that a clustered step is made of."""
    layout, state = start(problem, options)
    layout = jax.tree.map(jnp.asarray, layout)
    return _system(layout, state, jnp.asarray(damping), options), layout.part("partitions").at(
        iteration
    )


@functools.partial(jax.jit, static_argnames=("options",))
def _system(layout, state, damping, options):
    linear = linearize(layout, state.cameras, state.points, options.loss)
    return DampedSystem.of(layout, linear, state.cameras, state.points, damping, options)


MADE = [
    pytest.param(support.tiny, id="tiny", marks=pytest.mark.slow),
    pytest.param(support.odd, id="odd", marks=pytest.mark.slow),
    pytest.param(support.whitened, id="whitened"),
]
"""Problems of which one with weights holds what the others hold."""

# STBA


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("make", MADE)
def test_stba_with_one_cluster_is_the_exact_step(make, damping):
    check_step(make(), ONE_CLUSTER, damping)


@pytest.mark.parametrize("damping", [1e-4, 1e-2, 1.0])
def test_stba_with_one_cluster_and_plain_lm_make_the_same_step(damping):
    """To 1e-10 of the step, in the norm of the damped Hessian, which both solve."""
    problem = support.tiny()
    made = []
    for kind in (ONE_CLUSTER, StepOptions()):
        layout, before = start(problem, kind)
        after, info = step(layout, before, damping, kind)
        assert info.accepted
        made.append(support.difference(problem, support.back(problem, before, after), kind))
    truth = support.dense(problem, ONE_CLUSTER, damping)
    assert truth.norm(made[0] - made[1]) <= 1e-10 * truth.norm(made[1])


@pytest.mark.slow
@pytest.mark.parametrize("damping", [1e-6, 1e-3])
def test_the_clusters_solve_the_problem_whose_points_are_split(damping):
    """Below lambda 1 the step is that of a dense solution in which nothing holds the pieces of a
    point together."""
    problem = support.tiny()
    options = MANIFOLD
    system, part = systems(problem, options, damping)
    split = eliminate_replicas(system.layout, system.linear, jnp.asarray(damping), part, options)
    right = lift_to_cameras(system.layout, system.linear, *split) - system.cameras.gradient
    parts = system._replace(points=system.points._replace(projected=split[0]))
    found = solve_clusters(parts, right, part)
    truth = support.dense(pieces(problem, np.asarray(part.label)), options, damping)
    np.testing.assert_allclose(found.ravel(), truth.step[: found.size], rtol=1e-6, atol=1e-9)


def test_the_split_reduced_system_is_block_diagonal():
    """The dense Schur complement of the split problem has nothing outside the clusters; that of the
    true one has."""
    problem = support.tiny()
    options = MANIFOLD
    label = np.asarray(systems(problem, options, 1e-3)[-1].label)
    apart = np.repeat(label, 9)[:, None] != np.repeat(label, 9)

    def reduced(problem: BundleProblem) -> np.ndarray:
        dense = support.dense(problem, options, 1e-3)
        hessian = dense.jacobian.T @ dense.jacobian + 1e-3 * np.diag(dense.diagonal)
        cut = problem.cameras.size
        return hessian[:cut, :cut] - hessian[:cut, cut:] @ np.linalg.solve(
            hessian[cut:, cut:], hessian[cut:, :cut]
        )

    assert np.all(reduced(pieces(problem, label))[apart] == 0)
    assert np.abs(reduced(problem)[apart]).max() > 1


@pytest.mark.slow
@pytest.mark.parametrize("damping", [1e-3, 30.0])
def test_repairs_shrink_error_and_residual_by_the_spectral_radius_of_the_jacobi_iteration(damping):
    """In the norm of B the error, and in that of B^-1 the residual, falls by at least the spectral
    radius of `B^-1 (B - S)`, which is below one."""
    problem = support.tiny()
    options = MANIFOLD
    system, part = systems(problem, options, damping)
    size = system.cameras.right.size
    basis = jnp.eye(size).reshape(size, -1, 9)
    matrix = np.asarray(jax.vmap(lambda x: apply_reduced(system, x))(basis)).reshape(size, size)
    own = np.zeros((size, size))
    for camera, block in enumerate(np.asarray(system.cameras.blocks)):
        own[9 * camera : 9 * camera + 9, 9 * camera : 9 * camera + 9] = block
    root = np.linalg.cholesky(own)
    inner = np.linalg.solve(root, np.linalg.solve(root, (own - matrix).T).T)
    radius = np.max(np.abs(np.linalg.eigvalsh((inner + inner.T) / 2)))
    assert radius < 1
    exact = np.linalg.solve(matrix, np.asarray(system.cameras.right).ravel())
    first = clustered_step(system, part, options, repairs=0)

    def error(x):
        return np.linalg.norm(root.T @ (np.asarray(x).ravel() - exact))

    def residual(x):
        return np.linalg.norm(np.linalg.solve(root, matrix @ (np.asarray(x).ravel() - exact)))

    for norm, whole in (
        (error, np.linalg.norm(root.T @ exact)),
        (residual, residual(np.zeros(size))),
    ):
        before = norm(first)
        assert before > 1e-6 * whole
        for rounds in (1, 2, 4, 8):
            after = norm(richardson(system, first, rounds))
            assert after <= radius**rounds * before * (1 + 1e-6) + 1e-9 * before


def test_agreed_gradients_equal_the_published_projection():
    """`g - H^T (H D^-1 H^T)^-1 H D^-1 g` with H taking differences to the first copy."""
    system, part = systems(support.tiny(), CLUSTERED, 2.0)
    layout = system.layout
    rng = np.random.default_rng(0)
    copies = part.levels[-1].shape[0]
    gradient = rng.normal(size=(3, copies))
    diagonal = rng.uniform(0.1, 9, size=(3, copies))
    found = np.asarray(
        consensus_gradient(layout, part, jnp.asarray(diagonal), jnp.asarray(gradient))
    )
    compared = 0
    for point in range(layout.num_points):
        slots = np.flatnonzero(
            np.asarray(layout.slot_mask) & (np.asarray(layout.slot_point) == point)
        )
        own = np.unique(np.asarray(part.slot_replica)[slots])
        for k in range(3):
            g = gradient[k, own]
            d = diagonal[k, own]
            expected = g
            if len(own) > 1:
                h = np.hstack([np.ones((len(own) - 1, 1)), -np.eye(len(own) - 1)])
                expected = g - h.T @ np.linalg.solve(h @ np.diag(1 / d) @ h.T, h @ (g / d))
                compared += 1
            np.testing.assert_allclose(found[k, own], expected, rtol=1e-9, atol=1e-12)
    assert compared > 20


def test_copies_agree_from_lambda_one_on_and_not_before():
    system, part = systems(support.tiny(), CLUSTERED, 1.0)

    def plain(damping):
        return eliminate_replicas(*system[:2], jnp.asarray(damping), part, CLUSTERED)

    below = plain(1 - 1e-9)
    above = plain(1.0)
    assert np.abs(np.stack(below[1]) - np.stack(above[1])).max() > 0.1
    np.testing.assert_allclose(np.stack(below[0][0]), np.stack(above[0][0]), rtol=1e-6)


@pytest.mark.parametrize("options", [CLUSTERED, THREE_ITERATIONS])
def test_an_inexact_step_predicts_what_its_own_linear_model_says(options):
    """`-(g.d + d.H d / 2)` of the step that was made, not of the one that would solve the
    system."""
    problem = support.tiny()
    damping = 1e-2
    layout, before = start(problem, options)
    after, info = step(layout, before, damping, options, -1e9)
    assert info.accepted
    made = support.difference(problem, support.back(problem, before, after), options)
    dense = replace(support.dense(problem, options, damping), step=made)
    np.testing.assert_allclose(info.predicted, dense.predicted, rtol=1e-9)
    exact = support.dense(problem, options, damping)
    assert np.linalg.norm(made - exact.step) > 1e-3 * np.linalg.norm(exact.step)


# DeepLM, global


@pytest.mark.parametrize("damping", [1e-2, 100.0])
@pytest.mark.parametrize("make", MADE)
def test_global_deeplm_run_to_convergence_is_the_exact_step(make, damping):
    check_step(make(), NORMAL, damping)


# All of them


@pytest.mark.parametrize(
    "method",
    [
        "lm",
        pytest.param("stba", marks=pytest.mark.slow),
        pytest.param("deeplm", marks=pytest.mark.slow),
    ],
)
def test_every_method_lowers_the_cost_under_its_own_rule_and_stops(method):
    problem = support.tiny()
    small = f"{method}:3" if method == "stba" else method
    solution = solve(problem, make_method(method).rule, method=small)
    reference = solve(problem, "ceres")
    assert solution.converged
    assert np.all(np.diff(solution.history.cost) <= 0)
    assert solution.final_cost <= reference.final_cost * (1 + 1e-2)


@pytest.mark.slow
def test_a_method_chosen_by_name_is_the_one_made_of_its_options():
    problem = support.tiny()
    by_name = solve(problem, "classic", method="deeplm")
    by_hand = solve(problem, "classic", StepOptions(method=GlobalConjugateGradients()))
    np.testing.assert_array_equal(by_name.history.cost, by_hand.history.cost)
    assert by_name.linear_solver == "deeplm"


def test_a_method_with_its_own_solver_takes_no_other():
    with pytest.raises(ValueError, match="its own"):
        solve(support.tiny(), "ceres", method="stba", linear_solver="explicit")
    assert (
        solve(support.tiny(), "ceres", method="deeplm", linear_solver="auto").linear_solver
        == "deeplm"
    )


def test_an_unknown_method_is_named_with_the_known_ones():
    with pytest.raises(InputError, match="lm, stba, deeplm"):
        solve(support.tiny(), method="magic")


@pytest.mark.parametrize("method", METHODS)
def test_every_method_names_a_rule_that_exists(method):
    make_policy(make_method(method).rule)


@pytest.mark.slow
@needs_data
def test_random_clusters_are_one_program_for_all_turns():
    """Ladybug-49 in clusters of 16: iterations draw different clusters and compile nothing new."""
    problem = read_bal(bal_file("problem-49-7776-pre"))
    options = make_method("stba:16").options(StepOptions())
    layout, state = start(problem, options)
    label = layout.part("partitions").label
    assert len(np.unique(label, axis=0)) > 10
    state, _ = step(layout, state, 1e-3, options, iteration=0)
    with CompileClock() as clock:
        for iteration in range(1, 4):
            state, info = step(layout, state, 1e-3, options, iteration=iteration)
            assert float(info.cost) <= float(info.previous_cost)  # of arrays it would be a program
    assert clock.seconds == 0


@pytest.mark.slow
def test_clusters_and_camera_blocks_factored_in_one_program_do_not_deadlock():
    """Two batched factorisations side by side stood still on two threads. In a process of its own,
    to be killed."""
    script = """
import jax
jax.config.update("jax_enable_x64", True)
from jaxba import SceneConfig, SolveOptions, random_scene, solve
scene = random_scene(SceneConfig(336, 2500, 9000), 0)
options = SolveOptions(method="stba:16", max_iterations=30, compilation="full")
solution = solve(scene, "constant:1e-2", options)
print(solution.final_cost < 0.5 * solution.initial_cost)
"""
    found = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=240, check=True
    )
    assert found.stdout.split() == ["True"]
