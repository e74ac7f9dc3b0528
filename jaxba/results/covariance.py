"""Covariance of what a solve finds: of poses, lenses and points, by the inverse of the Gauss-Newton Hessian.

With `J^T J = [[B, E], [E^T, C]]` of the unknown numbers of cameras and points at the minimum, undamped,

    cov(cameras) = S^-1,    S = B - E C^-1 E^T,
    cov(points)  = C^-1 + C^-1 E^T S^-1 E C^-1,    of given cameras: C^-1.

Directions that nothing determines are left out of both inverses. A number has a covariance if none of them moves it.

It is that of the parameters if residuals are independent with unit variance: whitened, or pixels with a noise of one
pixel (else multiply by the variance). Robust losses weigh it as they weigh the cost.

Source: Triggs et al. 2000, "Bundle Adjustment - A Modern Synthesis", section 9; COLMAP, `EstimateBACovariance`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.lm.step import initial_state
from jaxba.model.linearize import Linearization, linearize, only_free
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.problem.facing import facing_away
from jaxba.problem.freedoms import SIMILARITY, fixed_freedoms
from jaxba.problem.hold import every_lens
from jaxba.problem.intrinsics import POSE_SIZE, lens_size
from jaxba.problem.labels import Part, part_names
from jaxba.problem.losses import Loss
from jaxba.problem.options import Coordinates, StepOptions
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics
from jaxba.solver.place import check_problem, placed
from jaxba.structure.layout import Layout, build_layout
from jaxba.structure.unknowns import Unknowns
from jaxba.typing import ArrayRecord

UNDETERMINED = 1e-9
"""A direction is not determined where residuals change by less than this share of what each number by itself changes
them by: sums of Jacobian columns that cancel are known to some 1e-12 of them."""

WEAK = 1e-6
"""Eigenvalues of the camera system, scaled to a unit diagonal of B, below which they are computed anew from the
Jacobian: differences of squares know them to some 1e-16."""

COMPONENT = 1e-7
"""Part of a number in a direction that is not determined from which the number is not determined either."""

CHUNK = 4096
"""Points whose covariances are computed at once."""


@dataclass(frozen=True, eq=False, repr=False)
class Covariance(ArrayRecord):
    """Covariances. Rows and columns of what is constant are zero; those of what is not determined are NaN."""

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
        return _through(change, _submatrix(self.cameras, rows))

    def relative_pose(self, first: int, second: int) -> Float[np.ndarray, "6 6"]:
        """Covariance of a camera's pose in the frame of another, `P_2 = R P_1 + t`: left perturbation of R, and t.

        By first-order propagation through `R = R_2 R_1^T` and `t = t_2 - R t_1`."""
        relative = self.rotations[second] @ self.rotations[first].T
        moved = relative @ self.translations[first]
        jacobian = np.zeros((6, 12))
        jacobian[:3, :3], jacobian[:3, 6:9] = -relative, np.eye(3)
        # R <- exp(d_2) R exp(-d_1): t_2 - R t_1 changes by d_2's and d_1's turn of R t_1
        (across,) = geometry.cross_matrices(moved[None])
        jacobian[3:, 6:9], jacobian[3:, :3] = across, -across @ relative
        jacobian[3:, 3:6], jacobian[3:, 9:] = -relative, np.eye(3)
        return _through(jacobian, self.between(first, second))


@numerics(np.float64, single_blas=False)
def covariance(problem: BundleProblem, *, loss: Loss | None = None) -> Covariance:
    """The covariance of the numbers of a problem at its minimum.

    Memory grows with the square of the unknown numbers of cameras, and time with their cube. What is not determined by
    what is observed, as a point that is seen once, has NaN, and a ProblemWarning names it. The problem is a solved one,
    with the constants, gauge, priors and other residuals that were used; `loss` is the robust loss of the solve,
    squared if None. Raises ProblemError: the position, orientation or scale of the scene is free; `with_gauge`,
    constants or priors fix them."""
    check_problem(problem)
    options = StepOptions(linear_solver="implicit", loss=loss or Loss(), coordinates=Coordinates(rotation="manifold"))
    given, (counted, offset, problem) = problem, placed(problem, facing_away(problem))
    free = SIMILARITY - fixed_freedoms(counted)
    if free:
        which = "7 directions of the cameras are" if free == SIMILARITY else f"{free} of 7 directions of the scene are"
        hint = "fix them with a gauge, constants or priors"
        raise ProblemError(f"{which} not determined by what is observed; {hint}")
    with numerics(np.float64):
        layout = build_layout(problem, options)
        linear = jax.device_get(jit(_linear, static_argnames="options")(layout, problem, options))
    index, count = _unknown_index(problem, layout)
    free_points = np.ones(problem.num_points, bool)
    if problem.constants is not None:
        free_points &= ~np.asarray(problem.constants.points)
    try:
        system = _system(layout, linear, index, count, free_points)
        inverse, null = _inverse(system)
    except np.linalg.LinAlgError:
        raise ProblemError("there are no covariances: derivatives of the pixels overflow") from None
    marginal, lost_by_cameras = _marginal(system, inverse, null)
    given_cameras = system.turn @ system.inverse @ system.turn.transpose(0, 2, 1)
    own = slice(given.num_points)  # without those that stand for rows of residuals
    lost_by_points = system.lost | (~system.seen & free_points)[:, None]
    for matrices, lost in ((marginal, lost_by_points | lost_by_cameras), (given_cameras, lost_by_points)):
        matrices[lost[:, :, None] | lost[:, None]] = np.nan
    lost = np.linalg.norm(null, axis=1) > COMPONENT
    of_cameras = np.where(lost[:, None] | lost, np.nan, inverse)
    cameras = np.asarray(given.cameras)
    seen, index = np.asarray(layout.camera_seen)[: len(cameras)], index[: len(cameras)]
    rotations = geometry.rotation_matrices(cameras[:, :3])
    changes = _changes(problem, layout, rotations, offset)
    pairs = zip(changes, index, strict=True)
    poses = np.array([_through(change, _submatrix(of_cameras, row)) for change, row in pairs])
    poses[~seen] = np.nan
    lenses = _of_lenses(counted, layout.unknowns, seen, index, of_cameras)
    unseen = np.setdiff1d(np.arange(len(lenses)), np.asarray(every_lens(counted).index)[seen])
    has = lambda x: np.isnan(x).any(axis=(1, 2))
    undetermined: dict[Part, np.ndarray] = {
        "image": np.flatnonzero(has(poses) & seen),
        "lens": np.setdiff1d(np.flatnonzero(has(lenses)), unseen),
        "point": np.flatnonzero((has(marginal) & system.seen)[own]),
    }
    parts = [part_names(problem.labels, kind, which) for kind, which in undetermined.items() if len(which)]
    if parts:
        note = f"not determined by what is observed, so with NaN for a covariance: {', '.join(parts)}"
        warnings.warn(note, ProblemWarning, stacklevel=2)
    of_points = marginal[own], given_cameras[own]
    return Covariance(poses, lenses, *of_points, index, of_cameras, changes, rotations, cameras[:, 3:6])


def _changes(
    problem: BundleProblem, layout: Layout, rotations: Float[np.ndarray, "cameras 3 3"], offset: np.ndarray
) -> Float[np.ndarray, "cameras 6 width"]:
    """`Covariance.changes`. With a step w, d of its frame and v, e of its extrinsics, a camera in a rig turns by
    `M w + v` and moves by `M d + v x M t_r + e`; of a scene shifted by -o, `t = t' - R o`."""
    unknowns = layout.unknowns
    changes = np.tile(np.eye(POSE_SIZE, unknowns.width), (len(rotations), 1, 1))
    if unknowns.in_rigs:
        assert problem.rigs is not None
        turn = np.asarray(problem.rigs.rotation)[: len(rotations)]
        changes[:, :3, :3] = changes[:, 3:6, 3:6] = turn
        moved = np.einsum("nij,nj->ni", turn, np.asarray(problem.cameras)[: len(rotations), 3:6])
        by_extrinsics = np.tile(np.eye(EXTRINSICS_SIZE), (len(rotations), 1, 1))
        by_extrinsics[:, 3:, :3] = -geometry.cross_matrices(moved)
        start = unknowns.lens_size
        for place, column in enumerate(unknowns.columns):
            if start <= column < start + EXTRINSICS_SIZE:
                changes[:, :, POSE_SIZE + place] = by_extrinsics[:, :, column - start]
    back = np.tile(np.eye(6), (len(rotations), 1, 1))
    back[:, 3:, :3] = geometry.cross_matrices(rotations @ offset)  # -(w x R o) = [R o]x w
    return back @ changes


def _linear(layout: Layout, problem: BundleProblem, options: StepOptions) -> Linearization:
    state = initial_state(layout, problem, options)
    return only_free(layout, linearize(layout, state.cameras, state.points, options.loss), options.intrinsics)


def _unknown_index(problem: BundleProblem, layout: Layout) -> tuple[np.ndarray, int]:
    """The unknown of each number in a camera's block, -1 where it is constant, and how many there are."""
    unknowns = layout.unknowns
    index = np.asarray(unknowns.numbers.index).reshape(problem.num_cameras, -1)
    free = np.asarray(layout.camera_seen)[:, None] & np.asarray(unknowns.free.values).T
    _, first, place = np.unique(index[free], return_index=True, return_inverse=True)
    found = np.full(index.shape, -1)
    found[free] = np.argsort(np.argsort(first))[place]
    return found, len(first)


class _System(NamedTuple):
    """The linear system in observations, sorted by point. Steps of points are `turn u`, with columns of the Jacobian by
    u that are nearly orthogonal and of unit length, or zero where a point is not determined."""

    jacobian: Any  # sparse, of two rows for each observation, by the unknowns of cameras
    by_point: Any  # sparse, of two rows for each observation by u
    inverse: Float[np.ndarray, "points 3 3"]  # C^-1 of each point, in u
    turn: Float[np.ndarray, "points 3 3"]
    lost: Bool[np.ndarray, "points 3"]  # coordinates that observations do not determine, whatever the cameras
    seen: Bool[np.ndarray, " points"]
    starts: Int[np.ndarray, " points_and_one"]  # first observation of each point


def _system(
    layout: Layout,
    linear: Linearization,
    index: Int[np.ndarray, "cameras width"],
    count: int,
    free_points: Bool[np.ndarray, " points"],
) -> _System:
    from scipy.sparse import csr_matrix

    held, points = np.asarray(layout.observation), len(free_points)
    mask = held < held.max()  # there is always an empty slot
    point = layout.points[np.asarray(layout.slot_point)[mask]]
    order = np.argsort(point, kind="stable")
    camera, point = np.asarray(layout.slot_camera)[mask][order], point[order]
    columns = lambda rows: np.moveaxis(np.array([[row[mask] for row in pair] for pair in rows]), 2, 0)[order]
    by_camera = columns(linear.camera_jacobian)
    by_point = columns(linear.point_jacobian) * free_points[point][:, None, None]

    def squares(rows: np.ndarray) -> np.ndarray:
        found = np.zeros((points, 3, 3))
        np.add.at(found, point, np.einsum("nki,nkj->nij", rows, rows))
        return found

    # squares know a weak direction badly, columns that are turned to it do not
    _, turn = np.linalg.eigh(squares(by_point))
    by_point = by_point @ turn[point]
    size = np.sqrt(np.diagonal(squares(by_point), axis1=1, axis2=2))
    known = size > UNDETERMINED * size.max(axis=1, keepdims=True)
    lost = (np.abs(turn) * ~known[:, None] > COMPONENT).any(axis=2) & free_points[:, None]
    turn = turn * np.where(known, 1 / np.where(known, size, 1.0), 0.0)[:, None]
    by_point = by_point * np.where(known, 1 / np.where(known, size, 1.0), 0.0)[point][:, None]
    inverse = np.linalg.inv(squares(by_point) + np.eye(3) * ~known[:, None]) * (known[:, None] & known[:, :, None])

    rows = np.arange(2 * len(point))
    place = np.repeat(index[camera], 2, axis=0).ravel()
    used = place >= 0
    at = np.repeat(rows, index.shape[1])
    jacobian = csr_matrix((by_camera.ravel()[used], (at[used], place[used])), (len(rows), count))
    place = np.repeat(3 * point[:, None] + np.arange(3), 2, axis=0).ravel()
    seen, starts = np.bincount(point, minlength=points) > 0, np.searchsorted(point, np.arange(points + 1))
    by_points = csr_matrix((by_point.ravel(), (np.repeat(rows, 3), place)), (len(rows), 3 * points))
    return _System(jacobian, by_points, inverse, turn, lost, seen, starts)


def _inverse(system: _System) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n directions"]]:
    """The inverse of S without the directions that are not determined, and an orthonormal basis of these, in which each
    number is divided by its deviation if all others are known."""
    from scipy.sparse import bsr_matrix

    whole = (system.jacobian.T @ system.jacobian).toarray()
    if not len(whole):
        return whole, whole
    cross = (system.jacobian.T @ system.by_point).tocsr()
    count = len(system.inverse)
    blocks = bsr_matrix((system.inverse, np.arange(count), np.arange(count + 1)), (3 * count, 3 * count))
    eliminated = blocks.tocsr() @ cross.T
    own = np.sqrt(np.diagonal(whole))
    scale = 1 / np.where(own > 0, own, 1.0)
    values, vectors = np.linalg.eigh((whole - (cross @ eliminated).toarray()) * scale[:, None] * scale)
    weak = values < WEAK
    strong = vectors[:, ~weak]
    inverse, null = (strong / values[~weak]) @ strong.T, np.zeros((len(whole), 0))
    if weak.any():
        candidates = vectors[:, weak]
        values, turn = np.linalg.eigh(_squares(system, eliminated, scale[:, None] * candidates))
        lost = values < UNDETERMINED**2
        candidates, null = candidates @ turn[:, ~lost], candidates @ turn[:, lost]
        inverse = inverse + (candidates / values[~lost]) @ candidates.T
    return inverse * scale[:, None] * scale, null


def _squares(system: _System, eliminated: Any, steps: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k k"]:
    """Products of the changes of all residuals with steps of cameras, where points follow."""
    observations = int(system.starts[-1])
    change = system.jacobian[2 * observations :] @ steps
    found = change.T @ change
    for first in range(0, len(system.seen), CHUNK):
        last = min(first + CHUNK, len(system.seen))
        rows, columns = slice(2 * system.starts[first], 2 * system.starts[last]), slice(3 * first, 3 * last)
        follow = eliminated[columns] @ steps
        change = system.jacobian[rows] @ steps - system.by_point[rows, columns] @ follow
        found += change.T @ change
    return found


def _marginal(
    system: _System, of_cameras: Float[np.ndarray, "n n"], null: Float[np.ndarray, "n directions"]
) -> tuple[Float[np.ndarray, "points 3 3"], Bool[np.ndarray, "points 3"]]:
    """`C^-1 + C^-1 E^T S^-1 E C^-1` of each point, and the coordinates of points that cameras leave undetermined."""
    count, unknowns = len(system.seen), len(of_cameras)
    cross = (system.by_point.T @ system.jacobian).tocsr()
    own = np.sqrt(np.asarray(system.jacobian.multiply(system.jacobian).sum(axis=0)).ravel())
    null = null / np.where(own > 0, own, 1.0)[:, None]
    found, lost = system.inverse.copy(), np.zeros((count, 3), bool)
    for start in range(0, count if unknowns else 0, CHUNK):
        part = slice(start, start + CHUNK)
        of_part, given = cross[3 * start : 3 * (start + CHUNK)], system.inverse[part]
        product = np.asarray(of_part @ of_cameras)  # (3 points, unknowns)
        columns = of_part.toarray().reshape(*given.shape[:2], unknowns)
        middle = np.einsum("piu,pju->pij", columns, product.reshape(columns.shape))
        found[part] += given @ middle @ given
        follow = system.turn[part] @ given @ np.asarray(of_part @ null).reshape(*given.shape[:2], null.shape[1])
        deviation = np.sqrt(np.einsum("pij,pjk,pik->pi", system.turn[part], given, system.turn[part]))
        lost[part] = np.linalg.norm(follow, axis=2) > COMPONENT * deviation
    return system.turn @ found @ system.turn.transpose(0, 2, 1), lost


def _of_lenses(
    problem: BundleProblem, unknowns: Unknowns, seen: np.ndarray, index: np.ndarray, of_cameras: np.ndarray
) -> Float[np.ndarray, "lenses numbers numbers"]:
    lenses = every_lens(problem)
    size = lens_size(problem.lenses)
    found = np.full((len(lenses.free), size, size), np.nan)
    for camera in np.flatnonzero(seen):
        rows = np.full(size, -1)
        for k, column in enumerate(unknowns.columns):
            if column < size:
                rows[column] = index[camera, POSE_SIZE + k]
        found[lenses.index[camera]] = _submatrix(of_cameras, rows)
    return found


def _through(change: Float[np.ndarray, "m n"], matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "m m"]:
    """`change matrix change^T`, NaN where it depends on a number that is NaN."""
    lost = np.isnan(np.diagonal(matrix))
    found = change @ np.where(lost[:, None] | lost, 0.0, matrix) @ change.T
    depends = (change[:, lost] != 0).any(axis=1)
    found[depends], found[:, depends] = np.nan, np.nan
    return found


def _submatrix(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows and columns of a matrix; zeros for those at -1."""
    known = rows >= 0
    found = np.zeros((len(rows), len(rows)))
    found[np.ix_(known, known)] = matrix[np.ix_(rows[known], rows[known])]
    return found
