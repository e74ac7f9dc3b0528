"""Ends are honest: nothing is called converged where nothing could happen, no focal length changes
its sign, and what is said of a start is what the solve computed."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import support
from support import solve, start, step

import jaxba
from jaxba import (
    BundleProblem,
    Loss,
    ProblemError,
    SolveOptions,
    StepOptions,
    Termination,
    make_policy,
    retriangulate,
)
from jaxba.cli.solve import run
from jaxba.damping.registry import POLICIES
from jaxba.problem import geometry
from jaxba.problem.labels import Labels
from jaxba.solver.diagnosis import explain_start

# Losses without a weight


def beyond(offset: float = 1e3) -> BundleProblem:
    """`tiny` with every key-point far from where it belongs."""
    problem = support.tiny()
    return problem.replace(observations=geometry.project(problem) + offset)


@pytest.mark.parametrize("method", ["lm", pytest.param("deeplm", marks=pytest.mark.slow)])
def test_a_solve_in_which_no_observation_has_a_weight_is_no_success(method):
    found = jaxba.solve(beyond(), "ceres", SolveOptions(loss=Loss("tukey", 2.0), method=method))
    assert (found.termination, found.iterations) == (Termination.NO_WEIGHT, 1)
    assert not found.converged
    assert "larger scale" in found.termination.reason
    assert np.array_equal(found.problem.cameras, beyond().cameras)


@pytest.mark.slow
def test_nor_in_the_compiled_loop_or_with_a_loss_of_ones_own():
    def flat(s):
        return jnp.minimum(s, 1.0)

    for loss in (Loss("tukey", 2.0), Loss(flat, 2.0)):
        found = solve(beyond(), "ceres", loss=loss)
        assert found.termination == Termination.NO_WEIGHT


def test_one_observation_with_a_weight_is_enough_to_begin():
    pixels = np.array(beyond().observations)
    pixels[7] = geometry.project(support.tiny())[7] + 0.5
    problem = support.tiny().replace(observations=pixels)
    layout, before = start(problem)
    assert not step(layout, before, 1e-3, StepOptions(loss=Loss("tukey", 2.0)))[1].weightless
    assert solve(problem, "ceres", loss=Loss("tukey", 2.0)).termination != Termination.NO_WEIGHT


@pytest.mark.parametrize("loss", ["squared", "tukey"])
def test_a_start_without_residuals_has_converged(loss):
    problem = support.tiny()
    exact = problem.replace(observations=geometry.project(problem))
    assert solve(exact, "ceres", loss=Loss(loss, 2.0)).converged


def test_weights_that_are_all_zero_are_refused():
    with pytest.raises(ProblemError, match="zero for every observation"):
        BundleProblem.create(*support.arrays(support.tiny()), weight=np.zeros(200))


def test_the_command_says_what_to_do(tmp_path, capsys):
    path = tmp_path / "far.txt"
    jaxba.write_problem(beyond(300.0), path)
    assert run([str(path), "--loss", "tukey"]) == 0
    printed = capsys.readouterr().out
    assert "not converged: every residual lies beyond the scale of the loss" in printed
    assert (
        "200 observations of 200 beyond --loss-scale 1 px had no weight: choose a larger one (half"
        in printed
    )
    assert "424 px" in printed  # 300 px each way


# Signs of focal lengths


@functools.cache
def mirrored() -> BundleProblem:
    """`tiny` with the pixels of one camera on the other side of the centre, which a negative focal
    length would fit."""
    problem = support.tiny()
    side = np.where(problem.camera_index == 2, -1.0, 1.0)[:, None]
    return problem.replace(observations=side * problem.observations)


def test_without_the_rule_the_focal_length_would_change_its_sign():
    truth = support.dense(mirrored(), StepOptions(), 1e-4)
    assert truth.step[9 * 2 + 6] < -mirrored().cameras[2, 6]
    layout, before = start(mirrored())
    after, info = step(layout, before, 1e-4, StepOptions())
    assert not info.accepted
    assert (after.cameras[6] > 0).all()


NAMES = [*POLICIES, "learned", "constant:1e-8"]
QUICK = {"ceres", "classic", "gauss-newton", "guarded", "ceres+embedded"}


@pytest.mark.parametrize(
    "name",
    [
        *sorted(QUICK),
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in sorted(
                {*NAMES, "ceres+refine3", "classic+embedded", "guarded+embedded"} - QUICK
            )
        ),
    ],
)
def test_no_policy_changes_the_sign_of_a_focal_length(name):
    found = jaxba.solve(mirrored(), name, SolveOptions(max_iterations=30, pad=True))
    assert (found.problem.cameras[:, 6] > 0).all()
    assert np.isfinite(found.problem.cameras).all()
    assert np.isfinite(found.problem.points).all()
    assert (np.diff([found.initial_cost, *found.history.cost]) <= 0).all()


@pytest.mark.parametrize("method", ["stba:3", pytest.param("deeplm", marks=pytest.mark.slow)])
def test_nor_does_any_method(method):
    found = jaxba.solve(mirrored(), "gauss-newton", SolveOptions(max_iterations=15, method=method))
    assert (found.problem.cameras[:, 6] > 0).all()


def test_a_negative_focal_length_stays_negative():
    cameras = np.array(support.tiny().cameras)
    cameras[:, 6] *= -1
    problem = support.tiny().replace(cameras=cameras, observations=-support.tiny().observations)
    found = jaxba.solve(problem, make_policy("ceres"), SolveOptions(max_iterations=5))
    assert found.accepted > 0
    assert (found.problem.cameras[:, 6] < 0).all()


# What is said of a start


def behind_glass() -> BundleProblem:
    """Point 3 on the plane of camera 2, which sees it in observation 20."""
    problem = support.tiny()
    number = int(np.flatnonzero((problem.camera_index == 2) & (problem.point_index == 3))[0])
    assert number == 20
    cameras = np.array(problem.cameras)
    points = np.array(problem.points)
    cameras[2, :6], points[3, 2] = 0, 0
    return problem.replace(cameras=cameras, points=points)


@pytest.mark.parametrize("asked", [{}, {"dtype": "float32"}, {"pad": True}, {"devices": 2}])
def test_without_iterations_the_start_is_measured_and_comes_back(asked):
    problem = support.tiny()
    problem = problem.replace(points=np.asarray(problem.points) + np.pi)  # no numbers of float32
    found = jaxba.solve(problem, options=SolveOptions(max_iterations=0, **asked))
    assert found.termination == Termination.MAX_ITERATIONS
    assert (found.iterations, found.accepted, found.converged) == (0, 0, False)
    assert found.initial_cost == found.final_cost
    np.testing.assert_allclose(
        found.final_cost, geometry.cost(problem), rtol=1e-12 if "dtype" not in asked else 1e-4
    )
    assert all(len(field) == 0 for field in found.history)
    assert np.array_equal(found.problem.cameras, problem.cameras)
    assert np.array_equal(found.problem.points, problem.points)


def huge(pixel: float) -> BundleProblem:
    pixels = np.array(support.tiny().observations)
    pixels[17] = pixel
    return support.tiny().replace(observations=pixels)


def test_a_point_on_the_plane_of_a_camera_is_named():
    words = r"observation 20, point 3 lies on the plane of camera 2$"
    with pytest.raises(ProblemError, match=words):
        solve(behind_glass(), "ceres")
    with pytest.raises(ProblemError, match=words):
        retriangulate(behind_glass())


def test_an_overflow_of_float32_alone_is_explained_as_one():
    with pytest.raises(
        ProblemError, match=r"observation 17, .* overflows in float32; float64 has a larger range"
    ):
        solve(huge(1e20), "ceres", dtype="float32", max_iterations=1)
    assert np.isfinite(solve(huge(1e20), "ceres", max_iterations=1).final_cost)
    with pytest.raises(
        ProblemError,
        match=r"observation 17, point \d+ has a residual in camera \d+ that overflows$",
    ):
        solve(huge(1e200), "ceres", max_iterations=1)


def test_a_sum_that_overflows_names_no_observation():
    many = support.tiny().replace(observations=np.full((200, 2), 5e18))
    assert np.isfinite(geometry.cost(many))
    with pytest.raises(ProblemError, match=r"^the cost at the start overflows in float32"):
        solve(many, "ceres", dtype="float32", max_iterations=1)


def test_the_explanation_is_that_of_the_loss():
    """A residual whose square overflows has a finite cost under no loss that looks at the
    square."""
    assert "observation 17" in explain_start(huge(1e200), Loss("cauchy"))


def test_messages_call_images_and_points_what_the_model_calls_them():
    problem = huge(1e200)
    camera = problem.camera_index[17]
    point = problem.point_index[17]
    names = tuple(f"{k}.jpg" for k in range(problem.num_cameras))
    count = problem.num_cameras
    labels = Labels(
        names, 70 + np.arange(count), np.arange(count), 7000 + np.arange(problem.num_points)
    )
    words = (
        f"point {7000 + point} has a residual in image {70 + camera} ({camera}.jpg) that overflows"
    )
    assert words in explain_start(problem.replace(labels=labels), Loss("cauchy"))
