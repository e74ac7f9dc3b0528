"""Whether the derivatives of a residual agree with differences of it, by one of its unknowns at a
time.

Steps are shares of the size of what is moved: of the scene for positions, of its own spread for a
block of unknowns. The right share depends on the function, which may bend within millimetres, and
on rounding, which is nanometres in map coordinates. So all of `STEPS` are tried. Derivatives are
right in a row where some difference agrees with them, and wrong where none does although
differences of neighbouring steps agree with each other. Where neither is so, as where a logarithm
of rotations jumps at 180 degrees, the row says nothing. Hence rows are also compared a little away
from the start. Source: Ridders 1982, "Accurate computation of F'(x) and F'(x)F''(x)", which takes
the step at which differences of neighbouring steps agree best."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxba.model.row_derivatives import values
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.residuals import LENS, POINT, POSE, SECOND
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.runtime.compilation import program
from jaxba.structure.residual_slots import ResidualSlots
from jaxba.structure.unknowns import Unknowns

STEPS = 10.0 ** -np.arange(2, 12)  # of central differences, as shares of sizes

AWAY = 1e-3  # how far from the start rows are compared once more, as a share of sizes

AGREE = 1e-3  # how near differences are to derivatives or to each other, relative

MOST_WRONG = 0.5  # share of the rows that may be wrong: a function may have a kink where it starts

MOST_ROWS = 1_000  # rows that are compared, evenly spread among all


def check_derivatives(
    kind: ResidualSlots,
    unknowns: Unknowns,
    start: tuple[Float[np.ndarray, "parameters cameras"], Float[np.ndarray, "3 points"]],
    extent: float,
) -> None:
    """Raises a ProblemError if the derivatives of a residual by one of its unknowns do not agree
    with differences.

    Args:
        kind: the rows of the residual in a layout.
        unknowns: those of the problem.
        start: parameters of cameras and points in the layout, near the origin.
        extent: size of the scene, scene units."""
    kept = np.unique(np.linspace(0, len(kind.rows) - 1, min(len(kind.rows), MOST_ROWS)).astype(int))
    used, points = np.unique([rows[kept] for rows in kind.points], return_inverse=True)
    kind = replace(
        kind,
        rows=kind.rows.of(kept),
        cameras=tuple(cameras[kept] for cameras in kind.cameras),
        points=tuple(points.reshape(len(kind.points), -1)),
        slots=kind.slots[:, :, kept],
    )
    start = (start[0], start[1][:, used])
    random = np.random.default_rng(0)
    names = list(dict.fromkeys(name.removesuffix(SECOND) for name in kind.rows.residual.unknowns))
    sizes = [_sizes(name, kind, unknowns, start, extent) for name in names]
    changes = [
        [size * random.standard_normal(size.shape) for size in part]
        for part in zip(*sizes, strict=True)
    ]
    changes = tuple(np.stack(part) for part in changes)
    away = tuple(x + AWAY * part.sum(axis=0) for x, part in zip(start, changes, strict=True))
    compared = [
        jax.device_get(program(_compared, level="quick")(kind, unknowns, place, changes))
        for place in (start, away)
    ]
    for k, name in enumerate(names):
        verdicts = [_judged(rates[k], differences[k]) for rates, differences in compared]
        right, wrong = np.sum(verdicts, axis=(0, 2))
        if wrong > MOST_WRONG * (right + wrong):
            what = kind.rows.residual.name
            raise ProblemError(
                f"derivatives of residual {what} do not agree with differences: by {name}"
            )


def _sizes(
    name: str,
    kind: ResidualSlots,
    unknowns: Unknowns,
    start: tuple[np.ndarray, np.ndarray],
    extent: float,
) -> tuple[Float[np.ndarray, "parameters cameras"], Float[np.ndarray, "3 points"]]:
    """How much each number of cameras and points is of what a name means; zero for all other
    numbers.

    Args:
        name: an unknown of the residual, without the ending of a second camera.
        kind: the rows of the residual in a layout.
        unknowns: those of the problem.
        start: parameters of cameras, and points.
        extent: size of the scene, scene units."""
    cameras = np.zeros_like(start[0])
    points = np.zeros_like(start[1])
    lens = slice(POSE_SIZE, POSE_SIZE + unknowns.lens_size)
    if name == POINT:
        points[:] = extent
    elif name == LENS:
        cameras[lens] = np.maximum(1.0, np.abs(start[0][lens]))
    elif name == POSE:
        pose = np.repeat([1.0, extent], 3)[:, None]
        cameras[:POSE_SIZE] = pose
        if unknowns.in_rigs:
            cameras[lens.stop : lens.stop + EXTRINSICS_SIZE] = pose
    else:
        block = slice(*kind.places[kind.rows.residual.unknowns.index(_first(name, kind))])
        numbers = start[0][block][:, np.unique(kind.cameras)]
        spread = np.abs(numbers - np.median(numbers, axis=1, keepdims=True)).max(
            axis=1, keepdims=True
        )
        largest = np.abs(numbers).max(axis=1, keepdims=True)
        size = np.where(spread > 0, spread, largest)
        cameras[block] = np.where(size > 0, size, 1.0)
    return cameras, points


def _first(name: str, kind: ResidualSlots) -> str:
    """The first unknown of a residual that has a name, perhaps with the ending of a second
    camera."""
    return next(
        given for given in kind.rows.residual.unknowns if given.removesuffix(SECOND) == name
    )


def _compared(
    kind: ResidualSlots,
    unknowns: Unknowns,
    place: tuple[Array, Array],
    changes: tuple[Float[Array, "unknowns parameters cameras"], Float[Array, "unknowns 3 points"]],
) -> tuple[Float[Array, "unknowns size rows"], Float[Array, "unknowns steps size rows"]]:
    """The rates of change of a residual in some directions, and its differences of all `STEPS`.

    Args:
        kind: the rows of the residual in a layout.
        unknowns: those of the problem.
        place: parameters of cameras, and points.
        changes: directions, each by one of the unknowns."""

    def along(change: tuple[Array, Array]) -> tuple[Array, Array]:
        def moved(step: Array) -> Array:
            return values(
                kind, unknowns, *(x + step * d for x, d in zip(place, change, strict=True))
            )

        def difference(step: Array) -> Array:
            return (moved(step) - moved(-step)) / (2 * step)

        _, rate = jax.jvp(moved, (0.0,), (1.0,))
        return rate, jax.lax.map(difference, jnp.asarray(STEPS))

    return jax.lax.map(along, changes)


def _judged(
    rate: Float[np.ndarray, "size rows"], differences: Float[np.ndarray, "steps size rows"]
) -> tuple[Bool[np.ndarray, " rows"], Bool[np.ndarray, " rows"]]:
    """Which rows are right, and which are wrong."""
    with np.errstate(all="ignore"):  # a function may have no value beside the start
        size = np.abs(rate).max(axis=0)
        right = (np.abs(differences - rate).max(axis=1) <= AGREE * size).any(axis=0)
        largest = np.maximum(np.abs(differences).max(axis=1), size)
        apart = np.abs(np.diff(differences, axis=0)).max(axis=1)
        steady = (apart <= AGREE * largest[:-1]).any(axis=0)
    return right, steady & ~right
