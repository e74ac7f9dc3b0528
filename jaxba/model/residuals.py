"""Values and derivatives of residuals of one's own, and their places among the slots of observations.

Functions see poses and points as they were when the residuals were registered (`Rows.scale`), a row at a time; JAX
evaluates all rows at once, along the last axis. Derivatives are in the coordinates of the camera Jacobian
(model/linearize.py), backwards from the few numbers of a row, or forwards where a function cannot be transposed. How
rows become slots: structure/residual_slots.py.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.model import camera
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.residuals import POINT, Rows
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.problem.row_value import Cameras, value
from jaxba.problem.safe_math import safe_sqrt
from jaxba.runtime.fusion import compute_unfused, fusion_barrier
from jaxba.structure.layout import Layout
from jaxba.structure.residual_slots import ResidualSlots
from jaxba.structure.segment_sums import take_each
from jaxba.structure.sharing import Mask
from jaxba.structure.unknowns import Unknowns

ROOT = math.sqrt(2.0)


class Linear(NamedTuple):
    """A linear model of the rows of a residual at their slots, weighted by its loss."""

    at: Array  # slots, flattened
    residual: list[Array]  # [2] of (entries,)
    by_camera: list[list[Array]]  # [2][width]
    by_point: list[list[Array]]  # [2][3], by the point of the slot


def values(
    rows: ResidualSlots, unknowns: Unknowns, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 _"]
) -> Float[Array, "size rows"]:
    """The residual of every row, whitened by the function, without the loss."""
    return _each(functools.partial(_value, rows, unknowns))(*_gathered(rows, unknowns, cameras, points))


def row_costs(rows: Rows, residual: Float[Array, "size rows"]) -> Float[Array, " rows"]:
    """`rho(|r|^2) / 2` of every row."""
    squared = jnp.sum(residual * residual, axis=0)
    return 0.5 * (squared if rows.loss.trivial else rows.loss(squared)[0])


def add_costs(
    layout: Layout, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 points"], costs: Array
) -> Float[Array, " slots"]:
    """Costs of slots with those of all rows, whose cameras or points have equal parts of them."""
    for rows in layout.residuals:
        own = row_costs(rows.rows, values(rows, layout.unknowns, cameras, points)) / rows.slots.shape[1]
        at = jnp.asarray(rows.slots)[0]
        costs = costs.at[at].add(jnp.broadcast_to(own, at.shape), mode="drop")
    return costs


def add_point_terms(
    layout: Layout, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 points"], sums: list[Array]
) -> list[Float[Array, " points"]]:
    """Sums over the observations of points, of the first ten `linearize.point_terms` or of costs alone, with those of
    all rows: of a row without a point only its cost, at the point that stands for it, and of one of two points half of
    it at each, since these do not move alone (`points_alone`)."""
    sums, cost = list(sums), 9 if len(sums) > 1 else 0
    for rows in layout.residuals:
        at = jnp.asarray(layout.slot_point).at[rows.slots[0]].get(mode="fill", fill_value=layout.num_points)
        if not cost or POINT not in rows.rows.residual.unknowns or len(rows.points) > 1:
            own = row_costs(rows.rows, values(rows, layout.unknowns, cameras, points))
            for end in at[: len(rows.points)]:
                sums[cost] = sums[cost].at[end].add(own / len(rows.points), mode="drop")
            continue
        residual, _, by_point = differentiated(rows, layout.unknowns, cameras, points)
        by_point = by_point[:, 0]  # [size, 3, rows]
        weighted = _weight(rows.rows, residual) * by_point
        terms = [jnp.sum(weighted[:, i] * by_point[:, j], axis=0) for i in range(3) for j in range(i + 1)]
        terms += [*jnp.sum(weighted * residual[:, None], axis=0), row_costs(rows.rows, residual)]
        sums[:10] = [x.at[at[0]].add(term, mode="drop") for x, term in zip(sums[:10], terms, strict=True)]
    return sums


def points_alone(layout: Layout) -> Mask:
    """Which points may move while all others stay: those that are free, and in no row with another point."""
    free, pairs = layout.unknowns.free_points, [own for x in layout.residuals if len(x.points) > 1 for own in x.points]
    if not pairs:
        return free
    return Mask(free.where(jnp.ones(layout.num_points, bool).at[jnp.concatenate(pairs)].set(False), False), False)


def linearized(
    rows: ResidualSlots, unknowns: Unknowns, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 _"]
) -> Linear:
    """Residuals and Jacobians of rows, at their slots."""
    residual, by_step, by_move = differentiated(rows, unknowns, cameras, points)
    root, several = safe_sqrt(_weight(rows.rows, residual)), rows.slots.shape[1]

    def pairs(x: Array) -> Array:  # [size, ..., rows] as [pairs, 2, ..., rows], weighted
        x = jnp.pad(x * root, [(0, rows.rows.size % 2), *[(0, 0)] * (x.ndim - 1)])
        return x.reshape(-1, 2, *x.shape[1:])

    residual, by_step, by_move = pairs(residual), pairs(by_step), pairs(by_move)
    shape = rows.slots.shape
    flat = lambda x: jnp.broadcast_to(x, shape).reshape(-1)
    split = ROOT if several > 1 else 1.0  # of a row of two cameras or points each has half of the residual
    own = [flat(residual[:, None, k] * (split / several)) for k in range(2)]
    by_camera = [[flat(split * by_step[:, k, :, w]) for w in range(unknowns.width)] for k in range(2)]
    by_point = [[flat(split * by_move[:, k, :, i]) for i in range(3)] for k in range(2)]
    signs = jnp.asarray([[ROOT], [-ROOT]], cameras.dtype)
    if len(rows.cameras) > 1:  # by the variables that split it
        by_point = [[flat(signs if i == k else 0 * signs) for i in range(3)] for k in range(2)]
    elif several > 1:
        which = jnp.arange(len(residual))[:, None, None]
        by_camera = [[flat(jnp.where(w == 2 * which + k, signs, 0)) for w in range(unknowns.width)] for k in range(2)]
    return Linear(jnp.asarray(rows.slots).reshape(-1), own, by_camera, by_point)


def _weight(rows: Rows, residual: Array) -> Array:
    squared = jnp.sum(residual * residual, axis=0)
    return jnp.ones_like(squared) if rows.loss.trivial else rows.loss(squared)[1]


def _each(function: Callable[..., Any]) -> Callable[..., Any]:
    return jax.vmap(function, in_axes=-1, out_axes=-1)


def differentiated(
    rows: ResidualSlots, unknowns: Unknowns, cameras: Float[Array, "parameters cameras"], points: Float[Array, "3 _"]
) -> tuple[Float[Array, "size rows"], Float[Array, "size _ width rows"], Float[Array, "size _ 3 rows"]]:
    """The residual of every row, and its Jacobians by steps of its cameras and by its points."""

    def backward(*given: Array) -> tuple[Array, tuple[Array, ...]]:
        at = lambda *parameters: _value(rows, unknowns, *parameters, *given[4:])
        residual, pull = jax.vjp(at, *given[:4])
        return residual, jax.vmap(pull)(jnp.eye(len(residual), dtype=residual.dtype))

    def forward(*given: Array) -> tuple[Array, tuple[Array, ...]]:
        at = functools.partial(_value, rows, unknowns)
        return at(*given), jax.jacfwd(at, (0, 1, 2, 3))(*given)

    given = _gathered(rows, unknowns, cameras, points)
    try:
        residual, derivatives = _each(backward)(*given)
    except (ValueError, TypeError, NotImplementedError):  # a loop of unknown length, or a rule for forward mode alone
        residual, derivatives = _each(forward)(*given)
    by_rotation, by_translation, by_numbers, by_point = derivatives
    # R <- R + [w]x R changes the residual by w . sum of R_j x dr/dR_j over columns j
    turn = jnp.sum(jnp.cross(given[0][None], by_rotation, axis=2), axis=3)
    if unknowns.in_rigs:  # R = M R_f and t = M t_f + m, with steps of frames and of M and m
        place, ends = given[4][None], unknowns.lens_size + np.array([0, EXTRINSICS_SIZE])
        matrix, (lens, _, own) = place[:, :, :9].reshape(1, len(rows.cameras), 3, 3, -1), jnp.split(by_numbers, ends, 2)
        of_place = turn + jnp.cross(place[:, :, 9:], by_translation, axis=2), by_translation
        by_numbers = jnp.concatenate([lens, *of_place, own], axis=2)
        turn, by_translation = (jnp.sum(matrix * x[:, :, :, None], axis=2) for x in (turn, by_translation))
    whole = jnp.concatenate([turn, by_translation, by_numbers], axis=2)
    return residual, jnp.asarray(unknowns.restricted(whole)), by_point


def _gathered(rows: ResidualSlots, unknowns: Unknowns, cameras: Array, points: Array) -> tuple[Array, ...]:
    """What a row needs of the problem, along the last axis: rotations, translations and numbers of its cameras, its
    points; in a rig M and M t_f; camera models, and the data."""
    frames = camera.frames(jnp.asarray(cameras), unknowns)
    rotation, translation, places = jnp.asarray(frames.rotation), jnp.asarray(frames.translation), []
    for place in frames.places:
        matrix = jnp.asarray(place)[:9].reshape(3, 3, -1)
        shifted = jnp.einsum("ijc,jc->ic", matrix, translation, precision="highest")
        rotation = jnp.einsum("ijc,jkc->ikc", matrix, rotation, precision="highest")
        translation, places = shifted + jnp.asarray(place)[9:], [matrix.reshape(9, -1), shifted]
    table = fusion_barrier(jnp.concatenate([rotation.reshape(9, -1), translation, *places, cameras[POSE_SIZE:]]))
    index, end = [jnp.asarray(one) for one in rows.cameras], 12 + 12 * len(frames.places)
    table = jnp.stack([jnp.stack(compute_unfused(take_each, table, one, index=one)) for one in index])
    model = jnp.stack([jnp.asarray(unknowns.model)[one] for one in index])
    data = (jnp.moveaxis(jnp.asarray(x, cameras.dtype), 0, -1) for x in rows.rows.data)
    matrices = table[:, :9].reshape(len(index), 3, 3, -1)
    places = jnp.stack([jnp.stack(take_each(points, jnp.asarray(one))) for one in rows.points])
    return matrices, table[:, 9:12], table[:, end:], places, table[:, 12:end], model, *data


def _value(
    rows: ResidualSlots,
    unknowns: Unknowns,
    rotation: Float[Array, "cameras 3 3"],
    translation: Float[Array, "cameras 3"],
    numbers: Float[Array, "cameras numbers"],
    points: Float[Array, "points 3"],
    place: Array,
    model: Array,
    *data: Array,
) -> Float[Array, " size"]:
    """The function at one row."""
    given = Cameras(rotation, translation, numbers[:, : unknowns.lens_size], model, unknowns.models)
    blocks = [numbers[:, max(0, first - POSE_SIZE) : max(0, last - POSE_SIZE)] for first, last in rows.places]
    return value(rows.rows, given, points, blocks, data)
