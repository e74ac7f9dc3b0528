"""Covariance of what a solve finds: of poses, lenses and points, by the inverse of the Gauss-Newton
Hessian.

With `J^T J = [[B, E], [E^T, C]]` of the unknown numbers of cameras and points at the minimum,
undamped,

    cov(cameras) = S^-1,    S = B - E C^-1 E^T,
    cov(points)  = C^-1 + C^-1 E^T S^-1 E C^-1,    of given cameras: C^-1.

Directions that nothing determines are left out of both inverses. A number has a covariance if none
of them moves it.

It is that of the parameters if residuals are independent with unit variance: whitened, or pixels
with a noise of one pixel (else multiply by the variance). Robust losses weigh it as they weigh the
cost.

Source: Triggs et al. 2000, "Bundle Adjustment - A Modern Synthesis", section 9; COLMAP,
`EstimateBACovariance`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

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
from jaxba.solver.information import (
    CHUNK,
    COMPONENT,
    System,
    inverse_of,
    linear_at,
    system_of,
    unknown_index,
)
from jaxba.solver.place import check_problem, placed
from jaxba.structure.layout import Layout, build_layout
from jaxba.structure.unknowns import Unknowns
from jaxba.typing import ArrayRecord


@dataclass(frozen=True, eq=False, repr=False)
class Covariance(ArrayRecord):
    """Covariances. Rows and columns of what is constant are zero; those of what is not determined
    are NaN."""

    poses: Float[np.ndarray, "cameras 6 6"]
    """Of the pose of each camera: rotation (left perturbation `exp(d) R`, radians), then
    translation (scene units)."""

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
    """From the unknowns of a camera to its pose: of frame and extrinsics through the rig, of a
    shifted scene to this one."""

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
        """Covariance of a camera's pose in the frame of another, `P_2 = R P_1 + t`: left
        perturbation of R, and t.

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

    Memory grows with the square of the unknown numbers of cameras, and time with their cube. What
    is not determined by what is observed, as a point that is seen once, has NaN, and a
    ProblemWarning names it. The problem is a solved one, with the constants, gauge, priors and
    other residuals that were used; `loss` is the robust loss of the solve, squared if None. Raises
    ProblemError: the position, orientation or scale of the scene is free; `with_gauge`, constants
    or priors fix them."""
    check_problem(problem)
    options = StepOptions(
        linear_solver="implicit", loss=loss or Loss(), coordinates=Coordinates(rotation="manifold")
    )
    given = problem
    (counted, offset, problem) = placed(problem, facing_away(problem))
    free = SIMILARITY - fixed_freedoms(counted)
    if free:
        which = (
            "7 directions of the cameras are"
            if free == SIMILARITY
            else f"{free} of 7 directions of the scene are"
        )
        hint = "fix them with a gauge, constants or priors"
        raise ProblemError(f"{which} not determined by what is observed; {hint}")
    with numerics(np.float64):
        layout = build_layout(problem, options)
        linear = jax.device_get(jit(linear_at, static_argnames="options")(layout, problem, options))
    index, count = unknown_index(problem, layout)
    free_points = np.ones(problem.num_points, bool)
    if problem.constants is not None:
        free_points &= ~np.asarray(problem.constants.points)
    try:
        system = system_of(layout, linear, index, count, free_points)
        inverse, null = inverse_of(system)
    except np.linalg.LinAlgError:
        raise ProblemError("there are no covariances: derivatives of the pixels overflow") from None
    marginal, lost_by_cameras = _marginal(system, inverse, null)
    given_cameras = system.turn @ system.inverse @ system.turn.transpose(0, 2, 1)
    own = slice(given.num_points)  # without those that stand for rows of residuals
    lost_by_points = system.lost | (~system.seen & free_points)[:, None]
    for matrices, lost in (
        (marginal, lost_by_points | lost_by_cameras),
        (given_cameras, lost_by_points),
    ):
        matrices[lost[:, :, None] | lost[:, None]] = np.nan
    lost = np.linalg.norm(null, axis=1) > COMPONENT
    of_cameras = np.where(lost[:, None] | lost, np.nan, inverse)
    cameras = np.asarray(given.cameras)
    seen = np.asarray(layout.camera_seen)[: len(cameras)]
    index = index[: len(cameras)]
    rotations = geometry.rotation_matrices(cameras[:, :3])
    changes = _changes(problem, layout, rotations, offset)
    pairs = zip(changes, index, strict=True)
    poses = np.array([_through(change, _submatrix(of_cameras, row)) for change, row in pairs])
    poses[~seen] = np.nan
    lenses = _of_lenses(counted, layout.unknowns, seen, index, of_cameras)
    unseen = np.setdiff1d(np.arange(len(lenses)), np.asarray(every_lens(counted).index)[seen])

    def has(x):
        return np.isnan(x).any(axis=(1, 2))

    undetermined: dict[Part, np.ndarray] = {
        "image": np.flatnonzero(has(poses) & seen),
        "lens": np.setdiff1d(np.flatnonzero(has(lenses)), unseen),
        "point": np.flatnonzero((has(marginal) & system.seen)[own]),
    }
    parts = [
        part_names(problem.labels, kind, which)
        for kind, which in undetermined.items()
        if len(which)
    ]
    if parts:
        note = (
            f"not determined by what is observed, so with NaN for a covariance: {', '.join(parts)}"
        )
        warnings.warn(note, ProblemWarning, stacklevel=2)
    of_points = marginal[own], given_cameras[own]
    return Covariance(
        poses, lenses, *of_points, index, of_cameras, changes, rotations, cameras[:, 3:6]
    )


def _changes(
    problem: BundleProblem,
    layout: Layout,
    rotations: Float[np.ndarray, "cameras 3 3"],
    offset: np.ndarray,
) -> Float[np.ndarray, "cameras 6 width"]:
    """`Covariance.changes`. With a step w, d of its frame and v, e of its extrinsics, a camera in a
    rig turns by `M w + v` and moves by `M d + v x M t_r + e`; of a scene shifted by -o, `t = t' - R
    o`."""
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


def _marginal(
    system: System, of_cameras: Float[np.ndarray, "n n"], null: Float[np.ndarray, "n directions"]
) -> tuple[Float[np.ndarray, "points 3 3"], Bool[np.ndarray, "points 3"]]:
    """`C^-1 + C^-1 E^T S^-1 E C^-1` of each point, and the coordinates of points that cameras leave
    undetermined."""
    count = len(system.seen)
    unknowns = len(of_cameras)
    cross = (system.by_point.T @ system.jacobian).tocsr()
    own = np.sqrt(np.asarray(system.jacobian.multiply(system.jacobian).sum(axis=0)).ravel())
    null = null / np.where(own > 0, own, 1.0)[:, None]
    found = system.inverse.copy()
    lost = np.zeros((count, 3), bool)
    for start in range(0, count if unknowns else 0, CHUNK):
        part = slice(start, start + CHUNK)
        of_part = cross[3 * start : 3 * (start + CHUNK)]
        given = system.inverse[part]
        product = np.asarray(of_part @ of_cameras)  # (3 points, unknowns)
        columns = of_part.toarray().reshape(*given.shape[:2], unknowns)
        middle = np.einsum("piu,pju->pij", columns, product.reshape(columns.shape))
        found[part] += given @ middle @ given
        follow = (
            system.turn[part]
            @ given
            @ np.asarray(of_part @ null).reshape(*given.shape[:2], null.shape[1])
        )
        deviation = np.sqrt(
            np.einsum("pij,pjk,pik->pi", system.turn[part], given, system.turn[part])
        )
        lost[part] = np.linalg.norm(follow, axis=2) > COMPONENT * deviation
    return system.turn @ found @ system.turn.transpose(0, 2, 1), lost


def _of_lenses(
    problem: BundleProblem,
    unknowns: Unknowns,
    seen: np.ndarray,
    index: np.ndarray,
    of_cameras: np.ndarray,
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


def _through(
    change: Float[np.ndarray, "m n"], matrix: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "m m"]:
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
