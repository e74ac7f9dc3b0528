"""A solution in which rows of residuals that do not fit the others have no weight: graduated
non-convexity, as in results/graduated.py, of the rows of residuals and of clicked pixels in the
place of all pixels.

A row has the weight `1 / (1 + (d / c)^2)^2` at a distance of d standard deviations. c falls from
the distances of the start to those of rows that fit.

Source: Black, Rangarajan 1996; Yang, Antonante, Tzoumas, Carlone 2020 (both as there)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxba.model.registration import residuals_of_rows
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.losses import Loss
from jaxba.problem.marks import whitening_of
from jaxba.problem.residuals import Residual, Rows

FIRST = 2.0
LAST = 4.0
"""Scale at the start, and the residual beyond which a match is rejected, in medians of the
residuals. With normal noise and without wrong matches the latter is 4.7 standard deviations, with
30% of them 6.3."""

FALL = 2.0
"""Scale of a stage over that of the next."""

RowsOfKinds = tuple[tuple[int, int], ...]
"""Rows, each by its kind, of which clicked pixels are the last, and its place there."""

LEAST_SCALE = 3.0  # standard deviations: rows that fit are not further away
STAGES = 30
STAGE_ITERATIONS = 5
LEAST_WEIGHT = 1e-6  # smallest factor of a residual


def robust_solution(
    problem: BundleProblem,
    clicked: Bool[np.ndarray, " observations"],
    again: Callable[[BundleProblem, int], BundleProblem],
    dropped: RowsOfKinds = (),
) -> BundleProblem:
    """The problem, with squared losses of its rows, at a solution that rows which do not fit do not
    pull.

    Args:
        problem: the start.
        clicked: observations of stated accuracy.
        again: solves a problem with a limit of iterations.
        dropped: rows that count as nothing."""
    rows = problem.residuals.rows
    problem = problem.replace(
        residuals=replace(problem.residuals, rows=tuple(map(_with_weights, rows)))
    )
    whitening = whitening_of(problem)
    problem = problem.replace(whitening=whitening)
    far = distances(problem, clicked)
    scales = [max(LEAST_SCALE, FIRST * _median(of_kind)) for of_kind in far]
    for _ in range(STAGES):
        roots = [
            np.maximum(1 / (1 + (d / c) ** 2), LEAST_WEIGHT)
            for d, c in zip(far, scales, strict=True)
        ]
        for kind, row in dropped:
            roots[kind][row] = LEAST_WEIGHT
        solved = again(_weighted(problem, whitening, clicked, roots), STAGE_ITERATIONS)
        without_weights = _with(solved, [np.ones(len(of_kind)) for of_kind in roots])
        problem = solved.replace(whitening=whitening, residuals=without_weights)
        before = far
        far = distances(problem, clicked)
        floors = [max(LEAST_SCALE, LAST * _median(of_kind)) for of_kind in far]
        ended = all(floor > 0.95 * scale for floor, scale in zip(floors, scales, strict=True))
        if ended and all(
            np.allclose(x, y, rtol=0.05, atol=0.05) for x, y in zip(before, far, strict=True)
        ):
            break
        scales = [max(c / FALL, min(floor, c)) for floor, c in zip(floors, scales, strict=True)]
    return problem


def distances(
    problem: BundleProblem, clicked: Bool[np.ndarray, " observations"]
) -> list[Float[np.ndarray, " _"]]:
    """For each kind of residuals, and for clicked pixels, the RMS of the numbers of each row; large
    if not finite."""
    whitened = [*residuals_of_rows(problem), geometry.residuals(problem.subset(clicked))]
    with np.errstate(all="ignore"):
        roots = [np.sqrt(np.mean(of_kind**2, axis=1)) for of_kind in whitened]
    return [np.nan_to_num(of_kind, nan=1e150, posinf=1e150) for of_kind in roots]


def _median(values: Float[np.ndarray, " rows"]) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _weighted(
    problem: BundleProblem,
    whitening: Float[np.ndarray, "observations 2 2"],
    clicked: Bool[np.ndarray, " observations"],
    roots: list[Float[np.ndarray, " _"]],
) -> BundleProblem:
    whitening = np.array(whitening)
    whitening[clicked] *= roots[-1][:, None, None]
    return problem.replace(whitening=whitening, residuals=_with(problem, roots))


def _with(problem: BundleProblem, roots: list[Float[np.ndarray, " _"]]) -> Any:
    """The residuals with other factors."""
    rows = zip(problem.residuals.rows, roots, strict=False)
    return replace(
        problem.residuals, rows=tuple(replace(x, data=(*x.data[:-1], root)) for x, root in rows)
    )


def _with_weights(rows: Rows) -> Rows:
    """Rows with a factor of each, as the last of their data."""
    return replace(
        rows,
        residual=_times_weight(rows.residual),
        data=(*rows.data, np.ones(len(rows))),
        loss=Loss(),
    )


@functools.cache  # a new function would be compiled again
def _times_weight(residual: Residual) -> Residual:
    def weighted(*unknowns: Any, root_of_weight: jax.Array, **data: Any) -> jax.Array:
        return root_of_weight * residual.function(*unknowns, **data)

    weighted.__name__ = residual.name
    return Residual(weighted, residual.unknowns, (*residual.data, "root_of_weight"))
