"""Priors of a problem from measurements: `with_position_priors`, `with_rotation_priors`, `with_lens_priors`.

A scene is first aligned with measured positions, since its frame and scale are arbitrary.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.constraints import every_lens, number_columns, positions_of
from jaxba.problem.losses import Loss
from jaxba.problem.priors import Priors
from jaxba.problem.similarity import umeyama

ROUNDS, KEPT = 10, 0.5
"""Rounds of a robust alignment, and the share of the images that each keeps: it stands half of the positions wrong."""


def with_position_priors(
    problem: BundleProblem,
    positions: Any,
    covariance: Any,
    *,
    images: Iterable[int] | Iterable[str] | None = None,
    loss: Loss | None = None,
    align: bool = True,
) -> BundleProblem:
    """The problem with measured positions of images.

    Args:
        problem: any problem.
        positions: measured centres, shape (n, 3), in the units of `covariance`.
        covariance: shape (3, 3) for all, or (n, 3, 3).
        images: positions or names of the images; None: all, in order.
        loss: robust loss of the squared whitened distance; None: squared.
        align: whether the scene is first moved, turned and scaled to the measured positions, robustly, as COLMAP does.
            Without it the scene must be in their frame already.

    Raises:
        ValueError: shapes, or no such image; one line.
        ProblemError: a covariance is not positive definite; or an alignment has too few positions, or would move what
            is constant or has priors.
    """
    at = np.arange(problem.num_cameras) if images is None else _images_at(problem, images)
    measured = np.asarray(positions, np.float64)
    if measured.shape != (len(at), 3) or not np.isfinite(measured).all():
        raise ValueError(f"positions must be finite, of shape ({len(at)}, 3), not {measured.shape}")
    whitening = _inverse_roots("position", covariance, len(at))
    if align:
        if problem.constants is not None or problem.priors is not None:
            raise ProblemError("an alignment would move what is constant or measured: align first, or align=False")
        problem = aligned(problem, measured, at)
    priors = priors_of(problem)
    places, weights = np.array(priors.positions), np.array(priors.position_whitening)
    places[at], weights[at] = measured, whitening
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
    at = np.arange(problem.num_cameras) if images is None else _images_at(problem, images)
    measured = np.asarray(rotations, np.float64)
    if measured.shape != (len(at), 3) or not np.isfinite(measured).all():
        raise ValueError(f"rotations must be finite, of shape ({len(at)}, 3), not {measured.shape}")
    priors = priors_of(problem)
    known, weights = np.array(priors.rotations), np.array(priors.rotation_whitening)
    known[at], weights[at] = measured, _inverse_roots("rotation", covariance, len(at))
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
    for name, deviation in numbers.items():
        if not 0 < deviation < np.inf:
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


def aligned(problem: BundleProblem, positions: Float[np.ndarray, "n 3"], images: np.ndarray) -> BundleProblem:
    """The problem moved, turned and scaled so that the centres of images are near the given positions.

    Source: `umeyama` in rounds that each keep the nearer half of the images (least trimmed squares; Rousseeuw 1984).

    Raises:
        ProblemError: fewer than three images, or their centres or positions lie on a line.
    """
    centers = geometry.camera_centers(problem.cameras)[images]
    best, error = umeyama(centers, positions), np.inf
    rng = np.random.default_rng(0)
    for start in range(ROUNDS):
        kept = np.arange(len(images)) if start == 0 else rng.choice(len(images), 3, replace=False)
        try:
            for _ in range(ROUNDS):
                fit = umeyama(centers[kept], positions[kept])
                distance = np.linalg.norm(fit.points(centers) - positions, axis=1)
                kept = np.argsort(distance)[: max(3, int(np.ceil(KEPT * len(images))))]
        except ProblemError:  # these few lie on a line
            continue
        found = float(np.sum(distance[kept] ** 2))
        if found < error:
            best, error = fit, found
    scale, rotation, shift = best
    cameras = np.array(problem.cameras, np.float64)
    matrices = geometry.rotation_matrices(cameras[:, :3]) @ rotation.T
    cameras[:, :3] = geometry.angle_axis(matrices)
    cameras[:, 3:6] = scale * cameras[:, 3:6] - np.einsum("nij,j->ni", matrices, shift)
    rigs = None if problem.rigs is None else problem.rigs.scaled(scale)
    return problem.replace(cameras=cameras, points=best.points(np.asarray(problem.points)), rigs=rigs)


def _images_at(problem: BundleProblem, images: Iterable[int] | Iterable[str]) -> np.ndarray:
    at = positions_of(problem, np.asarray(list(images)), "image")
    bad = at[(at < 0) | (at >= problem.num_cameras)]
    if len(bad):
        raise ValueError(f"there is no image {bad[0]}: there are {problem.num_cameras}")
    return at


def _inverse_roots(what: str, covariance: Any, count: int) -> Float[np.ndarray, "n 3 3"]:
    matrices = np.broadcast_to(np.asarray(covariance, np.float64), (count, 3, 3))
    values, vectors = np.linalg.eigh(matrices)
    symmetric = np.abs(matrices - matrices.transpose(0, 2, 1)).max(axis=(1, 2)) <= 1e-9 * np.abs(values).max(axis=1)
    bad = np.flatnonzero(~(np.isfinite(matrices).all(axis=(1, 2)) & (values[:, 0] > 0) & symmetric))
    if len(bad):
        raise ProblemError(f"the covariance of {what} {bad[0]} is not symmetric positive definite")
    return (vectors / np.sqrt(values)[:, None, :]) @ vectors.transpose(0, 2, 1)
