"""A scene moved, turned and scaled to measured positions, as far as these determine it."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.problem.labels import part_name
from jaxba.problem.misfit import BENDS, MISFIT, extent_of, off_by, wrong_places, wrong_text
from jaxba.problem.similarity import Similarity, along_line, transformed, umeyama

STARTS = 20
ROUNDS = 10
KEPT = 0.5
COMPARED = 2 / 3
"""Starts of a robust alignment, the rounds of each, the share of the images that these keep, and
that by which ends are compared: it stands a third of the positions wrong, of which all starts have
one in 1 of 300."""

SIGNIFICANT = 3.0
"""Standard deviations by which positions must spread in a direction before they say anything about
scale or rotation: three images on a line with this spread across it determine the roll about it to
some 0.2 radians, 30 to 0.06."""

MOST = 0.75  # share of the images that must fit: it is noted if fewer do

DOUBTFUL = 2.0  # distance, over that of noise, from which other axes or units are tried

BETTER = 0.3
EXPLAINED = 0.1
LEAST_IMAGES = 5
"""Other axes or units are taken for the true ones if they leave this share of the misfit, and no
more than this share of the extent, with so many images: of four, half fit too well by chance, so
that all must fit."""

MEDIAN = 1.538
UPPER_QUARTER = 2.027
NEARLY_ALL = 3.37
"""Norm of three standard normal numbers: its quantiles at 50, 75 and 99 percent."""

LARGEST_AREA = 1.0
EARTH = 6.371e6
"""Extent of what may be latitude and longitude, degrees: metres are no degrees of half a continent.
Radius, metres."""

_MIRRORED = np.outer([-1, 1, 1], [-1, 1, 1])  # signs of a covariance once x is mirrored

NOT_DETERMINED = (
    "the positions are at one place within their noise: the alignment only moves the scene",
    "the positions lie on a line within their noise: the alignment does not turn the scene about "
    "it",
)
"""Notes, by the number of directions in which the positions spread."""


def aligned(
    problem: BundleProblem,
    positions: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    images: np.ndarray,
) -> BundleProblem:
    """The problem moved, turned and scaled so that the centres of images are near the given
    positions.

    Other `ProblemWarning`s than those of `alignment` say which positions do not fit, or that they
    do not fit together. Raises ProblemError: as that does."""
    if not len(images):
        return problem
    centers = geometry.camera_centers(problem.cameras)[images]
    best, chi = alignment(centers, positions, covariances)

    def name(at: int) -> str:
        return part_name(problem.labels, "image", int(images[at]))

    for text in misfit_texts(
        name, "images", best.points(centers) - positions, positions, covariances, chi
    ):
        _note(text)
    return transformed(problem, best)


def misfit_texts(
    name: Callable[[int], str],
    kind: str,
    away: Float[np.ndarray, "n 3"],
    positions: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    chi: float,
) -> list[str]:
    """Which measured positions the aligned scene does not have, or that many do not fit; none if
    they do.

    Args:
        name: what a position is of.
        kind: what these are called.
        away: places of the aligned scene less the positions.
        positions: measured, scene units.
        covariances: of these.
        chi: misfit over that of noise, as `alignment` has it."""
    wrong = wrong_places(positions, away, covariances)
    distance, _ = off_by(away, covariances)
    most = float(np.quantile(distance, MOST))
    if chi > MISFIT and most > BENDS * extent_of(positions):
        farthest = wrong if len(wrong) else np.argsort(-distance)
        return [
            f"a quarter of the {kind} of the aligned scene are {most:.3g} or more from their "
            f"positions, {chi:.3g} "
            "times what the standard deviations explain: "
            f"{wrong_text(name, farthest, away, covariances)}"
        ]
    if len(wrong):
        return [
            "measured positions do not fit the others: "
            f"{wrong_text(name, wrong, away, covariances)}"
        ]
    return []


def check_axes(
    places: Float[np.ndarray, "n 3"],
    positions: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
) -> bool:
    """Whether measured positions fit places of a scene as well if an axis is mirrored, as those in
    a plane do.

    Raises ProblemError: they fit well with other axes or units only."""
    best, _ = _robust_fit(places, positions, covariances)
    misfit = float(np.max(_distances(best, places, positions, covariances)))
    if misfit > DOUBTFUL * NEARLY_ALL:
        _refuse_other_axes(places, positions)
    mirrored = positions * [-1, 1, 1]
    other, _ = _robust_fit(places, mirrored, covariances * _MIRRORED)
    away, sigmas = off_by(other.points(places) - mirrored, covariances * _MIRRORED)
    fits = not ((away > BENDS * extent_of(positions)) & (sigmas > MISFIT)).any()
    return fits and float(sigmas.max()) < DOUBTFUL * max(misfit, NEARLY_ALL)


def alignment(
    centers: Float[np.ndarray, "n 3"],
    positions: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
) -> tuple[Similarity, float]:
    """The similarity from places of a scene to measured positions, and the misfit over that of
    noise.

    What the positions do not determine beyond their noise stays as it was, with a `ProblemWarning`:
    the rotation about a line, or all but the translation.

    Source: `umeyama` in rounds that each keep the nearer half of the places (least trimmed squares;
    Rousseeuw 1984).
    Raises ProblemError: the positions are latitude and longitude, or mirrored; or too far apart."""
    with np.errstate(over="ignore"):
        if not np.isfinite([np.sum(centers**2), np.sum(positions**2)]).all():
            raise ProblemError(
                "the scene cannot be aligned: positions are too far apart to be squared"
            )
    best, rank = _robust_fit(centers, positions, covariances)
    left_over = 3 * len(centers) - (3, 6, 7)[rank]
    chi = (
        float(np.quantile(_distances(best, centers, positions, covariances), MOST)) / UPPER_QUARTER
    )
    chi = chi * np.sqrt(3 * len(centers) / left_over) if left_over else 0.0
    if chi > DOUBTFUL or _rank(positions[:, :2], covariances[:, :2, :2]) == 0:
        _refuse_other_axes(centers, positions)
    if rank < 2:
        _note(NOT_DETERMINED[rank], 5)
    return best, chi


def _note(text: str, stacklevel: int = 4) -> None:
    warnings.warn(text, ProblemWarning, stacklevel=stacklevel)


def _robust_fit(
    centers: np.ndarray, positions: np.ndarray, covariances: np.ndarray
) -> tuple[Similarity, int]:
    """The similarity that fits most images, and in how many directions, at most two, positions and
    centres spread."""
    rng = np.random.default_rng(0)
    best = None
    least = np.inf
    count = len(centers)
    for start in range(STARTS):
        kept = np.arange(count) if start == 0 else rng.choice(count, min(3, count), replace=False)
        for _ in range(ROUNDS):
            fit, _ = _fit(centers[kept], positions[kept], covariances[kept])
            distance = _distances(fit, centers, positions, covariances)
            kept = np.argsort(distance)[: max(3, int(np.ceil(KEPT * count)))]
        nearest = float(np.sort(distance)[: int(np.ceil(COMPARED * count))].sum())
        # of more than half: that may lie on a line, and others not
        if best is None or nearest < least:
            best = distance
            least = nearest
    assert best is not None
    # in standard deviations: the scene has its own
    error = max(1.0, float(np.median(best)) / MEDIAN)
    near = best <= NEARLY_ALL * error
    return _fit(
        centers[near], positions[near], max(1.0, error / SIGNIFICANT) ** 2 * covariances[near]
    )


def _fit(
    centers: np.ndarray, positions: np.ndarray, covariances: np.ndarray
) -> tuple[Similarity, int]:
    """The similarity as far as it is determined, and the rank as `_robust_fit` says it."""
    weights = _weights(covariances)
    rank = min(2, _rank(positions, covariances))
    if rank:
        spread = np.linalg.svd(
            np.sqrt(weights)[:, None] * (centers - weights @ centers), compute_uv=False
        )
        scale = np.sqrt(
            weights
            @ np.sum((positions - weights @ positions) ** 2, axis=1)
            / max(spread @ spread, 1e-300)
        )
        noise = np.sqrt(np.linalg.eigvalsh(np.einsum("n,nij->ij", weights, covariances))[0])
        rounding = 1e-12 * np.abs(centers).max()
        rank = min(rank, int(np.sum((scale * spread > SIGNIFICANT * noise) & (spread > rounding))))
    if rank == 2:
        try:
            return umeyama(centers, positions, weights), 2
        except ProblemError:  # both spread, but not together
            rank = 1
    if rank == 1:
        return along_line(centers, positions, weights), 1
    return Similarity(1.0, np.eye(3), weights @ (positions - centers)), 0


def _rank(positions: np.ndarray, covariances: np.ndarray) -> int:
    """In how many directions positions spread beyond their noise."""
    weights = _weights(covariances)
    values, vectors = np.linalg.eigh(np.einsum("n,nij->ij", weights, covariances))
    white = (
        (positions - weights @ positions)
        @ vectors
        / np.sqrt(np.maximum(values, np.finfo(float).tiny))
    )
    white *= np.sqrt(weights)[:, None]
    return int(np.sum(np.linalg.svd(white, compute_uv=False) > SIGNIFICANT))


def _weights(covariances: np.ndarray) -> Float[np.ndarray, " n"]:
    """Shares of the images in a fit: by their mean variance."""
    weights = 1 / np.trace(covariances, axis1=1, axis2=2)
    return weights / weights.sum()


def _distances(
    fit: Similarity, centers: np.ndarray, positions: np.ndarray, covariances: np.ndarray
) -> Float[np.ndarray, " n"]:
    """Distances from the measured positions in standard deviations."""
    away = fit.points(centers) - positions
    return np.sqrt(
        np.einsum("ni,ni->n", away, np.linalg.solve(covariances, away[:, :, None])[:, :, 0])
    )


def _refuse_other_axes(centers: np.ndarray, positions: np.ndarray) -> None:
    """Raises ProblemError: positions fit well with other axes or units only: degrees, or
    mirrored."""
    if len(centers) < LEAST_IMAGES - 1:
        return
    few = len(centers) < LEAST_IMAGES
    others = [(positions * [-1, 1, 1], "mirrored: are two axes swapped, or is one reversed?")]
    for latitude, longitude in ((0, 1), (1, 0)):
        middle = np.median(positions, axis=0)
        near = np.median(np.abs(positions - middle)[:, :2].max(axis=1)) < LARGEST_AREA
        if (
            near
            and np.abs(positions[:, latitude]).max() <= 90
            and np.abs(positions[:, longitude]).max() <= 180
        ):
            east, north = (
                np.radians(positions - middle)[:, at] * EARTH for at in (longitude, latitude)
            )
            metres = np.stack(
                [east * np.cos(np.radians(middle[latitude])), north, positions[:, 2]], axis=1
            )
            others.append(
                (metres, "latitude and longitude in degrees: give metres, or crs: EPSG:4326")
            )
    misfit = _misfit(centers, positions)
    for other, what in others:
        if _misfit(centers, other) < min((EXPLAINED if few else BETTER) * misfit, EXPLAINED):
            raise ProblemError(
                f"the positions seem to be {what} (align: false takes them as they are)"
            )


def _misfit(centers: np.ndarray, positions: np.ndarray) -> float:
    """Median distance of the centres from the positions that they best fit, as a share of the
    extent; of few ones the largest distance."""
    extent = float(np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))
    if not extent > 0:
        return np.inf
    few = len(centers) < LEAST_IMAGES
    small = np.broadcast_to((1e-6 * extent) ** 2 * np.eye(3), (len(positions), 3, 3))
    fit, _ = _fit(centers, positions, small) if few else _robust_fit(centers, positions, small)
    distance = np.linalg.norm(fit.points(centers) - positions, axis=1)
    return float(distance.max() if few else np.median(distance)) / extent
