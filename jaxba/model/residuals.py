"""Residuals of one's own among the slots of observations (structure/residual_slots.py): their
costs, linear models, and parts in sums over points."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.model.row_derivatives import differentiated, values
from jaxba.problem.residuals import POINT, Rows
from jaxba.structure.layout import Layout
from jaxba.structure.residual_slots import ResidualSlots
from jaxba.structure.sharing import Mask
from jaxba.structure.unknowns import Unknowns

ROOT = math.sqrt(2.0)


class Linear(NamedTuple):
    """A linear model of the rows of a residual at their slots, weighted by its loss."""

    at: Array  # slots, flattened
    residual: list[Array]  # [2] of (entries,)
    by_camera: list[list[Array]]  # [2][width]
    by_point: list[list[Array]]  # [2][3], by the point of the slot


def row_costs(rows: Rows, residual: Float[Array, "size rows"]) -> Float[Array, " rows"]:
    """`rho(|r|^2) / 2` of every row."""
    squared = jnp.sum(residual * residual, axis=0)
    return 0.5 * (squared if rows.loss.trivial else rows.loss(squared)[0])


def add_costs(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    costs: Array,
) -> Float[Array, " slots"]:
    """Costs of slots with those of all rows, whose cameras or points have equal parts of them."""
    for rows in layout.residuals:
        own = (
            row_costs(rows.rows, values(rows, layout.unknowns, cameras, points))
            / rows.slots.shape[1]
        )
        at = jnp.asarray(rows.slots)[0]
        costs = costs.at[at].add(jnp.broadcast_to(own, at.shape), mode="drop")
    return costs


def add_point_terms(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    sums: list[Array],
) -> list[Float[Array, " points"]]:
    """Sums over the observations of points, of the first ten `linearize.point_terms` or of costs
    alone, with those of all rows: of a row without a point only its cost, at the point that stands
    for it, and of one of two points half of it at each, since these do not move alone
    (`points_alone`)."""
    sums, cost = list(sums), 9 if len(sums) > 1 else 0
    for rows in layout.residuals:
        at = _points_of(layout, rows)
        if not cost or POINT not in rows.rows.residual.unknowns or len(rows.points) > 1:
            own = row_costs(rows.rows, values(rows, layout.unknowns, cameras, points))
            for end in at[: len(rows.points)]:
                sums[cost] = sums[cost].at[end].add(own / len(rows.points), mode="drop")
            continue
        found = differentiated(rows, layout.unknowns, cameras, points)
        by_point = found.by_point[:, 0]
        terms = [(by_point[:, i] * by_point[:, j]).sum() for i in range(3) for j in range(i + 1)]
        terms += [*(by_point * found.residual[:, None]).sum(axis=0), found.costs]
        sums[:10] = [
            x.at[at[0]].add(term, mode="drop") for x, term in zip(sums[:10], terms, strict=True)
        ]
    return sums


def _points_of(layout: Layout, rows: ResidualSlots) -> Int[Array, "ends rows"]:
    """The points at the slots of rows; out of range for a row that is none, as of a shard without
    rows."""
    return (
        jnp.asarray(layout.slot_point)
        .at[rows.slots[0]]
        .get(mode="fill", fill_value=layout.num_points)
    )


def points_alone(layout: Layout) -> Mask:
    """Which points may move while all others stay: those that are free, and in no row with another
    point."""
    free = layout.unknowns.free_points
    pairs = [_points_of(layout, x) for x in layout.residuals if len(x.points) > 1]
    if not pairs:
        return free
    alone = (
        jnp.ones(layout.num_points, bool).at[jnp.concatenate(pairs, axis=1)].set(False, mode="drop")
    )
    return Mask(free.where(alone, False), False)


def linearized(
    rows: ResidualSlots,
    unknowns: Unknowns,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 _"],
) -> Linear:
    """Residuals and Jacobians of rows, at their slots."""
    found = differentiated(rows, unknowns, cameras, points)
    (pairs, several, _) = rows.slots.shape
    zero = jnp.zeros_like(found.costs)
    # of a row of two cameras or points each has half of the residual
    split = ROOT if several > 1 else 1.0

    def at_slots(of: Callable[[int, int], Any]) -> tuple[Array, ...]:
        """For each of a pair of numbers a vector over slots, of what there is of a number of rows
        and of an end."""
        vectors = []
        for k in range(2):
            numbers = [(2 * pair + k, end) for pair in range(pairs) for end in range(several)]
            parts = [split * of(*one) if one[0] < rows.rows.size else zero for one in numbers]
            vectors.append(parts[0] if len(parts) == 1 else jnp.concatenate(parts))
        return tuple(vectors)

    # of the variables that split it
    def sign(here, end):
        return jnp.full_like(zero, (1 - 2 * end) * here)

    residual = at_slots(lambda number, end: found.residual[number] / several)

    def by_camera(w):
        if len(rows.points) > 1:
            return lambda number, end: sign(number == w, end)
        return lambda number, end: found.by_camera[number, end, w]

    def by_point(i):
        if len(rows.cameras) > 1:
            return lambda number, end: sign(number % 2 == i, end)
        return lambda number, end: found.by_point[number, end, i]

    columns = (
        [at_slots(by_camera(w)) for w in range(unknowns.width)],
        [at_slots(by_point(i)) for i in range(3)],
    )
    jacobians = ([list(row) for row in zip(*each, strict=True)] for each in columns)
    return Linear(jnp.asarray(rows.slots).reshape(-1), list(residual), *jacobians)
