"""Residuals, cost and Jacobians of all observations, in slot order.

    f = 1/2 sum_i rho(|r_i|^2),    r_i = Sigma_i^(-1/2) (predicted - observed)

The robust loss enters the linear model as weights: residuals and Jacobians are scaled by
`sqrt(rho'(|r_i|^2))` (problem/losses.py), so that `g = J^T r` is the gradient of f and `H = J^T J`
its Gauss-Newton Hessian."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxba.model import camera
from jaxba.model.observations import Views, view_terms
from jaxba.model.residuals import add_costs, linearized
from jaxba.problem.losses import Loss
from jaxba.problem.options import Intrinsics
from jaxba.problem.safe_math import safe_sqrt
from jaxba.runtime.compilation import traced_once
from jaxba.runtime.fusion import compute_unfused, fast_compilation, fusion_barrier
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import total


class Reference(NamedTuple):
    """Costs and depths before a step, with which a candidate is compared."""

    costs: Array  # (slots,), pixels^2
    inverse_depth: Array  # (slots,), 1 / P.z; negative in front of the camera, zero in empty slots


class Linearization(NamedTuple):
    """Whitened and weighted residuals and Jacobians; everything is zero in empty slots.

    Columns of the camera Jacobian: rotation on the manifold (left perturbation, radians),
    translation, then the numbers of the lens that are unknown (structure/unknowns.py): f, k1 and k2
    of BAL."""

    residual: list[Array]  # [2] of (slots,), pixels
    camera_jacobian: list[list[Array]]  # [2][width] of (slots,)
    point_jacobian: list[list[Array]]  # [2][3] of (slots,)
    reference: Reference  # the part of it that does not need derivatives


@traced_once()
def slot_frames(layout: Layout, cameras: Float[Array, "parameters cameras"]) -> camera.Frames:
    """The camera of every slot; rotation matrices are computed once per camera."""
    return camera.frames(cameras, layout.unknowns).at(layout.slot_camera)


def view_residuals(views: Views, projection: camera.Projection) -> list[Array]:
    """The whitened residual `Sigma^(-1/2) (predicted - observed)`, pixels; zero in empty slots."""
    measured = [row.astype(projection.radius.dtype) for row in views.pixels]
    return _whiten(
        views,
        [predicted - pixel for predicted, pixel in zip(projection.pixel, measured, strict=True)],
    )


def slot_costs(loss: Loss, residual: list[Array]) -> Float[Array, "*slots"]:
    """`rho(|r|^2) / 2` of every slot, pixels^2."""
    squared = residual[0] * residual[0] + residual[1] * residual[1]
    return 0.5 * (squared if loss.trivial else loss(squared)[0])


@traced_once("loss")
def observation_costs(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    loss: Loss,
) -> Float[Array, " slots"]:
    """`slot_costs` at the given parameters; zero in empty slots."""

    def terms(views):
        return [slot_costs(loss, view_residuals(views, views.projected()))]

    return add_costs(
        layout, cameras, points, view_terms(layout, slot_frames(layout, cameras), points, terms)[0]
    )


def cost(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    loss: Loss,
) -> Float[Array, ""]:
    """The cost `1/2 sum rho(|Sigma^(-1/2) (predicted - observed)|^2)`, pixels^2, and that of other
    residuals."""
    # not fused with the sum: XLA would compile both to a slow library call
    costs = compute_unfused(
        total, observation_costs(layout, cameras, points, loss), index=layout.slot_camera
    )
    return sum_over_devices(layout, costs)


def point_terms(views: Views, loss: Loss) -> list[Array]:
    """Point normal equations of every observation, eleven vectors.

    The six lower entries of `J_p^T J_p` row by row, the three of `J_p^T r`, the cost (pixels^2) and
    the inverse depth."""
    projection = views.projected()
    residual = view_residuals(views, projection)
    by_point = _whiten_columns(views, camera.derivatives(views.frames, projection, ())[1])
    rows = [*by_point[0], *by_point[1], *residual]
    if fast_compilation.value:  # computed once for several uses
        rows = list(fusion_barrier(jnp.stack(rows)))
    residual = rows[6:]
    entries = normal_entries([rows[:3], rows[3:6]], residual)
    if not loss.trivial:
        slope = loss(residual[0] * residual[0] + residual[1] * residual[1])[1]
        entries = [slope * entry for entry in entries]
    return [*entries, slot_costs(loss, residual), projection.inverse_depth]


def normal_entries(by_point: list[list[Array]], residual: list[Array]) -> list[Array]:
    """The six lower entries of `J_p^T J_p`, row by row, and the three of `J_p^T r`."""
    first, second = by_point
    matrix = [first[i] * first[j] + second[i] * second[j] for i in range(3) for j in range(i + 1)]
    return matrix + [first[i] * residual[0] + second[i] * residual[1] for i in range(3)]


@traced_once("loss")
def linearize(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    loss: Loss,
) -> Linearization:
    """Residuals and analytic Jacobians at the given parameters, whitened and weighted by the robust
    loss."""
    unknowns = layout.unknowns

    def terms(views: Views) -> list[Array]:
        projection = views.projected()
        residual = view_residuals(views, projection)
        jacobians = camera.derivatives(views.frames, projection, unknowns.columns)
        by_camera, by_point = (_whiten_columns(views, rows) for rows in jacobians)
        costs = slot_costs(loss, residual)
        rows = [*residual, *by_camera[0], *by_camera[1], *by_point[0], *by_point[1]]
        if not loss.trivial:
            root = safe_sqrt(loss(residual[0] * residual[0] + residual[1] * residual[1])[1])
            rows = [root * row for row in rows]
        return [*rows, costs, projection.inverse_depth]

    *rows, costs, inverse_depth = view_terms(layout, slot_frames(layout, cameras), points, terms)
    costs = add_costs(layout, cameras, points, costs)
    for own in layout.residuals:
        found = linearized(own, unknowns, cameras, points)
        added = [
            *found.residual,
            *found.by_camera[0],
            *found.by_camera[1],
            *found.by_point[0],
            *found.by_point[1],
        ]
        rows = [
            row.at[found.at].add(one, mode="drop") for row, one in zip(rows, added, strict=True)
        ]
    residual = rows[:2]
    rows = rows[2:]
    width = (len(rows) - 6) // 2
    by_camera = [rows[:width], rows[width : 2 * width]]
    by_point = [rows[-6:-3], rows[-3:]]
    return Linearization(residual, by_camera, by_point, Reference(costs, inverse_depth))


def is_weightless(
    layout: Layout, linear: Linearization, cost: Float[Array, ""], loss: Loss
) -> Bool[Array, ""]:
    """Whether the loss gives weight to no observation though there is a cost: gradient and Hessian
    are zero."""
    if loss.trivial:
        return jnp.zeros((), bool)
    first, second = linear.residual
    return (sum_over_devices(layout, total(first * first + second * second)) == 0) & (cost > 0)


def only_free(
    layout: Layout, linear: Linearization, intrinsics: Intrinsics, *, alone: bool = False
) -> Linearization:
    """The linear model in the unknowns: columns of what is constant are zero. Its gradient, and so
    its step, is then zero, too. `layout` knows what is constant; with `fixed` intrinsics all of
    these are. `alone`: whether cameras are optimised one by one, so that what they share must be
    constant."""
    unknowns = layout.unknowns
    zero = jnp.zeros_like(linear.residual[0])
    constant = unknowns.constant(intrinsics, alone=alone)
    free = unknowns.free.at_columns(layout.slot_camera)
    moves = unknowns.free_points.at_columns(layout.slot_point)
    by_camera = [
        [zero if constant[k] else free.row(k).where(column, zero) for k, column in enumerate(row)]
        for row in linear.camera_jacobian
    ]
    by_point = [[moves.where(column, zero) for column in row] for row in linear.point_jacobian]
    return linear._replace(camera_jacobian=by_camera, point_jacobian=by_point)


def _whiten(slots: Layout | Views, pair: list[Array]) -> list[Array]:
    if slots.whitening is None:
        return pair
    factor = slots.whitening.astype(pair[0].dtype)
    return [factor[k, 0] * pair[0] + factor[k, 1] * pair[1] for k in range(2)]


def _whiten_columns(slots: Layout | Views, rows: list[list[Array]]) -> list[list[Array]]:
    columns = [_whiten(slots, [first, second]) for first, second in zip(*rows, strict=True)]
    return [list(row) for row in zip(*columns, strict=True)]
