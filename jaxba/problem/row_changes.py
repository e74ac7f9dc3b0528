"""How the rows of residuals change when a scene is turned, moved and scaled."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.camera_models import BAL
from jaxba.problem.geometry import camera_centers, rotation_matrices
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.residuals import SECOND, Rows
from jaxba.problem.row_owners import Owners, block_groups, owners_of
from jaxba.problem.row_value import Cameras, value
from jaxba.rotations import rotation_matrix
from jaxba.runtime.numerics import numerics

SIMILARITY = 7
OF_ROW = 18
"""Numbers of a similarity, and of two poses and two points."""


def changes_by_similarity(
    problem: BundleProblem, middle: Float[np.ndarray, "3"], extent: float
) -> list[Float[np.ndarray, "numbers 7"]]:
    """For each residual besides those of pixels the derivatives of its numbers by a rotation of the
    scene about its middle, a translation in extents, and the scale, as shares of their largest
    derivative by one of the row's poses or points in the same units."""
    groups = block_groups(problem)
    with numerics(np.float64):
        every = problem.residuals.rows
        return [
            _changes(problem, rows, owners_of(problem, rows, groups), middle, extent)
            for rows in every
        ]


def _changes(
    problem: BundleProblem,
    rows: Rows,
    owners: Owners,
    middle: Float[np.ndarray, "3"],
    extent: float,
) -> Float[np.ndarray, "numbers 7"]:
    own = np.maximum(np.stack(owners.cameras, axis=1), 0)
    lenses = problem.lenses
    at = np.asarray(problem.cameras, np.float64)[own.ravel()]
    shape = own.shape
    models = (BAL,) if lenses is None else lenses.models
    model = (
        np.zeros(shape, int)
        if lenses is None or lenses.model is None
        else lenses.model[lenses.index[own]]
    )
    named = dict(zip(problem.residuals.names, problem.residuals.blocks, strict=True))
    none = np.zeros((len(rows), 0))
    pairs = zip(rows.residual.unknowns, rows.index, strict=True)
    at_rows = [(named.get(name.removesuffix(SECOND)), i) for name, i in pairs]
    blocks = [
        np.repeat((none if own is None else own[i])[:, None], 2, axis=1) for own, i in at_rows
    ]

    def moved(change, rotation, center, lens, model, points, *rest):
        scene = change[:SIMILARITY]
        own = change[SIMILARITY:].reshape(-1, 3)
        turn = rotation_matrix(scene[:3, None])[:, :, 0]

        def move(x):
            return middle + (1 + scene[6]) * (x - middle) @ turn.T + extent * scene[3:6]

        turns = jnp.moveaxis(rotation_matrix(own[: len(rotation)].T), 2, 0)
        rotation = turns @ rotation @ turn.T
        center = move(center) + extent * own[2 : 2 + len(center)]
        translation = -jnp.einsum("cij,cj->ci", rotation, center)
        of = Cameras(rotation, translation, lens, model, models)
        points = move(points) + extent * own[4 : 4 + len(points)]
        return value(rows, of, points, rest[: len(blocks)], rest[len(blocks) :])

    given = (
        rotation_matrices(at[:, :3]).reshape(*shape, 3, 3),
        camera_centers(at).reshape(*shape, 3),
        at[:, POSE_SIZE:].reshape(*shape, -1),
        model,
        np.vstack([np.asarray(problem.points, np.float64), np.zeros((1, 3))])[
            np.stack(owners.points, axis=1)
        ],
        *blocks,
        *rows.data,
    )
    by_number = jax.vmap(jax.jacfwd(moved))(
        jnp.zeros((len(rows), SIMILARITY + OF_ROW)), *map(jnp.asarray, given)
    )
    by_number = np.array(by_number).reshape(-1, SIMILARITY + OF_ROW)
    size = np.abs(by_number[:, SIMILARITY:]).max(axis=1, initial=0.0, keepdims=True)
    return by_number[:, :SIMILARITY] / np.where(size > 0, size, 1.0)
