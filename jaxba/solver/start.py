"""Where a solve starts: the scene where other residuals than those of pixels say that it is, as a
whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxba.model.registration import costs_of_rows
from jaxba.model.whole_scene import WholeScene
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.freedoms import freedoms
from jaxba.problem.moving import has_size, moved
from jaxba.problem.preprocess import far_middle
from jaxba.problem.similarity import Similarity, transformed

# mean square of whitened residuals, one for noise as stated, from which a scene may have to be
# moved
MISFIT = 4.0

WORTH = 0.5  # share of the cost of the residuals that may be left where the scene is moved


def as_measured(problem: BundleProblem) -> BundleProblem:
    """The problem with its scene moved, turned and scaled as residuals other than those of pixels
    say, where that leaves at most half of their cost; else the problem itself. Pixels stay as they
    are, and so does what constants, rigs, or rows that the scene is aligned with (`Rows.aligned`)
    determine."""
    kinds = problem.residuals.rows
    if all(rows.aligned for rows in kinds):
        return problem
    numbers = sum(len(rows) * rows.size for rows in kinds)
    with np.errstate(all="ignore"):
        cost = sum(float(np.sum(costs)) for costs in costs_of_rows(problem))
    if not 0.5 * MISFIT * numbers < cost < np.inf:
        return problem
    offset = far_middle(problem)
    near = transformed(problem, Similarity(1.0, np.eye(3), -offset))
    directions, *_, middle, extent = freedoms(near, of_rows=False)
    if has_size(problem):
        directions = _without_scale(directions)
    by, blocks, left = WholeScene.of(near, middle, extent).minimised(directions)
    if not left <= WORTH:
        return problem
    translation = by.translation + offset - by.scale * by.rotation @ offset
    residuals = replace(problem.residuals, blocks=blocks or problem.residuals.blocks)
    return moved(problem, by._replace(translation=translation)).replace(residuals=residuals)


def _without_scale(directions: Float[np.ndarray, "7 n"]) -> Float[np.ndarray, "7 m"]:
    """The directions of a subspace that leave the scale as it is."""
    _, values, basis = np.linalg.svd(directions[-1:], full_matrices=True)
    return directions @ basis[int(np.sum(values > 1e-9)) :].T
