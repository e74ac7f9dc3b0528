"""Lens distortion that is not BAL's: Brown's model and the polynomial fisheye, and their inverses.

A point of the image plane p = (X/Z, Y/Z) at radius r is moved to

    Brown      p' = (1 + k1 r^2 + k2 r^4 + ...) p + (2 p1 x y + p2 (r^2 + 2 x^2), 2 p2 x y + p1 (r^2 + 2 y^2))
    fisheye    p' = (t + k1 t^3 + k2 t^5 + ...) / r p,    t = atan r

Source: OpenCV, "Camera calibration and 3D reconstruction" and "Fisheye camera model"; COLMAP's OPENCV and
OPENCV_FISHEYE, OpenMVG's Brown_T2 and Fisheye and OpenSfM's brown, fisheye and fisheye_opencv are these.

VisualSFM's acts the other way round, and is inverted here: `p = (1 + k1 r'^2 + ...) p'`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_HALVINGS = 60
"""Bisections of the radius, after which Newton's steps have nothing left to gain: 2^-60 of the search interval."""

_NEWTON_STEPS = 20
"""Steps on the tangential part; it is small, and three or four are enough."""

_TOLERANCE = 1e-10
"""Largest difference in the image plane of a point that counts as the inverse."""

_SMALLEST_DETERMINANT = 1e-6
"""Of the derivative of the distortion; below it the image folds over itself."""


@dataclass(frozen=True)
class Distortion:
    """Coefficients of one lens."""

    radial: tuple[float, ...] = ()
    """k1, k2, ..., of r^2, r^4, ...; of t^2, t^4, ... for a fisheye."""

    tangential: tuple[float, float] = (0.0, 0.0)
    """p1 and p2."""

    fisheye: bool = False
    """Whether radii are angles."""

    inverse: bool = False
    """Whether the coefficients are those of the way from the measured point to that of the image plane."""

    @classmethod
    def of(cls, numbers: Sequence[float], fisheye: bool) -> Distortion:
        """The lens of coefficients as OpenMVG and AliceVision write them; p1 and p2 of Brown's model are last."""
        if fisheye:
            return cls(tuple(numbers), fisheye=True)
        return cls(tuple(numbers[:3]), (numbers[3], numbers[4]) if len(numbers) == 5 else (0.0, 0.0))

    @property
    def is_bal(self) -> bool:
        """Whether BAL's k1 and k2 say the same."""
        return not (self.fisheye or self.inverse or any(self.tangential) or any(self.radial[2:]))

    def apply(self, plane: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
        """Moved points by the formula of the coefficients, and the derivative of each with respect to the point."""
        x, y = plane.T
        p1, p2 = self.tangential
        square = x * x + y * y
        factor, rate = self._factor(np.sqrt(square))
        moved = factor[:, None] * plane
        moved += np.column_stack(
            [2 * p1 * x * y + p2 * (square + 2 * x * x), 2 * p2 * x * y + p1 * (square + 2 * y * y)]
        )
        mixed = 2 * (p1 * x + p2 * y)
        derivative = factor[:, None, None] * np.eye(2) + rate[:, None, None] * plane[:, :, None] * plane[:, None, :]
        derivative[:, 0, 0] += 2 * p1 * y + 6 * p2 * x
        derivative[:, 1, 1] += 2 * p2 * x + 6 * p1 * y
        derivative[:, 0, 1] += mixed
        derivative[:, 1, 0] += mixed
        return moved, derivative

    def remove(self, moved: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
        """The points of the image plane for measured ones, and the derivatives of the measured with respect to them.

        NaN where there is none: beyond the radius at which the image folds over itself, or 90 degrees off the axis.
        """
        with np.errstate(all="ignore"):
            if self.inverse:
                plane, derivative = self.apply(moved)
                good = np.hypot(*moved.T) <= self._fold()
                good &= np.linalg.det(derivative) >= _SMALLEST_DETERMINANT
                derivative[~good] = np.eye(2)
                return np.where(good[:, None], plane, np.nan), np.linalg.inv(derivative)
            plane = self._remove_radial(moved)
            for _ in range(_NEWTON_STEPS if any(self.tangential) else 0):
                found, derivative = self.apply(plane)
                flat = ~(np.abs(np.linalg.det(derivative)) >= _SMALLEST_DETERMINANT)
                derivative[flat] = np.eye(2)
                plane = plane - np.linalg.solve(derivative, (found - moved)[:, :, None])[:, :, 0]
            found, derivative = self.apply(plane)
            good = np.abs(found - moved).max(axis=1) <= _TOLERANCE * (1 + np.abs(moved).max(axis=1))
            good &= np.linalg.det(derivative) >= _SMALLEST_DETERMINANT
            if any(self.tangential):  # Newton's steps may have crossed the fold
                good &= np.hypot(*plane.T) <= 1.1 * self._fold()
        return np.where(good[:, None], plane, np.nan), np.where(good[:, None, None], derivative, np.nan)

    def _factor(self, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`s = r' / r`, and `ds/dr / r`."""
        near = radius < 1e-6  # the series, to double precision
        r = np.where(near, 1.0, radius)
        moved, slope = self._along(np.arctan(r) if self.fisheye else r)
        factor = moved / r
        rate = ((slope / (1 + r * r) if self.fisheye else slope) - factor) / (r * r)
        k1 = self.radial[0] if self.radial else 0.0
        return np.where(near, 1.0, factor), np.where(near, 2 * (k1 - 1 / 3 if self.fisheye else k1), rate)

    def _along(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`t (1 + k1 t^2 + ...)` of a radius or an angle, and its derivative."""
        moved, slope = np.array(t), np.ones_like(t)
        for power, k in enumerate(self.radial, 1):
            moved = moved + k * t ** (2 * power + 1)
            slope = slope + (2 * power + 1) * k * t ** (2 * power)
        return moved, slope

    def _remove_radial(self, moved: np.ndarray) -> np.ndarray:
        """As `remove`, without the tangential part: bisection up to the radius at which the image folds."""
        wanted = np.hypot(*moved.T)
        limit = self._fold()
        low, high = np.zeros_like(wanted), np.full_like(wanted, limit if np.isfinite(limit) else 1.0)
        while not np.isfinite(limit) and (short := (self._along(high)[0] < wanted) & np.isfinite(wanted)).any():
            high = np.where(short, 2 * high, high)
        high0 = high
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            below = self._along(middle)[0] < wanted
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        radius = 0.5 * (low + high)
        radius = np.where(wanted <= self._along(high0)[0], radius, np.nan)
        radius = np.tan(radius) if self.fisheye else radius
        return np.where(wanted > 0, radius / np.where(wanted > 0, wanted, 1.0), 1.0)[:, None] * moved

    def _fold(self) -> float:
        """Radius or angle up to which `_along` grows; 90 degrees at most for angles."""
        slope = [(2 * power + 1) * k for power, k in reversed(list(enumerate(self.radial, 1)))]  # in t^2
        if not np.isfinite(slope).all():
            return 0.0
        roots = np.roots(np.trim_zeros([*slope, 1.0], "f"))
        real = roots[np.abs(roots.imag) <= 1e-12 * np.abs(roots)].real
        limit = float(np.sqrt(min(real[real > 0], default=np.inf)))
        return min(limit, np.pi / 2) if self.fisheye else limit
