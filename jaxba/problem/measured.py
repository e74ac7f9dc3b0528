"""Priors of a problem from measurements: `with_position_priors`, `with_rotation_priors`, `with_lens_priors`.

A scene is first aligned with measured positions, since its frame and scale are arbitrary.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.problem.alignment import aligned
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.checks import finite, inverse_roots, shown
from jaxba.problem.hold import every_lens, number_columns, positions_of
from jaxba.problem.losses import Loss
from jaxba.problem.priors import Priors

LEAST_VARIANCE = 1e-200
"""Smallest eigenvalue of a covariance whose inverse can be computed with."""


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
    """The problem with measured positions of images.

    Args:
        problem: any problem.
        positions: measured centres, shape (n, 3), in the units of `covariance`.
        covariance: shape (3, 3) for all, or (n, 3, 3).
        stddev: standard deviations instead: one number, three along x, y and z, or one or three for each image, shape
            (n, 1), (n, 3), or (n,) where n is not 3.
        images: positions or names of the images; None: all, in order.
        loss: robust loss of the squared whitened distance; None: squared.
        align: whether the scene is first moved, turned and scaled to the measured positions, robustly, as COLMAP does.
            What they do not determine, such as the rotation about a line, stays as it is, with a `ProblemWarning`.
            Without it the scene must be in their frame already.

    Raises:
        ValueError: shapes, or no such image; one line.
        ProblemError: a covariance is not positive definite; or an alignment would move what is constant or has priors,
            or the positions are latitude and longitude, or mirrored.
    """
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
        if problem.constants is not None or problem.priors is not None:
            raise ProblemError("an alignment would move what is constant or measured: align first, or align=False")
        problem = aligned(problem, measured, covariances, at)
    priors = priors_of(problem)
    places, weights = np.array(priors.positions), np.array(priors.position_whitening)
    places[at], weights[at] = measured, roots
    return problem.replace(
        priors=replace(priors, positions=places, position_whitening=weights, position_loss=loss or Loss())
    )


def with_rotation_priors(
    problem: BundleProblem, rotations: Any, covariance: Any, *, images: Iterable[int] | Iterable[str] | None = None
) -> BundleProblem:
    """The problem with measured rotations of images.

    Args:
        problem: any problem, in the frame of the measurements.
        rotations: angle-axis from the world to the camera (BAL's axes, as in `problem.cameras`), shape (n, 3), radians.
        covariance: of the rotation in the camera's frame, radians squared, shape (3, 3) for all, or (n, 3, 3).
        images: as for `with_position_priors`.

    Raises:
        ValueError, ProblemError: as `with_position_priors`.
    """
    at = _images_at(problem, images)
    measured = finite("rotations", rotations, (len(at), 3))
    priors = priors_of(problem)
    known, weights = np.array(priors.rotations), np.array(priors.rotation_whitening)
    known[at], weights[at] = measured, _covariances(problem, "rotation", covariance, at)[1]
    return problem.replace(priors=replace(priors, rotations=known, rotation_whitening=weights))


def with_lens_priors(problem: BundleProblem, numbers: dict[str, float]) -> BundleProblem:
    """The problem with its lenses' numbers believed as they are, to a standard deviation.

    Args:
        problem: any problem; the numbers it has are the expected ones.
        numbers: standard deviation by the name of a number, such as `k1`, or of a group (`focal`, `principal_point`,
            `distortion`), in the units of the number.

    Raises:
        ValueError: no such number, or a standard deviation that is not positive; one line.
    """
    lenses, priors = every_lens(problem), priors_of(problem)
    mean, weight = np.array(priors.lenses), np.array(priors.lens_weight)
    cameras = np.asarray(problem.cameras)
    _, first = np.unique(lenses.index, return_index=True)
    used = np.asarray(lenses.index)[first]
    mean[used] = cameras[first, 6:]
    if not isinstance(numbers, dict):
        raise ValueError(f"standard deviations are a dict by the names of numbers, not {shown(numbers)}")
    for name, value in numbers.items():
        deviation = float(finite(f"the standard deviation of {name}", value, ()))
        if deviation <= 0:
            raise ValueError(f"the standard deviation of {name} must be positive, is {deviation}")
        weight[number_columns(lenses, [name])] = 1 / deviation
    return problem.replace(lenses=lenses, priors=replace(priors, lenses=mean, lens_weight=weight))


def priors_of(problem: BundleProblem) -> Priors:
    """The priors of a problem, or ones without weight."""
    if problem.priors is not None:
        return problem.priors
    count, lenses = problem.num_cameras, every_lens(problem)
    none = np.zeros((count, 3, 3))
    numbers = np.zeros(np.asarray(lenses.free).shape)
    return Priors(np.zeros((count, 3)), none, np.array(problem.cameras)[:, :3], none, numbers, numbers)


def _images_at(problem: BundleProblem, images: Iterable[int] | Iterable[str] | None) -> np.ndarray:
    """The images of measurements, each once."""
    if images is None:
        return np.arange(problem.num_cameras)
    at = positions_of(problem, images, "image")
    values, counts = np.unique(at, return_counts=True)
    if (counts > 1).any():
        raise ValueError(f"{_name(problem, int(values[counts > 1][0]))} has more than one measurement")
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
    """A covariance for each image, and its inverse root. Raises ValueError: shapes; one line. Raises ProblemError: one
    is not symmetric positive definite; it names the image."""
    given = finite(f"the covariance of a {what}", covariance, (3, 3), (len(at), 3, 3))
    matrices = np.broadcast_to(given, (len(at), 3, 3))
    roots, bad = inverse_roots(matrices, LEAST_VARIANCE)
    if len(bad):
        where = _name(problem, int(at[bad[0]]))
        raise ProblemError(f"the covariance of the {what} of {where} is not symmetric positive definite")
    return matrices, roots
