"""`with_residual`: rows of a residual registered with a problem, and what is wrong with them said at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.model import residuals as model
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.checks import shown
from jaxba.problem.frames import in_frames
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.losses import Loss
from jaxba.problem.residuals import LENS, POINT, POSE, SECOND, Residuals, Rows, with_rows
from jaxba.runtime.numerics import numerics
from jaxba.structure.agreement import ALONE
from jaxba.structure.residual_slots import ResidualSlots, laid_out, residual_slots
from jaxba.structure.unknowns import Unknowns, unknowns_of

CHECKED = 64
"""Most rows whose derivatives are compared with differences."""

STEP, AGREE = 1e-6, 1e-3
"""Step of central differences, relative to a number or one, and how near they have to be to derivatives, relative to
the largest; functions with kinks differ in a few rows."""


def with_residual(
    problem: BundleProblem, rows: Rows, *, loss: Loss | None = None, unknowns: Mapping[str, Any] | None = None
) -> BundleProblem:
    """The problem with rows of a residual of one's own (`jaxba.residual`).

    The cost has `1/2 rho(|r|^2)` for each row, with r as the function returns it. Points are eliminated as for pixels.

    Args:
        problem: any problem.
        rows: a residual called with its indices and data.
        loss: robust loss of the squared norm of a row; None: squared.
        unknowns: start of each new block by its name, shape (n, numbers): a row for each camera, or fewer, which
            several cameras have in common. `Solution.problem.residuals` has their values after a solve.

    Raises:
        ValueError: an index is out of range, a block is missing or malformed, or the function cannot be computed, is
            not finite at the start, or depends on a parameter in no row; one line.
        ProblemError: unknowns of one row belong to different cameras without saying so (`_2`), or derivatives do not
            agree with differences.
    """
    if not isinstance(rows, Rows):
        raise ValueError(f"rows must be those of a residual, called with indices and data, not {shown(rows)}")
    if not len(rows):
        return problem
    if not isinstance(loss, Loss | None):
        raise ValueError(f"loss must be a jaxba.Loss, not {shown(loss)}")
    lenses = problem.num_cameras if problem.lenses is None else len(problem.lenses.free)
    counts = {POSE: problem.num_cameras, LENS: lenses, POINT: problem.num_points}
    rows = replace(rows, loss=loss or Loss(), size=1)
    found = with_rows(problem.residuals, rows, dict(unknowns or {}), counts)
    rows = replace(rows, size=_checked(problem, found))
    return problem.replace(residuals=replace(found, rows=(*found.rows[:-1], rows)))


@numerics(np.float64)
def _checked(problem: BundleProblem, residuals: Residuals) -> int:
    """Numbers in a row of the last residual, if there is nothing wrong with it."""
    rows = residuals.rows[-1]
    name = rows.residual.name
    with numerics(np.float64):
        here = laid_out(in_frames(problem.replace(residuals=residuals)))
        every = np.arange(here.num_points)
        seen = np.bincount(here.camera_index, minlength=here.num_cameras) > 0
        of = unknowns_of(here, seen, every, fixed=False, agreement=ALONE)
        kind = residual_slots(here, np.arange(here.num_observations), every, ALONE)[-1]
        at = jnp.asarray(here.cameras.T), jnp.asarray(here.points.T)
        try:
            shape = jax.eval_shape(lambda: model.values(kind, of, *at)).shape
        except Exception as error:
            text = " ".join(str(error).split())
            raise ValueError(f"residual {name} cannot be computed: {shown(text, 200)}") from error
        if len(shape) != 2 or not shape[1]:
            raise ValueError(f"residual {name} must return a number or a vector, not an array of shape {shape[1:]}")
        kind = replace(kind, size=shape[1])
        found = np.asarray(model.values(kind, of, *at))
        bad = np.flatnonzero(~np.isfinite(found).all(axis=1))
        if bad.size:
            raise ValueError(f"residual {name} is not finite at the start in row {bad[0]}: {shown(found[bad[0]])}")
        linear = jax.device_get(model.linearized(kind, of, *at))
        _check_dependence(kind, of, linear)
        _check_differences(kind, of, *at)
    return shape[1]


def _check_dependence(kind: ResidualSlots, unknowns: Unknowns, linear: model.Linear) -> None:
    """Raises a ValueError for a parameter that the residual depends on in no row, or whose derivative is not finite."""
    by_camera = np.array(linear.by_camera).reshape(2, unknowns.width, -1, len(kind.cameras))
    numbers = np.array([*range(POSE_SIZE), *(POSE_SIZE + column for column in unknowns.columns)])
    for name, (start, end) in zip(kind.residual.unknowns, kind.places, strict=True):
        base, which = name.removesuffix(SECOND), int(name.endswith(SECOND) and len(kind.cameras) > 1)
        if base == POINT:
            own = np.array(linear.by_point)
        else:
            lens = POSE_SIZE + unknowns.lens_size
            first, last = {POSE: (0, POSE_SIZE), LENS: (POSE_SIZE, lens)}.get(base, (start, end))
            own = by_camera[:, (numbers >= first) & (numbers < last), :, which]
        if not np.isfinite(own).all():
            raise ValueError(f"the derivative of residual {kind.residual.name} by {name} is not finite at the start")
        if own.size and not own.any():
            raise ValueError(f"residual {kind.residual.name} does not depend on {name} at the start, in no row")


def _check_differences(kind: ResidualSlots, unknowns: Unknowns, cameras: jax.Array, points: jax.Array) -> None:
    """Raises a ProblemError where derivatives do not agree with central differences in most rows."""
    few = np.linspace(0, len(kind.point) - 1, min(len(kind.point), CHECKED)).astype(int)
    take = lambda x: np.asarray(x)[few]
    parts = {"cameras": tuple(map(take, kind.cameras)), "data": tuple(map(take, kind.data))}
    kind = replace(kind, point=take(kind.point), slots=take(kind.slots), **parts)
    random = np.random.default_rng(0)
    change = [random.standard_normal(x.shape) * np.maximum(1.0, np.abs(x)) for x in (cameras, points)]
    at = lambda step: model.values(kind, unknowns, cameras + step * change[0], points + step * change[1])
    _, rate = jax.jvp(at, (0.0,), (1.0,))
    size = np.abs(rate).max(axis=1) + 1e-6 * np.abs(at(0.0)).max(axis=1)
    wrong = np.abs((at(STEP) - at(-STEP)) / (2 * STEP) - rate).max(axis=1) > AGREE * size
    if np.mean(wrong) > 0.5:
        raise ProblemError(f"derivatives of residual {kind.residual.name} do not agree with differences")
