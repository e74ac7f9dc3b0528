"""Whether residuals fit their standard deviations: tests with a stated level, and which rows are to
blame.

Whitened residuals e of what was measured are independent standard normals if their standard
deviations are right. With the Jacobian J of all residuals, least squares leave

    r = Q e,    Q = I - J (J^T J)^-1 J^T <= I,

so that the squares of n numbers of r exceed any bound less often than those of n normals do, or
than those of n - m normals where m unknowns are in these numbers alone. Q is the covariance of r,
its trace the redundancy.

1. All rows of a kind: `sum |r_i|^2` against the upper quantile of chi^2 with as many degrees of
   freedom as numbers, less the unknowns that only these have; with Q, `sum |r_i|^2 / a` against
   that with f of them, `a = tr Q^2 / tr Q` and `f = (tr Q)^2 / tr Q^2` of the kind.
2. The largest row: `max |r_i|^2` against that with as many as the row has, at the level over the
   number of rows (Bonferroni); with Q, the largest `T_i = r_i^T Q_ii^-1 r_i`, by which the sum of
   all squares falls without the row.

Rows that are left out, D, take what they pulled with them (a deletion, exactly as a solve of the
linear model without them), and are predicted by the others:

    r <- r - Q_D Q_DD^-1 r_D,    Q <- Q - Q_D Q_DD^-1 Q_D^T,    error of the rows of D = Q_DD^-1
    r_D.

Errors of single rows are told from standard deviations that are all too small by Schwarz's
criterion.

The level is that of a solve: with right standard deviations at most one in `1 / LEVEL` has a note.

Source: Baarda 1968, "A testing procedure for use in geodetic networks" (global test and data
snooping); Satterthwaite 1946, "An approximate distribution of estimates of variance components" (a
and f); Cook, Weisberg 1982, "Residuals and influence in regression" (deletion); Schwarz 1978,
"Estimating the dimension of a model"."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

LEVEL = 1e-3
"""Probability of a note where standard deviations are right. Source: Baarda 1968, who takes it for
data snooping."""

LEAST_REDUNDANCY = 1e-6
"""Share of an error of a row that its residual must have to be known: above the rounding of
differences of one. The standard deviation of the error, over that of the row, is one over its
root."""

MOST_WRONG = 1 / 3  # share of the rows of a kind that may be left out
MOST_OTHERS = 20  # rows that are tried in the place of one


def quantile(degrees: int | float, level: float) -> float:
    """What chi^2 with some degrees of freedom exceeds with a probability of `level`."""
    # imported late: most solves have no other residuals than pixels
    from scipy.special import chdtri

    return float(chdtri(degrees, level))


def too_large(residual: Float[np.ndarray, "rows size"], level: float) -> Bool[np.ndarray, " rows"]:
    """Which rows are larger than standard normals are; half of the level is that of the other
    test."""
    squares = np.sum(residual**2, axis=1)
    return ~(squares <= quantile(residual.shape[1], level / 2 / len(squares)))


def fits(residual: Float[np.ndarray, "rows size"], level: float, unknowns: int = 0) -> bool:
    """Whether rows are standard normals as far as both tests say, or what least squares leave of
    them where so many unknowns are in these rows alone."""
    together = np.sum(residual**2) <= quantile(max(residual.size - unknowns, 1), level / 2)
    return bool(together) and not too_large(residual, level).any()


@dataclass(frozen=True)
class Left:
    """What least squares leave of tested rows, perhaps without some of them."""

    residual: Float[np.ndarray, " numbers"]
    """r."""

    cofactor: Float[np.ndarray, "numbers numbers"]
    """Q."""

    kinds: tuple[Int[np.ndarray, "_ _"], ...]
    """Where the numbers of the rows of each kind are."""

    out: tuple[tuple[int, int], ...] = ()
    """Rows that are left out: kind, and row of it."""

    def without(self, rows: tuple[tuple[int, int], ...]) -> Left:
        """What is left without some more rows."""
        at = np.concatenate([self.kinds[kind][row] for kind, row in rows])
        across = self.cofactor[:, at]
        inverse = _inverse(self.cofactor[np.ix_(at, at)])
        cofactor = self.cofactor - across @ inverse @ across.T
        residual = self.residual - across @ (inverse @ self.residual[at])
        return replace(self, residual=residual, cofactor=cofactor, out=self.out + rows)

    def error(self, row: tuple[int, int]) -> tuple[Float[np.ndarray, " size"], float]:
        """By how much a row is off, as the others say, and T of that."""
        at = self.kinds[row[0]][row[1]]
        inverse = _inverse(self.cofactor[np.ix_(at, at)])
        off = inverse @ self.residual[at]
        return off, float(off @ self.residual[at])

    def deletions(self, kind: int) -> tuple[Float[np.ndarray, " rows"], Int[np.ndarray, " rows"]]:
        """T of each row of a kind, and its rank; zero for those that are left out."""
        at = self.kinds[kind]
        values, vectors = np.linalg.eigh(self.cofactor[at[:, :, None], at[:, None, :]])
        known = values > LEAST_REDUNDANCY
        known[[row for of, row in self.out if of == kind]] = False
        along = np.einsum("rij,ri->rj", vectors, self.residual[at])
        squares = np.where(known, along**2 / np.where(known, values, 1.0), 0.0)
        return squares.sum(axis=1), known.sum(axis=1)

    def excess(self, kind: int, level: float) -> Float[np.ndarray, " rows"]:
        """T of each row of a kind over its bound."""
        squares, rank = self.deletions(kind)
        bounds = np.full(len(squares), np.inf)
        for size in np.unique(rank[rank > 0]):
            bounds[rank == size] = quantile(int(size), level / 2 / len(squares))
        return squares / bounds

    def misfit(self, kind: int) -> tuple[float, float, float]:
        """The sum of squares of a kind, its redundancy, and the trace of the square of its
        cofactor."""
        gone = [row for of, row in self.out if of == kind]
        at = np.delete(self.kinds[kind], gone, axis=0).ravel()
        cofactor = self.cofactor[np.ix_(at, at)]
        return (
            float(np.sum(self.residual[at] ** 2)),
            float(np.trace(cofactor)),
            float(np.sum(cofactor**2)),
        )

    def fits(self, kind: int, level: float) -> bool:
        """Whether a kind passes both tests."""
        if not self.kinds[kind].size:
            return True
        squares, redundancy, square = self.misfit(kind)
        if redundancy > LEAST_REDUNDANCY:
            scale = square / redundancy
            if not squares / scale <= quantile(redundancy / scale, level / 2):
                return False
        return not (self.excess(kind, level) > 1).any()

    def all_fit(self, level: float) -> bool:
        """Whether all kinds do, each at its part of the level."""
        return all(self.fits(kind, level / len(self.kinds)) for kind in range(len(self.kinds)))


def explained(
    left: Left, suspects: tuple[tuple[int, int], ...], level: float = LEVEL
) -> tuple[tuple[int, int], ...] | None:
    """The fewest rows without which the others fit, as far as a search says; None: there are no few
    ones.

    Rows are left out, first the suspects, then those with the largest T, until all fit; and taken
    back in, those with the smallest T first, as long as all fit. Source: forward and backward
    search of outliers, Hadi and Simonoff 1993, "Procedures for the identification of multiple
    outliers in linear models"."""
    limits = [max(1, int(MOST_WRONG * len(kind))) for kind in left.kinds]
    rest = left.without(suspects) if suspects else left
    while not rest.all_fit(level):
        excess = [rest.excess(kind, level) for kind in range(len(left.kinds))]
        full = [
            sum(of == kind for of, _ in rest.out) >= limits[kind] for kind in range(len(limits))
        ]
        largest = [
            0.0 if full[kind] or not x.size else float(x.max()) for kind, x in enumerate(excess)
        ]
        kind = int(np.argmax(largest))
        if not largest[kind] > 0:
            return None
        rest = rest.without(((kind, int(np.argmax(excess[kind]))),))
    out = rest.out
    for row in sorted(out, key=lambda row: _predicted(left, out, row)):
        fewer = tuple(other for other in out if other != row)
        if (left.without(fewer) if fewer else left).all_fit(level):
            out = fewer
    return out


def instead(
    left: Left, out: tuple[tuple[int, int], ...], row: tuple[int, int], level: float = LEVEL
) -> list:
    """Other rows without which, in the place of one that is left out, all fit as well."""
    others = tuple(other for other in out if other != row)
    rest = left.without(others) if others else left
    as_well = []
    for kind in range(len(left.kinds)):
        squares, _ = rest.deletions(kind)
        for other in np.argsort(-squares, kind="stable")[:MOST_OTHERS].tolist():
            if (
                (kind, other) != row
                and squares[other] > 0
                and rest.without(((kind, other),)).all_fit(level)
            ):
                as_well.append((kind, other))
    return as_well


def is_scale(left: Left, kind: int, out: tuple[tuple[int, int], ...]) -> bool:
    """Whether larger standard deviations of a kind explain it better than errors of the rows of it
    that are left out.

    By Schwarz's criterion, with the redundancy f for the number of data: minus twice the logarithm
    of the likelihood, and `log f` for each parameter, a factor of all deviations, or the numbers of
    rows and which ones they are."""
    wrong = tuple(row for row in out if row[0] == kind)
    others = tuple(row for row in out if row[0] != kind)
    base = left.without(others) if others else left
    squares, redundancy, _ = base.misfit(kind)
    kept, _, _ = base.without(wrong).misfit(kind)
    size = left.kinds[kind].shape[1]
    several = np.log(max(redundancy, 2.0))
    by_errors = kept + len(wrong) * (size * several + 2 * np.log(len(left.kinds[kind])))
    by_factor = redundancy * (np.log(max(squares / redundancy, 1.0)) + 1) + several
    return bool(by_factor < by_errors)


def _predicted(left: Left, out: tuple[tuple[int, int], ...], row: tuple[int, int]) -> float:
    """T of a row that is left out, among the others that are not."""
    others = tuple(other for other in out if other != row)
    return (left.without(others) if others else left).error(row)[1]


def _inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The inverse on directions that are controlled."""
    values, vectors = np.linalg.eigh(matrix)
    known = values > LEAST_REDUNDANCY
    return (vectors[:, known] / values[known]) @ vectors[:, known].T
