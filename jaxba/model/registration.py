"""`with_residual`: rows of a residual registered with a problem, and what is wrong with them said
at once."""

from __future__ import annotations

import contextlib
import hashlib
import math
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxba.model import row_derivatives as model
from jaxba.model.differences import check_derivatives
from jaxba.model.residuals import row_costs
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.checks import shown
from jaxba.problem.frames import in_frames
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.labels import Labels, Part, part_name
from jaxba.problem.losses import Loss
from jaxba.problem.preprocess import far_middle, middle_and_extent, shift
from jaxba.problem.residuals import LENS, POINT, POSE, SECOND, Residual, Residuals, Rows, with_rows
from jaxba.problem.row_data import other_length
from jaxba.runtime.announce import announced
from jaxba.runtime.compilation import program
from jaxba.runtime.numerics import numerics
from jaxba.runtime.trace_errors import advice
from jaxba.structure.agreement import ALONE
from jaxba.structure.residual_slots import ResidualSlots, laid_out, residual_slots
from jaxba.structure.unknowns import Unknowns, unknowns_of

CHECKED_INDICES = "jax_check_static_indices"  # a setting of JAX
LONGEST_REASON = 200  # characters of JAX's messages that are passed on


def with_residual(
    problem: BundleProblem,
    rows: Rows,
    *,
    loss: Loss | None = None,
    unknowns: Mapping[str, Any] | None = None,
) -> BundleProblem:
    """The problem with rows of a residual of one's own (`jaxba.residual`).

    The cost has `1/2 rho(|r|^2)` for each row, with r as the function returns it. Points are
    eliminated as for pixels. Raises ValueError, ProblemError: an index is out of range, a block is
    missing or malformed, unknowns of a row belong to different cameras without saying so (`_2`), or
    the function cannot be computed, is not finite at the start, depends on a parameter in no row,
    or has other derivatives than differences; one line.

    Args:
        problem: any problem.
        rows: a residual called with its indices and data.
        loss: robust loss of the squared norm of a row; None: squared.
        unknowns: start of each new block by its name, shape (n, numbers): a row for each camera, or
            fewer, which several cameras have in common. `Solution.problem.residuals` has their
            values after a solve."""
    if not isinstance(rows, Rows):
        raise ValueError(
            f"rows must be those of a residual, called with indices and data, not {shown(rows)}"
        )
    if not isinstance(loss, Loss | None) or not isinstance(unknowns, Mapping | None):
        raise ValueError(
            f"loss must be a jaxba.Loss and unknowns a dict, not {shown(loss)} and "
            f"{shown(unknowns)}"
        )
    if not len(rows):
        return problem
    lenses = problem.num_cameras if problem.lenses is None else len(problem.lenses.free)
    counts = {POSE: problem.num_cameras, LENS: lenses, POINT: problem.num_points}
    rows = replace(rows, loss=loss or Loss(), size=1)
    found = with_rows(problem.residuals, rows, dict(unknowns or {}), counts)
    _check_values(problem.labels, found.rows[-1])
    with announced(f"registering residual {rows.residual.name}, whose derivatives are compiled"):
        size, known = _checked(problem, found)
    rows = replace(found.rows[-1], size=size, residual=known, whole=())
    return problem.replace(residuals=replace(found, rows=(*found.rows[:-1], rows)))


def costs_by_kind(problem: BundleProblem) -> dict[str, float]:
    """The cost of each residual besides those of pixels, by the name of its function."""
    found: dict[str, float] = {}
    for rows, costs in zip(problem.residuals.rows, costs_of_rows(problem), strict=True):
        found[rows.residual.name] = found.get(rows.residual.name, 0.0) + float(np.sum(costs))
    return found


def costs_of_rows(problem: BundleProblem) -> list[Float[np.ndarray, " _"]]:
    """The cost of every row of `problem.residuals.rows`."""
    found = residuals_of_rows(problem)
    with numerics(np.float64):
        pairs = zip(problem.residuals.rows, found, strict=True)
        return [np.asarray(row_costs(rows, jnp.asarray(residual.T))) for rows, residual in pairs]


def residuals_of_rows(problem: BundleProblem) -> list[Float[np.ndarray, "_ _"]]:
    """What the functions return for every row of `problem.residuals.rows`, without the losses."""
    with numerics(np.float64):
        kinds, of, at, _ = rows_of(problem)
        values = program(model.values, level="quick")
        return [np.asarray(values(kind, of, *at)).T for kind in kinds]


class LaidRows(NamedTuple):
    """Rows of all residuals of a problem, and what their functions need."""

    kinds: tuple[ResidualSlots, ...]
    unknowns: Unknowns
    parameters: tuple[jax.Array, jax.Array]  # of cameras, by their numbers, and of points
    # for each block of residuals the row that each camera has; negative for none
    groups: tuple[np.ndarray, ...]


def rows_of(problem: BundleProblem) -> LaidRows:
    """Rows of all residuals, and cameras and points as their functions need them."""
    laid = laid_out(in_frames(problem))
    points = np.arange(laid.num_points)
    seen = np.bincount(laid.camera_index, minlength=laid.num_cameras) > 0
    unknowns = unknowns_of(laid, seen, points, fixed=False, agreement=ALONE)
    slots = np.arange(laid.num_observations)
    kinds = residual_slots(laid, slots, slots, points, ALONE)
    parameters = jnp.asarray(laid.cameras.T), jnp.asarray(laid.points.T)
    return LaidRows(kinds, unknowns, parameters, tuple(map(np.asarray, laid.residuals.groups)))


def _checked(problem: BundleProblem, residuals: Residuals) -> tuple[int, Residual]:
    """Numbers in a row of the last residual, if there is nothing wrong with it, and that residual
    with its source."""
    name = residuals.rows[-1].residual.name
    with numerics(np.float64):
        problem = problem.replace(residuals=residuals)
        problem = shift(problem, -far_middle(problem))  # rounding and steps are those of a solve
        (*_, kind), of, at, _ = rows_of(problem)
        try:
            traced, shape = _traced(kind, of, at)
        except Exception as error:
            _check_lengths(kind, of, at, math.inf)
            reason = textwrap.shorten(advice(error), LONGEST_REASON)
            raise ValueError(f"residual {name} cannot be computed: {reason}") from error
        _check_lengths(kind, of, at, float(math.prod(shape[1:])))
        if len(shape) != 2 or not shape[1]:
            raise ValueError(
                f"residual {name} must return a number or a vector, not an array of shape "
                f"{shape[:0:-1]}"
            )
        if len(kind.points) > 1 and shape[1] > POSE_SIZE:  # of the camera that splits it
            raise ValueError(
                f"residual {name} has two points in a row, so at most {POSE_SIZE} numbers, not "
                f"{shape[1]}"
            )
        known = replace(kind.rows.residual, source=_source(traced))
        kind = replace(kind, rows=replace(kind.rows, size=shape[1], loss=Loss(), residual=known))
        found = jax.device_get(program(_derivatives, level="quick")(kind, of, at))
        residual, *derivatives = map(np.array, found)
        bad = np.flatnonzero(~np.isfinite(residual).all(axis=0))
        if bad.size:
            where = f"row {bad[0]}: {shown(residual[:, bad[0]])}"
            raise ValueError(f"residual {name} is not finite at the start in {where}")
        _check_dependence(kind, of, *derivatives)
        check_derivatives(kind, of, jax.device_get(at), middle_and_extent(problem)[1] or 1.0)
    return shape[1], known


def _check_values(labels: Labels | None, rows: Rows) -> None:
    """Raises a ValueError that names a row whose data cannot be what they are of a ready-made
    residual."""
    kinds = dict(rows.residual.kinds)
    for name, values in zip(rows.residual.data, rows.data, strict=True):
        if name in kinds and (wrong := kinds[name].wrong(np.asarray(values))):
            what = f"{name} of {rows.residual.name}"
            value = shown(np.asarray(values)[wrong[0]].tolist())
            where = _row_name(labels, rows, wrong[0])
            raise ValueError(f"{what} must be {kinds[name].what}, not {value} ({where})")


def _row_name(labels: Labels | None, rows: Rows, row: int) -> str:
    """A row by the names of its images and points; by its position if it has none."""
    parts: dict[str, Part] = {POSE: "image", POINT: "point"}
    names = []
    for unknown, index in zip(rows.residual.unknowns, rows.index, strict=True):
        kind = parts.get(unknown.removesuffix(SECOND))
        if kind is not None:
            names.append(part_name(labels, kind, index[row]))
    return ", ".join(names) or f"row {row}"


def _traced(
    kind: ResidualSlots, unknowns: Unknowns, at: tuple[Any, Any]
) -> tuple[Any, tuple[int, ...]]:
    """What a residual computes, and the shape of its values, rows first."""

    # a new function: an earlier trace may have had other globals
    def values(*given: Any) -> jax.Array:
        return model.values(*given)

    with _checked_indices():
        traced, result = jax.make_jaxpr(values, return_shape=True)(kind, unknowns, *at)
    return traced, result.shape[::-1]


def _check_lengths(
    kind: ResidualSlots, unknowns: Unknowns, at: tuple[Any, Any], size: float
) -> None:
    """Raises a ValueError for an array of another length that counts, whole, for each row, where
    rows have fewer numbers than `size` with one of its entries: it was meant to have an entry for
    each row."""
    names = kind.rows.residual.data
    data = kind.rows.data
    for name in kind.rows.whole:
        k = names.index(name)
        rows = replace(kind.rows, data=(*data[:k], data[k][:, 0], *data[k + 1 :]))
        if _size(replace(kind, rows=rows), unknowns, at) < size:
            what = f"{name} of {kind.rows.residual.name}"
            raise ValueError(other_length(what, data[k].shape[1], len(kind.rows)))


def _size(kind: ResidualSlots, unknowns: Unknowns, at: tuple[Any, Any]) -> float:
    """How many numbers a row of a residual has; infinite if it cannot be computed, or is no number
    or vector."""
    try:
        _, shape = _traced(kind, unknowns, at)
    except Exception:
        return math.inf
    return float(math.prod(shape[1:])) if len(shape) <= 2 else math.inf


@contextlib.contextmanager
def _checked_indices() -> Iterator[None]:
    """Indices that are out of range raise an IndexError; JAX takes the nearest number otherwise."""
    before = jax.config.values[CHECKED_INDICES]
    jax.config.update(CHECKED_INDICES, True)
    try:
        yield
    finally:
        jax.config.update(CHECKED_INDICES, before)


def _source(traced: Any) -> str:
    """A digest of what a function does, with all that it closes over; empty where its text does not
    say all of it."""
    text = str(traced)
    if any(word in text for word in ("custom_jvp", "custom_vjp", "callback", "0x")):
        return ""
    digest = hashlib.sha256(text.encode())
    for constant in _constants(traced):
        digest.update(np.asarray(constant).tobytes())
    return digest.hexdigest()


def _constants(found: Any) -> list[Any]:
    """All arrays that a traced function holds, also in the functions that it calls."""
    if isinstance(found, tuple | list):
        return [x for one in found for x in _constants(one)]
    equations = getattr(getattr(found, "jaxpr", found), "eqns", ())
    return [
        *getattr(found, "consts", ()),
        *(x for one in equations for x in _constants([*one.params.values()])),
    ]


def _derivatives(
    kind: ResidualSlots, unknowns: Unknowns, at: tuple[jax.Array, jax.Array]
) -> list[Any]:
    """Values and derivatives of all rows."""
    return [numbers.tolist() for numbers in model.differentiated(kind, unknowns, *at)[:3]]


def _check_dependence(
    kind: ResidualSlots, unknowns: Unknowns, by_camera: np.ndarray, by_point: np.ndarray
) -> None:
    """Raises a ValueError for a parameter that the residual depends on in no row, or whose
    derivative is not finite."""
    numbers = np.array([*range(POSE_SIZE), *(POSE_SIZE + column for column in unknowns.columns)])
    what = f"residual {kind.rows.residual.name}"
    for name, (start, end) in zip(kind.rows.residual.unknowns, kind.places, strict=True):
        base = name.removesuffix(SECOND)
        which = int(
            name.endswith(SECOND) and len(kind.points if base == POINT else kind.cameras) > 1
        )
        lens = POSE_SIZE, POSE_SIZE + unknowns.lens_size
        first, last = {POSE: (0, POSE_SIZE), LENS: lens}.get(base, (start, end))
        own = (
            by_point[:, which]
            if base == POINT
            else by_camera[:, which, (numbers >= first) & (numbers < last)]
        )
        if not np.isfinite(own).all():
            raise ValueError(f"the derivative of {what} by {name} is not finite at the start")
        if own.size and not own.any():
            raise ValueError(f"{what} depends on {name} in no row at the start")
