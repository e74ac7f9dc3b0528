"""Residuals, cost and Jacobians of all observations, in slot order."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxba import camera
from jaxba.barrier import materialized
from jaxba.layout import Layout
from jaxba.losses import Loss
from jaxba.options import Intrinsics
from jaxba.programs import traced_once
from jaxba.sums import take, total


class Present(NamedTuple):
    """What a candidate is compared with, slot by slot."""

    costs: Array  # (slots,), pixels squared
    front: Bool[Array, " slots"]  # whether the point lies in front of its camera


class Linearization(NamedTuple):
    """Whitened, loss-weighted residuals and Jacobians; everything is zero in empty slots.

    Camera columns are: rotation on the manifold (left perturbation, radians), translation, f, k1, k2.
    """

    residual: list[Array]  # [2] of (slots,), pixels
    camera_jacobian: list[list[Array]]  # [2][9] of (slots,)
    point_jacobian: list[list[Array]]  # [2][3] of (slots,)
    costs: Array  # (slots,), pixels squared
    front: Bool[Array, " slots"]  # whether the point lies in front of its camera

    @property
    def present(self) -> Present:
        """What there is to know without derivatives."""
        return Present(self.costs, self.front)


@traced_once()
def slot_frames(layout: Layout, cameras: Float[Array, "9 cameras"]) -> camera.Frames:
    """The camera of every slot; rotation matrices are made once per camera."""
    return camera.frames(cameras).at(layout.slot_camera)


@traced_once()
def residuals(
    layout: Layout, frames: camera.Frames, points: Float[Array, "3 points"]
) -> tuple[camera.Projection, list[Array]]:
    """Projects every slot through its frame (`slot_frames`).

    Returns:
        The projection and the whitened residual `Sigma^(-1/2) (predicted - observed)`, pixels, as two
        vectors over slots; zero in empty slots.
    """
    projection = camera.project(frames, take(points, layout.slot_point), layout.slot_mask)
    difference = projection.pixel - layout.pixels.astype(projection.pixel.dtype)
    return projection, _whiten(layout, [difference[0], difference[1]])


def in_front(projection: camera.Projection) -> Bool[Array, " slots"]:
    """Whether the point of a slot lies in front of its camera, which looks down -z; false in empty slots."""
    return projection.inverse_depth < 0


def behind(projection: camera.Projection) -> Bool[Array, " slots"]:
    """Whether it lies behind; false in empty slots."""
    return projection.inverse_depth > 0


def slot_costs(loss: Loss, residual: list[Array]) -> Float[Array, " slots"]:
    """`rho(|r|^2) / 2` of every slot, pixels squared."""
    squared = residual[0] * residual[0] + residual[1] * residual[1]
    return 0.5 * (squared if loss.trivial else loss(squared)[0])


def cost(
    layout: Layout, cameras: Float[Array, "9 cameras"], points: Float[Array, "3 points"], loss: Loss
) -> Float[Array, ""]:
    """The objective `1/2 sum rho(|Sigma^(-1/2) r|^2)`, pixels squared (design, section 2)."""
    return total(slot_costs(loss, residuals(layout, slot_frames(layout, cameras), points)[1]))


@traced_once("loss")
def point_normal_equations(
    layout: Layout, frames: camera.Frames, projection: camera.Projection, residual: list[Array], loss: Loss
) -> list[Array]:
    """Per slot: the six lower entries of `J_p^T J_p` (row by row), then the three of `J_p^T r`."""
    by_point = _whiten_columns(layout, camera.derivatives(frames, projection).point)
    rows = list(materialized(jnp.stack([*by_point[0], *by_point[1], *residual])))
    by_point, residual = [rows[:3], rows[3:6]], rows[6:]
    entries = normal_entries(by_point, residual)
    if loss.trivial:
        return entries
    slope = loss(residual[0] * residual[0] + residual[1] * residual[1])[1]
    return [slope * entry for entry in entries]


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
    frames = slot_frames(layout, cameras)
    projection, residual = residuals(layout, frames, points)
    # What the 26 Jacobian columns share is computed once, not once per column.
    frames, projection, residual = lax.optimization_barrier((frames, projection, residual))
    jacobians = camera.derivatives(frames, projection)
    by_camera = _whiten_columns(layout, jacobians.camera)
    by_point = _whiten_columns(layout, jacobians.point)
    costs = slot_costs(loss, residual)
    if not loss.trivial:
        slope = loss(residual[0] * residual[0] + residual[1] * residual[1])[1]
        root = jnp.sqrt(slope)
        residual = [root * r for r in residual]
        by_camera = [[root * column for column in row] for row in by_camera]
        by_point = [[root * column for column in row] for row in by_point]
    return Linearization(residual, by_camera, by_point, costs, in_front(projection))


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


def _whiten(layout: Layout, pair: list[Array]) -> list[Array]:
    if layout.whitening is None:
        return pair
    factor = layout.whitening.astype(pair[0].dtype)
    return [factor[k, 0] * pair[0] + factor[k, 1] * pair[1] for k in range(2)]


def _whiten_columns(layout: Layout, rows: list[list[Array]]) -> list[list[Array]]:
    columns = [_whiten(layout, [first, second]) for first, second in zip(*rows, strict=True)]
    return [list(row) for row in zip(*columns, strict=True)]
