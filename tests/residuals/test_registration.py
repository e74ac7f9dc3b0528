"""Registration of residuals: what is refused, what stays when a scene moves, and costs by kind."""

from __future__ import annotations

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from test_rows import (
    CAMERAS,
    POINTS,
    apart,
    control_point,
    depth,
    example,
    pose,
    position,
    relative_pose,
    scene,
    whole,
)

import jaxba
from jaxba.problem import geometry
from jaxba.residuals import distance


@jaxba.residual
def idle(pose, point, *, at):
    return point - at


@jaxba.residual
def logarithm(point, *, at):
    return jnp.log(point[0] - at)


@jaxba.residual
def table(point):
    return jnp.outer(point, point)


@jaxba.residual
def broken(point):
    return point.nothing


@jax.custom_jvp
def doubled(x):
    return 2 * x


@doubled.defjvp
def _(primals, tangents):
    return doubled(*primals), 3 * tangents[0]


@jaxba.residual
def wrong_derivative(point):
    return doubled(point)


@jaxba.residual
def shared(pose, sensor, *, at):
    return pose.center * sensor - at


@jaxba.residual
def between_points(pose, point, point_2):
    return pose.to_camera(point) - point_2


@jaxba.residual
def complex_numbers(point):
    return 1j * point


@jaxba.residual
def many(point, point_2):
    return jnp.outer(point, point_2).ravel()


def refused():
    ones = {"at": 0.0, "sigma": 1.0}

    def of(rows, **more):
        return lambda p: jaxba.with_residual(p, rows, **more)

    image = {"image": np.ones((CAMERAS, 2))}

    def depths(**which):
        return depth(measured=1.0, sigma=1.0, **which)

    sensors = np.ones((2, 3))
    return {
        "no parameter": (lambda _: position(pose=0, at=0.0), "residual position needs sigma"),
        "another parameter": (
            lambda _: position(pose=0, lens=0, **ones),
            "residual position has no lens",
        ),
        "lengths": (
            lambda _: depths(pose=[0, 1], point=[0, 1, 2], image=0),
            "pose of depth must be a vector of 3",
        ),
        "not an index": (
            lambda _: position(pose=0.5, **ones),
            "pose of position must be a vector of 1 integers",
        ),
        "not finite": (
            lambda _: position(pose=0, at=np.nan, sigma=1.0),
            "at of position must be finite",
        ),
        "no rows": (of(position), "rows must be those of a residual, called with indices and data"),
        "no such camera": (
            of(position(pose=CAMERAS, **ones)),
            rf"pose of position\[0\] is {CAMERAS}, outside",
        ),
        "no such point": (
            of(control_point(point=-1, **ones)),
            r"point of control_point\[0\] is -1, outside",
        ),
        "no start": (
            of(depths(pose=0, point=0, image=0)),
            "image of residual depth has no start: give unknowns",
        ),
        "start of another shape": (
            of(depths(pose=0, point=0, image=0), unknowns={"image": 1.0}),
            "unknown image must have finite numbers, 1 to 5 rows",
        ),
        "too many rows": (
            of(depths(pose=0, point=0, image=0), unknowns={"image": np.ones((CAMERAS + 1, 2))}),
            "unknown image must have finite numbers, 1 to 5 rows",
        ),
        "no parameter of it": (
            of(position(pose=0, **ones), unknowns={"foo": [[1.0]]}),
            "unknown foo is no parameter",
        ),
        "no dict": (of(position(pose=0, **ones), unknowns=[1]), "unknowns a dict"),
        "two points with a camera": (
            of(between_points(pose=0, point=0, point_2=1)),
            "between_points: a camera and two points in one row are not supported",
        ),
        "many numbers of two points": (
            of(many(point=0, point_2=1)),
            "two points in a row, so at most 6 numbers, not 9",
        ),
        "no function": (lambda _: jaxba.residual(3), "made of a function"),
        "a taken name": (
            of(position(pose=0, **ones), unknowns={"lens": [[1.0]]}),
            "may not be named lens",
        ),
        "two cameras": (
            of(depths(pose=0, point=0, image=1), unknowns=image),
            "row 0 of .* depth: image 1 is not",
        ),
        "nothing depends": (
            of(idle(pose=0, point=0, at=1.0)),
            "residual idle depends on pose in no row",
        ),
        "infinite": (
            of(logarithm(point=0, at=1e6)),
            "residual logarithm is not finite at the start in row 0",
        ),
        "a short block": (
            of(depths(pose=0, point=0, image=0), unknowns={"image": np.ones((CAMERAS, 1))}),
            "residual depth cannot be computed: .*index 1 out of bounds for axis 0 with size 1",
        ),
        "complex": (
            of(complex_numbers(point=0)),
            "residual complex_numbers cannot be computed: .*it returns complex",
        ),
        "a matrix": (of(table(point=0)), "residual table must return a number or a vector"),
        "an error": (of(broken(point=0)), "residual broken cannot be computed: .*nothing"),
        "derivative": (
            of(wrong_derivative(point=0)),
            "derivatives of residual wrong_derivative do not agree",
        ),
        "two sensors": (
            of(shared(pose=[0, 0], sensor=[0, 1], at=0.0), unknowns={"sensor": sensors}),
            "camera 0 has two rows of the unknown sensor",
        ),
        "loss": (of(position(pose=0, **ones), loss="huber"), "loss must be a jaxba.Loss"),
        "default": (
            lambda _: jaxba.residual(lambda pose, *, at=1: at),
            "no \\*, \\*\\* and defaults",
        ),
        "no unknown": (lambda _: jaxba.residual(lambda *, at: at), "has no unknown"),
    }


@pytest.mark.parametrize("what", refused())
def test_what_is_wrong_with_a_residual_is_said_in_one_line(what, unchecked):
    attempt, message = refused()[what]
    with pytest.raises(ValueError, match=message) as caught:
        attempt(scene())
    assert "\n" not in str(caught.value)


def everything() -> jaxba.BundleProblem:
    """Positions, depths with a block for each camera, relative poses, and scale bars in one
    problem."""
    problem = example("depth")[0]
    centers = geometry.camera_centers(problem.cameras)
    problem = jaxba.with_residual(
        problem, position(pose=[0, 2], at=centers[[0, 2]] + 0.01, sigma=0.1)
    )
    turn = np.eye(3)
    shift = np.array([1.0, 0.0, 0.0])
    rows = relative_pose(pose=[0, 1], pose_2=[1, 2], turn=turn[None], shift=shift, sigma=2.0)
    problem = jaxba.with_residual(problem, rows, loss=jaxba.Loss("cauchy"))
    change = problem.points[[9, 5]] - problem.points[[0, 4]]
    by = np.hstack([np.linalg.norm(change, axis=1)[:, None], change]) / 0.1 + 0.5
    return jaxba.with_residual(problem, apart(point=[0, 4], point_2=[9, 5], by=by, sigma=0.1))


@pytest.mark.slow("another file has a sample of it")
def test_a_moved_scene_has_the_same_residuals_and_the_same_end():
    problem = everything()
    options = jaxba.SolveOptions(max_iterations=60)
    there = jaxba.solve(problem, "ceres", options)
    assert list(there.costs) == ["pixels", "depth", "position", "relative_pose", "apart"]
    pixels = 0.5 * np.sum(geometry.residuals(there.problem) ** 2)
    assert there.costs["pixels"] == pytest.approx(pixels, rel=1e-9)
    here = jaxba.solve(support.at_origin(problem, 100.0), "ceres", options)
    assert here.initial_cost == pytest.approx(there.initial_cost, rel=1e-9)
    assert here.final_cost == pytest.approx(there.final_cost, rel=1e-6)


@pytest.mark.slow
def test_rows_of_a_point_that_goes_go_and_the_others_stay():
    problem = everything()
    kept = problem.subset(problem.point_index != 4, points=np.delete(np.arange(POINTS), 4))
    assert kept.num_points == POINTS - 1
    of = dict(
        zip(["depth", "position", "relative_pose", "apart"], kept.residuals.rows, strict=True)
    )
    before = problem.residuals.rows[0].points[0]
    after = of["depth"].points[0]
    np.testing.assert_array_equal(kept.points[after], problem.points[before[before != 4]])
    np.testing.assert_array_equal([own[0] for own in of["apart"].points], [0, 8])
    assert len(of["apart"]) == 1


@pytest.mark.slow
def test_derivatives_by_the_data_are_those_of_differences():
    problem = jaxba.hold(everything(), poses=[0])
    tight = jaxba.SolveOptions(tolerances=jaxba.Tolerances(1e-15, 1e-15, 1e-15), max_iterations=200)
    solve = jaxba.differentiable_solve(problem, "ceres", tight)
    inputs = jax.tree.map(jnp.asarray, jaxba.inputs_of(problem))

    def value(inputs):
        return jnp.sum(solve(inputs)[1][::7])

    found = jax.grad(value)(inputs)
    (measured, sigma), *rest = inputs.residuals

    def at(step):
        return value(inputs._replace(residuals=((measured.at[5].add(step), sigma), *rest)))

    np.testing.assert_allclose(found.residuals[0][0][5], (at(1e-4) - at(-1e-4)) / 2e-4, rtol=5e-3)


def test_a_function_whose_globals_have_changed_is_compiled_anew():
    sigma = [1.0]

    @jaxba.residual
    def near(point, *, at):
        return (point - at) / sigma[0]

    problem = scene()
    rows = near(point=np.arange(5), at=0.0)
    costs = []
    for sigma[0] in (1.0, 0.1):
        solution = jaxba.solve(
            jaxba.with_residual(problem, rows), "ceres", jaxba.SolveOptions(max_iterations=0)
        )
        costs.append(solution.costs["near"])
        assert solution.initial_cost == pytest.approx(sum(solution.costs.values()))
        pixels = 0.5 * np.sum(geometry.residuals(problem) ** 2)
        assert solution.costs["pixels"] == pytest.approx(pixels, rel=1e-6)
    assert costs[1] == pytest.approx(100 * costs[0])


@pytest.mark.slow
def test_a_gauge_holds_no_scale_that_scale_bars_know():
    problem = jaxba.with_residual(
        scene(), distance(point=[0, 3], point_2=[7, 8], length=9.0, sigma=0.1)
    )
    tight = jaxba.SolveOptions(tolerances=jaxba.Tolerances(1e-14, 1e-14, 1e-14), max_iterations=300)
    ends = [
        jaxba.solve(p, "ceres", tight).final_cost
        for p in (problem, jaxba.with_gauge(problem, "two-cameras"))
    ]
    assert ends[1] == pytest.approx(ends[0], rel=1e-8)
    with pytest.warns(
        jaxba.ProblemWarning, match="1 of 7 directions of the scene are fixed already"
    ):
        jaxba.with_gauge(problem, "three-points")


def test_a_problem_with_residuals_can_be_pickled_and_compared():
    problem = jaxba.with_position_priors(
        everything(), geometry.camera_centers(scene().cameras), stddev=1.0, align=False
    )
    assert pickle.loads(pickle.dumps(problem)) == problem
    assert (
        "2 rows of position, 2 rows of relative_pose, 2 rows of apart, 5 rows of position_prior"
        in repr(problem)
    )


@pytest.mark.slow
def test_points_are_looked_for_anew_with_all_residuals():
    problem = everything()
    points = problem.points.copy()
    points[3] *= 40.0
    found = jaxba.retriangulate(problem.replace(points=points))
    assert found.moved >= 1
    costs = [
        jaxba.solve(x, options=jaxba.SolveOptions(max_iterations=0)).final_cost
        for x in (problem, found.problem)
    ]
    assert found.cost_after == pytest.approx(costs[1], rel=1e-9)
    assert costs[1] < 1.01 * costs[0]


@pytest.mark.slow
def test_other_types_and_levels_of_compilation_end_at_the_same_cost():
    problem = everything()
    truth = jaxba.solve(problem, "bold").final_cost
    for options in (
        jaxba.SolveOptions(dtype="mixed", compilation="full"),
        jaxba.SolveOptions(dtype="float32"),
    ):
        assert jaxba.solve(problem, "bold", options).final_cost == pytest.approx(truth, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["depth", "apart"])
def test_covariances_are_those_of_the_dense_inverse(kind):
    problem, rows = example(kind)
    problem = jaxba.hold(problem, poses=[0, 1])
    solved = jaxba.solve(problem, "ceres", jaxba.SolveOptions(max_iterations=200)).problem
    x, residuals = whole(solved, rows)
    jacobian = np.asarray(jax.jacfwd(residuals)(x))
    free = np.ones(len(x), bool)
    free[[*range(6), *range(9, 15)]] = False
    covariance = np.zeros((len(x), len(x)))
    covariance[np.ix_(free, free)] = np.linalg.inv(jacobian[:, free].T @ jacobian[:, free])
    found = jaxba.covariance(solved)
    points = slice(9 * CAMERAS, 9 * CAMERAS + 3 * POINTS)
    blocks = covariance[points, points].reshape(POINTS, 3, POINTS, 3)
    np.testing.assert_allclose(found.points, np.einsum("iaib->iab", blocks), rtol=1e-4, atol=1e-12)
    lens = slice(9 * 3 + 6, 9 * 4)
    np.testing.assert_allclose(found.lenses[3], covariance[lens, lens], rtol=1e-4, atol=1e-12)
    assert np.isfinite(pose(jnp.asarray(solved.cameras[0]))[0]).all()
