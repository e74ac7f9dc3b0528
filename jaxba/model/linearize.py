"""Residuals, cost and Jacobians of all observations, in slot order."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.model import camera
from jaxba.model.observations import Views, view_terms
from jaxba.problem.losses import Loss
from jaxba.problem.options import Intrinsics
from jaxba.runtime.compilation import traced_once
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import take, total


class Reference(NamedTuple):
    """What a candidate is compared with, slot by slot."""

    costs: Array  # (slots,), pixels squared
    inverse_depth: Array  # (slots,), 1 / P.z; negative in front of the camera, zero in empty slots


class Linearization(NamedTuple):
    """Whitened, loss-weighted residuals and Jacobians; everything is zero in empty slots.

    Camera columns are: rotation on the manifold (left perturbation, radians), translation, f, k1, k2.
    """

    residual: list[Array]  # [2] of (slots,), pixels
    camera_jacobian: list[list[Array]]  # [2][9] of (slots,)
    point_jacobian: list[list[Array]]  # [2][3] of (slots,)
    costs: Array  # (slots,), pixels squared
    inverse_depth: Array  # (slots,), 1 / P.z; negative in front of the camera, zero in empty slots

    @property
    def reference(self) -> Reference:
        """What there is to know without derivatives."""
        return Reference(self.costs, self.inverse_depth)


@traced_once()
def slot_frames(layout: Layout, cameras: Float[Array, "9 cameras"]) -> camera.Frames:
    """The camera of every slot, stored; rotation matrices are made once per camera."""
    return camera.frames(cameras).stored().at(layout.slot_camera).stacked()


def view_residuals(views: Views, projection: camera.Projection) -> list[Array]:
    """The whitened residual `Sigma^(-1/2) (predicted - observed)`, pixels; zero where there is no observation."""
    measured = [row.astype(projection.radius.dtype) for row in views.pixels]
    return _whiten(views, [predicted - pixel for predicted, pixel in zip(projection.pixel, measured, strict=True)])


def slot_costs(loss: Loss, residual: list[Array]) -> Float[Array, "*slots"]:
    """`rho(|r|^2) / 2` of every slot, pixels squared."""
    squared = residual[0] * residual[0] + residual[1] * residual[1]
    return 0.5 * (squared if loss.trivial else loss(squared)[0])


@traced_once("loss")
def observation_costs(
    layout: Layout, cameras: Float[Array, "9 cameras"], points: Float[Array, "3 points"], loss: Loss
) -> Float[Array, " slots"]:
    """`slot_costs` at the given parameters; zero in empty slots."""
    terms = lambda views: [slot_costs(loss, view_residuals(views, views.projected()))]
    return view_terms(layout, slot_frames(layout, cameras), points, terms)[0]


def cost(
    layout: Layout, cameras: Float[Array, "9 cameras"], points: Float[Array, "3 points"], loss: Loss
) -> Float[Array, ""]:
    """The objective `1/2 sum rho(|Sigma^(-1/2) r|^2)`, pixels squared (design, section 2)."""
    # fused with their sum, the costs would go to a library, and slowly
    return compute_unfused(total, observation_costs(layout, cameras, points, loss), index=layout.slot_camera)


def point_terms(views: Views, loss: Loss) -> list[Array]:
    """Of every observation the six lower entries of `J_p^T J_p` (row by row), the three of `J_p^T r`, its cost (pixels
    squared), and the inverse depth."""
    projection = views.projected()
    residual = view_residuals(views, projection)
    by_point = _whiten_columns(views, camera.derivatives(views.frames, projection).point)
    rows = views.kept([*by_point[0], *by_point[1], *residual])
    residual = rows[6:]
    entries = normal_entries([rows[:3], rows[3:6]], residual)
    if not loss.trivial:
        slope = loss(residual[0] * residual[0] + residual[1] * residual[1])[1]
        entries = [slope * entry for entry in entries]
    return [*entries, slot_costs(loss, residual), projection.inverse_depth]


def normal_entries(by_point: list[list[Array]], residual: list[Array]) -> list[Array]:
    """Products of point columns with each other and with the residual, nine vectors."""
    first, second = by_point
    matrix = [first[i] * first[j] + second[i] * second[j] for i in range(3) for j in range(i + 1)]
    return matrix + [first[i] * residual[0] + second[i] * residual[1] for i in range(3)]


@traced_once("loss")
def linearize(
    layout: Layout, cameras: Float[Array, "9 cameras"], points: Float[Array, "3 points"], loss: Loss
) -> Linearization:
    """Analytic Jacobians at the given parameters."""

    def terms(views: Views) -> list[Array]:
        projection = views.projected()
        residual = view_residuals(views, projection)
        jacobians = camera.derivatives(views.frames, projection)
        by_camera, by_point = _whiten_columns(views, jacobians.camera), _whiten_columns(views, jacobians.point)
        costs = slot_costs(loss, residual)
        rows = [*residual, *by_camera[0], *by_camera[1], *by_point[0], *by_point[1]]
        if not loss.trivial:
            root = jnp.sqrt(loss(residual[0] * residual[0] + residual[1] * residual[1])[1])
            rows = [root * row for row in rows]
        return [*rows, costs, projection.inverse_depth]

    *rows, costs, inverse_depth = view_terms(layout, slot_frames(layout, cameras), points, terms)
    residual, rows = rows[:2], rows[2:]
    return Linearization(residual, [rows[:9], rows[9:18]], [rows[18:21], rows[21:24]], costs, inverse_depth)


def with_free_lenses(
    layout: Layout, linear: Linearization, intrinsics: Intrinsics, *, alone: bool = False
) -> Linearization:
    """The same where no residual depends on what of f, k1 and k2 stays: its part of the damped system is the clamped
    damping alone, its gradient zero, and so is its step.

    Args:
        layout: knows the lenses.
        linear: all derivatives.
        intrinsics: `fixed` holds all lenses.
        alone: whether every camera moves by itself, so that shared lenses must stay.
    """
    lenses = layout.lenses
    zero = jnp.zeros_like(linear.residual[0])
    if intrinsics == "fixed" or (alone and lenses is not None and lenses.shared):
        return linear._replace(camera_jacobian=[[*row[:6], zero, zero, zero] for row in linear.camera_jacobian])
    if lenses is None:
        return linear
    free = take(jnp.asarray(lenses.free), layout.slot_camera)
    kept = lambda row: [jnp.where(free[k], column, zero) for k, column in enumerate(row[6:])]
    return linear._replace(camera_jacobian=[[*row[:6], *kept(row)] for row in linear.camera_jacobian])


def _whiten(slots: Layout | Views, pair: list[Array]) -> list[Array]:
    if slots.whitening is None:
        return pair
    factor = slots.whitening.astype(pair[0].dtype)
    return [factor[k, 0] * pair[0] + factor[k, 1] * pair[1] for k in range(2)]


def _whiten_columns(slots: Layout | Views, rows: list[list[Array]]) -> list[list[Array]]:
    columns = [_whiten(slots, [first, second]) for first, second in zip(*rows, strict=True)]
    return [list(row) for row in zip(*columns, strict=True)]
