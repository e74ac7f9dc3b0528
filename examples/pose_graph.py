"""Solves a pose graph in g2o's format: vertices VERTEX_SE3:QUAT and edges EDGE_SE3:QUAT.

    python examples/pose_graph.py graph.g2o solved.g2o

A graph is a problem of cameras alone, with a relative pose for each edge
(`jaxba.residuals.relative_pose`). Information matrices are those of translation and rotation
vector, as GTSAM's `readG2o` takes them. The first vertex stays."""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import residuals

AXES = np.array([1.0, -1.0, -1.0])
"""From the axes of `jaxba.residuals`, which are any body's, to those of a BAL camera."""

ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


def read(text: str) -> tuple[list[str], jaxba.BundleProblem]:
    """Names of the vertices, and the graph."""
    lines = [line.split() for line in text.splitlines()]
    vertices = {
        words[1]: np.array(words[2:9], float) for words in lines if words[:1] == ["VERTEX_SE3:QUAT"]
    }
    edges = [words[1:] for words in lines if words[:1] == ["EDGE_SE3:QUAT"]]
    names = list(vertices)
    place = {name: k for k, name in enumerate(vertices)}
    poses = np.array(list(vertices.values()))
    turn = AXES[:, None] * Rotation.from_quat(poses[:, 3:]).inv().as_matrix()
    move = -np.einsum("nij,nj->ni", turn, poses[:, :3])
    cameras = np.hstack([Rotation.from_matrix(turn).as_rotvec(), move, np.ones((len(names), 3))])
    first, second = (np.array([place[edge[k]] for edge in edges]) for k in (0, 1))
    measured = np.array([edge[2:9] for edge in edges], float)
    information = np.zeros((len(edges), 6, 6))
    rows, columns = np.triu_indices(6)
    information[:, rows, columns] = information[:, columns, rows] = np.array(
        [edge[9:30] for edge in edges], float
    )
    information = information[:, ROTATION_FIRST[:, None], ROTATION_FIRST]
    edges_of_graph = residuals.relative_pose(
        pose=first,
        pose_2=second,
        rotation=Rotation.from_quat(measured[:, 3:]).as_matrix(),
        translation=measured[:, :3],
        whitening=np.linalg.cholesky(information).transpose(0, 2, 1),
    )
    return names, jaxba.with_residual(
        jaxba.hold(jaxba.BundleProblem.create(cameras), poses=[0]), edges_of_graph
    )


def written(names: list[str], problem: jaxba.BundleProblem) -> str:
    """The vertices."""
    turn = (AXES[:, None] * Rotation.from_rotvec(problem.cameras[:, :3]).as_matrix()).transpose(
        0, 2, 1
    )
    at = -np.einsum("nij,nj->ni", turn, AXES * problem.cameras[:, 3:6])
    poses = np.hstack([at, Rotation.from_matrix(turn).as_quat()])
    numbers = (" ".join(f"{x:.17g}" for x in pose) for pose in poses)
    return "".join(
        f"VERTEX_SE3:QUAT {name} {pose}\n" for name, pose in zip(names, numbers, strict=True)
    )


def main(source: str, target: str) -> jaxba.Solution:
    """Reads, solves, writes."""
    jax.config.update("jax_enable_x64", True)
    text = Path(source).read_text()
    names, problem = read(text)
    solution = jaxba.solve(problem)
    print(f"{len(names)} poses: cost {solution.initial_cost:.6e} -> {solution.final_cost:.6e}")
    edges = (line for line in text.splitlines(keepends=True) if not line.startswith("VERTEX"))
    Path(target).write_text(written(names, solution.problem) + "".join(edges))
    return solution


if __name__ == "__main__":
    main(*sys.argv[1:])
