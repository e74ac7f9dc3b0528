"""Covariance of what a solve finds: of poses, lenses and points, by the inverse of the Gauss-Newton Hessian.

With `J^T J = [[B, E], [E^T, C]]` of the unknown numbers of cameras and points at the minimum, undamped,

    cov(cameras) = S^-1,    S = B - E C^-1 E^T,
    cov(points)  = C^-1 + C^-1 E^T S^-1 E C^-1,    of given cameras: C^-1.

It is that of the parameters if residuals are independent with unit variance: whitened, or pixels with a noise of one
pixel (else multiply by the variance). Robust losses weigh it as they weigh the cost.

Source: Triggs et al. 2000, "Bundle Adjustment - A Modern Synthesis", section 9; COLMAP, `EstimateBACovariance`.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxba.lm.step import initial_state
from jaxba.model.linearize import Linearization, linearize, only_free
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.facing import facing_away, without_views_of
from jaxba.problem.frames import in_frames
from jaxba.problem.intrinsics import LENS_SIZE, POSE_SIZE, lens_size
from jaxba.problem.losses import Loss
from jaxba.problem.options import Coordinates, StepOptions
from jaxba.problem.preprocess import far_middle, shift
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics
from jaxba.solver.prepare import check_problem
from jaxba.structure.layout import Layout, layout_for
from jaxba.typing import ArrayRecord

SINGULAR = 1e-12
"""Smallest eigenvalue of the reduced camera system, scaled to a unit diagonal, that is not taken for a free gauge. On
scenes with a gauge it is above 1e-9, and without one at the rounding error."""

CHUNK = 4096
"""Points whose covariances are computed at once."""


@dataclass(frozen=True, eq=False, repr=False)
class Covariance(ArrayRecord):
    """Covariances. Rows and columns of what is constant are zero; those of what nothing observes are NaN."""

    poses: Float[np.ndarray, "cameras 6 6"]
    """Of the pose of each camera: rotation (left perturbation `exp(d) R`, radians), then translation (scene units)."""

    lenses: Float[np.ndarray, "lenses numbers numbers"]
    """Of the numbers of each lens."""

    points: Float[np.ndarray, "points 3 3"]
    """Of each point, marginal: cameras are uncertain, too."""

    points_given_cameras: Float[np.ndarray, "points 3 3"]
    """Of each point, conditional: as if cameras were known."""

    unknowns: Int[np.ndarray, "cameras width"]
    """Row of each number of a camera in `cameras`: pose, then lens; -1 where it is constant."""

    cameras: Float[np.ndarray, "unknowns unknowns"]
    """Of all unknown numbers of cameras together."""

    changes: Float[np.ndarray, "cameras 6 width"]
    """From the unknowns of a camera to its pose: of frame and extrinsics through the rig, of a shifted scene to this
    one."""

    rotations: Float[np.ndarray, "cameras 3 3"]
    """Rotation matrices of the cameras."""

    translations: Float[np.ndarray, "cameras 3"]
    """Translations of the cameras."""

    def between(self, first: int, second: int) -> Float[np.ndarray, "12 12"]:
        """Joint covariance of the poses of two cameras."""
        rows = np.concatenate([self.unknowns[at] for at in (first, second)])
        width = len(rows) // 2
        change = np.zeros((12, 2 * width))
        change[:6, :width], change[6:, width:] = self.changes[first], self.changes[second]
        return change @ _submatrix(self.cameras, rows) @ change.T

    def relative_pose(self, first: int, second: int) -> Float[np.ndarray, "6 6"]:
        """Covariance of a camera's pose in the frame of another, `P_2 = R P_1 + t`: left perturbation of R, and t.

        By first-order propagation through `R = R_2 R_1^T` and `t = t_2 - R t_1`.
        """
        relative = self.rotations[second] @ self.rotations[first].T
        moved = relative @ self.translations[first]
        jacobian = np.zeros((6, 12))
        jacobian[:3, :3], jacobian[:3, 6:9] = -relative, np.eye(3)
        # R <- exp(d_2) R exp(-d_1): t_2 - R t_1 changes by d_2's and d_1's turn of R t_1
        jacobian[3:, 6:9], jacobian[3:, :3] = _cross(moved), -_cross(moved) @ relative
        jacobian[3:, 3:6], jacobian[3:, 9:] = -relative, np.eye(3)
        return jacobian @ self.between(first, second) @ jacobian.T


@numerics(np.float64, single_blas=False)
def covariance(problem: BundleProblem, *, loss: Loss | None = None) -> Covariance:
    """The covariance of the numbers of a problem at its minimum.

    Memory grows with the square of the unknown numbers of cameras, and time with their cube.

    Args:
        problem: a solved problem, with the constants, gauge and priors that were used.
        loss: robust loss of the solve; None: squared.

    Raises:
        ProblemError: the position, orientation and scale of the scene are free (`with_gauge`, constants or priors fix
            them), or something that is not constant is not determined by what is observed.
    """
    check_problem(problem)
    options = StepOptions(linear_solver="implicit", loss=loss or Loss(), coordinates=Coordinates(rotation="manifold"))
    given, problem = problem, without_views_of(problem, facing_away(problem))
    offset = far_middle(problem)
    problem = in_frames(problem if offset is None else shift(problem, -offset))
    with numerics(np.dtype("float64")):
        layout = layout_for(problem, options)
        linear = jax.device_get(jit(_linear, static_argnames="options")(layout, problem, options))
    index, count = _unknown_index(problem, layout)
    members = np.concatenate([np.asarray(points) for points in layout.bucket_points])
    mask = np.asarray(layout.slot_mask)
    camera, point = np.asarray(layout.slot_camera)[mask], members[np.asarray(layout.slot_point)[mask]]
    by_camera = np.moveaxis(np.array([[row[mask] for row in pair] for pair in linear.camera_jacobian]), 2, 0)
    by_point = np.moveaxis(np.array([[row[mask] for row in pair] for pair in linear.point_jacobian]), 2, 0)

    free_points = np.ones(problem.num_points, bool)
    if problem.constants is not None:
        free_points &= ~np.asarray(problem.constants.points)
    seen_points = np.bincount(point, minlength=problem.num_points) > 0
    system, inverse, coupling, rows = _reduced(index, count, camera, point, by_camera, by_point, free_points, linear)
    of_cameras = _inverse(system)
    of_points = np.where(free_points[:, None, None], inverse, 0.0)
    marginal = of_points + _of_cameras(of_cameras, of_points, coupling, rows, point)
    for matrices in (of_points, marginal):
        matrices[~seen_points & free_points] = np.nan
    seen = np.asarray(layout.camera_seen)
    cameras = np.asarray(given.cameras)
    rotations = geometry.rotation_matrices(cameras[:, :3])
    changes = _changes(problem, layout, rotations, offset)
    poses = np.array([_submatrix(of_cameras, row) for row in index])
    poses = changes @ poses @ changes.transpose(0, 2, 1)
    poses[~seen] = np.nan
    lenses = _of_lenses(problem, layout, index, of_cameras)
    return Covariance(poses, lenses, marginal, of_points, index, of_cameras, changes, rotations, cameras[:, 3:6])


def _changes(
    problem: BundleProblem, layout: Layout, rotations: Float[np.ndarray, "cameras 3 3"], offset: np.ndarray | None
) -> Float[np.ndarray, "cameras 6 width"]:
    """`Covariance.changes`. With a step w, d of its frame and v, e of its extrinsics, a camera in a rig turns by
    `M w + v` and moves by `M d + v x M t_r + e`; of a scene shifted by -o, `t = t' - R o`."""
    unknowns = layout.unknowns
    width = POSE_SIZE + LENS_SIZE if unknowns is None else unknowns.width
    changes = np.tile(np.eye(POSE_SIZE, width), (len(rotations), 1, 1))
    if unknowns is not None and unknowns.in_rigs:
        assert problem.rigs is not None
        turn = np.asarray(problem.rigs.rotation)
        changes[:, :3, :3] = changes[:, 3:6, 3:6] = turn
        moved = np.einsum("nij,nj->ni", turn, np.asarray(problem.cameras)[:, 3:6])
        by_extrinsics = np.tile(np.eye(EXTRINSICS_SIZE), (len(rotations), 1, 1))
        by_extrinsics[:, 3:, :3] = [-_cross(one) for one in moved]
        start = unknowns.size - EXTRINSICS_SIZE
        for place, column in enumerate(unknowns.columns):
            if column >= start:
                changes[:, :, POSE_SIZE + place] = by_extrinsics[:, :, column - start]
    if offset is not None:
        back = np.tile(np.eye(6), (len(rotations), 1, 1))
        back[:, 3:, :3] = [_cross(moved) for moved in rotations @ offset]  # -(w x R o) = [R o]x w
        changes = back @ changes
    return changes


def _linear(layout: Layout, problem: BundleProblem, options: StepOptions) -> Linearization:
    state = initial_state(layout, problem, options)
    return only_free(layout, linearize(layout, state.cameras, state.points, options.loss), options.intrinsics)


def _unknown_index(problem: BundleProblem, layout: Layout) -> tuple[np.ndarray, int]:
    """The unknown of each number in a camera's block, -1 where it is constant, and how many there are."""
    unknowns = layout.unknowns
    width = POSE_SIZE + LENS_SIZE if unknowns is None else unknowns.width
    cameras = problem.num_cameras
    index = np.arange(cameras * width).reshape(cameras, width)
    free = np.tile(np.asarray(layout.camera_seen)[:, None], (1, width))
    if unknowns is not None:
        index = np.asarray(unknowns.index(cameras))
        if unknowns.free is not None:
            free &= np.asarray(unknowns.free).T
    used, place = np.unique(index[free], return_inverse=True)
    found = np.full(index.shape, -1)
    found[free] = place
    return found, len(used)


def _reduced(
    index: np.ndarray,
    count: int,
    camera: np.ndarray,
    point: np.ndarray,
    by_camera: np.ndarray,
    by_point: np.ndarray,
    free_points: np.ndarray,
    linear: Linearization,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """S, the inverses of C, and for each observation its part of E with the unknowns of its rows."""
    from scipy.sparse import csr_matrix

    points = np.zeros((len(free_points), 3, 3))
    np.add.at(points, point, np.einsum("nki,nkj->nij", by_point, by_point))
    constant = ~free_points | (np.bincount(point, minlength=len(free_points)) == 0)
    points[constant] = np.eye(3)
    if np.linalg.cond(points).max(initial=0.0) > 1 / np.finfo(float).eps:
        bad = int(np.linalg.cond(points).argmax())
        raise ProblemError(f"point {bad} is not determined by what is observed: no covariance")
    inverse = np.linalg.inv(points)
    inverse[constant] = 0.0
    rows = index[camera]
    coupling = np.einsum("nka,nkj->naj", by_camera, by_point) * (rows >= 0)[:, :, None]
    # B - E C^-1 E^T as sparse products
    columns = np.repeat(rows[:, None], 2, axis=1).ravel()
    used = columns >= 0
    at = np.repeat(np.arange(2 * len(camera)), rows.shape[1])
    jacobian = csr_matrix((by_camera.ravel()[used], (at[used], columns[used])), (2 * len(camera), count))
    place = (3 * point[:, None, None] + np.arange(3)[None, None] + np.zeros_like(rows)[:, :, None]).ravel()
    of_row = np.repeat(rows[:, :, None], 3, axis=2).ravel()
    used = of_row >= 0
    cross = csr_matrix((coupling.ravel()[used], (of_row[used], place[used])), (count, 3 * len(free_points)))
    blocks = _block_diagonal(inverse)
    system = (jacobian.T @ jacobian).toarray() - (cross @ blocks @ cross.T).toarray()
    if linear.priors is not None:
        for row, block in zip(index, np.asarray(linear.priors.blocks), strict=True):
            own = row >= 0
            np.add.at(system, np.ix_(row[own], row[own]), block[np.ix_(own, own)])
    return system, inverse, coupling, rows


def _block_diagonal(blocks: Float[np.ndarray, "n 3 3"]):
    from scipy.sparse import bsr_matrix

    count = len(blocks)
    return bsr_matrix((blocks, np.arange(count), np.arange(count + 1)), (3 * count, 3 * count)).tocsr()


def _inverse(system: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    if not len(system):
        return system
    scale = 1 / np.sqrt(np.maximum(np.diagonal(system), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(system * scale[:, None] * scale)
    if values[0] < SINGULAR:
        null = int(np.sum(values < SINGULAR))
        hint = "; fix them with a gauge, constants or priors" if null <= 7 else ""
        raise ProblemError(f"{null} directions of the cameras are not determined by what is observed{hint}")
    return (vectors / values) @ vectors.T * scale[:, None] * scale


def _of_cameras(
    of_cameras: np.ndarray, given: np.ndarray, coupling: np.ndarray, rows: np.ndarray, point: np.ndarray
) -> Float[np.ndarray, "points 3 3"]:
    """`C^-1 E^T S^-1 E C^-1` of each point."""
    from scipy.sparse import csr_matrix

    count = len(given)
    if not len(of_cameras):
        return np.zeros((count, 3, 3))
    place = (3 * point[:, None, None] + np.arange(3)[None, None] + np.zeros_like(rows)[:, :, None]).ravel()
    of_row = np.repeat(rows[:, :, None], 3, axis=2).ravel()
    used = of_row >= 0
    cross = csr_matrix((coupling.ravel()[used], (place[used], of_row[used])), (3 * count, len(of_cameras)))
    found = np.zeros((count, 3, 3))
    for start in range(0, count, CHUNK):
        part = slice(start, start + CHUNK)
        of_part = cross[3 * start : 3 * (start + CHUNK)]
        product = np.asarray(of_part @ of_cameras)  # (3 points, unknowns)
        own = of_part.toarray().reshape(-1, 3, len(of_cameras))
        middle = np.einsum("piu,pju->pij", own, product.reshape(own.shape))
        found[part] = given[part] @ middle @ given[part]
    return found


def _of_lenses(
    problem: BundleProblem, layout: Layout, index: np.ndarray, of_cameras: np.ndarray
) -> Float[np.ndarray, "lenses numbers numbers"]:
    unknowns = layout.unknowns
    lenses = problem.lenses
    size = lens_size(lenses)
    columns = range(size) if unknowns is None else unknowns.columns
    place = [(k, column) for k, column in enumerate(columns) if column < size]
    of_camera = np.arange(problem.num_cameras) if lenses is None else np.asarray(lenses.index)
    count = problem.num_cameras if lenses is None else len(lenses.free)
    found = np.full((count, size, size), np.nan)
    for camera in np.flatnonzero(layout.camera_seen):
        rows = np.full(size, -1)
        for k, column in place:
            rows[column] = index[camera, POSE_SIZE + k]
        found[of_camera[camera]] = _submatrix(of_cameras, rows)
    return found


def _submatrix(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows and columns of a matrix; zeros for those at -1."""
    known = rows >= 0
    found = np.zeros((len(rows), len(rows)))
    found[np.ix_(known, known)] = matrix[np.ix_(rows[known], rows[known])]
    return found


def _cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
