"""The linear system of a problem where it is, for covariances: `[[B, E], [E^T, C]] = J^T J`, with
points eliminated."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.lm.step import initial_state
from jaxba.model.linearize import Linearization, linearize, only_free
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.structure.layout import Layout

UNDETERMINED = 1e-9
"""A direction is not determined where residuals change by less than this share of what each number
by itself changes them by: sums of Jacobian columns that cancel are known to some 1e-12 of them."""

WEAK = 1e-6
"""Eigenvalues of the camera system, scaled to a unit diagonal of B, below which they are computed
anew from the Jacobian: differences of squares know them to some 1e-16."""

COMPONENT = 1e-7
"""Part of a number in a direction that is not determined from which the number is not determined
either."""

CHUNK = 4096
"""Points whose covariances are computed at once."""


def linear_at(layout: Layout, problem: BundleProblem, options: StepOptions) -> Linearization:
    """The linear model of a problem that is laid out, in its unknowns."""
    state = initial_state(layout, problem, options)
    return only_free(
        layout, linearize(layout, state.cameras, state.points, options.loss), options.intrinsics
    )


def unknown_index(problem: BundleProblem, layout: Layout) -> tuple[np.ndarray, int]:
    """The unknown of each number in a camera's block, -1 where it is constant, and how many there
    are."""
    unknowns = layout.unknowns
    index = np.asarray(unknowns.numbers.index).reshape(problem.num_cameras, -1)
    free = np.asarray(layout.camera_seen)[:, None] & np.asarray(unknowns.free.values).T
    _, first, place = np.unique(index[free], return_index=True, return_inverse=True)
    found = np.full(index.shape, -1)
    found[free] = np.argsort(np.argsort(first))[place]
    return found, len(first)


class System(NamedTuple):
    """The linear system in observations, sorted by point. Steps of points are `turn u`, with
    columns of the Jacobian by u that are nearly orthogonal and of unit length, or zero where a
    point is not determined."""

    jacobian: Any  # sparse, of two rows for each observation, by the unknowns of cameras
    by_point: Any  # sparse, of two rows for each observation by u
    inverse: Float[np.ndarray, "points 3 3"]  # C^-1 of each point, in u
    turn: Float[np.ndarray, "points 3 3"]
    # coordinates that observations do not determine, whatever the cameras
    lost: Bool[np.ndarray, "points 3"]
    seen: Bool[np.ndarray, " points"]
    starts: Int[np.ndarray, " points_and_one"]  # first observation of each point
    observation: Int[np.ndarray, " observations"]  # the observation of the problem at each place
    residual: Float[np.ndarray, " rows"]  # two numbers of each observation


def system_of(
    layout: Layout,
    linear: Linearization,
    index: Int[np.ndarray, "cameras width"],
    count: int,
    free_points: Bool[np.ndarray, " points"],
) -> System:
    from scipy.sparse import csr_matrix

    held = np.asarray(layout.observation)
    points = len(free_points)
    mask = held < held.max()  # there is always an empty slot
    point = layout.points[np.asarray(layout.slot_point)[mask]]
    order = np.argsort(point, kind="stable")
    camera = np.asarray(layout.slot_camera)[mask][order]
    point = point[order]

    def columns(rows):
        return np.moveaxis(np.array([[row[mask] for row in pair] for pair in rows]), 2, 0)[order]

    by_camera = columns(linear.camera_jacobian)
    by_point = columns(linear.point_jacobian) * free_points[point][:, None, None]

    def squares(rows: np.ndarray) -> np.ndarray:
        sums = np.zeros((points, 3, 3))
        np.add.at(sums, point, np.einsum("nki,nkj->nij", rows, rows))
        return sums

    # squares know a weak direction badly, columns that are turned to it do not
    _, turn = np.linalg.eigh(squares(by_point))
    by_point = by_point @ turn[point]
    size = np.sqrt(np.diagonal(squares(by_point), axis1=1, axis2=2))
    known = size > UNDETERMINED * size.max(axis=1, keepdims=True)
    lost = (np.abs(turn) * ~known[:, None] > COMPONENT).any(axis=2) & free_points[:, None]
    turn = turn * np.where(known, 1 / np.where(known, size, 1.0), 0.0)[:, None]
    by_point = by_point * np.where(known, 1 / np.where(known, size, 1.0), 0.0)[point][:, None]
    inverse = np.linalg.inv(squares(by_point) + np.eye(3) * ~known[:, None]) * (
        known[:, None] & known[:, :, None]
    )

    rows = np.arange(2 * len(point))
    place = np.repeat(index[camera], 2, axis=0).ravel()
    used = place >= 0
    at = np.repeat(rows, index.shape[1])
    jacobian = csr_matrix((by_camera.ravel()[used], (at[used], place[used])), (len(rows), count))
    place = np.repeat(3 * point[:, None] + np.arange(3), 2, axis=0).ravel()
    seen = np.bincount(point, minlength=points) > 0
    starts = np.searchsorted(point, np.arange(points + 1))
    by_points = csr_matrix((by_point.ravel(), (np.repeat(rows, 3), place)), (len(rows), 3 * points))
    residual = np.stack(
        [np.asarray(number)[mask][order] for number in linear.residual], axis=1
    ).ravel()
    return System(
        jacobian, by_points, inverse, turn, lost, seen, starts, held[mask][order], residual
    )


def point_blocks(system: System) -> Any:
    """`C^-1` of all points, as one sparse matrix."""
    from scipy.sparse import bsr_matrix

    count = len(system.inverse)
    return bsr_matrix(
        (system.inverse, np.arange(count), np.arange(count + 1)), (3 * count, 3 * count)
    ).tocsr()


def inverse_of(
    system: System,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n directions"]]:
    """The inverse of S without the directions that are not determined, and an orthonormal basis of
    these, in which each number is divided by its deviation if all others are known."""
    whole = (system.jacobian.T @ system.jacobian).toarray()
    if not len(whole):
        return whole, whole
    cross = (system.jacobian.T @ system.by_point).tocsr()
    eliminated = point_blocks(system) @ cross.T
    roots = np.sqrt(np.diagonal(whole))
    scale = 1 / np.where(roots > 0, roots, 1.0)
    values, vectors = np.linalg.eigh(
        (whole - (cross @ eliminated).toarray()) * scale[:, None] * scale
    )
    weak = values < WEAK
    strong = vectors[:, ~weak]
    inverse = (strong / values[~weak]) @ strong.T
    null = np.zeros((len(whole), 0))
    if weak.any():
        candidates = vectors[:, weak]
        values, turn = np.linalg.eigh(_squares(system, eliminated, scale[:, None] * candidates))
        lost = values < UNDETERMINED**2
        candidates, null = candidates @ turn[:, ~lost], candidates @ turn[:, lost]
        inverse = inverse + (candidates / values[~lost]) @ candidates.T
    return inverse * scale[:, None] * scale, null


def _squares(
    system: System, eliminated: Any, steps: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, "k k"]:
    """Products of the changes of all residuals with steps of cameras, where points follow."""
    observations = int(system.starts[-1])
    change = system.jacobian[2 * observations :] @ steps
    found = change.T @ change
    for first in range(0, len(system.seen), CHUNK):
        last = min(first + CHUNK, len(system.seen))
        rows = slice(2 * system.starts[first], 2 * system.starts[last])
        columns = slice(3 * first, 3 * last)
        follow = eliminated[columns] @ steps
        change = system.jacobian[rows] @ steps - system.by_point[rows, columns] @ follow
        found += change.T @ change
    return found
