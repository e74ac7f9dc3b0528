"""Notes on what was measured and does not fit what was found: `Solution.notes`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxba.model.registration import residuals_of_rows
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.labels import Part, part_name
from jaxba.problem.losses import Loss
from jaxba.problem.marks import of_marks, whitening_of
from jaxba.problem.options import Intrinsics
from jaxba.problem.residuals import LENS, POINT, POSE, SECOND, Rows
from jaxba.solver.fit import LEAST_REDUNDANCY, LEVEL, Left, explained, fits, instead, is_scale
from jaxba.solver.redundancy import Noise, TooLargeError, left_of, noise_left, noise_of
from jaxba.solver.robust import LAST, LEAST_SCALE, RowsOfKinds, distances, robust_solution

NAMED = 3  # rows that a note names of more

OPTIMISTIC = 5.0
"""Factor of standard deviations up to which these are called too small, and beyond it the
measurements wrong."""

MARKS = "pixels of control points"
"""Name of the kind of pixels that were clicked."""

PARTS: dict[str, Part] = {POSE: "image", LENS: "lens", POINT: "point"}
"""What the unknowns of residuals belong to."""

LENGTHS = ("position_prior", "position", "control_point", "distance", "baseline", "point_to_plane")
"""Residuals whose numbers are lengths once they are multiplied by standard deviations."""


class Kind(NamedTuple):
    """What was measured of one kind, as a solve has it."""

    name: str
    residual: Float[np.ndarray, "rows size"]  # whitened
    row_name: Callable[[int], str]
    # how far a whitened residual of a row is in its own units; may be empty
    off: Callable[[int, np.ndarray], str]
    unknowns: int = 0  # numbers of the blocks that only this kind has


class Solved(NamedTuple):
    """A solve, for its notes."""

    start: BundleProblem
    problem: BundleProblem
    counted: Bool[np.ndarray, " observations"]  # which count in the cost
    loss: Loss
    intrinsics: Intrinsics
    # solves a problem with a limit of iterations
    again: Callable[[BundleProblem, int], BundleProblem]
    noise: Noise = Noise(1.0, 1.0)  # of pixels without a stated deviation


def notes_of(solved: Solved) -> tuple[str, ...]:
    """A note for each kind of residuals that does not fit its standard deviations, with the rows to
    blame.

    Pixels count if their deviations are stated, as those of control points are. Whether anything
    does not fit, the residuals of the solution say, or those of the pixels that took its error;
    what it is, another solve in which it has no weight."""
    before = {
        name: getattr(solved.start, name) for name in ("cameras", "points", "rigs", "residuals")
    }
    problem = solved.problem.subset(solved.counted)
    solved = solved._replace(start=problem.replace(**before), problem=problem)
    clicked = of_marks(solved.problem)
    kinds = _kinds(solved.problem, clicked)
    worse = [kind for kind in kinds if not fits(kind.residual, LEVEL / len(kinds), kind.unknowns)]
    try:
        if not worse and (not kinds or _fits_with_pixels(solved, clicked)):
            return ()
        return _explained(solved, clicked, kinds)
    except (TooLargeError, ProblemError, np.linalg.LinAlgError):
        return tuple(_as_found(kind) for kind in worse)


def _fits_with_pixels(solved: Solved, clicked: Bool[np.ndarray, " observations"]) -> bool:
    """Whether all rows fit in a linear model of the solution. Where pixels give way to a wrong row
    it has hardly a residual, which is large over its own deviation. Their noise is taken to be all
    that the solution leaves of them."""
    rows = tuple(replace(kind, loss=Loss()) for kind in solved.problem.residuals.rows)
    problem = solved.problem.replace(residuals=replace(solved.problem.residuals, rows=rows))
    left, _ = left_of(
        problem, clicked, solved.loss, solved.intrinsics, noise_left(problem, clicked)
    )
    return left.all_fit(LEVEL)


def _explained(
    solved: Solved, clicked: Bool[np.ndarray, " observations"], kinds: list[Kind]
) -> tuple[str, ...]:
    """Notes by the simplest explanation: a few wrong rows, else one kind, else all kinds that do
    not fit."""
    every = tuple((kind, row) for kind, of in enumerate(kinds) for row in range(len(of.residual)))
    noise = noise_of(robust_solution(solved.start, clicked, solved.again, every), clicked)
    solved = solved._replace(noise=noise)
    robust = _linear(solved, clicked)
    out = explained(robust.left, robust.suspects)
    if out == ():
        return ()
    if notes := _of_few(solved, clicked, kinds, robust, out):
        return notes
    alone = []
    for kind in range(len(kinds)):
        if alone and kinds[kind].name == MARKS:
            continue  # control points fit anything that is not clicked
        every = tuple((kind, row) for row in range(len(kinds[kind].residual)))
        without = _linear(solved, clicked, every)
        if without.left.without(every).all_fit(LEVEL):
            if notes := _of_few(solved, clicked, kinds, without, explained(without.left, ())):
                return notes
            alone.append(_of_whole_kind(without.left, kind, kinds[kind]))
    if alone:
        return tuple(alone)
    worse = [
        kind
        for kind in range(len(kinds))
        if not robust.left.fits(kind, LEVEL / len(robust.left.kinds))
    ]
    return tuple(_of_whole_kind(robust.left, kind, kinds[kind]) for kind in worse)


class Linear(NamedTuple):
    """A linear model of a solve where some rows have no weight."""

    left: Left
    # by what rows of each kind are multiplied besides their standard deviations
    factors: list[np.ndarray]
    suspects: RowsOfKinds  # rows that seem not to fit


def _linear(
    solved: Solved, clicked: Bool[np.ndarray, " observations"], dropped: RowsOfKinds = ()
) -> Linear:
    """What least squares leave where rows that do not fit, and those that are dropped, have no
    weight."""
    robust = robust_solution(solved.start, clicked, solved.again, dropped)
    left, of_clicks = left_of(robust, clicked, solved.loss, solved.intrinsics, solved.noise)
    factors = [np.ones(len(kind)) for kind in left.kinds[:-1]] + [of_clicks]
    suspects = []
    for kind, far in enumerate(distances(robust, clicked)):
        bound = max(LEAST_SCALE, LAST * float(np.median(far))) if len(far) else 0.0
        suspects += [(kind, row) for row in np.flatnonzero(far > bound).tolist()]
    return Linear(left, factors, tuple(suspects))


def _of_few(
    solved: Solved,
    clicked: Bool[np.ndarray, " observations"],
    kinds: list[Kind],
    linear: Linear,
    out: RowsOfKinds | None,
) -> tuple[str, ...]:
    """Notes on a few rows without which all others fit, as a solve without them confirms; none if
    it does not."""
    if not out or _scaled(linear.left, out):
        return ()
    linear = _linear(solved, clicked, out)
    out = explained(linear.left, out)
    if not out or _scaled(linear.left, out):
        return ()
    return tuple(_of_rows(linear, out, kind, kinds) for kind in sorted({kind for kind, _ in out}))


def _scaled(left: Left, out: RowsOfKinds) -> bool:
    """Whether some kind has standard deviations that are all too small rather than some wrong
    rows."""
    return any(is_scale(left, kind, out) for kind in {kind for kind, _ in out})


def _kinds(problem: BundleProblem, clicked: Bool[np.ndarray, " observations"]) -> list[Kind]:
    """Everything that was measured to standard deviations."""
    kinds = []
    for rows, residual in zip(problem.residuals.rows, residuals_of_rows(problem), strict=True):
        of_rows = functools.partial(_row_name, problem, rows), functools.partial(_off, rows)
        kinds.append(Kind(rows.residual.name, residual, *of_rows, _unknowns_of(problem, rows)))
    if clicked.any():
        marks = problem.subset(clicked)
        of_pixels = functools.partial(_pixel_name, marks), functools.partial(_pixels_off, marks)
        kinds.append(Kind(MARKS, geometry.residuals(marks), *of_pixels))
    return kinds


def _unknowns_of(problem: BundleProblem, rows: Rows) -> int:
    """How many numbers are in rows of blocks that no other residual has."""
    residuals = problem.residuals
    used: dict[str, list[np.ndarray]] = {}
    for name, index in zip(rows.residual.unknowns, rows.index, strict=True):
        used.setdefault(name.removesuffix(SECOND), []).append(np.asarray(index))
    others = [other.residual.unknowns for other in residuals.rows if other is not rows]
    shared = {name.removesuffix(SECOND) for names in others for name in names}
    sizes = dict(zip(residuals.names, residuals.sizes, strict=True))
    alone = [name for name in used if name in sizes and name not in shared]
    return sum(sizes[name] * len(np.unique(np.concatenate(used[name]))) for name in alone)


def _of_rows(linear: Linear, out: RowsOfKinds, kind: int, kinds: list[Kind]) -> str:
    """That rows of a kind do not fit the rest, by how much, and which others might be wrong in
    their place."""
    left = linear.left
    rows = [row for row in out if row[0] == kind]
    errors = {}
    for row in rows:
        others = tuple(other for other in out if other != row)
        errors[row] = (left.without(others) if others else left).error(row)
    rows.sort(key=lambda row: -errors[row][1])
    texts = []
    for row in rows[:NAMED]:
        off, square = errors[row]
        name = kinds[kind].row_name(row[1])
        far = kinds[kind].off(row[1], off / linear.factors[kind][row[1]])
        texts.append(f"{name} is {far}{np.sqrt(square):.3g} standard deviations off")
        perhaps = instead(left, out, row)
        if perhaps:
            names = [_name(kinds, other) for other in perhaps]
            texts[-1] += f", unless {_listed(names, 'or')} is wrong instead"
    return f"{kinds[kind].name}: does not fit the rest: {_listed(texts, 'and', len(rows))}"


def _of_whole_kind(left: Left, kind: int, of: Kind) -> str:
    """That all standard deviations of a kind are too small, or that the whole kind is wrong, with
    its largest rows."""
    squares, redundancy, _ = left.misfit(kind)
    factor = np.sqrt(squares / max(redundancy, LEAST_REDUNDANCY))
    sizes, _ = left.deletions(kind)
    largest = [row for row in np.argsort(-sizes, kind="stable")[:NAMED].tolist() if sizes[row] > 0]
    named = _listed(
        [f"{of.row_name(row)} by {np.sqrt(sizes[row]):.3g}" for row in largest], "and", len(sizes)
    )
    what = f"its standard deviations should be {factor:.2g} times as large"
    if factor > OPTIMISTIC:
        what = (
            f"by {factor:.3g} times its standard deviations: is it of other units, axes or "
            "another frame"
        )
    return f"{of.name}: does not fit the rest, {what}; the largest are {named} standard deviations"


def _as_found(kind: Kind) -> str:
    """That a kind does not fit, with its largest rows as the solution has them."""
    sizes = np.sqrt(np.sum(kind.residual**2, axis=1))
    factor = np.sqrt(np.mean(kind.residual**2))
    named = []
    for row in np.argsort(-sizes, kind="stable")[:NAMED].tolist():
        name = kind.row_name(row)
        far = kind.off(row, kind.residual[row])
        named.append(f"{name} is {far}{sizes[row]:.3g} standard deviations off")
    return (
        f"{kind.name}: does not fit its standard deviations, which would have to be {factor:.3g} "
        "times as large: "
        f"{_listed(named, 'and', len(sizes))}"
    )


def _name(kinds: list[Kind], row: tuple[int, int]) -> str:
    return f"{kinds[row[0]].row_name(row[1])} ({kinds[row[0]].name})"


def _listed(texts: list[str], word: str, count: int = 0) -> str:
    """Some texts as a list, of `count` in all."""
    shown = texts[:NAMED]
    more = max(count, len(texts)) - len(shown)
    if more:
        return f"{', '.join(shown)} {word} {more} more"
    return f" {word} ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)


def _row_name(problem: BundleProblem, rows: Rows, row: int) -> str:
    """What a note calls a row: by its images and points, and by its number where these may have
    several."""
    pairs = zip(rows.residual.unknowns, rows.index, strict=True)
    parts = [(name.removesuffix(SECOND), index[row]) for name, index in pairs]
    names = dict.fromkeys(
        part_name(problem.labels, PARTS[name], at) for name, at in parts if name in PARTS
    )
    listed = " and ".join(names)
    if rows.residual.function.__module__.startswith("jaxba.") and listed:
        return listed
    return f"row {row} ({listed})" if listed else f"row {row}"


def _off(rows: Rows, row: int, whitened: Float[np.ndarray, " size"]) -> str:
    data = dict(zip(rows.residual.data, rows.data, strict=True))
    if rows.residual.name not in LENGTHS:
        return ""
    if "whitening" in data:
        off = np.linalg.solve(np.asarray(data["whitening"])[row], whitened)
    elif "sigma" in data:
        off = whitened * np.asarray(data["sigma"])[row]
    else:
        return ""
    if len(off) == 1:
        return f"{off[0]:.3g} or "
    axes = ", ".join(f"{axis} {number:.3g}" for axis, number in zip("xyz", off, strict=False))
    return f"{np.linalg.norm(off):.3g} ({axes}) or "


def _pixel_name(marks: BundleProblem, row: int) -> str:
    point = part_name(marks.labels, "point", marks.point_index[row])
    return f"{point} in {part_name(marks.labels, 'image', marks.camera_index[row])}"


def _pixels_off(marks: BundleProblem, row: int, whitened: Float[np.ndarray, "2"]) -> str:
    return f"{np.linalg.norm(np.linalg.solve(whitening_of(marks)[row], whitened)):.3g} px or "
