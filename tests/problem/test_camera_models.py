"""Camera models: derivatives are those of differences, and a user's own is solved like any
other."""

from __future__ import annotations

import pickle

import jax.numpy as jnp
import numpy as np
import pytest
import support
from scipy.spatial.transform import Rotation

from jaxba import (
    CAMERA_MODELS,
    BundleProblem,
    Lenses,
    Loss,
    SolveOptions,
    StepOptions,
    register_camera_model,
    solve,
)
from jaxba.linear.schur import jacobian_product
from jaxba.model.linearize import linearize
from jaxba.problem import geometry

START = {
    "omega": 0.8,
    "alpha": 0.6,
    "beta": 1.1,
    "width": 640.0,
    "height": 320.0,
    "cx": 320.0,
    "cy": 240.0,
}
MIXED = ("OPENCV", "SIMPLE_RADIAL_FISHEYE", "BAL")


def lens_of(name: str, rng: np.random.Generator) -> np.ndarray:
    numbers = []
    for parameter in CAMERA_MODELS[name].parameters:
        middle = 500.0 if parameter in ("f", "fx", "fy") else START.get(parameter, 0.0)
        numbers.append(middle * rng.uniform(0.9, 1.1) if middle else rng.uniform(-0.02, 0.02))
    return np.array(numbers)


def scene(*names: str, noise: float = 0.3, shared: bool = True) -> BundleProblem:
    """The cameras and points of a random scene, with lenses of these models in turn."""
    plain = support.tiny()
    rng = np.random.default_rng(1)
    models = tuple(CAMERA_MODELS[name] for name in names)
    size = max(map(len, models))
    cameras = np.zeros((plain.num_cameras, 6 + size))
    cameras[:, :6] = plain.cameras[:, :6]
    index = np.arange(plain.num_cameras) % len(names)
    for at, name in enumerate(names):
        cameras[index == at, 6 : 6 + len(models[at])] = lens_of(name, rng)
    free = np.ones((len(names), size), bool)
    if not shared:
        index, free = np.arange(plain.num_cameras), free[index]
    model = np.arange(len(free)) % len(names)
    problem = BundleProblem.create(
        cameras, *support.arrays(plain)[1:], lenses=Lenses(index, free, model, models)
    )
    pixels = geometry.project(problem)
    return problem.replace(observations=pixels + noise * rng.normal(size=pixels.shape))


COMMON = ("SIMPLE_RADIAL", "PINHOLE", "FULL_OPENCV", "OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE")


@pytest.mark.parametrize(
    "names",
    [
        *(
            pytest.param((name,), marks=() if name in COMMON else pytest.mark.slow)
            for name in CAMERA_MODELS
        ),
        MIXED,
    ],
    ids="+".join,
)
def test_residuals_and_derivatives_are_those_of_the_host_and_of_differences(names):
    problem = scene(*names, shared=False)
    layout, state = support.start(problem, StepOptions(linear_solver="implicit"))
    linear = linearize(layout, state.cameras, state.points, Loss())
    order = np.asarray(layout.points)
    rng = np.random.default_rng(2)
    # of focal lengths and principal points, and of the rest
    scale = np.where(np.abs(problem.cameras) > 10, 1.0, 1e-2)
    change = (
        scale * rng.normal(size=problem.cameras.shape),
        1e-2 * rng.normal(size=problem.points.shape),
    )
    # what a model has no number for is no column of a camera that has it
    sizes = np.array([len(problem.lenses.model_of(lens)) for lens in problem.lenses.index.tolist()])
    change[0][:, 6:][np.arange(problem.cameras.shape[1] - 6) >= sizes[:, None]] = 0
    points = jnp.asarray(change[1][np.minimum(order, len(change[1]) - 1)].T)
    found = jacobian_product(layout, linear, jnp.asarray(change[0]), points)

    def residuals(step: float) -> np.ndarray:
        cameras = problem.cameras + step * change[0]
        turned = Rotation.from_rotvec(step * change[0][:, :3]) * Rotation.from_rotvec(
            problem.cameras[:, :3]
        )
        cameras[:, :3] = turned.as_rotvec()
        return -geometry.residuals(
            problem.replace(cameras=cameras, points=problem.points + step * change[1])
        )

    mask = np.asarray(layout.slot_mask)
    camera = np.asarray(layout.slot_camera)[mask]
    point = order[np.asarray(layout.slot_point)[mask]]
    by_slot = np.lexsort((camera, point))
    by_host = np.lexsort((problem.camera_index, problem.point_index))

    def in_order(rows):
        return np.stack([np.asarray(row)[mask] for row in rows], axis=1)[by_slot]

    np.testing.assert_allclose(
        in_order(linear.residual), residuals(0.0)[by_host], rtol=1e-9, atol=1e-9
    )
    difference = (residuals(1e-4) - residuals(-1e-4))[by_host] / 2e-4
    np.testing.assert_allclose(
        in_order(found), difference, rtol=0, atol=1e-6 * np.abs(difference).max()
    )


def test_a_users_own_model_is_solved_and_a_second_one_of_its_name_is_refused():
    def project(lens, x, y, z):
        f, k = lens
        xp = x.__array_namespace__()
        scale = f / (z + k * xp.sqrt(x * x + y * y + z * z))  # the unified model
        return scale * x, scale * y

    register_camera_model("UNIFIED", "f k", project)
    try:
        with pytest.raises(ValueError, match="there is a camera model UNIFIED already"):
            register_camera_model("UNIFIED", "f k", lambda lens, x, y, z: (x, y))
        problem = scene("UNIFIED", noise=0.0)
        moved = problem.replace(
            points=problem.points
            + 0.01 * np.random.default_rng(0).normal(size=problem.points.shape)
        )
        solution = solve(moved, "ceres", SolveOptions(max_iterations=50))
        assert solution.final_cost < 1e-6 * solution.initial_cost
        np.testing.assert_allclose(
            solution.final_cost, geometry.cost(solution.problem), rtol=1e-6, atol=1e-12
        )
    finally:
        del CAMERA_MODELS["UNIFIED"]


@pytest.mark.slow
def test_mixed_models_end_at_one_cost_with_every_linear_solver_and_embedded_iterations():
    problem = scene(*MIXED)
    ways = (("guarded", "explicit"), ("ceres", "sparse"), ("ceres", "implicit"))

    def options(solver):
        return SolveOptions(linear_solver=solver, max_iterations=60)

    costs = [solve(problem, policy, options(solver)).final_cost for policy, solver in ways]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-5)


def test_a_problem_of_any_model_can_be_pickled_and_its_programs_are_named():
    for name in CAMERA_MODELS:
        problem = pickle.loads(pickle.dumps(scene(name)))
        assert problem.lenses.models == (CAMERA_MODELS[name],)


def test_lenses_with_impossible_models_are_refused():
    problem = scene("PINHOLE")
    parts = (problem.cameras, *support.arrays(problem)[1:])
    models = (CAMERA_MODELS["PINHOLE"],)
    index = problem.lenses.index
    free = problem.lenses.free
    for lenses, message in (
        (
            Lenses(index, free, np.array([1]), models),
            r"the model of lenses\[0\] is 1, outside 0..0",
        ),
        (Lenses(index, free[:, :3], None, models), "what is free, shape"),
    ):
        with pytest.raises(ValueError, match=message):
            BundleProblem.create(*parts, lenses=lenses)


@pytest.mark.parametrize(
    ("project", "message"),
    [
        (lambda lens, x, y, z: (lens[0] * np.exp(np.asarray(x)), y), "by JAX: it calls NumPy"),
        (lambda lens, x, y, z: (x, y) if x > 0 else (y, x), "by NumPy: "),
        (lambda lens, x, y, z: (x, y, z), "two coordinates"),
    ],
)
def test_a_wrong_camera_model_is_refused_when_registered(project, message):
    with pytest.raises(ValueError, match=message):
        register_camera_model("WRONG", "f", project)
    assert "WRONG" not in CAMERA_MODELS
