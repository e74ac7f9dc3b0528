"""Derivatives of a solution are those of differences of solutions."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import SceneConfig, SolveOptions, Tolerances, differentiable_solve, inputs_of, rotations
from jaxba.problem import geometry
from jaxba.problem.frames import in_frames, out_of_frames
from jaxba.problem.freedoms import determined_directions, fixed_freedoms, free_directions

TIGHT = SolveOptions(tolerances=Tolerances(ftol=1e-15, xtol=1e-15, gtol=1e-13), max_iterations=300)


def scene() -> jaxba.BundleProblem:
    config = SceneConfig(cameras=6, points=40, mean_track=5.0, trajectory="orbit", max_depth=10.0)
    return jaxba.random_scene(config, seed=0)


def constrained() -> jaxba.BundleProblem:
    """One lens for all, a constant pose, a constant point and number, and measured positions of
    four cameras."""
    plain = scene()
    rng = np.random.default_rng(0)
    cameras = np.array(plain.cameras)
    cameras[:, 6:] = cameras[0, 6:]
    lenses = jaxba.Lenses(np.zeros(6, np.int32), np.ones((1, 3), bool))
    problem = jaxba.hold(
        plain.replace(cameras=cameras, lenses=lenses), poses=[0], points=[3], numbers=["k2"]
    )
    places = geometry.camera_centers(cameras)[1:5] + 0.05 * rng.normal(size=(4, 3))
    return jaxba.with_position_priors(
        problem, places, 0.01 * np.eye(3), images=[1, 2, 3, 4], align=False
    )


@pytest.mark.slow
@pytest.mark.parametrize("make", [scene, constrained], ids=["free gauge", "constants and priors"])
def test_compiled_and_mapped_derivatives_are_those_of_single_solves(make):
    problem = make()
    rng = np.random.default_rng(2)
    inputs = jax.tree.map(jnp.asarray, inputs_of(problem))
    solved = differentiable_solve(problem, "ceres", TIGHT)
    lenses = rng.normal(size=(6, 3)) * [1e-3, 1, 1]  # they are the same on an orbit of a free gauge

    def value(pixels):
        return jnp.sum(lenses * solved(inputs._replace(observations=pixels))[0][:, 6:])

    pixels = inputs.observations + 0.1 * rng.normal(size=(3, *inputs.observations.shape))
    found = jax.jit(jax.vmap(jax.value_and_grad(value)))(pixels)
    for number, one in enumerate(pixels):
        cost, gradient = jax.value_and_grad(value)(one)
        assert found[0][number] == pytest.approx(float(cost), rel=1e-6)
        np.testing.assert_allclose(
            found[1][number], gradient, atol=1e-5 * float(jnp.abs(gradient).max())
        )
    rows = jax.jacrev(lambda pixels: solved(inputs._replace(observations=pixels))[0][:2, 6])(
        pixels[0]
    )
    one = jax.grad(lambda pixels: solved(inputs._replace(observations=pixels))[0][1, 6])(pixels[0])
    np.testing.assert_allclose(rows[1], one, atol=1e-6 * float(jnp.abs(one).max()))


@pytest.mark.slow
@pytest.mark.parametrize("linear_solver", ["explicit", "implicit"])
def test_derivatives_by_observations_weights_priors_and_constants_are_those_of_differences(
    linear_solver,
):
    problem = constrained()
    rng = np.random.default_rng(1)
    problem = problem.replace(
        whitening=np.tile(np.array([[1.0, 0.3], [0.3, 0.8]]), (problem.num_observations, 1, 1))
    )
    inputs = jax.tree.map(jnp.asarray, inputs_of(problem))
    weights = (
        rng.normal(size=problem.cameras.shape) * [1, 1, 1, 1, 1, 1, 1e-3, 1, 1],
        rng.normal(size=(40, 3)),
    )

    def value(linear_solver: str, inputs) -> jax.Array:
        options = dataclasses.replace(TIGHT, linear_solver=linear_solver)
        cameras, points = differentiable_solve(problem, "ceres", options)(inputs)
        return jnp.sum(weights[0] * cameras) + jnp.sum(weights[1] * points)

    found = jax.grad(functools.partial(value, linear_solver))(inputs)
    ((position, whitening),) = inputs.residuals
    steps = {
        "observations": inputs.observations.at[7, 1].add(1.0) - inputs.observations,
        "residuals": ((position.at[1, 1].add(1.0) - position, jnp.zeros_like(whitening)),),
        "whitening": jnp.zeros_like(inputs.whitening).at[:30, 0].set(1.0),
        # k2 is one number of all
        "cameras": jnp.zeros_like(inputs.cameras).at[0, 4].set(1.0).at[:, 8].set(0.3),
        "points": jnp.zeros_like(inputs.points).at[3, 0].set(1.0),
    }
    for name, change in steps.items():
        start = getattr(inputs, name)

        def at(step, *pair):
            return jax.tree.map(lambda x, d: x + step * d, *pair)

        ends = [
            value("explicit", inputs._replace(**{name: at(step, start, change)}))
            for step in (1e-3, -1e-3)
        ]
        wanted = float(ends[0] - ends[1]) / 2e-3
        products = jax.tree.map(lambda a, b: float(jnp.sum(a * b)), getattr(found, name), change)
        np.testing.assert_allclose(sum(jax.tree.leaves(products)), wanted, rtol=5e-3)
    # what is not constant is only where the solve begins
    assert float(found.cameras[3, 0]) == 0
    assert float(found.points[5, 1]) == 0


@pytest.mark.slow
def test_the_scale_of_a_loss_is_an_input_by_what_whitens():
    """The cost over scale^2, with a loss of scale one, has the same minimum."""
    problem = constrained()
    inputs = jax.tree.map(jnp.asarray, inputs_of(problem))
    ((position, whitening),) = inputs.residuals
    eye = jnp.tile(jnp.eye(2), (problem.num_observations, 1, 1))

    def options(scale):
        return dataclasses.replace(TIGHT, loss=jaxba.Loss("cauchy", scale))

    solved = differentiable_solve(problem.replace(whitening=np.array(eye)), "ceres", options(1.0))
    weights = np.random.default_rng(3).normal(size=problem.cameras.shape) * [
        1,
        1,
        1,
        1,
        1,
        1,
        1e-3,
        1,
        1,
    ]

    def value(scale) -> jax.Array:
        scaled = inputs._replace(whitening=eye / scale, residuals=((position, whitening / scale),))
        return jnp.sum(weights * solved(scaled)[0])

    ends = [
        np.sum(weights * jaxba.solve(problem, "ceres", options(0.6 + step)).problem.cameras)
        for step in (1e-3, -1e-3)
    ]
    assert float(jax.grad(value)(0.6)) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=5e-3)


def small() -> jaxba.BundleProblem:
    """5 cameras and 20 points, all of equal lenses."""
    config = SceneConfig(cameras=5, points=20, mean_track=4.5, trajectory="orbit", max_depth=10.0)
    plain = jaxba.random_scene(config, seed=1)
    cameras = np.array(plain.cameras)
    cameras[:, 6:] = [600.0, -0.02, 0.001]
    exact = plain.replace(cameras=cameras)
    noise = np.random.default_rng(1).normal(size=plain.observations.shape)
    return exact.replace(observations=geometry.project(exact) + 0.5 * noise)


def shared(problem: jaxba.BundleProblem) -> jaxba.BundleProblem:
    lenses = jaxba.Lenses(np.zeros(5, np.int32), np.array([[True, True, False]]))
    return problem.replace(lenses=lenses)


def in_rig(problem: jaxba.BundleProblem) -> jaxba.BundleProblem:
    """Cameras 0 and 1 in a frame: the lens of camera 1 has a place in the rig."""
    matrices = geometry.rotation_matrices(problem.cameras[:, :3])
    moved = np.array(problem.cameras[:, 3:6])
    turn = np.tile(np.eye(3), (5, 1, 1))
    place = np.zeros((5, 3))
    turn[1] = matrices[1] @ matrices[0].T
    place[1] = moved[1] - turn[1] @ moved[0]
    return problem.replace(rigs=jaxba.Rigs(np.array([0, 0, 1, 2, 3], np.int32), turn, place))


def measured(problem: jaxba.BundleProblem) -> jaxba.BundleProblem:
    """Two positions are known: all but the roll about their line is fixed."""
    places = geometry.camera_centers(problem.cameras)[[1, 3]] + 0.02
    return jaxba.with_position_priors(problem, places, 0.01 * np.eye(3), images=[1, 3], align=False)


def seen_once(problem: jaxba.BundleProblem) -> jaxba.BundleProblem:
    """Of point 7 the first observation, of point 8 none."""
    first = np.flatnonzero(problem.point_index == 7)[0]
    kept = (problem.point_index != 7) & (problem.point_index != 8)
    kept[first] = True
    names = ("observations", "camera_index", "point_index")
    return problem.replace(**{name: getattr(problem, name)[kept] for name in names})


SETTINGS = {  # of each how many directions of a similarity are free
    "free": (lambda p: p, 7),
    "lenses held": (lambda p: jaxba.hold(p, lenses="all"), 7),
    "shared lens": (shared, 7),
    "two cameras": (lambda p: jaxba.with_gauge(p, "two-cameras"), 0),
    "shared lens, three points": (lambda p: jaxba.with_gauge(shared(p), "three-points"), 0),
    "a pose held, k2 held": (lambda p: jaxba.hold(p, poses=[1], numbers=["k2"]), 1),
    "a rotation and a point held": (lambda p: jaxba.hold(shared(p), rotations=[2], points=[3]), 1),
    "two points held": (lambda p: jaxba.hold(p, points=[3, 9], lenses="all"), 1),
    "positions of two": (lambda p: measured(shared(p)), 1),
    "a point seen once": (lambda p: seen_once(shared(p)), 7),
    "rig": (lambda p: in_rig(jaxba.hold(p, numbers=["k1", "k2"])), 6),
}


def from_a_body(
    problem: jaxba.BundleProblem, free: bool = False, apart: float = 1.0
) -> jaxba.BundleProblem:
    """A rig whose axes are those of no camera: camera 1 is `apart` times as far from camera 0 as it
    was."""
    rig = in_rig(problem)
    cameras = np.array(problem.cameras)
    assert rig.rigs is not None
    turn = rig.rigs.rotation
    place = np.tile([0.2, -0.1, 0.3], (5, 1))
    centers = geometry.camera_centers(cameras)
    matrices = geometry.rotation_matrices(cameras[:, :3])
    cameras[1, 3:6] = -matrices[1] @ (centers[0] + apart * (centers[1] - centers[0]))
    place[1] = cameras[1, 3:6] - turn[1] @ (cameras[0, 3:6] - place[0])
    lenses = jaxba.Lenses(np.array([0, 1, 0, 0, 0], np.int32), np.ones((2, 3), bool))
    rigs = jaxba.Rigs(rig.rigs.frame, turn, place, np.arange(5) == 1 if free else None)
    return problem.replace(cameras=cameras, lenses=lenses, rigs=rigs)


DIRECTIONS = SETTINGS | {
    "rig of a body": (from_a_body, 6),
    "rig of a body, a free place": (lambda p: from_a_body(p, free=True), 7),
    "rig of a body, a free place and a pose held": (
        lambda p: jaxba.hold(from_a_body(p, free=True), poses=[1]),
        0,
    ),
    "rig of a body, at one place": (lambda p: from_a_body(p, apart=0.0), 7),
    "rig of a body, a free place, positions of two": (
        lambda p: measured(from_a_body(p, free=True)),
        1,
    ),
}


@pytest.mark.parametrize("name", DIRECTIONS)
def test_free_directions_of_the_gauge_change_no_residual_and_nothing_that_is_held(name):
    make, count = DIRECTIONS[name]
    problem = make(small())
    here = in_frames(problem)
    cameras, points = free_directions(problem)
    assert len(cameras) == len(points) == 7 - fixed_freedoms(problem) == count
    size = np.abs(cameras).max(axis=(1, 2), initial=0.0) + np.abs(points).max(
        axis=(1, 2), initial=0.0
    )
    assert (size > 0.1).all()

    def moved(scale: float, of_cameras, of_points) -> jaxba.BundleProblem:
        found = here.cameras + scale * of_cameras
        turns = Rotation.from_rotvec(scale * of_cameras[:, :3]) * Rotation.from_rotvec(
            here.cameras[:, :3]
        )
        found[:, :3] = turns.as_rotvec()
        there = here.replace(cameras=found, points=here.points + scale * of_points)
        return there if here.rigs is None else there.replace(cameras=out_of_frames(there, found)[0])

    def changes(value) -> np.ndarray:
        step = 1e-5
        ends = [
            [value(moved(s, *one)) for one in zip(cameras, points, strict=True)]
            for s in (step, -step)
        ]
        return (np.array(ends[0]) - np.array(ends[1])) / (2 * step)

    if count:
        # of pixels, per extent of the scene
        np.testing.assert_allclose(changes(geometry.project), 0.0, atol=1e-4)
    if problem.constants is not None:
        assert (points[:, np.asarray(problem.constants.points)] == 0).all()
        assert (cameras[:, :, :6][:, np.asarray(problem.constants.poses)] == 0).all()
    if problem.residuals:
        np.testing.assert_allclose(
            changes(lambda p: geometry.camera_centers(p.cameras)[[1, 3]]), 0.0, atol=1e-8
        )


def test_what_determines_a_point_are_rays_that_are_not_parallel():
    problem = seen_once(jaxba.hold(small(), points=[3]))
    found = determined_directions(problem)
    ray = (
        problem.points[7]
        - geometry.camera_centers(problem.cameras)[
            problem.camera_index[problem.point_index == 7][0]
        ]
    )
    np.testing.assert_allclose(found[7] @ ray, 0, atol=1e-12)
    np.testing.assert_array_equal(
        np.linalg.matrix_rank(found), [{3: 0, 7: 2, 8: 0}.get(p, 3) for p in range(20)]
    )


def invariants(cameras: jax.Array, points: jax.Array) -> jax.Array:
    """Numbers that no similarity changes: ratios of distances of points and of cameras, an angle,
    focal lengths."""
    rotation = jnp.moveaxis(rotations.rotation_matrix(cameras[:, :3].T), 2, 0)

    def center(at):
        return -rotation[at].T @ cameras[at, 3:6]

    def length(x):
        return jnp.sqrt(jnp.sum(x * x))

    base = length(points[0] - points[11])
    turn = rotation[0] @ rotation[3].T
    ratios = length(points[2] - points[5]) / base, length(center(1) - points[4]) / base
    return jnp.stack(
        [*ratios, length(center(0) - center(3)) / base, turn[0, 1], cameras[4, 6] / 600]
    )


PAIRS = [
    (name, loss)
    for name in SETTINGS
    for loss in (("squared", "cauchy") if "lens" in name else ("squared",))
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "loss"), PAIRS)
def test_derivatives_of_invariants_are_those_of_differences_in_every_setting(name, loss):
    options = dataclasses.replace(TIGHT, loss=jaxba.Loss(loss, 3.0))
    solution = jaxba.solve(SETTINGS[name][0](small()), "ceres", options)
    problem = solution.problem
    find = differentiable_solve(problem, "ceres", options)
    inputs = jax.tree.map(jnp.asarray, inputs_of(problem))
    weights = np.array([1.0, -0.7, 0.5, 0.3, 0.8])
    step = 0.04

    def value(inputs):
        return jnp.sum(weights * invariants(*find(inputs)))

    found = jax.grad(value)(inputs)
    change = np.random.default_rng(2).normal(size=inputs.observations.shape)

    # central differences of fourth order
    def at(scale):
        return float(
            value(inputs._replace(observations=inputs.observations + scale * step * change))
        )

    wanted = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)
    # a solve ends some sqrt(2 ftol cost) pixels from its minimum
    away = 3 * np.sqrt(2 * TIGHT.tolerances.ftol * solution.final_cost) / step + 1e-7
    atol = away * np.linalg.norm(found.observations)
    np.testing.assert_allclose(jnp.sum(found.observations * change), wanted, rtol=0, atol=atol)


@pytest.mark.slow
def test_with_a_free_gauge_the_solution_moves_at_right_angles_to_its_orbit():
    problem = jaxba.solve(shared(small()), "ceres", TIGHT).problem
    find = differentiable_solve(problem, "ceres", TIGHT)
    inputs = jax.tree.map(jnp.asarray, inputs_of(problem))
    found, pull = jax.vjp(find, inputs)
    # all points and all translations moved by one vector: the derivative of how far along it is
    # zero
    by_translation = -geometry.rotation_matrices(problem.cameras[:, :3]).transpose(2, 0, 1)
    for k in range(3):
        along = np.zeros(problem.cameras.shape)
        along[:, 3:6] = by_translation[k]
        (gradient,) = pull((jnp.asarray(along), jnp.zeros_like(found[1]).at[:, k].set(1.0)))
        assert np.abs(gradient.observations).max() < 1e-9
