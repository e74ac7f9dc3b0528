"""Damped normal equations, reduced to the cameras, solved, and carried back to the points.

With `H = [[B, E], [E^T, C]]` and damping `D` the step solves `(H + D) d = -g`. Points are eliminated
through `C + D_p = L L^T`: with `Q = J_p L^-T` per observation and `Y = J_c^T Q`, the reduced camera system is
`S = B + D_c - sum Y Y^T`, its right-hand side `-J_c^T (r - Q h)`, `h = L^-1 g_p`. Writing the right-hand
side with the projected residual `r - Q h` keeps it free of cancellation.

Rotations are perturbed on the manifold here. `Coordinates` says in which coordinates damping is diagonal.
Source: Triggs et al. 2000, section 6; Agarwal et al. 2010, section 3.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float, Int

from jaxba import camera
from jaxba.blocks3 import Cholesky3, cholesky3
from jaxba.cg import conjugate_gradients
from jaxba.layout import Layout
from jaxba.linearize import Linearization, normal_entries
from jaxba.options import DIAGONAL_MAXIMUM, DIAGONAL_MINIMUM, StepOptions
from jaxba.sums import point_sum, take, take_rows, tree_sum


class Step(NamedTuple):
    """A step and what the linear model says about it."""

    cameras: Float[Array, "9 cameras"]  # in the coordinates of the options
    points: Float[Array, "3 points"]
    predicted: Float[Array, ""]  # decrease of the cost promised by the linear model, pixels^2
    gradient_max: Float[Array, ""]  # largest entry of the gradient before the step
    cg_iterations: Int[Array, ""]  # 0 when the system was factored


class Coordinates(NamedTuple):
    """Maps between manifold rotation steps and the coordinates in which damping is diagonal."""

    forward: Float[Array, "cameras 3 3"]  # coordinates -> manifold
    inverse: Float[Array, "cameras 3 3"]

    @classmethod
    def of(cls, cameras: Float[Array, "9 cameras"], options: StepOptions) -> Coordinates:
        """Angle-axis coordinates need the left Jacobian; the manifold's own need nothing."""
        if options.rotation == "manifold":
            one = jnp.broadcast_to(jnp.eye(3, dtype=cameras.dtype), (cameras.shape[1], 3, 3))
            return cls(one, one)
        to_front = lambda m: jnp.moveaxis(m, -1, 0)
        return cls(to_front(camera.left_jacobian(cameras[:3])), to_front(camera.left_jacobian_inverse(cameras[:3])))


class PointSystem(NamedTuple):
    """The eliminated points."""

    factor: Cholesky3
    gradient: list[Array]  # g_p, [3] of (points,)
    damping: list[Array]  # D_p, [3] of (points,)
    solved: list[Array]  # h = L^-1 g_p
    projected: list[list[Array]]  # Q, [2][3] of (slots,)


class CameraSystem(NamedTuple):
    """What is left for the cameras, except the sum of Y Y^T."""

    blocks: Float[Array, "cameras 9 9"]  # B + D_c, manifold coordinates
    gradient: Float[Array, "cameras 9"]  # g_c, manifold coordinates
    right: Float[Array, "cameras 9"]  # right-hand side of the reduced system
    damping: Float[Array, "cameras 9"]  # D_c, diagonal in the options' coordinates


def solve_step(
    layout: Layout,
    linear: Linearization,
    cameras: Float[Array, "9 cameras"],
    damping: Float[Array, ""],
    options: StepOptions,
) -> Step:
    """One damped step.

    Args:
        layout: slots; must hold pairs when the options ask for the explicit solver.
        linear: Jacobians and residuals at the current parameters.
        cameras: current cameras, for the rotation coordinates.
        damping: lambda, dimensionless for diagonal scaling.
        options: solver, scaling, coordinates.

    Returns:
        The step; not finite where the factorisation failed, which the caller treats as a rejection.
    """
    coordinates = Coordinates.of(cameras, options)
    points = eliminate_points(layout, linear, damping, options)
    system = camera_system(layout, linear, points, coordinates, damping, options)
    if options.linear_solver == "explicit":
        reduced = explicit_system(layout, linear, points, system)
        step, iterations = _factor_and_solve(reduced, system.right), jnp.zeros((), jnp.int32)
    else:
        step, iterations = _implicit_solve(layout, linear, points, system, options)
    step = jnp.where(layout.camera_seen[:, None], step, jnp.zeros_like(step))
    point_step = back_substitute(layout, linear, points, step)
    turned = jnp.einsum("cij,cj->ci", coordinates.inverse, step[:, :3])
    camera_step = jnp.concatenate([turned, step[:, 3:]], axis=1)
    turned = jnp.einsum("cji,cj->ci", coordinates.forward, system.gradient[:, :3])
    gradient = jnp.concatenate([turned, system.gradient[:, 3:]], axis=1)
    gradient_max = jnp.maximum(jnp.max(jnp.abs(gradient)), jnp.max(jnp.abs(jnp.stack(points.gradient))))
    return Step(
        camera_step.T,
        jnp.stack(point_step),
        _predicted_decrease(points, system, step, camera_step, point_step),
        gradient_max,
        iterations,
    )


def eliminate_points(
    layout: Layout, linear: Linearization, damping: Float[Array, ""], options: StepOptions
) -> PointSystem:
    """Forms, damps and factors the 3 x 3 block of every point."""
    sums = point_sum(layout, jnp.stack(normal_entries(linear.point_jacobian, linear.residual)))
    matrix, gradient = [sums[k] for k in range(6)], [sums[k] for k in range(6, 9)]
    diagonal = [_damping_diagonal(matrix[k], damping, options) for k in (0, 2, 5)]
    for place, extra in zip((0, 2, 5), diagonal, strict=True):
        matrix[place] = matrix[place] + extra
    factor = cholesky3(matrix)
    solved = factor.forward(gradient)
    at_slot = Cholesky3(*take(jnp.stack(factor), layout.slot_point))
    projected = [at_slot.forward(row) for row in linear.point_jacobian]
    return PointSystem(factor, gradient, diagonal, solved, projected)


def camera_system(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    coordinates: Coordinates,
    damping: Float[Array, ""],
    options: StepOptions,
) -> CameraSystem:
    """Sums `[J_c, r, r - Q h]^T [J_c, r, r - Q h]` per camera: block, gradient and right-hand side at once."""
    solved = take(jnp.stack(points.solved), layout.slot_point)
    rows = []
    for k in range(2):
        reduced = linear.residual[k] - sum(points.projected[k][i] * solved[i] for i in range(3))
        rows += [*linear.camera_jacobian[k], linear.residual[k], reduced]
    level, *levels = layout.camera_levels
    gathered = take_rows(jnp.stack(rows).T, level).reshape(level.shape[0], -1, 11)
    products = tree_sum(jnp.einsum("kla,klb->kab", gathered, gathered), tuple(levels))
    blocks, gradient, right = products[:, :9, :9], products[:, :9, 9], -products[:, :9, 10]
    rotation = jnp.einsum("cji,cjk,ckl->cil", coordinates.forward, blocks[:, :3, :3], coordinates.forward)
    diagonal = jnp.concatenate(
        [jnp.diagonal(rotation, axis1=1, axis2=2), jnp.diagonal(blocks, axis1=1, axis2=2)[:, 3:]], axis=1
    )
    extra = _damping_diagonal(diagonal, damping, options)
    # a camera that nobody uses gets a unit block and so a zero step
    extra = jnp.where(layout.camera_seen[:, None], extra, jnp.ones_like(extra))
    turned = jnp.einsum("cji,cj,cjk->cik", coordinates.inverse, extra[:, :3], coordinates.inverse)
    damped = blocks + extra[:, :, None] * jnp.eye(9, dtype=extra.dtype)
    damped = damped.at[:, :3, :3].set(blocks[:, :3, :3] + turned)
    return CameraSystem(damped, gradient, right, extra)


def explicit_system(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "unknowns unknowns"]:
    """The reduced camera system as a dense matrix; only its lower triangle is filled."""
    pairs = layout.pairs
    if pairs is None:
        raise ValueError("this layout lists no pairs: build it with pairs=True for the explicit solver")
    coupling = _coupling_rows(linear, points)

    def multiply(sides: tuple[Array, Array]) -> Array:
        left, right = (take_rows(coupling, side).reshape(side.shape[0], -1, 9) for side in sides)
        return jnp.einsum("kla,klb->kab", left, right)

    # one batch after the other, so that the gathered operands stay small
    chunks = lax.map(multiply, (pairs.left, pairs.right)).reshape(-1, 81)
    blocks = tree_sum(chunks, pairs.levels)
    zero = jnp.zeros((1, 81), blocks.dtype)
    blocks = take_rows(jnp.concatenate([system.blocks.reshape(-1, 81), zero]), pairs.block_camera) - blocks
    cameras = layout.num_cameras
    dense = take_rows(blocks, pairs.table).reshape(cameras, cameras, 9, 9)
    return dense.transpose(0, 2, 1, 3).reshape(9 * cameras, 9 * cameras)


def apply_reduced(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem, x: Float[Array, "cameras 9"]
) -> Float[Array, "cameras 9"]:
    """`S x` without forming S: two passes over the observations."""
    inner = _project_to_points(layout, linear, points, x)
    at_slot = take(jnp.stack(inner), layout.slot_point)
    lifted = [sum(points.projected[k][i] * at_slot[i] for i in range(3)) for k in range(2)]
    first, second = linear.camera_jacobian
    columns = jnp.stack([first[a] * lifted[0] + second[a] * lifted[1] for a in range(9)])
    return jnp.einsum("cab,cb->ca", system.blocks, x) - tree_sum(columns.T, layout.camera_levels)


def back_substitute(
    layout: Layout, linear: Linearization, points: PointSystem, step: Float[Array, "cameras 9"]
) -> list[Array]:
    """Point steps `-L^-T (h + sum Y^T step)`, three vectors over points."""
    inner = _project_to_points(layout, linear, points, step)
    return [-x for x in points.factor.backward([h + w for h, w in zip(points.solved, inner, strict=True)])]


def _coupling_rows(linear: Linearization, points: PointSystem) -> Float[Array, "slots 27"]:
    """`Y = J_c^T Q` of every slot, the point's index slow and the camera's fast."""
    first, second = linear.camera_jacobian
    over, under = points.projected
    columns = [first[a] * over[i] + second[a] * under[i] for i in range(3) for a in range(9)]
    return jnp.stack(columns).T


def _project_to_points(
    layout: Layout, linear: Linearization, points: PointSystem, x: Float[Array, "cameras 9"]
) -> list[Array]:
    """`sum Y^T x` over each point's slots."""
    at_slot = take(x.T, layout.slot_camera)
    moved = [sum(row[a] * at_slot[a] for a in range(9)) for row in linear.camera_jacobian]
    inner = jnp.stack([points.projected[0][i] * moved[0] + points.projected[1][i] * moved[1] for i in range(3)])
    return list(point_sum(layout, inner))


def _damping_diagonal(diagonal: Array, damping: Float[Array, ""], options: StepOptions) -> Array:
    if options.scaling == "identity":
        return jnp.full_like(diagonal, 1) * damping
    high = min(DIAGONAL_MAXIMUM, float(jnp.finfo(diagonal.dtype).max) / 4)
    return damping * jnp.clip(diagonal, DIAGONAL_MINIMUM, high)


def _factor_and_solve(matrix: Float[Array, "n n"], right: Float[Array, "cameras 9"]) -> Float[Array, "cameras 9"]:
    """Cholesky after Jacobi scaling; not finite when the matrix is not positive definite."""
    scale = lax.rsqrt(jnp.diagonal(matrix))
    factor = jnp.linalg.cholesky(matrix * scale[:, None] * scale, symmetrize_input=False)
    half = solve_triangular(factor, right.reshape(-1) * scale, lower=True)
    return (solve_triangular(factor, half, lower=True, trans="T") * scale).reshape(right.shape)


def _implicit_solve(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem, options: StepOptions
) -> tuple[Float[Array, "cameras 9"], Int[Array, ""]]:
    level, *levels = layout.camera_levels
    gathered = take_rows(_coupling_rows(linear, points), level).reshape(level.shape[0], -1, 9)
    diagonal = system.blocks - tree_sum(jnp.einsum("kla,klb->kab", gathered, gathered), tuple(levels))
    factor = jnp.linalg.cholesky(diagonal, symmetrize_input=False)
    eye = jnp.broadcast_to(jnp.eye(9, dtype=factor.dtype), factor.shape)
    root = solve_triangular(factor, eye, lower=True)
    inverse = jnp.einsum("cji,cjk->cik", root, root)
    return conjugate_gradients(
        lambda x: apply_reduced(layout, linear, points, system, x),
        system.right,
        lambda r: jnp.einsum("cab,cb->ca", inverse, r),
        forcing=options.cg_forcing,
        tolerance=options.cg_tolerance,
        max_iterations=options.cg_max_iterations,
    )


def _predicted_decrease(
    points: PointSystem, system: CameraSystem, step: Array, camera_step: Array, point_step: list[Array]
) -> Float[Array, ""]:
    """`-(g.d + d.H d / 2)` written as sums that do not cancel.

    `(H + D) d = -g - rest` turns it into `(d.D d - g.d - d.rest) / 2`. The rest is zero for a factored system,
    and orthogonal to the step for conjugate gradients started at zero. Both kept terms are positive.
    """
    moves = jnp.stack(point_step)
    slope = jnp.sum(system.gradient * step) + jnp.sum(jnp.stack(points.gradient) * moves)
    damped = jnp.sum(system.damping * camera_step**2) + jnp.sum(jnp.stack(points.damping) * moves**2)
    return 0.5 * (damped - slope)


def largest_diagonal(layout: Layout, linear: Linearization) -> Float[Array, ""]:
    """Largest diagonal entry of the undamped Hessian, the unit of g2o's first lambda."""
    square = lambda rows: [a * a + b * b for a, b in zip(*rows, strict=True)]
    by_camera = tree_sum(jnp.stack(square(linear.camera_jacobian)).T, layout.camera_levels)
    by_point = point_sum(layout, jnp.stack(square(linear.point_jacobian)))
    return jnp.maximum(jnp.max(by_camera), jnp.max(by_point))
