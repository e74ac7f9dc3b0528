"""The Schur complement: points eliminated from the damped normal equations.

With the damped Hessian in blocks of cameras and points, `[[B + D_c, E], [E^T, C + D_p]]`,
eliminating the points gives the reduced camera system

    S d_c = b,    S = B + D_c - E (C + D_p)^-1 E^T,    b = -g_c + E (C + D_p)^-1 g_p,

and the points follow by back-substitution, `d_p = -(C + D_p)^-1 (g_p + E^T d_c)`.

C is block-diagonal, so everything is computed from 3 x 3 factors `C + D_p = L L^T`, one a point.
Per observation, with Jacobians `J_c` [2, width] and `J_p` [2, 3]:

    Q = J_p L^-T,   Y = J_c^T Q,   h = L^-1 g_p
    S = B + D_c - sum Y Y^T,   b = -sum J_c^T (r - Q h),   d_p = -L^-T (h + sum Y^T d_c)

The projected residual `r - Q h` in b avoids the cancellation between its two terms.

Rotations are perturbed on the manifold, `R <- exp(d) R`; damping is diagonal in the coordinates of
the options (`rotation_coordinates`).

Source: Triggs et al. 2000, "Bundle Adjustment - A Modern Synthesis", section 6; Agarwal et al.
2010, "Bundle Adjustment in the Large", section 3."""

from __future__ import annotations

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.cholesky3 import Cholesky3, cholesky3
from jaxba.model.linearize import Linearization, normal_entries
from jaxba.problem.options import DIAGONAL_MAXIMUM, DIAGONAL_MINIMUM, StepOptions
from jaxba.rotations import left_jacobian, left_jacobian_inverse
from jaxba.runtime.fusion import compute_in_one_loop
from jaxba.structure.devices import kept, max_over_devices, sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import (
    as_rows,
    outer_sum,
    point_sums,
    take,
    take_each,
    take_rows,
    tree_sum,
)

RotationCoordinates = tuple[Float[Array, "cameras 3 3"], Float[Array, "cameras 3 3"]]
"""Maps of rotation steps, to first order: from coordinates in which damping is diagonal to the
manifold, and back."""


def rotation_coordinates(
    cameras: Float[Array, "parameters cameras"], options: StepOptions
) -> RotationCoordinates:
    """The left Jacobian of SO(3) and its inverse for angle-axis coordinates, the identity for
    manifold coordinates."""
    if options.coordinates.rotation == "manifold":
        one = jnp.broadcast_to(jnp.eye(3, dtype=cameras.dtype), (cameras.shape[1], 3, 3))
        return one, one

    def to_front(m):
        return jnp.moveaxis(m, -1, 0)

    return to_front(left_jacobian(cameras[:3])), to_front(left_jacobian_inverse(cameras[:3]))


class PointSystem(NamedTuple):
    """The factored point blocks `C + D_p = L L^T` and what follows from them."""

    factor: Cholesky3  # L, of (points,)
    gradient: list[Array]  # g_p, [3] of (points,)
    damping: list[Array]  # D_p, [3] of (points,)
    solved: list[Array]  # h = L^-1 g_p, [3] of (points,)
    projected: list[list[Array]]  # Q, [2][3] of (slots,)


class CameraSystem(NamedTuple):
    """The reduced camera system without the sum of `Y Y^T`, which each solver forms or applies in
    its own way."""

    blocks: Float[Array, "cameras width width"]  # B + D_c, manifold coordinates
    own: Float[Array, "cameras width width"]  # the part of it that is no sum over observations: D_c
    gradient: Float[Array, "cameras width"]  # g_c, manifold coordinates
    right: Float[Array, "cameras width"]  # b, right-hand side of the reduced system
    # D_c, diagonal in the options' coordinates; each camera has an equal part of what is shared
    damping: Float[Array, "cameras width"]
    # [J_c, r, r - Q h], two rows an observation, sorted by camera (structure/layout.py)
    rows: Float[Array, "chunks terms columns"] | None = None


class DampedSystem(NamedTuple):
    """The damped normal equations `(H + D) d = -g` of one iteration, points eliminated."""

    layout: Layout
    linear: Linearization
    points: PointSystem
    cameras: CameraSystem
    damping: Float[Array, ""]  # lambda
    parameters: tuple[Float[Array, "parameters cameras"], Float[Array, "3 points"]]  # current ones
    coordinates: RotationCoordinates  # in which the damping is diagonal
    forcing: float | Float[Array, ""] = 0.0  # where conjugate gradients stop, if they are used
    iteration: int | Int[Array, ""] = 0  # from 0

    @classmethod
    def of(
        cls,
        layout: Layout,
        linear: Linearization,
        cameras: Float[Array, "parameters cameras"],
        points: Float[Array, "3 points"],
        damping: Float[Array, ""],
        options: StepOptions,
    ) -> DampedSystem:
        """That of a linear model at current cameras and points."""
        coordinates = rotation_coordinates(cameras, options)
        eliminated = eliminate_points(layout, linear, damping, options)
        reduced = camera_system(layout, linear, eliminated, coordinates, damping, options)
        return cls(layout, linear, eliminated, reduced, damping, (cameras, points), coordinates)


def eliminate_points(
    layout: Layout, linear: Linearization, damping: Float[Array, ""], options: StepOptions
) -> PointSystem:
    """Forms, damps and factors the 3 x 3 block of every point."""
    sums = point_sums(layout, normal_entries(linear.point_jacobian, linear.residual))

    def factored(sums: list[Array], damping: Array) -> list[Array]:
        matrix = sums[:6]
        gradient = sums[6:]
        diagonal = [damping_diagonal(matrix[k], damping, options) for k in (0, 2, 5)]
        for entry, extra in zip((0, 2, 5), diagonal, strict=True):
            matrix[entry] = matrix[entry] + extra
        factor = cholesky3(matrix)
        return [*factor, *factor.forward(gradient), *diagonal]

    entries = kept(
        layout, compute_in_one_loop(factored, sums, jnp.broadcast_to(damping, sums[0].shape))
    )
    factor = Cholesky3(*entries[:6])
    solved = entries[6:9]
    diagonal = entries[9:]
    at_slot = take(jnp.stack(factor), layout.slot_point)

    def projected(factor: Array, jacobian: list[list[Array]]) -> list[Array]:
        return [entry for row in jacobian for entry in Cholesky3(*factor).forward(row)]

    rows = compute_in_one_loop(projected, at_slot, linear.point_jacobian)
    return PointSystem(factor, kept(layout, sums[6:]), diagonal, solved, [rows[:3], rows[3:]])


def camera_system(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    coordinates: RotationCoordinates,
    damping: Float[Array, ""],
    options: StepOptions,
) -> CameraSystem:
    """B + D_c, g_c and b of every camera.

    `J_c^T [J_c, r, r - Q h]`, summed over a camera's observations, holds B, g_c and -b: one pass
    for all."""
    solved = take(jnp.stack(points.solved), layout.slot_point)
    rows = []
    for k in range(2):
        reduced = linear.residual[k] - sum(points.projected[k][i] * solved[i] for i in range(3))
        rows += [*linear.camera_jacobian[k], linear.residual[k], reduced]
    level, *levels = layout.camera_levels
    width = len(linear.camera_jacobian[0])
    (forward, inverse) = coordinates
    gathered = take_rows(as_rows(rows), level).reshape(level.shape[0], -1, width + 2)
    products = sum_over_devices(
        layout, tree_sum(outer_sum(gathered[..., :width], gathered), tuple(levels))
    )
    blocks = products[:, :, :width]
    gradient = products[:, :, width]
    right = -products[:, :, width + 1]
    rotation = jnp.einsum("cji,cjk,ckl->cil", forward, blocks[:, :3, :3], forward)
    diagonal = jnp.concatenate(
        [jnp.diagonal(rotation, axis1=1, axis2=2), jnp.diagonal(blocks, axis1=1, axis2=2)[:, 3:]],
        axis=1,
    )
    extra = layout.unknowns.shares(
        damping_diagonal(layout.unknowns.sums(diagonal), damping, options)
    )
    # a camera without observations gets a unit block, and so a zero step
    extra = jnp.where(layout.camera_seen[:, None], extra, jnp.ones_like(extra))
    on_manifold = jnp.einsum("cji,cj,cjk->cik", inverse, extra[:, :3], inverse)
    added = extra[:, :, None] * jnp.eye(width, dtype=extra.dtype)
    added = added.at[:, :3, :3].set(on_manifold)
    return CameraSystem(blocks + added, added, gradient, right, extra, gathered)


def back_substitute(system: DampedSystem, step: Float[Array, "cameras width"]) -> list[Array]:
    """Point step `-L^-T (h + sum Y^T d_c)` of a camera step on the manifold, [3] of (points,)."""
    points = system.points
    inner = project_to_points(system, step)
    return [
        -x
        for x in points.factor.backward([h + w for h, w in zip(points.solved, inner, strict=True)])
    ]


def apply_reduced(
    system: DampedSystem, x: Float[Array, "cameras width"]
) -> Float[Array, "cameras width"]:
    """`S x = (B + D_c) x - sum Y (Y^T x)` without forming S, in two passes over the
    observations."""
    layout, linear, points = system[:3]
    at_slot = take(jnp.stack(project_to_points(system, x)), layout.slot_point)

    def lifted(
        at_slot: Array, projected: list[list[Array]], first: list[Array], second: list[Array]
    ) -> list[Array]:
        over, under = (sum(row[i] * at_slot[i] for i in range(3)) for row in projected)
        return [a * over + b * under for a, b in zip(first, second, strict=True)]

    rows = as_rows(compute_in_one_loop(lifted, at_slot, points.projected, *linear.camera_jacobian))
    eliminated = sum_over_devices(layout, tree_sum(rows, layout.camera_levels))
    return jnp.einsum("cab,cb->ca", system.cameras.blocks, x) - eliminated


def lift_to_cameras(
    layout: Layout, linear: Linearization, projected: list[list[Array]], solved: list[Array] | Array
) -> Float[Array, "cameras width"]:
    """`E (C + D_p)^-1 g_p = sum Y h` of every camera, for the solved gradients h of the points at
    their slots."""
    over, under = (sum(row[i] * solved[i] for i in range(3)) for row in projected)
    rows = as_rows([a * over + b * under for a, b in zip(*linear.camera_jacobian, strict=True)])
    return sum_over_devices(layout, tree_sum(rows, layout.camera_levels))


def coupling_by_camera(system: DampedSystem) -> Float[Array, "sorted three_width"]:
    """`Y^T` [3, width] of every observation, flattened, sorted by camera (structure/layout.py)."""
    layout, _, points, cameras = system[:4]
    assert cameras.rows is not None
    over, under = points.projected
    projected = take_rows(as_rows([*over, *under]), layout.camera_levels[0].reshape(-1)).reshape(
        -1, 2, 3
    )
    width = cameras.blocks.shape[-1]
    rows = cameras.rows[..., :width].reshape(-1, 2, width)
    return outer_sum(projected, rows).reshape(-1, 3 * width)


def coupling_rows(system: DampedSystem) -> Float[Array, "slots three_width"]:
    """`Y^T` [3, width] of every slot, flattened."""
    first, second = system.linear.camera_jacobian
    over, under = system.points.projected
    columns = [
        a * over[i] + b * under[i] for i in range(3) for a, b in zip(first, second, strict=True)
    ]
    return as_rows(columns)


def project_to_points(system: DampedSystem, x: Float[Array, "cameras width"]) -> list[Array]:
    """`sum Y^T x` over each point's observations, [3] of (points,)."""
    at_slot = take(x.T, system.layout.slot_camera)

    def inner(
        at_slot: Array, projected: list[list[Array]], jacobian: list[list[Array]]
    ) -> list[Array]:
        over, under = (sum(a * x for a, x in zip(row, at_slot, strict=True)) for row in jacobian)
        return [projected[0][i] * over + projected[1][i] * under for i in range(3)]

    terms = compute_in_one_loop(
        inner, at_slot, system.points.projected, system.linear.camera_jacobian
    )
    return point_sums(system.layout, terms)


def jacobian_product(
    layout: Layout,
    linear: Linearization,
    cameras: Float[Array, "cameras width"],
    points: Float[Array, "3 points"],
) -> list[Array]:
    """`J d` of every slot for a step on the manifold, [2] of (slots,), pixels."""
    by_camera = take_each(cameras.T, layout.slot_camera)
    by_point = take_each(points, layout.slot_point)
    rows = zip(linear.camera_jacobian, linear.point_jacobian, strict=True)

    def dot(a, b):
        return functools.reduce(operator.add, [x * y for x, y in zip(a, b, strict=True)])

    return [dot(c, by_camera) + dot(p, by_point) for c, p in rows]


def largest_gradient(system: DampedSystem) -> Float[Array, ""]:
    """Largest absolute entry of the gradient, in the options' coordinates."""
    gradient = system.layout.unknowns.sums(system.cameras.gradient)
    rotation = jnp.einsum("cji,cj->ci", system.coordinates[0], gradient[:, :3])
    parts = rotation, gradient[:, 3:], jnp.stack(system.points.gradient)
    largest = functools.reduce(jnp.maximum, [jnp.max(jnp.abs(part)) for part in parts if part.size])
    return max_over_devices(system.layout, largest)


def damping_diagonal(diagonal: Array, damping: Float[Array, "..."], options: StepOptions) -> Array:
    """Diagonal of D for a Hessian with the given diagonal.

    `lambda I` for identity scaling, else `lambda diag(H)` with the diagonal clamped to
    [`DIAGONAL_MINIMUM`, `DIAGONAL_MAXIMUM`] as in Ceres."""
    if options.coordinates.scaling == "identity":
        return jnp.full_like(diagonal, 1) * damping
    high = min(DIAGONAL_MAXIMUM, float(jnp.finfo(diagonal.dtype).max) / 4)
    return damping * jnp.clip(diagonal, DIAGONAL_MINIMUM, high)
