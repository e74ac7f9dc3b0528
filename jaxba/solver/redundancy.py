"""What least squares leave of the rows that are tested, and its covariance: `Q v` and Q
(solver/fit.py) of these rows.

With the Jacobians A and P of all residuals v by cameras and points, A' and P' of the tested ones
among them, and, as in results/covariance.py, `B = A^T A`, `E = A^T P`, `C = P^T P`, `S = B - E C^-1
E^T`,

    F = A' - P' C^-1 E^T
    Q = I - P' C^-1 P'^T - F S^-1 F^T
    Q v = v' - P' C^-1 P^T v - F S^-1 (A^T v - E C^-1 P^T v).

Pixels of other points have no stated standard deviation. Theirs is estimated: the median of their
residuals, over that of normals."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.frames import num_unknowns
from jaxba.problem.losses import Loss
from jaxba.problem.options import Coordinates, Intrinsics, StepOptions
from jaxba.runtime.compilation import compile_and_run, program
from jaxba.runtime.numerics import numerics
from jaxba.solver.fit import Left
from jaxba.solver.information import inverse_of, linear_at, point_blocks, system_of, unknown_index
from jaxba.solver.place import placed
from jaxba.structure.layout import build_layout

NORMAL = 1.4826  # standard deviation over the median absolute value of normals
# least standard deviation of pixels, which keeps those of scenes without noise in bounds
LEAST_PIXELS = 0.01

MOST_UNKNOWNS = 3000
MOST_NUMBERS = 3000
"""Most unknown numbers of cameras, and numbers of tested rows, whose matrices are dense: ten
seconds on two cores."""


class TooLargeError(Exception):
    """There are more numbers than dense matrices hold."""


@numerics(np.float64, single_blas=False)
def left_of(
    problem: BundleProblem,
    clicked: Bool[np.ndarray, " observations"],
    loss: Loss,
    intrinsics: Intrinsics,
    noise: Noise,
) -> tuple[Left, Float[np.ndarray, " clicked"]]:
    """What least squares leave of all rows of residuals, and of clicked pixels as the last kind, in
    a linear model.

    Clicks are no more accurate than other pixels turn out to be. The second result is their stated
    deviation over the one that they get.

    Args:
        problem: with squared losses of its rows, near its minimum.
        clicked: observations of stated accuracy.
        loss: that of other pixels.
        intrinsics: whether lenses were optimised.
        noise: of other pixels.

    Raises TooLargeError: see `MOST_UNKNOWNS`."""
    from scipy.sparse import csr_matrix

    options = StepOptions(
        linear_solver="implicit",
        intrinsics=intrinsics,
        coordinates=Coordinates(rotation="manifold"),
    )
    here = placed(problem).here
    layout = build_layout(here, options)
    index, count = unknown_index(here, layout)
    sizes = [len(rows) * rows.size for rows in problem.residuals.rows]
    if count > MOST_UNKNOWNS or sum(sizes) + 2 * np.sum(clicked) > MOST_NUMBERS:
        raise TooLargeError
    free_points = np.ones(here.num_points, bool)
    if here.constants:
        free_points &= ~np.asarray(here.constants.points)
    linear = jax.device_get(
        compile_and_run(program(linear_at, "options", level="quick"), layout, here, options)
    )
    weights = np.ones(here.num_observations + 1)
    weights[: problem.num_observations] = _weights(problem, clicked, loss, noise)
    of_clicks = weights[: problem.num_observations][clicked]
    slots = weights[np.minimum(np.asarray(layout.observation), here.num_observations)]
    linear = linear._replace(
        residual=[slots * x for x in linear.residual],
        camera_jacobian=[[slots * x for x in row] for row in linear.camera_jacobian],
        point_jacobian=[[slots * x for x in row] for row in linear.point_jacobian],
    )
    system = system_of(layout, linear, index, count, free_points)
    inverse, _ = inverse_of(system)
    place = np.zeros(here.num_observations, int)
    place[system.observation] = np.arange(len(system.observation))
    combined = [_rows_among(place[np.asarray(x.observation)], x.size) for x in here.residuals.rows]
    combined.append(_rows_among(place[np.flatnonzero(clicked)][:, None, None], 2))
    numbers = sum(kind.shape[0] * kind.shape[1] for kind, _ in combined)
    entries = []
    columns = []
    factors = []
    kinds = []
    start = 0
    for at, factor in combined:  # (rows, size, ends)
        place_of_number = start + np.arange(at.shape[0] * at.shape[1]).reshape(at.shape[:2])
        entries.append(np.repeat(place_of_number.ravel(), at.shape[2]))
        columns.append(at.ravel())
        factors.append(np.full(at.size, factor))
        kinds.append(place_of_number)
        start += place_of_number.size
    shape = numbers, len(system.residual)
    chosen = csr_matrix(
        (np.concatenate(factors), (np.concatenate(entries), np.concatenate(columns))), shape
    )
    by_camera = chosen @ system.jacobian
    by_point = chosen @ system.by_point
    blocks = point_blocks(system)
    cross = system.jacobian.T @ system.by_point
    followed = by_point @ blocks
    change = np.asarray((by_camera - followed @ cross.T).todense())
    cofactor = np.eye(numbers) - (followed @ by_point.T).toarray() - change @ inverse @ change.T
    of_points = system.by_point.T @ system.residual
    step = inverse @ (system.jacobian.T @ system.residual - cross @ (blocks @ of_points))
    residual = chosen @ system.residual - followed @ of_points - change @ step
    return Left(residual, cofactor, tuple(kinds)), of_clicks


class Noise(NamedTuple):
    """Standard deviations of pixels that are not clicked."""

    whitened: float
    pixels: float


def noise_of(problem: BundleProblem, clicked: Bool[np.ndarray, " observations"]) -> Noise:
    """The noise of the other pixels where nothing else pulls; one where they are too few to tell
    it."""
    spare = 2 * np.sum(~clicked) - num_unknowns(problem)
    if spare <= 0:
        return Noise(1.0, 1.0)
    lost = NORMAL * np.sqrt(2 * np.sum(~clicked) / spare)
    left = (
        geometry.residuals(problem)[~clicked],
        (problem.observations - geometry.project(problem))[~clicked],
    )
    return Noise(
        *(max(LEAST_PIXELS, lost * float(np.median(np.abs(residual)))) for residual in left)
    )


def noise_left(problem: BundleProblem, clicked: Bool[np.ndarray, " observations"]) -> Noise:
    """The root mean square of what a solution leaves of the other pixels, per degree of freedom."""
    spare = max(2 * np.sum(~clicked) - num_unknowns(problem), 1)
    left = (
        geometry.residuals(problem)[~clicked],
        (problem.observations - geometry.project(problem))[~clicked],
    )
    return Noise(
        *(max(LEAST_PIXELS, float(np.sqrt(np.sum(residual**2) / spare))) for residual in left)
    )


def _weights(
    problem: BundleProblem, clicked: Bool[np.ndarray, " observations"], loss: Loss, noise: Noise
) -> Float[np.ndarray, " observations"]:
    """Square roots of the weights of pixels: the inverse of their deviation, in whitened units."""
    whitened = geometry.residuals(problem)
    pixels = problem.observations - geometry.project(problem)
    with np.errstate(divide="ignore", invalid="ignore"):
        stated = np.linalg.norm(pixels, axis=1) / np.linalg.norm(whitened, axis=1)
    clicks = np.minimum(1.0, np.nan_to_num(stated, nan=1.0) / noise.pixels)
    slope = np.asarray(loss(jnp.asarray(np.sum(whitened**2, axis=1)))[1])
    return np.where(clicked, clicks, np.sqrt(slope) / noise.whitened)


def _rows_among(
    place: Int[np.ndarray, "rows pairs ends"], size: int
) -> tuple[Int[np.ndarray, "rows size ends"], float]:
    """Where the numbers of rows are among those of observations, and by what the sum over ends is
    multiplied: of a row of two cameras or points each end has its residual over the root of two
    (structure/residual_slots.py)."""
    numbers = np.arange(size)
    return 2 * place[:, numbers // 2] + (numbers % 2)[:, None], 1 / np.sqrt(place.shape[2])
