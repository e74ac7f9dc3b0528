"""The bundle adjustment problem: parameters, observations, and the checks that they are valid.

A `BundleProblem` made by `BundleProblem.create` is finite, has observations, and indices in
range."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba.problem.checks import indices, inverse_roots, real_numbers, shown
from jaxba.problem.constants import Constants, checked_constants
from jaxba.problem.intrinsics import LENS_SIZE, POSE_SIZE, Lenses, checked_lenses, lens_size
from jaxba.problem.labels import Labels
from jaxba.problem.residuals import Residuals
from jaxba.problem.rigs import Rigs, checked_rigs
from jaxba.typing import AnyArray, ArrayRecord, InputError, register_pytree

# parameters of a BAL camera: angle-axis (3, radians), translation (3), f (pixels), k1, k2
CAMERA_SIZE = 9
POINT_SIZE = 3  # parameters of a point: x, y, z in scene units


NONE = np.zeros(0, np.int32)  # no index


class ProblemError(InputError):
    """The input is not a valid bundle adjustment problem. The message is one line for the user."""


class NothingObserved(ProblemError):
    """No observation is left that could be solved. The message is one line for the user."""


def check_is_problem(problem: Any) -> None:
    """Raises ValueError: it is something else; one line."""
    if not isinstance(problem, BundleProblem):
        raise ValueError(
            "problem must be a BundleProblem, as jaxba.read_problem returns it, not "
            f"{shown(problem)}"
        )


class ProblemWarning(UserWarning):
    """A part of the input was left out, was mended, or looks wrong. The message is one line for the
    user."""


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class BundleProblem(ArrayRecord):
    """Cameras, points and observations, in the conventions of BAL.

    A camera `[w, t, f, k1, k2]` maps a point X to the pixel z:

        P = R(w) X + t,    p = -P.xy / P.z,    z = f (1 + k1 |p|^2 + k2 |p|^4) p

    With lenses of other camera models (`jaxba.CAMERA_MODELS`) a camera is `[w, t, numbers]`, and z
    the model's pixel of the point (P.x, -P.y, -P.z): poses look down -z as BAL's do, and pixels are
    those of the model.

    Source: Agarwal et al. 2010, "Bundle Adjustment in the Large"."""

    cameras: Float[AnyArray, "cameras parameters"]
    """Angle-axis (radians), translation (scene units), and the lens: f (pixels), k1 and k2, or the
    numbers of its camera model, with zeros after them where another model has more."""

    points: Float[AnyArray, "points 3"]
    """Positions in scene units."""

    observations: Float[AnyArray, "observations 2"]
    """Measured pixels; of a BAL lens with the origin at the image centre, x to the right, y
    upwards."""

    camera_index: Int[AnyArray, " observations"]
    """Camera of each observation, int32."""

    point_index: Int[AnyArray, " observations"]
    """Point of each observation, int32."""

    whitening: Float[AnyArray, "observations 2 2"] | None = None
    """`Sigma^(-1/2)` of each observation (1 / pixels); None: the identity."""

    lenses: Lenses | None = None
    """Shared and fixed intrinsics, and camera models; None: every camera has its own BAL lens, all
    optimised."""

    constants: Constants | None = None
    """Constant poses and points; None: all are optimised."""

    rigs: Rigs | None = None
    """Cameras that move together; None: every camera has a pose of its own."""

    residuals: Residuals = field(default_factory=Residuals)
    """Residuals besides those of pixels: one's own (`jaxba.with_residual`) and priors."""

    labels: Labels | None = field(default=None, metadata={"host": True})
    """What the file calls images, lenses and points; None if nothing does."""

    @classmethod
    def create(
        cls,
        cameras: Any,
        points: Any = None,
        observations: Any = None,
        camera_index: Any = NONE,
        point_index: Any = NONE,
        *,
        covariance: Any = None,
        weight: Any = None,
        lenses: Lenses | None = None,
        constants: Constants | None = None,
        rigs: Rigs | None = None,
    ) -> BundleProblem:
        """Checks the arrays and returns a problem of float64 and int32 NumPy arrays. Raises
        ProblemError: shapes differ, an index is out of range, a number is not finite, there is an
        empty array of observations, a covariance is not positive definite, cameras of one lens
        differ in their intrinsics, or a part of the problem does not fit the others.

        Args:
            cameras: shape (cameras, 9), or (cameras, 6 + numbers of the largest camera model).
            points: shape (points, 3).
            observations: shape (observations, 2), pixels. Without them and points a problem has
                cameras alone, whose lenses are constant, and needs other residuals
                (`jaxba.with_residual`): a pose graph.
            camera_index: shape (observations,), integers in [0, cameras).
            point_index: shape (observations,), integers in [0, points).
            covariance: optional, shape (observations, 2, 2), pixels squared; symmetric and
                positive definite. The cost then uses `|Sigma^(-1/2) r|^2`.
            weight: optional, shape (observations,), non-negative; multiplies the squared
                residual, like the covariance `I / weight`. Excludes `covariance`.
            lenses: optional; which cameras share intrinsics, of which models these are, and which
                are optimised.
            constants: optional; poses and points that are not optimised.
            rigs: optional; cameras that move together."""
        if covariance is not None and weight is not None:
            raise ProblemError("give a covariance or a weight per observation, not both")
        parts = {
            "lenses": (lenses, Lenses),
            "constants": (constants, Constants),
            "rigs": (rigs, Rigs),
        }
        for name, (part, kind) in parts.items():
            if part is not None and not isinstance(part, kind):
                raise ProblemError(
                    f"{name} must be a {kind.__name__}, not of type {type(part).__name__}"
                )
        try:
            cameras = _floats("cameras", cameras, POSE_SIZE + lens_size(lenses))
            alone = points is None and observations is None
            if alone:
                points = np.zeros((0, POINT_SIZE))
                observations = np.zeros((0, 2))
                lenses = lenses or Lenses(
                    np.arange(len(cameras)), np.zeros((len(cameras), LENS_SIZE), bool)
                )
            points = _floats("points", points, POINT_SIZE)
            observations = _floats("observations", observations, 2)
            whitening = _whitening(covariance, weight, len(observations))
            if not alone and not len(observations):
                raise ProblemError("the problem has no observations")
            camera_index = indices("camera_index", camera_index, len(cameras), len(observations))
            point_index = indices("point_index", point_index, len(points), len(observations))
            if lenses is not None:
                lenses = checked_lenses(lenses, cameras)
            if constants is not None:
                constants = checked_constants(constants, len(cameras), len(points))
            if rigs is not None:
                rigs = checked_rigs(rigs, cameras, lenses)
        except ValueError as error:
            raise error if isinstance(error, ProblemError) else ProblemError(str(error)) from None
        arrays = (cameras, points, observations, camera_index, point_index, whitening)
        return cls(*arrays, lenses=lenses, constants=constants, rigs=rigs)

    def __repr__(self) -> str:
        arrays = ("cameras", "points", "observations")
        counts = [
            f"{(*getattr(getattr(self, name), 'shape', ()), '?')[0]} {name}" for name in arrays
        ]
        parts = ("whitening", "lenses", "constants", "rigs", "labels")
        own = [f"{len(rows)} rows of {rows.residual.name}" for rows in self.residuals.rows]
        found = [*counts, *(name for name in parts if getattr(self, name) is not None), *own]
        return f"BundleProblem({', '.join(found)})"

    def _repr_html_(self) -> str:
        # which imports this module, and pictures
        return importlib.import_module("jaxba.problem.display").card_of(self)

    @property
    def num_cameras(self) -> int:
        """Number of cameras, observed or not."""
        return self.cameras.shape[0]

    @property
    def num_points(self) -> int:
        """Number of points, observed or not."""
        return self.points.shape[0]

    @property
    def num_observations(self) -> int:
        """Number of observations; the cost has twice as many residuals."""
        return self.observations.shape[0]

    def replace(self, **changes: Any) -> BundleProblem:
        """The same problem with some fields replaced, without new checks."""
        return replace(self, **changes)

    def subset(
        self,
        observations: Any,
        cameras: Int[np.ndarray, " _"] | None = None,
        points: Int[np.ndarray, " _"] | None = None,
    ) -> BundleProblem:
        """The problem with some of its observations and, if they are given, of its cameras and
        points. `observations` is a mask or positions; they name no other cameras and points than
        those that stay. `cameras` and `points` are positions, ascending; None: all. Lenses and
        frames keep their numbers. With points or cameras given there are no labels, and no
        residuals but those of pixels, unless the problem is laid out
        (structure/residual_slots.py)."""
        names = ("observations", "camera_index", "point_index", "whitening")
        arrays = {name: getattr(self, name) for name in names}
        found = replace(
            self,
            **{name: np.asarray(x)[observations] for name, x in arrays.items() if x is not None},
        )
        if self.constants is not None:
            of_both = (slice(None) if kept is None else kept for kept in (cameras, points))
            found = replace(found, constants=self.constants.of(*of_both))
        if points is not None:
            index = np.searchsorted(points, found.point_index).astype(np.int32)
            found = replace(
                found, points=np.asarray(self.points)[points], point_index=index, labels=None
            )
            found = replace(
                found,
                residuals=self.residuals and self.residuals.of(np.asarray(observations), points),
            )
        if cameras is None:
            return found
        return replace(
            found,
            cameras=np.asarray(self.cameras)[cameras],
            camera_index=np.searchsorted(cameras, found.camera_index).astype(np.int32),
            lenses=None if self.lenses is None else self.lenses.of(cameras),
            rigs=None if self.rigs is None else self.rigs.of(cameras),
            residuals=Residuals(),
            labels=None,
        )


def _floats(name: str, values: Any, width: int) -> np.ndarray:
    """A float64 array of shape (n, width), checked to be finite."""
    array = real_numbers(name, values)
    if array.ndim != 2 or array.shape[1] != width:
        raise ProblemError(f"{name} must have shape (n, {width}), not {array.shape}")
    # without an array as large for this
    if array.size and not np.isfinite([array.min(), array.max()]).all():
        bad = np.isfinite(array).all(axis=1).argmin()
        raise ProblemError(f"{name}[{bad}] is not finite: {array[bad].tolist()}")
    return array


def _whitening(covariance: Any, weight: Any, count: int) -> np.ndarray | None:
    """`Sigma^(-1/2)` of each observation, shape (count, 2, 2), from covariances or weights."""
    if weight is not None:
        weight = real_numbers("weight", weight)
        if weight.shape != (count,) or not np.isfinite(weight).all() or (weight < 0).any():
            raise ProblemError(f"weight must be {count} finite numbers that are not negative")
        if not weight.any():
            raise ProblemError("weight is zero for every observation: there is nothing to optimise")
        return np.sqrt(weight)[:, None, None] * np.eye(2)
    if covariance is None:
        return None
    covariance = real_numbers("covariance", covariance)
    if covariance.shape != (count, 2, 2) or not np.isfinite(covariance).all():
        raise ProblemError(
            f"covariance must be finite, of shape ({count}, 2, 2), not {covariance.shape}"
        )
    roots, bad = inverse_roots(covariance)
    if bad.size:
        raise ProblemError(f"covariance[{bad[0]}] is not symmetric positive definite")
    return roots
