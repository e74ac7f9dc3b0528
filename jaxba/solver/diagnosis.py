"""What a start or an end is worth: why a cost is not finite, and whether a fit is exact."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax import Array

from jaxba.lm.step import initial_state
from jaxba.model.linearize import slot_costs, slot_frames, view_residuals
from jaxba.model.observations import Views, view_terms
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.labels import part_name
from jaxba.problem.losses import Loss
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import COST_ROUNDING
from jaxba.runtime.compilation import compile_and_run, program
from jaxba.runtime.numerics import numerics
from jaxba.solver.place import placed
from jaxba.structure.layout import NO_SYSTEM, Layout, build_layout


def explain_start(problem: BundleProblem, loss: Loss | None = None, dtype: Any = np.float64) -> str:
    """A one-line message that names the observation for which the initial cost is not finite.

    Costs and depths are those of the step's own model in the same arithmetic, so that the message
    cannot contradict it. `loss` is that of the solve (None: squared residuals), `dtype` the type of
    its parameters."""
    dtype = np.dtype(dtype)
    loss = loss or Loss()
    with numerics(dtype):
        here = placed(problem).here
        layout = build_layout(here, NO_SYSTEM)
        found = compile_and_run(
            program(_start_terms, "loss", "dtype", level="quick"), layout, here, loss, dtype
        )
        costs, inverse_depth = (np.asarray(x) for x in found)
    slots = np.flatnonzero(np.asarray(layout.slot_mask) & ~np.isfinite(costs))
    narrow = "" if dtype == np.float64 else f" in {dtype}; float64 has a larger range"
    if not slots.size:
        return f"the cost at the start overflows{narrow}"
    first = slots[np.argmin(np.asarray(layout.observation)[slots])]
    number = int(layout.observation[first])
    camera = int(problem.camera_index[number])
    point = int(problem.point_index[number])
    on_plane = not np.isfinite(inverse_depth[first])

    def name(kind, at):
        return part_name(problem.labels, kind, at)

    view = name("image", camera)
    why = f"lies on the plane of {view}" if on_plane else f"has a residual in {view} that overflows"
    others = f" (and {slots.size - 1} more)" if slots.size > 1 else ""
    where = f"observation {number}{others}, " if problem.labels is None else ""
    more = "" if problem.labels is None else others
    return f"the cost at the start is not finite: {where}{name('point', point)}{more} {why}{narrow}"


def cost_of_rounding(problem: BundleProblem, dtype: Any) -> float:
    """Cost (pixels^2) of residuals that are rounding errors of their pixels alone: an exact fit has
    no more."""
    pixels = np.asarray(problem.observations, np.float64)
    if problem.whitening is not None:
        pixels = np.einsum("nij,nj->ni", np.asarray(problem.whitening, np.float64), pixels)
    return 0.5 * float(np.sum((COST_ROUNDING * float(np.finfo(dtype).eps) * pixels) ** 2))


def _start_terms(
    layout: Layout, problem: BundleProblem, loss: Loss, dtype: Any
) -> tuple[Array, ...]:
    """Cost and inverse depth of every slot at the start."""
    state = initial_state(layout, problem, StepOptions(loss=loss), dtype)

    def terms(views: Views) -> list[Array]:
        projection = views.projected()
        return [slot_costs(loss, view_residuals(views, projection)), projection.inverse_depth]

    return tuple(view_terms(layout, slot_frames(layout, state.cameras), state.points, terms))
