"""Values and derivatives of residuals of one's own.

Functions see poses and points as they were when the residuals were registered (`Rows.scale`), a row
at a time. They are differentiated backwards, number by number, as operations on vectors over all
rows (model/vectors.py); what has no rule there JAX maps over the rows, backwards or, where it
cannot be transposed, forwards. Derivatives are in the coordinates of the camera Jacobian
(model/linearize.py)."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.model import camera
from jaxba.model.vectors import Numbers, Traced, filled, numbers_of
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.residuals import Rows
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.problem.row_value import Cameras, value
from jaxba.problem.safe_math import safe_sqrt
from jaxba.runtime.fusion import compute_in_one_loop, compute_unfused, fusion_barrier
from jaxba.structure.residual_slots import ResidualSlots
from jaxba.structure.segment_sums import take_each
from jaxba.structure.unknowns import Unknowns

LARGEST = 1_000
"""Most operations that a residual is differentiated as on vectors. Measured on chains of sines: a
solve compiles 1.8 times as long as with the mapped function for 1,080, 2.5 times for 3,600, 7 times
for 9,720. A projection has 300."""


class Differentiated(NamedTuple):
    """Residuals and Jacobians of rows, weighted by the loss, and costs: vectors over rows."""

    residual: Numbers  # [size]
    by_camera: Numbers  # [size, cameras, width], by steps of cameras
    by_point: Numbers  # [size, points, 3]
    costs: Float[Array, " rows"]


def values(
    rows: ResidualSlots,
    unknowns: Unknowns,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 _"],
) -> Float[Array, "size rows"]:
    """The residual of every row, whitened by the function, without the loss."""
    return jax.vmap(functools.partial(_value, rows, unknowns), -1, -1)(
        *_gathered(rows, unknowns, cameras, points)
    )


def differentiated(
    rows: ResidualSlots,
    unknowns: Unknowns,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 _"],
) -> Differentiated:
    """Residuals, Jacobians and costs of all rows."""
    given = _gathered(rows, unknowns, cameras, points)
    size = rows.rows.size
    try:
        found = compute_in_one_loop(functools.partial(_on_vectors, rows, unknowns), *given)
    except NotImplementedError:
        found = _mapped(rows, unknowns, *given)
    shapes = (size,), (size, len(rows.cameras), unknowns.width), (size, len(rows.points), 3)
    parts = np.split(filled(found[:-1]), np.cumsum([math.prod(shape) for shape in shapes])[:-1])
    residual, by_camera, by_point = (
        part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)
    )
    return Differentiated(residual, by_camera, by_point, found[-1])


def _on_vectors(rows: ResidualSlots, unknowns: Unknowns, *given: Array) -> list[Array]:
    """The numbers of `Differentiated`. Raises NotImplementedError: no rule for something in it, or
    too large."""
    over_rows = given[3].ndim - 2
    numbers = [numbers_of(x, x.ndim - over_rows) for x in given]
    function = Traced(functools.partial(_value, rows, unknowns), *numbers)
    parameters = numbers[:4]
    if function.size * rows.rows.size > LARGEST:
        raise NotImplementedError("too large")
    ends = np.cumsum([x.size for x in parameters])[:-1]

    def number(k: int, *flat: Array) -> Array:
        parts = zip(np.split(filled(flat), ends), parameters, strict=True)
        return function(*(part.reshape(x.shape) for part, x in parts), *numbers[4:])[k]

    residual = []
    derivatives = []
    for k in range(rows.rows.size):
        one, pull = jax.vjp(
            functools.partial(number, k), *(x for part in parameters for x in part.flat)
        )
        residual.append(one)
        derivatives += pull(jnp.ones_like(one))
    by_parts = zip(
        np.split(filled(derivatives).reshape(len(residual), -1), ends, axis=1),
        parameters,
        strict=True,
    )
    return _weighted(
        rows.rows,
        unknowns,
        numbers,
        filled(residual),
        *(by.reshape(-1, *x.shape) for by, x in by_parts),
    )


def _mapped(rows: ResidualSlots, unknowns: Unknowns, *given: Array) -> list[Array]:
    """The same of any function."""

    def backward(*given: Array) -> tuple[Array, tuple[Array, ...]]:
        def at(*parameters):
            return _value(rows, unknowns, *parameters, *given[4:])

        residual, pull = jax.vjp(at, *given[:4])
        return residual, jax.vmap(pull)(jnp.eye(len(residual), dtype=residual.dtype))

    def forward(*given: Array) -> tuple[Array, tuple[Array, ...]]:
        at = functools.partial(_value, rows, unknowns)
        return at(*given), jax.jacfwd(at, (0, 1, 2, 3))(*given)

    each = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
    try:
        residual, by_parts = each(backward)(*given)
    # a loop of unknown length, or a rule for forward mode alone
    except (ValueError, TypeError, NotImplementedError):
        residual, by_parts = each(forward)(*given)

    def numbers(arrays):
        return [numbers_of(x, x.ndim - 1) for x in arrays]

    return _weighted(rows.rows, unknowns, numbers(given), *numbers((residual, *by_parts)))


def _weighted(
    rows: Rows,
    unknowns: Unknowns,
    given: list[Numbers],
    residual: Numbers,
    turn: Numbers,
    shift: Numbers,
    own: Numbers,
    by_point: Numbers,
) -> list[Array]:
    """The numbers of `Differentiated`, for derivatives by rotations, translations, numbers of
    cameras, points."""
    # R <- R + [w]x R changes the residual by w . sum of R_j x dr/dR_j over columns j
    turn = _cross(given[0], turn, -2).sum(axis=-1)
    if unknowns.in_rigs:  # R = M R_f and t = M t_f + m, with steps of frames and of M and m
        place = given[4]
        ends = unknowns.lens_size + np.array([0, EXTRINSICS_SIZE])
        matrix = place[:, :9].reshape(-1, 3, 3)
        (lens, _, own) = np.split(own, ends, axis=2)
        own = np.concatenate([lens, turn + _cross(place[:, 9:], shift, -1), shift, own], axis=2)
        turn, shift = ((matrix * x[..., None]).sum(axis=2) for x in (turn, shift))
    columns = [*range(POSE_SIZE), *(POSE_SIZE + column for column in unknowns.columns)]
    by_camera = np.concatenate([turn, shift, own], axis=2)[:, :, columns]
    every = [*residual, *by_camera.flat, *by_point.flat]
    squared = (residual * residual).sum()
    if rows.loss.trivial:
        return [*every, 0.5 * squared]
    cost, slope = rows.loss(squared)
    root = safe_sqrt(slope)
    return [*(root * x for x in every), 0.5 * cost]


def _cross(one: Numbers, other: Numbers, axis: int) -> Numbers:
    """The product of vectors along an axis."""
    (a, b), (p, q) = ([np.roll(x, -k, axis) for k in (1, 2)] for x in (one, other))
    return a * q - b * p


def _gathered(
    rows: ResidualSlots, unknowns: Unknowns, cameras: Array, points: Array
) -> tuple[Array, ...]:
    """What a row needs of the problem, along the last axis: rotations, translations and numbers of
    its cameras, its points; in a rig M and M t_f; camera models, and the data."""
    frames = camera.frames(jnp.asarray(cameras), unknowns)
    rotation = jnp.asarray(frames.rotation)
    translation = jnp.asarray(frames.translation)
    places = []
    for place in frames.places:
        matrix = jnp.asarray(place)[:9].reshape(3, 3, -1)
        shifted = jnp.einsum("ijc,jc->ic", matrix, translation, precision="highest")
        rotation = jnp.einsum("ijc,jkc->ikc", matrix, rotation, precision="highest")
        translation = shifted + jnp.asarray(place)[9:]
        places = [matrix.reshape(9, -1), shifted]
    table = fusion_barrier(
        jnp.concatenate([rotation.reshape(9, -1), translation, *places, cameras[POSE_SIZE:]])
    )
    index = [jnp.asarray(one) for one in rows.cameras]
    end = 12 + 12 * len(frames.places)
    table = jnp.stack(
        [jnp.stack(compute_unfused(take_each, table, one, index=one)) for one in index]
    )
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
    blocks = [
        numbers[:, max(0, first - POSE_SIZE) : max(0, last - POSE_SIZE)]
        for first, last in rows.places
    ]
    return value(rows.rows, given, points, blocks, data)
