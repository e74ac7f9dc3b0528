"""Which measured places a scene does not have, once it is aligned with them, and whether it then
stands on its head."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem

BENDS = 0.03
"""Share of its extent by which images alone may bend a scene, which a solve with what was measured
mends. Not fitted: blocks of images without control points bow by about one percent, James and
Robson 2014, doi:10.1002/esp.3609."""

MISFIT = 5.0  # distance, over that of noise, from which places do not fit

APART = 5.0  # distance, over the median of all, from which a place is the one that is wrong

LEAST = 5  # places of which one can be told apart: of four, any three fit nearly

NAMED = 3  # places that a note names

STEEP = 0.7
NEARLY_ALL_IMAGES = 0.9
"""Cosine of an angle from the vertical within which images say what is up, and the share of them
that must agree."""

ON_ITS_HEAD = (
    "the scene stands on its head, and would fit as well if an axis were mirrored: are two axes "
    "swapped, or is one "
    "reversed?"
)
"""Note on places in a plane, which fit a scene that is turned over as well."""


def off_by(
    away: Float[np.ndarray, "n 3"], covariances: Float[np.ndarray, "n 3 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Lengths of differences from measured places, scene units, and the same in standard
    deviations."""
    white = np.linalg.solve(covariances, away[:, :, None])[:, :, 0]
    return np.linalg.norm(away, axis=1), np.sqrt(np.einsum("ni,ni->n", away, white))


def extent_of(places: Float[np.ndarray, "n 3"]) -> float:
    """Twice the median distance of places from their middle, which half of them may be wrong in."""
    return 2 * float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))


def wrong_places(
    places: Float[np.ndarray, "n 3"],
    away: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
) -> Int[np.ndarray, " wrong"]:
    """Measured places that neither noise nor a bent scene explains where the others fit; the
    largest first.

    Args:
        places: measured, scene units.
        away: places of the aligned scene less these.
        covariances: of the measurements."""
    if len(places) < LEAST:
        return np.zeros(0, int)
    distance, sigmas = off_by(away, covariances)
    far = distance > max(BENDS * extent_of(places), APART * float(np.median(distance)))
    wrong = np.flatnonzero(far & (sigmas > MISFIT))
    return wrong[np.argsort(-distance[wrong])]


def wrong_text(
    name: Callable[[int], str],
    wrong: Int[np.ndarray, " wrong"],
    away: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
) -> str:
    """How far the scene has some places from where they were measured, with names."""
    distance, sigmas = off_by(away, covariances)
    named = []
    for at in wrong[:NAMED].tolist():
        axes = ", ".join(
            f"{axis} {number:.3g}" for axis, number in zip("xyz", away[at].tolist(), strict=True)
        )
        named.append(
            f"{name(at)} is {distance[at]:.3g} from there ({axes}; {sigmas[at]:.3g} standard "
            "deviations)"
        )
    rest = f", and {len(wrong) - NAMED} more are" if len(wrong) > NAMED else ""
    return f"{', '.join(named)}{rest}"


def on_its_head(problem: BundleProblem) -> bool:
    """Whether nearly all images that say what is up, z in the scene, look up or are upside down."""
    poses = geometry.camera_poses(problem.cameras)
    ahead = poses[:, 2, 2]
    up = -poses[:, 2, 1]
    wrong = (ahead > STEEP) | (up < -STEEP)
    right = (ahead < -STEEP) | (up > STEEP)
    says: Bool[np.ndarray, " images"] = wrong | right
    return bool(2 * says.sum() >= len(poses) and wrong.sum() >= NEARLY_ALL_IMAGES * says.sum())
