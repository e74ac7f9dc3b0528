"""Every kind of row of a residual of one's own, against SciPy's least squares on the same cost
written once more."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import jaxba
from jaxba.problem import geometry
from jaxba.scenes import SceneConfig, random_scene

CAMERAS = 5
POINTS = 30
AXES = np.diag([1.0, -1.0, -1.0])


@jaxba.residual
def position(pose, *, at, sigma):
    return (pose.center - at) / sigma


@jaxba.residual
def control_point(point, *, at, sigma):
    return (point - at) / sigma


@jaxba.residual
def focal_length(lens, *, mean, sigma):
    return (lens.numbers[0] - mean) / sigma


@jaxba.residual
def depth(pose, point, image, *, measured, sigma):
    return (image[0] * pose.to_camera(point)[2] + image[1] - measured) / sigma


@jaxba.residual
def relative_pose(pose, pose_2, *, turn, shift, sigma):
    between = pose.between(pose_2)
    off = between.rotation @ turn.T
    axis = jnp.stack([off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]]) / 2
    return jnp.concatenate([axis, between.translation - shift]) / sigma


@jaxba.residual
def drift(pose, pose_2, clock, clock_2, *, measured):
    return 5.0 * (
        jnp.sum((pose.center - pose_2.center) ** 2) * (1 + clock[0]) - clock_2[0] - measured
    )


@jaxba.residual
def apart(point, point_2, *, by, sigma):
    """Of points: their distance, and by how much each axis differs."""
    change = point_2 - point
    return jnp.concatenate([jnp.linalg.norm(change)[None], change]) / sigma - by


@jaxba.residual
def reprojection(pose, lens, point, *, pixel):
    return lens.project(pose.to_camera(point)) - pixel


def scene() -> jaxba.BundleProblem:
    return random_scene(SceneConfig(CAMERAS, POINTS, CAMERAS * POINTS), 3)


def depths(
    problem: jaxba.BundleProblem, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cameras, points and depths in one unit, of a third of the observations."""
    chosen = rng.permutation(problem.num_observations)[: problem.num_observations // 3]
    camera = problem.camera_index[chosen]
    point = problem.point_index[chosen]
    rotation = geometry.rotation_matrices(problem.cameras[camera, :3])
    local = np.einsum("nij,nj->ni", rotation, problem.points[point]) + problem.cameras[camera, 3:6]
    return camera, point, -local[:, 2] * (1 + 0.05 * rng.standard_normal(len(chosen)))


def pose(camera) -> tuple[jax.Array, jax.Array]:
    """R and t of a BAL camera in the axes of COLMAP, by the exponential series."""
    x, y, z = camera[:3]
    skew = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return AXES @ jax.scipy.linalg.expm(skew), AXES @ camera[3:6]


def pixels(camera, point) -> jax.Array:
    rotation, translation = pose(camera)
    local = rotation @ point + translation
    plane = local[:2] / local[2] * np.array([1.0, -1.0])
    square = plane @ plane
    return camera[6] * (1 + camera[7] * square + camera[8] * square**2) * plane


KINDS = {
    "position": "pose alone",
    "control": "point alone",
    "focal": "lens alone",
    "depth": "pose, point and a block for each camera",
    "relative": "two poses",
    "drift": "two poses and a block for all cameras",
    "apart": "two points",
}


def example(kind: str) -> tuple[jaxba.BundleProblem, object]:
    """A problem with rows of a kind, and these residuals as a function of cameras, points and
    blocks."""
    problem = scene()
    rng = np.random.default_rng(1)
    centers = geometry.camera_centers(problem.cameras)
    add = jaxba.with_residual
    all_cameras = np.arange(CAMERAS)

    def center(camera):
        return -pose(camera)[0].T @ pose(camera)[1]

    if kind == "position":
        at = centers + 0.05 * rng.standard_normal(centers.shape)
        found = add(problem, position(pose=all_cameras, at=at, sigma=0.02))
        return found, lambda cameras, points, _: (jax.vmap(center)(cameras) - at) / 0.02
    if kind == "control":
        which = np.arange(0, POINTS, 3)
        at = problem.points[::3] + 0.03 * rng.standard_normal((POINTS // 3, 3))
        sigma = np.linspace(0.01, 0.1, len(which))[:, None]
        found = add(problem, control_point(point=which, at=at, sigma=sigma))
        return found, lambda cameras, points, _: (points[which] - at) / sigma
    if kind == "focal":
        found = add(problem, focal_length(lens=all_cameras, mean=450.0, sigma=3.0))
        return found, lambda cameras, points, _: (cameras[:, 6] - 450.0) / 3.0
    if kind == "depth":
        camera, point, measured = depths(problem, rng)
        start = np.tile([1.0, 0.0], (CAMERAS, 1))
        rows = depth(pose=camera, point=point, image=camera, measured=measured, sigma=0.1)
        found = add(problem, rows, unknowns={"image": start})

        def of(c, x, b):
            return b[0] * (pose(c)[0] @ x + pose(c)[1])[2] + b[1]

        return (
            found,
            lambda cameras, points, blocks: (
                (jax.vmap(of)(cameras[camera], points[point], blocks[0][camera]) - measured) / 0.1
            ),
        )
    if kind == "relative":
        first = np.array([0, 1, 2, 4])
        second = np.array([1, 2, 3, 0])
        truth = [pose(jnp.asarray(c)) for c in problem.cameras]
        turn = np.array(
            [np.asarray(truth[j][0] @ truth[i][0].T) for i, j in zip(first, second, strict=True)]
        )
        turn = Rotation.from_rotvec(0.02 * rng.standard_normal((4, 3))).as_matrix() @ turn
        moved = [
            np.asarray(truth[j][1]) - t @ np.asarray(truth[i][1])
            for i, j, t in zip(first, second, turn, strict=True)
        ]
        sigma = np.array([0.01] * 3 + [0.05] * 3)
        found = add(
            problem, relative_pose(pose=first, pose_2=second, turn=turn, shift=moved, sigma=sigma)
        )

        def of(one, other, turn, shift):
            (r1, t1) = pose(one)
            (r2, t2) = pose(other)
            off = r2 @ r1.T @ turn.T
            axis = (
                jnp.array([off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]]) / 2
            )
            return jnp.concatenate([axis, t2 - r2 @ r1.T @ t1 - shift]) / sigma

        given = turn, np.array(moved)
        return found, lambda cameras, points, _: jax.vmap(of)(
            cameras[first], cameras[second], *given
        )
    if kind == "apart":
        first = np.array([0, 3, 5, 5])
        second = np.array([7, 8, 0, 9])
        change = problem.points[second] - problem.points[first]
        by = np.hstack(
            [np.linalg.norm(change, axis=1)[:, None], change]
        ) / 0.02 + rng.standard_normal((4, 4))
        found = add(problem, apart(point=first, point_2=second, by=by, sigma=0.02))

        def of_points(cameras, points, _):
            change = points[second] - points[first]
            return jnp.hstack([jnp.sqrt(jnp.sum(change**2, axis=1))[:, None], change]) / 0.02 - by

        return found, of_points
    first = np.arange(CAMERAS - 1)
    second = np.arange(1, CAMERAS)
    measured = np.sum((centers[first] - centers[second]) ** 2, axis=1) * 1.1
    zero = np.zeros(CAMERAS - 1, int)
    rows = drift(pose=first, pose_2=second, clock=zero, clock_2=zero, measured=measured)
    found = add(problem, rows, unknowns={"clock": [[0.05]]})

    def drifted(one, other, clock, measured):
        return 5.0 * (
            jnp.sum((center(one) - center(other)) ** 2) * (1 + clock[0]) - clock[0] - measured
        )

    return found, lambda cameras, points, blocks: jax.vmap(drifted, (0, 0, None, 0))(
        cameras[first], cameras[second], blocks[0][0], measured
    )


def whole(problem: jaxba.BundleProblem, rows) -> tuple[np.ndarray, object]:
    """All numbers of a problem as one vector, and its residuals as a function of them."""
    parts = [problem.cameras, problem.points, *problem.residuals.blocks]
    ends = np.cumsum([x.size for x in parts])

    def split(x):
        cameras, points, *blocks = [
            one.reshape(p.shape) for one, p in zip(jnp.split(x, ends[:-1]), parts, strict=True)
        ]
        return cameras, points, blocks

    def residuals(x):
        cameras, points, blocks = split(x)
        own = (
            jax.vmap(pixels)(cameras[problem.camera_index], points[problem.point_index])
            - problem.observations
        )
        return jnp.concatenate([own.ravel(), rows(cameras, points, blocks).ravel()])

    return np.concatenate([np.ravel(x) for x in parts]), residuals


QUICK = ("apart",)
SLOW = [
    pytest.param(kind, marks=() if kind in QUICK else pytest.mark.slow, id=what)
    for kind, what in KINDS.items()
]


@pytest.mark.parametrize("kind", SLOW)
def test_rows_have_the_cost_and_the_minimum_that_scipy_finds(kind):
    problem, rows = example(kind)
    start, residuals = whole(problem, rows)
    residuals = jax.jit(residuals)
    solution = jaxba.solve(
        problem, "ceres", jaxba.SolveOptions(tolerances=jaxba.Tolerances(1e-15, 1e-15, 1e-15))
    )
    assert solution.initial_cost == pytest.approx(
        0.5 * np.sum(np.square(residuals(start))), rel=1e-11
    )
    found = least_squares(
        residuals,
        start,
        jax.jit(jax.jacfwd(residuals)),
        x_scale="jac",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    assert solution.final_cost == pytest.approx(found.cost, rel=1e-9)
    after, _ = whole(solution.problem, rows)
    assert 0.5 * np.sum(np.square(residuals(after))) == pytest.approx(
        solution.final_cost, rel=1e-11
    )


@pytest.mark.parametrize(
    ("policy", "linear_solver"),
    [
        pytest.param("bold", "explicit", marks=pytest.mark.slow),
        pytest.param("ceres", "sparse", marks=pytest.mark.slow),
        pytest.param("bold", "implicit", marks=pytest.mark.slow),
    ],
)
def test_all_solvers_and_refinements_find_the_same_minimum(policy, linear_solver):
    for kind in ("depth", "relative", "apart"):
        problem, _ = example(kind)
        truth = jaxba.solve(problem, "ceres").final_cost
        options = jaxba.SolveOptions(linear_solver=linear_solver)
        assert jaxba.solve(problem, policy, options).final_cost == pytest.approx(truth, rel=1e-4)


@jaxba.residual
def planar(state, state_2, *, bearing, distance):
    seen = turned(state, state_2)
    return 10 * jnp.stack(
        [jnp.arctan2(seen[1], seen[0]) - bearing, jnp.sqrt(seen @ seen) - distance]
    )


@jaxba.residual
def odometry(state, state_2, *, move):
    return 5 * (jnp.concatenate([turned(state, state_2), (state_2[2] - state[2])[None]]) - move)


@jaxba.residual
def start(state):
    return 5 * state


def turned(state, state_2):
    cos = jnp.cos(state[2])
    sin = jnp.sin(state[2])
    return jnp.array([[cos, sin], [-sin, cos]]) @ (state_2[:2] - state[:2])


def test_unknowns_of_ones_own_alone_say_that_they_have_to_be_of_one_block():
    cameras = np.tile([0.0] * 6 + [1.0, 0.0, 0.0], (5, 1))
    rows = odometry(state=[0, 1], state_2=[1, 2], move=[2.0, 0.0, 0.0])
    with pytest.raises(
        jaxba.ProblemError, match=r"no residual says which .* a row for each of 5 cameras"
    ):
        jaxba.with_residual(
            jaxba.BundleProblem.create(cameras), rows, unknowns={"state": np.zeros((3, 3))}
        )


@pytest.mark.slow
def test_a_robot_in_the_plane_is_one_block_of_states_and_landmarks():
    """GTSAM's PlanarSLAMExample, without noise: three states, then two landmarks."""
    cameras = np.tile([0.0] * 6 + [1.0, 0.0, 0.0], (5, 1))
    problem = jaxba.hold(jaxba.BundleProblem.create(cameras), poses="all")
    truth = np.array([[0, 0, 0], [2, 0, 0], [4, 0, 0], [2, 2, 0], [4, 2, 0.0]])
    off = truth + np.array(
        [[-0.2, 0.2, 0.1], [0.3, 0.1, -0.2], [0.1, 0.1, 0.1], [-0.2, 0.1, 0], [0.1, -0.2, 0]]
    )
    rows = odometry(state=[0, 1], state_2=[1, 2], move=[2.0, 0.0, 0.0])
    problem = jaxba.with_residual(problem, rows, unknowns={"state": off})
    problem = jaxba.with_residual(problem, start(state=0))
    bearing = np.radians([45.0, 90.0, 90.0])
    length = [np.sqrt(8), 2.0, 2.0]
    rows = planar(state=[0, 1, 2], state_2=[3, 3, 4], bearing=bearing, distance=length)
    solution = jaxba.solve(jaxba.with_residual(problem, rows), "ceres")
    assert solution.final_cost < 1e-20
    np.testing.assert_allclose(solution.problem.residuals.blocks[0], truth, atol=1e-9)
