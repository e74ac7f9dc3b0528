"""Values and derivatives of residuals of one's own, and their places among the slots of observations.

Functions see poses and points as they were when the residuals were registered (`Residuals.scale`), a row at a time;
JAX evaluates all rows at once. Derivatives are by forward mode, in the coordinates of the camera Jacobian
(model/linearize.py). How rows become slots: structure/residual_slots.py.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.model import camera
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.row_value import Cameras, value
from jaxba.problem.safe_math import safe_sqrt
from jaxba.rotations import rotation_matrix
from jaxba.structure.layout import Layout
from jaxba.structure.residual_slots import ResidualSlots
from jaxba.structure.unknowns import Unknowns

ROOT = math.sqrt(2.0)


class Linear(NamedTuple):
    """A linear model of the rows of a residual at their slots, weighted by its loss."""

    at: Array  # slots, flattened
    residual: list[Array]  # [2] of (entries,)
    by_camera: list[list[Array]]  # [2][width]
    by_point: list[list[Array]]  # [2][3]


def values(
    rows: ResidualSlots, unknowns: Unknowns, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 _"]
) -> Float[Array, "rows size"]:
    """The residual of every row, whitened by the function, without the loss."""
    function = lambda *given: _value(rows, unknowns, *given)
    return jax.vmap(function)(*_gathered(rows, unknowns, cameras, points))


def row_costs(rows: ResidualSlots, residual: Float[Array, "rows size"]) -> Float[Array, " rows"]:
    """`rho(|r|^2) / 2` of every row."""
    squared = jnp.sum(residual * residual, axis=1)
    return 0.5 * (squared if rows.loss.trivial else rows.loss(squared)[0])


def add_costs(
    layout: Layout, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 points"], costs: Array
) -> Float[Array, " slots"]:
    """Costs of slots with those of all rows, whose cameras have equal parts of them."""
    for rows in layout.residuals:
        own = row_costs(rows, values(rows, layout.unknowns, cameras, points)) / len(rows.cameras)
        at = jnp.asarray(rows.slots)[:, 0]
        costs = costs.at[at].add(jnp.broadcast_to(own[:, None], at.shape), mode="drop")
    return costs


def add_point_terms(
    layout: Layout, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 points"], sums: list[Array]
) -> list[Float[Array, " points"]]:
    """Sums over the observations of points, of the first ten `linearize.point_terms` or of costs alone, with those of
    all rows: of a row without a point only its cost, at the point that stands for it."""
    sums, cost = list(sums), 9 if len(sums) > 1 else 0
    for rows in layout.residuals:
        at = jnp.asarray(layout.slot_point).at[rows.slots[:, 0, 0]].get(mode="fill", fill_value=layout.num_points)
        step = lambda d, *given, rows=rows: _value(rows, layout.unknowns, *given, move=d)
        given = _gathered(rows, layout.unknowns, cameras, points)
        residual = values(rows, layout.unknowns, cameras, points)
        sums[cost] = sums[cost].at[at].add(row_costs(rows, residual), mode="drop")
        if not cost or not rows.has_point:
            continue
        zero = jnp.zeros((len(residual), 3), points.dtype)
        by_point = jax.vmap(jax.jacfwd(step))(zero, *given)  # [rows, size, 3]
        slope = _weight(rows, residual)[:, None]
        terms = [jnp.sum(slope * by_point[..., i] * by_point[..., j], axis=1) for i in range(3) for j in range(i + 1)]
        terms += [jnp.sum(slope * by_point[..., i] * residual, axis=1) for i in range(3)]
        for k, term in enumerate(terms):
            sums[k] = sums[k].at[at].add(term, mode="drop")
    return sums


def linearized(
    rows: ResidualSlots, unknowns: Unknowns, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 _"]
) -> Linear:
    """Residuals and Jacobians of rows, at their slots."""
    several, width = len(rows.cameras), unknowns.width
    dtype = cameras.dtype
    given = _gathered(rows, unknowns, cameras, points)

    def at(steps: Array, move: Array, *given: Array) -> tuple[Array, Array]:
        found = _value(rows, unknowns, *given, steps=steps, move=move)
        return found, found

    zero = jnp.zeros((len(given[1]), several, width), dtype), jnp.zeros((len(given[1]), 3), dtype)
    (by_step, by_move), residual = jax.vmap(jax.jacfwd(at, (0, 1), has_aux=True))(*zero, *given)
    root = safe_sqrt(_weight(rows, residual))
    odd = rows.size % 2

    def pairs(x: Array) -> Array:  # [rows, size, ...] as [rows, pairs, 2, ...], weighted
        x = x * root.reshape(-1, *[1] * (x.ndim - 1))
        x = jnp.pad(x, [(0, 0), (0, odd), *[(0, 0)] * (x.ndim - 2)])
        return x.reshape(x.shape[0], -1, 2, *x.shape[2:])

    residual, by_step, by_move = pairs(residual), pairs(by_step), pairs(by_move)
    shape = (*residual.shape[:2], several)
    flat = lambda x: jnp.broadcast_to(x, shape).reshape(-1)
    if several == 1:
        own = [flat(residual[:, :, k, None]) for k in range(2)]
        by_point = [[flat(by_move[:, :, k, None, i]) for i in range(3)] for k in range(2)]
        scale = 1.0
    else:
        own = [flat(residual[:, :, k, None] / ROOT) for k in range(2)]
        signs = jnp.asarray([ROOT, -ROOT], dtype)
        by_point = [[flat(signs if i == k else jnp.zeros((), dtype)) for i in range(3)] for k in range(2)]
        scale = ROOT
    by_camera = [[flat(scale * by_step[:, :, k, :, w]) for w in range(width)] for k in range(2)]
    return Linear(jnp.asarray(rows.slots).reshape(-1), own, by_camera, by_point)


def _weight(rows: ResidualSlots, residual: Array) -> Array:
    squared = jnp.sum(residual * residual, axis=1)
    return jnp.ones_like(squared) if rows.loss.trivial else rows.loss(squared)[1]


def _gathered(rows: ResidualSlots, unknowns: Unknowns, cameras: Array, points: Array) -> tuple[Any, ...]:
    """What a row needs of the problem, along a first axis: cameras, their models, the point, and the data."""
    of_rows = jnp.stack([jnp.asarray(cameras)[:, c].T for c in map(jnp.asarray, rows.cameras)], axis=1)
    model = jnp.stack([jnp.asarray(unknowns.model)[c] for c in map(jnp.asarray, rows.cameras)], axis=1)
    data = tuple(jnp.asarray(x, cameras.dtype) for x in rows.data)
    return of_rows, model, jnp.asarray(points)[:, jnp.asarray(rows.point)].T, *data


def _value(
    rows: ResidualSlots,
    unknowns: Unknowns,
    cameras: Array,
    model: Array,
    point: Array,
    *data: Array,
    steps: Array | None = None,
    move: Array | None = None,
) -> Float[Array, " size"]:
    """The function at the parameters of one row: cameras [cameras, parameters], after steps [cameras, width], and a
    point, after a move."""
    columns = cameras.T
    if steps is not None:
        columns = camera.moved(columns, unknowns.expanded(steps.T), unknowns)
    angle_axis, translation = camera.poses(columns, unknowns)
    lenses = columns[POSE_SIZE : POSE_SIZE + unknowns.lens_size].T
    given = Cameras(jnp.moveaxis(rotation_matrix(angle_axis), 2, 0), translation.T, lenses, model, unknowns.models)
    blocks = [columns[start:end].T for start, end in rows.places]
    return value(rows, given, point if move is None else point + move, blocks, data)
