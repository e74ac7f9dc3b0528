"""Residuals of one's own: functions of unknowns and data, in JAX, whose rows are registered with a
problem.

    f = 1/2 sum_i rho(|r_i|^2) + 1/2 sum_k sum_rows rho_k(|r_k(unknowns, data)|^2)

A function's positional parameters are unknowns, by name: `pose`, `lens` and `point`, and any other
name for a block of numbers of its own, one for each camera or a few for all. With `_2` after it a
name means those of a second camera. Keyword-only parameters are data, a row each. The function
whitens its residual itself."""

from __future__ import annotations

import importlib
import inspect
import operator
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.checks import indices, plain_array, real_numbers, shown
from jaxba.problem.losses import Loss
from jaxba.problem.row_data import Datum
from jaxba.typing import AnyArray, ArrayRecord, register_pytree

POSE = "pose"
LENS = "lens"
POINT = "point"
PIXELS = "pixels"
"""Names of unknowns that every problem has, and of the costs of its observations."""

SECOND = "_2"  # ending of the names of a second camera's unknowns


@dataclass(frozen=True)
class Residual:
    """A function that `jaxba.residual` has read. Called with an index array for each unknown and a
    row of data for each keyword, it makes the rows that `jaxba.with_residual` registers."""

    function: Callable[..., Any]
    """From `Pose`, `Lens`, arrays of points and blocks, and data to a vector or a number, of
    JAX."""

    unknowns: tuple[str, ...]
    """Names of its positional parameters."""

    data: tuple[str, ...]
    """Names of its keyword-only parameters."""

    kinds: tuple[tuple[str, Datum], ...] = ()
    """What data may be, by keyword, as far as it is known (`with_data`)."""

    source: str = ""
    """What determines the computations of the function once it is registered, a digest; empty if
    nothing does."""

    @property
    def name(self) -> str:
        """Name of the function: the kind of its costs."""
        return self.function.__name__

    def __repr__(self) -> str:
        return f"Residual({self.name})"

    def __reduce__(self) -> tuple[Any, ...]:
        """By name: a problem may be pickled where the decorated function can be imported."""
        return _imported, (self.function.__module__, self.function.__qualname__, self.source)

    def __call__(self, **columns: Any) -> Rows:
        """Rows of the residual.

        Args:
            columns: for each unknown an index or a vector of them: a camera for `pose`, a point for
                `point`, a lens (a camera in a problem without shared lenses) for `lens`, a row for
                a block. For each keyword of data one value for all rows, which is a number or has a
                first axis of one, or an array whose first axis is as long as there are rows.
                Ready-made residuals know whether a value is a number, a vector or a matrix, and
                take that as one value, too. Any other array counts, whole, for each row, as a
                vector `up` does, and `with_residual` refuses it if rows have fewer numbers with one
                of its entries.

        Raises:
            ValueError: a name is missing or unknown, lengths differ, or something is no index or no
                number; one line.
        """
        names = (*self.unknowns, *self.data)
        for what, names_wrong in (
            ("has no", columns.keys() - set(names)),
            ("needs", set(names) - columns.keys()),
        ):
            if names_wrong:
                parameters = ", ".join(names)
                raise ValueError(
                    f"residual {self.name} {what} {min(names_wrong)}; its parameters: {parameters}"
                )
        given = [
            np.atleast_1d(plain_array(f"{x} of {self.name}", columns[x])) for x in self.unknowns
        ]
        count = max(map(len, given))
        index = [
            np.broadcast_to(column, count) if column.shape == (1,) else column for column in given
        ]
        for x, column in zip(self.unknowns, index, strict=True):
            if column.shape != (count,) or (count and column.dtype.kind not in "iu"):
                raise ValueError(
                    f"{x} of {self.name} must be a vector of {count} integers, not "
                    f"{shown(columns[x])}"
                )
        kinds = dict(self.kinds)
        data = []
        whole = []
        for x in self.data:
            value = real_numbers(f"{x} of {self.name}", columns[x])
            if not np.isfinite(value).all():
                raise ValueError(f"{x} of {self.name} must be finite")
            if x in kinds:
                data.append(kinds[x].rows_of(f"{x} of {self.name}", value, count))
            elif value.shape[:1] in ((), (1,), (count,)):
                data.append(np.broadcast_to(value, (count, *value.shape[1:])))
            else:
                data.append(np.broadcast_to(value, (count, *value.shape)))
                whole.append(x)
        return Rows(tuple(index), tuple(data), residual=self, whole=tuple(whole))


def _imported(module: str, name: str, source: str) -> Residual:
    return replace(operator.attrgetter(name)(importlib.import_module(module)), source=source)


def residual(function: Callable[..., Any]) -> Residual:
    """A decorator: a function as a residual. Positional parameters are unknowns, keyword-only ones
    data (`jaxba.with_residual`). The function is differentiated by JAX, for one row at a time, and
    returns a number or a vector, whitened. Raises ValueError: it has no unknown, or parameters of
    another kind; one line."""
    if not inspect.isfunction(function) or function.__name__ == PIXELS:
        raise ValueError(
            f"a residual is made of a function that is not named {PIXELS}, not of {shown(function)}"
        )
    kinds = inspect.Parameter
    found = inspect.signature(function).parameters.values()
    wrong = [
        p.name
        for p in found
        if p.kind in (kinds.VAR_POSITIONAL, kinds.VAR_KEYWORD) or p.default is not p.empty
    ]
    if wrong:
        raise ValueError(
            f"parameter {wrong[0]} of residual {function.__name__}: no *, ** and defaults"
        )
    data = tuple(p.name for p in found if p.kind == kinds.KEYWORD_ONLY)
    unknowns = tuple(p.name for p in found if p.name not in data)
    if not unknowns:
        raise ValueError(
            f"residual {function.__name__} has no unknown: its positional parameters are unknowns"
        )
    return Residual(function, unknowns, data)


def with_data(**kinds: Datum) -> Callable[[Residual], Residual]:
    """A decorator of a residual: what its data may be, by keyword."""

    def known(given: Residual) -> Residual:
        assert set(kinds) == set(given.data), f"{given} has the data {given.data}"
        return replace(given, kinds=tuple(kinds.items()))

    return known


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Rows(ArrayRecord):
    """Rows of one residual."""

    index: tuple[Int[AnyArray, " rows"], ...]
    """For each unknown of the function the camera, lens, point or row of its block."""

    data: tuple[Float[AnyArray, "rows ..."], ...]
    """For each keyword of the function its values."""

    scale: Float[AnyArray, ""] = field(default_factory=lambda: np.ones(()))
    """With rotation and translation: the function sees `scale rotation x + translation` for a
    position x of the problem, which may have been moved since the rows were registered."""

    rotation: Float[AnyArray, "3 3"] = field(default_factory=lambda: np.eye(3))
    translation: Float[AnyArray, "3"] = field(default_factory=lambda: np.zeros(3))

    observation: Int[AnyArray, "_ _ _"] = field(
        default_factory=lambda: np.zeros((0, 0, 0), np.int32)
    )
    """Observations that stand for the rows, once the problem is laid out
    (structure/residual_slots.py)."""

    residual: Residual = field(metadata={"static": True}, kw_only=True)
    """The function."""

    loss: Loss = field(default=Loss(), metadata={"static": True}, kw_only=True)
    """Robust loss of the squared norm of a row."""

    size: int = field(default=0, metadata={"static": True}, kw_only=True)
    """Numbers that the function returns; 0 before it is registered."""

    aligned: bool = field(default=False, metadata={"static": True}, kw_only=True)
    """Whether the scene has been moved to the frame of the rows, or must stay in the one that it
    has."""

    whole: tuple[str, ...] = field(default=(), metadata={"static": True}, kw_only=True)
    """Keywords whose array counts, whole, for each row; none once it is registered."""

    def __len__(self) -> int:
        return len(self.index[0])

    @property
    def points(self) -> list[Int[np.ndarray, " rows"]]:
        """One or two points of each row, -1 without one."""
        of = dict(zip(self.residual.unknowns, self.index, strict=True))
        return [np.asarray(of[x]) for x in (POINT, POINT + SECOND) if x in of] or [
            np.full(len(self), -1)
        ]

    def of(self, kept: Int[np.ndarray, " kept"] | Bool[np.ndarray, " rows"]) -> Rows:
        """Some of the rows."""
        index, data = (tuple(np.asarray(x)[kept] for x in part) for part in (self.index, self.data))
        observation = (
            np.asarray(self.observation)[kept] if len(self.observation) else self.observation
        )
        return replace(self, index=index, data=data, observation=observation)


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Residuals(ArrayRecord):
    """All residuals of a problem besides those of its pixels, and the unknowns that only they
    have."""

    rows: tuple[Rows, ...] = ()
    """Rows of each residual."""

    blocks: tuple[Float[AnyArray, "_ _"], ...] = ()
    """Values of the unknowns that only residuals have, a row for each camera, or fewer."""

    groups: tuple[Int[AnyArray, " cameras"], ...] = ()
    """The row of each block that each camera has, by all rows of a problem that is laid out
    (`block_groups`)."""

    names: tuple[str, ...] = field(default=(), metadata={"static": True})
    """Names of the blocks."""

    def __bool__(self) -> bool:
        return bool(self.rows)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers in a row of each block."""
        return tuple(block.shape[1] for block in self.blocks)

    def moved(self, scale: float, rotation: np.ndarray, translation: np.ndarray) -> Residuals:
        """Those of a problem whose positions x have become `scale rotation x + translation`."""
        found = []
        for rows in self.rows:
            own = np.asarray(rows.scale / scale)
            turn = np.asarray(rows.rotation) @ rotation.T
            back = rows.translation - own * turn @ translation
            found.append(replace(rows, scale=own, rotation=turn, translation=back))
        return replace(self, rows=tuple(found))

    def of(
        self, observations: Bool[np.ndarray, " n"], points: Int[np.ndarray, " kept"]
    ) -> Residuals:
        """Those of some of the points, and in a problem that is laid out of some of the
        observations."""
        place = np.where(observations, np.cumsum(observations) - 1, -1)
        found = []
        for rows in self.rows:
            if len(rows.observation):
                own = place[np.asarray(rows.observation)]
                kept = np.flatnonzero((own >= 0).any(axis=(1, 2)))
                # never empty
                rows = replace(rows, observation=own).of(kept if len(kept) else np.zeros(1, int))
            else:
                rows = rows.of(
                    np.all([(own < 0) | np.isin(own, points) for own in rows.points], axis=0)
                )
            pairs = zip(rows.residual.unknowns, rows.index, strict=True)

            def of_point(name):
                return name.removesuffix(SECOND) == POINT

            index = (
                np.searchsorted(points, i).astype(np.int32) if of_point(name) else i
                for name, i in pairs
            )
            found += [replace(rows, index=tuple(index))] if len(rows) else []
        return replace(self, rows=tuple(found))


def with_rows(
    residuals: Residuals, rows: Rows, unknowns: dict[str, Any], counts: dict[str, int]
) -> Residuals:
    """Residuals with other rows and new blocks, of a problem with so many cameras, lenses and
    points (by their names).

    Raises ValueError: a block is missing, there already, or no matrix of finite numbers; or an
    index is out of range."""
    blocks = dict(zip(residuals.names, residuals.blocks, strict=True))
    name = rows.residual.name
    for own, value in unknowns.items():
        if own in counts or own in blocks or own.endswith(SECOND):
            raise ValueError(f"a new unknown may not be named {own}")
        blocks[own] = real_numbers(f"unknown {own}", value)
        whole = (
            blocks[own].ndim == 2 and 0 < len(blocks[own]) <= counts[POSE] and blocks[own].size > 0
        )
        if not whole or not np.isfinite(blocks[own]).all():
            raise ValueError(
                f"unknown {own} must have finite numbers, 1 to {counts[POSE]} rows, not "
                f"{shown(value)}"
            )
        if own not in {name.removesuffix(SECOND) for name in rows.residual.unknowns}:
            raise ValueError(f"unknown {own} is no parameter of residual {name}")
    counts = counts | {own: len(block) for own, block in blocks.items()}
    index = []
    for own, given in zip(rows.residual.unknowns, rows.index, strict=True):
        base = own.removesuffix(SECOND)
        if base not in counts:
            raise ValueError(
                f"{own} of residual {name} has no start: give unknowns={{'{base}': array}}"
            )
        index.append(indices(f"{own} of {name}", given, counts[base], len(rows)))
    rows = replace(rows, index=tuple(index))
    return replace(
        residuals, rows=(*residuals.rows, rows), blocks=tuple(blocks.values()), names=tuple(blocks)
    )
