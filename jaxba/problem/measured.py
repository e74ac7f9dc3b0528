"""Priors of a problem from measurements: `with_position_priors`, `with_rotation_priors`,
`with_lens_priors`.

A scene is first aligned with measured positions, since its frame and scale are arbitrary."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.problem.alignment import aligned
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.checks import finite, inverse_roots, shown
from jaxba.problem.geometry import rotation_matrices
from jaxba.problem.hold import every_lens, number_columns, positions_of
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.losses import Loss
from jaxba.problem.residuals import Rows, residual
from jaxba.problem.row_value import AXES

LEAST_VARIANCE = 1e-200  # smallest eigenvalue of a covariance whose inverse can be computed with


def with_position_priors(
    problem: BundleProblem,
    positions: Any,
    covariance: Any = None,
    *,
    stddev: Any = None,
    images: Iterable[int] | Iterable[str] | None = None,
    loss: Loss | None = None,
    align: bool = True,
) -> BundleProblem:
    """The problem with measured positions of images. Raises ValueError: shapes, or no such image;
    one line. Raises ProblemError: a covariance is not positive definite; or an alignment would move
    what is constant or has priors, or the positions are latitude and longitude, or mirrored.

    Args:
        problem: any problem.
        positions: measured centres, shape (n, 3), in the units of `covariance`.
        covariance: shape (3, 3) for all, or (n, 3, 3).
        stddev: standard deviations instead: one number, three along x, y and z, or one or three for
            each image, shape (n, 1), (n, 3), or (n,) where n is not 3.
        images: positions or names of the images; None: all, in order.
        loss: robust loss of the squared whitened distance; None: squared.
        align: whether the scene is first moved, turned and scaled to the measured positions,
            robustly, as COLMAP does. What they do not determine, such as the rotation about a line,
            stays as it is, with a `ProblemWarning`. Without it the scene must be in their frame
            already."""
    at = _images_at(problem, images)
    measured = finite("positions", positions, (len(at), 3))
    if (covariance is None) == (stddev is None):
        raise ValueError("positions need either a covariance or a stddev")
    if stddev is not None:
        covariance = _variances(stddev, len(at))
    covariances, roots = _covariances(problem, "position", covariance, at)
    if not isinstance(loss, Loss | None):
        raise ValueError(f"loss must be a jaxba.Loss, not {shown(loss)}")
    if align:
        if problem.constants is not None or problem.residuals:
            raise ProblemError(
                "an alignment would move what is constant or measured: align first, or align=False"
            )
        problem = aligned(problem, measured, covariances, at)
    rows = position_prior(pose=at, position=measured, whitening=roots)
    return _with(problem, replace(rows, loss=loss or Loss(), size=3, aligned=True))


def with_rotation_priors(
    problem: BundleProblem,
    rotations: Any,
    covariance: Any,
    *,
    images: Iterable[int] | Iterable[str] | None = None,
) -> BundleProblem:
    """The problem, which is in the frame of the measurements, with measured rotations of images.
    `rotations` are angle-axis from the world to the camera (BAL's axes, as in `problem.cameras`),
    shape (n, 3), radians. `covariance` is that of the rotation in the camera's frame, radians
    squared, shape (3, 3) for all, or (n, 3, 3). `images` are as for `with_position_priors`. Raises
    ValueError, ProblemError: as that does."""
    at = _images_at(problem, images)
    measured = finite("rotations", rotations, (len(at), 3))
    whitening = AXES * _covariances(problem, "rotation", covariance, at)[1] * AXES[:, None]
    matrices = AXES[:, None] * rotation_matrices(measured)
    rows = rotation_prior(pose=at, rotation=matrices, whitening=whitening)
    return _with(problem, replace(rows, size=3, aligned=True))


def with_lens_priors(problem: BundleProblem, numbers: dict[str, float]) -> BundleProblem:
    """The problem with its lenses' numbers believed as they are, to a standard deviation. `numbers`
    has the standard deviation by the name of a number, such as `k1`, or of a group (`focal`,
    `principal_point`, `distortion`), in the units of the number. Raises ValueError: no such number,
    or a standard deviation that is not positive; one line."""
    lenses = every_lens(problem)
    used, first = np.unique(lenses.index, return_index=True)
    mean = np.asarray(problem.cameras)[first, POSE_SIZE:]
    weight = np.zeros(np.asarray(lenses.free).shape)
    if not isinstance(numbers, dict):
        raise ValueError(
            f"standard deviations are a dict by the names of numbers, not {shown(numbers)}"
        )
    for name, value in numbers.items():
        deviation = float(finite(f"the standard deviation of {name}", value, ()))
        if deviation <= 0:
            raise ValueError(f"the standard deviation of {name} must be positive, is {deviation}")
        weight[number_columns(lenses, [name])] = 1 / deviation
    rows = lens_prior(lens=used, mean=mean, weight=weight[used])
    rows = replace(rows, size=mean.shape[1], aligned=True)
    return _with(problem.replace(lenses=lenses), rows)


@residual
def position_prior(pose, *, position, whitening):
    """Whitened difference of a camera's centre from a measured position. Source: COLMAP,
    `CovarianceWeightedCostFunctor<AbsolutePosePositionPriorCostFunctor>`."""
    return whitening @ (pose.center - position)


@residual
def rotation_prior(pose, *, rotation, whitening):
    """Whitened rotation from a measured one, in the camera's frame, both in the axes of `Pose`."""
    return whitening @ pose.turn_from(rotation)


@residual
def lens_prior(lens, *, mean, weight):
    """Differences of the numbers of a lens from expected ones, over standard deviations."""
    return weight * (lens.numbers - mean)


def _with(problem: BundleProblem, rows: Rows) -> BundleProblem:
    """The problem with rows of a prior in place of earlier ones of the same cameras or lenses."""
    known = problem.residuals
    kept = []
    for one in known.rows:
        if one.residual == rows.residual:
            one = one.of(~np.isin(one.index[0], rows.index[0]))
        kept += [one] if len(one) else []
    return problem.replace(residuals=replace(known, rows=(*kept, rows)))


def _images_at(problem: BundleProblem, images: Iterable[int] | Iterable[str] | None) -> np.ndarray:
    """The images of measurements, each once."""
    if images is None:
        return np.arange(problem.num_cameras)
    at = positions_of(problem, images, "image")
    values, counts = np.unique(at, return_counts=True)
    if (counts > 1).any():
        raise ValueError(
            f"{_name(problem, int(values[counts > 1][0]))} has more than one measurement"
        )
    return at


def _name(problem: BundleProblem, image: int) -> str:
    return f"image {image}" if problem.labels is None else f"image {problem.labels.names[image]!r}"


def _variances(stddev: Any, count: int) -> Float[np.ndarray, "n 3 3"]:
    """Diagonal covariances from any of the shapes of `stddev`."""
    spread = finite("stddev", stddev, (), (3,), (count,), (count, 1), (count, 3))
    if spread.shape == (count,) != (3,):
        spread = spread[:, None]
    if not (spread > 0).all():
        raise ValueError(f"stddev must be positive, is {spread.min():g}")
    return np.broadcast_to(spread**2, (count, 3))[:, :, None] * np.eye(3)


def _covariances(
    problem: BundleProblem, what: str, covariance: Any, at: np.ndarray
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3 3"]]:
    """A covariance for each image, and its inverse root. Raises ValueError: shapes; one line.
    Raises ProblemError: one is not symmetric positive definite; it names the image."""
    given = finite(f"the covariance of a {what}", covariance, (3, 3), (len(at), 3, 3))
    matrices = np.broadcast_to(given, (len(at), 3, 3))
    roots, bad = inverse_roots(matrices, LEAST_VARIANCE)
    if len(bad):
        where = _name(problem, int(at[bad[0]]))
        raise ProblemError(
            f"the covariance of the {what} of {where} is not symmetric positive definite"
        )
    return matrices, roots
