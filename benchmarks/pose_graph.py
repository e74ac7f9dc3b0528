"""Pose graphs beside GTSAM and Ceres: final costs, and milliseconds an iteration with residuals of
C++ and of Python.

    python -m benchmarks.pose_graph [--poses 1000] [--python 200] [--linear-solver auto]

Needs gtsam and pyceres in the same Python. The graph is a walk on a sphere with loop closures
between its rounds, of which each start is the sum of its noisy steps. All have GTSAM's error
`Log(T_measured^-1 T_1^-1 T_2)`, rotation before translation, and take Levenberg-Marquardt steps to
convergence. Functions in Python have derivatives by hand in GTSAM and Ceres, by JAX here; they are
timed on `--python` poses. Compilation is not counted, and printed."""

from __future__ import annotations

import argparse
import functools
import time

import gtsam  # pyright: ignore[reportMissingImports]
import jax
import jax.numpy as jnp
import numpy as np
import pyceres
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import jaxba
from jaxba.problem.options import LinearSolverChoice
from jaxba.rotations import angle_axis, left_jacobian_inverse

SIGMA = np.array([0.02] * 3 + [0.1] * 3)
"""Standard deviations of a measured pose: radians, and units in which the sphere has a radius of
20."""

AXES = np.array([1.0, -1.0, -1.0])
"""From the axes of COLMAP to those of BAL."""

ROUND = 50
RADIUS = 20.0
"""Poses in a round, and the sphere's radius."""


class Graph:
    """Poses from body to world, and relative ones from the second body to the first."""

    def __init__(self, count: int) -> None:
        random = np.random.default_rng(0)
        turn = np.arange(count)
        height = np.linspace(-0.9, 0.9, count)
        around = 2 * np.pi * turn / ROUND
        ring = np.sqrt(1 - height**2)
        at = RADIUS * np.stack([ring * np.cos(around), ring * np.sin(around), height], axis=1)
        rotation = Rotation.from_rotvec(around[:, None] * [0.0, 0.0, 1.0]).as_matrix()
        loops = np.arange(0, count - ROUND)
        self.first = np.concatenate([turn[:-1], loops])
        self.second = np.concatenate([turn[1:], loops + ROUND])
        noise = SIGMA * random.standard_normal((len(self.first), 6))
        inverse = rotation[self.first].transpose(0, 2, 1)
        relative = inverse @ rotation[self.second]
        moved = np.einsum("nij,nj->ni", inverse, at[self.second] - at[self.first])
        self.turn = relative @ Rotation.from_rotvec(noise[:, :3]).as_matrix()
        self.move = moved + np.einsum("nij,nj->ni", relative, noise[:, 3:])
        self.rotation = [rotation[0]]
        self.position = [at[0]]
        for k in range(count - 1):
            self.position.append(self.rotation[-1] @ self.move[k] + self.position[-1])
            self.rotation.append(self.rotation[-1] @ self.turn[k])


@jaxba.residual
def between(pose, pose_2, *, rotation, translation):
    """GTSAM's BetweenFactor of poses."""
    found = pose_2.between(pose)  # T_1^-1 T_2
    turn = angle_axis((rotation.T @ found.rotation)[None])
    move = rotation.T @ (found.translation - translation)
    return jnp.concatenate([turn[0], left_jacobian_inverse(turn.T)[:, :, 0] @ move]) / SIGMA


def problem_of(graph: Graph) -> jaxba.BundleProblem:
    """The graph, whose first pose is constant."""
    rotation = AXES[:, None] * np.array(graph.rotation).transpose(0, 2, 1)
    translation = -np.einsum("nij,nj->ni", rotation, np.array(graph.position))
    lens = np.tile([1.0, 0.0, 0.0], (len(rotation), 1))
    cameras = np.hstack([Rotation.from_matrix(rotation).as_rotvec(), translation, lens])
    problem = jaxba.hold(jaxba.BundleProblem.create(cameras), poses=[0])
    rows = between(
        pose=graph.first, pose_2=graph.second, rotation=graph.turn, translation=graph.move
    )
    return jaxba.with_residual(problem, rows)


def with_jaxba(graph: Graph, linear_solver: LinearSolverChoice) -> tuple[float, float, str]:
    """Final cost, seconds an iteration, and what else there is to say."""
    started = time.perf_counter()
    problem = problem_of(graph)
    registered = time.perf_counter() - started
    tight = jaxba.Tolerances(1e-14, 1e-14, 1e-14)
    options = jaxba.SolveOptions(compilation="full", linear_solver=linear_solver, tolerances=tight)
    solutions = [jaxba.solve(problem, "ceres", options) for _ in range(3)]
    best = min(one.total_s / one.iterations for one in solutions)
    products = solutions[0].history.cg_iterations.sum() / solutions[0].iterations
    one = solutions[0]
    more = f"{one.iterations} iterations, {one.linear_solver}, {products:.0f} products each"
    return (
        one.final_cost,
        best,
        f"{more}; registration {registered:.1f} s, compilation {one.compile_s:.1f} s",
    )


def python_factor(
    model: gtsam.noiseModel.Base, measured: gtsam.Pose3, first: int, second: int
) -> gtsam.CustomFactor:
    """The same factor, of a function in Python with derivatives by hand."""

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list | None) -> np.ndarray:
        one, two = (values.atPose3(key) for key in list(this.keys()))
        found = one.between(two)
        off = measured.between(found)
        if jacobians is not None:
            by_error = inverse_of_right_jacobian(gtsam.Pose3.Logmap(off))
            jacobians[0] = -by_error @ found.inverse().AdjointMap()
            jacobians[1] = by_error
        return gtsam.Pose3.Logmap(off)

    return gtsam.CustomFactor(model, [first, second], error)


def inverse_of_right_jacobian(twist: Float[np.ndarray, "6"]) -> Float[np.ndarray, "6 6"]:
    """Of SE(3), rotation first."""
    return np.linalg.inv(gtsam.Pose3.ExpmapDerivative(twist))


def with_gtsam(graph: Graph, in_python: bool) -> tuple[float, float, str]:
    """As `with_jaxba`."""
    model = gtsam.noiseModel.Diagonal.Sigmas(SIGMA)
    factors = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    poses = [
        gtsam.Pose3(gtsam.Rot3(r), p) for r, p in zip(graph.rotation, graph.position, strict=True)
    ]
    for key, pose in enumerate(poses):
        values.insert(key, pose)
    factors.add(gtsam.NonlinearEqualityPose3(0, poses[0]))
    for first, second, turn, move in zip(
        graph.first, graph.second, graph.turn, graph.move, strict=True
    ):
        measured = gtsam.Pose3(gtsam.Rot3(turn), move)
        make = (
            python_factor
            if in_python
            else lambda *x: gtsam.BetweenFactorPose3(x[2], x[3], x[1], x[0])
        )
        factors.add(make(model, measured, int(first), int(second)))
    options = gtsam.LevenbergMarquardtParams()
    options.setRelativeErrorTol(1e-14)
    options.setAbsoluteErrorTol(1e-14)
    best = np.inf
    for _ in range(1 if in_python else 3):
        optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, options)
        started = time.perf_counter()
        optimizer.optimize()
        best = min(best, (time.perf_counter() - started) / optimizer.iterations())
    return optimizer.error(), best, f"{optimizer.iterations()} iterations"


class PythonCost(pyceres.CostFunction):
    """The same residual of poses as vectors: world from body, angle-axis before translation."""

    def __init__(self, turn: np.ndarray, move: np.ndarray) -> None:
        super().__init__()
        self.set_num_residuals(6)
        self.set_parameter_block_sizes([6, 6])
        self._measured = gtsam.Pose3(gtsam.Rot3(turn), move)

    def Evaluate(self, parameters: list, residuals: np.ndarray, jacobians: list | None) -> bool:
        """Ceres' interface."""
        one, two = (gtsam.Pose3(gtsam.Rot3.Expmap(x[:3]), x[3:]) for x in parameters)
        found = one.between(two)
        twist = gtsam.Pose3.Logmap(self._measured.between(found))
        residuals[:] = twist / SIGMA
        if jacobians is not None:
            by_error = inverse_of_right_jacobian(twist) / SIGMA[:, None]
            for k, (pose, x, by) in enumerate(
                [
                    (one, parameters[0], -by_error @ found.inverse().AdjointMap()),
                    (two, parameters[1], by_error),
                ]
            ):
                if jacobians[k] is not None:
                    local = np.zeros((6, 6))
                    local[:3, :3] = gtsam.Rot3.ExpmapDerivative(x[:3])
                    local[3:, 3:] = pose.rotation().matrix().T
                    jacobians[k][:] = (by @ local).ravel()
        return True


def with_ceres(graph: Graph) -> tuple[float, float, str]:
    """As `with_jaxba`."""
    problem = pyceres.Problem()
    turns = Rotation.from_matrix(np.array(graph.rotation)).as_rotvec()
    poses = [np.concatenate(pair) for pair in zip(turns, graph.position, strict=True)]
    costs = [PythonCost(turn, move) for turn, move in zip(graph.turn, graph.move, strict=True)]
    for cost, first, second in zip(costs, graph.first, graph.second, strict=True):
        problem.add_residual_block(cost, None, [poses[first], poses[second]])
    problem.set_parameter_block_constant(poses[0])
    options = pyceres.SolverOptions()
    summary = pyceres.SolverSummary()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.function_tolerance = options.parameter_tolerance = options.gradient_tolerance = 1e-14
    options.max_num_iterations = 100
    options.num_threads = 1
    started = time.perf_counter()
    pyceres.solve(options, problem, summary)
    count = summary.num_successful_steps + summary.num_unsuccessful_steps
    return summary.final_cost, (time.perf_counter() - started) / count, f"{count} iterations"


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--python", type=int, default=200)
    parser.add_argument("--linear-solver", default="auto")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for count, in_python in ((arguments.poses, False), (arguments.python, True)):
        graph = Graph(count)
        own = functools.partial(with_jaxba, linear_solver=arguments.linear_solver)
        runs = {"jaxba": own, "gtsam, C++": lambda graph: with_gtsam(graph, False)}
        if in_python:
            runs |= {
                "gtsam, Python": lambda graph: with_gtsam(graph, True),
                "ceres, Python": with_ceres,
            }
        print(f"{count} poses, {len(graph.first)} relative poses")
        for name, run in runs.items():
            cost, seconds, more = run(graph)
            print(f"  {name:14} cost {cost:.12g}, {1e3 * seconds:.2f} ms an iteration; {more}")


if __name__ == "__main__":
    main()
