"""Whether marks can be what a survey says, before anything is solved: in their images, one point
each, in their places.

What is compared is the scene as images alone have it, so that only what neither noise nor a bent
scene explains is said; `Solution.notes` tests the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.constraints.values import names_of
from jaxba.io.notes import report
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.marks import Marks
from jaxba.problem.misfit import MISFIT, extent_of, wrong_places, wrong_text
from jaxba.results.retriangulate import retriangulate

# share of an image by which marks may lie outside: its border may be cut by an undistortion
EDGE = 0.01

SIZES = tuple(np.geomspace(0.1, 10.0, 47).tolist())
"""Sizes of photos in which marks may have been made, over those of the images: steps of a tenth."""

BETTER = 0.1
LEAST_LEFT = 4
"""Pixels of other photos are taken for the true ones if they leave this share of the misfit, with
so many numbers more than the marks have."""

ENOUGH = 100_000  # observations of which a median is taken

DEEPER = 0.1
"""Share of the extent of cameras and points by which these may be too far from the cameras, whose
positions alone are measured: images that all look down hardly tell a focal length from a height."""

MANY = 0.1  # share of the pixels which lie outside that typing errors do not explain

UPRIGHT = 0.9  # share of a difference along z from which it is one of heights

SAME = 0.3  # spread of differences over their median, below which all places are moved alike


class Clicks(NamedTuple):
    """Pixels of marks as a file has them."""

    image: Int[np.ndarray, " pixels"]
    mark: Int[np.ndarray, " pixels"]
    pixels: Float[np.ndarray, "pixels 2"]  # from the upper left corner, y down
    sizes: Float[np.ndarray, "pixels 2"]  # of their images; 0 where they are not known

    def of(self, kept: Bool[np.ndarray, " pixels"]) -> Clicks:
        """Some of them."""
        return Clicks(*(column[kept] for column in self))


def outside(clicks: Clicks, sigma: float) -> Bool[np.ndarray, " pixels"]:
    """Which pixels lie outside of their image, by more than their noise (`sigma`, pixels) and a
    border."""
    beyond = EDGE * clicks.sizes + MISFIT * sigma
    out = (clicks.pixels < -beyond) | (clicks.pixels > clicks.sizes + beyond)
    known = np.all(clicks.sizes > 0, axis=1)
    return np.any(out, axis=1) & known


def outside_text(
    clicks: Clicks, out: Bool[np.ndarray, " pixels"], names: list[str], images: tuple[str, ...]
) -> str:
    """Which marks lie outside of which images, with the sizes of these. Raises ValueError: this, if
    they are many."""
    first = int(np.argmax(out))
    width, height = clicks.sizes[first].tolist()
    others = int(out.sum()) - 1
    more = f", and {others} more" if others else ""
    name = names[clicks.mark[first]]
    image = images[clicks.image[first]]
    text = (
        f"pixels of {name} lie outside of {image} ({width:g} x {height:g}){more}: photos of "
        "another size, or turned?"
    )
    if out.sum() > max(1, MANY * len(out)):
        raise ValueError(text)
    return text


def say(where: str, texts: list[str], strict: bool) -> None:
    """Notes what does not fit; `where` is file and key. Raises ValueError: the first text, if
    `strict`."""
    if texts and strict:
        raise ValueError(texts[0])
    report([f"{where}: {text}" for text in texts])


def pixels_texts(
    problem: BundleProblem,
    clicks: Clicks,
    names: tuple[str, ...],
    sigma: float,
    observed: Callable[[np.ndarray], np.ndarray],
) -> list[str]:
    """Which marks have rays that do not meet, in one line or none.

    Args:
        problem: with the marks as its last points, where their rays meet best.
        clicks: their pixels.
        names: of the marks.
        sigma: standard deviation of the pixels.
        observed: what makes observations of a problem of pixels.

    Raises:
        ValueError: the pixels are those of photos of another size, or turned; one line."""
    first = problem.num_points - len(names)
    alone = np.asarray(problem.point_index) >= first
    ties = problem.subset(_some(np.flatnonzero(~alone)))
    apart = np.asarray(ties.observations) - geometry.project(ties)
    noise = max(sigma, 1.4826 * float(np.median(np.abs(apart)))) if len(apart) else sigma
    marks = problem.subset(alone, points=np.arange(first, problem.num_points))
    squares = np.sum(_apart(marks) ** 2, axis=1)
    count = np.bincount(marks.point_index, minlength=len(names))
    total = np.bincount(marks.point_index, squares, len(names))
    rms = np.sqrt(total / np.maximum(2 * count - 3, 1))
    wrong = np.flatnonzero(~(rms <= MISFIT * noise))
    if not len(wrong):
        return []
    left = 2 * len(clicks.pixels) - 3 * len(names) - 1
    if left >= LEAST_LEFT and len(wrong) > 1:
        _refuse_other_photos(marks, clicks, observed, noise)
    wrong = wrong[np.argsort(-rms[wrong])]
    largest = int(np.argmax(np.where(marks.point_index == wrong[0], squares, -1)))
    image = problem.labels.names[clicks.image[largest]] if problem.labels is not None else ""
    listed = names_of([f"{names[at]} ({rms[at]:.3g})" for at in wrong.tolist()])
    return [
        f"rays of the same point do not meet, by pixels (RMS): {listed}; those of "
        f"{names[wrong[0]]} least in {image}. "
        f"The pixels are said to be accurate to {sigma:g}"
    ]


def _some(at: Int[np.ndarray, " n"]) -> Int[np.ndarray, " some"]:
    """At most about `ENOUGH` of some observations, evenly."""
    return at[:: max(1, len(at) // ENOUGH)]


def _apart(marks: BundleProblem) -> Float[np.ndarray, "pixels 2"]:
    return np.asarray(marks.observations) - geometry.project(marks)


def _refuse_other_photos(
    marks: BundleProblem, clicks: Clicks, observed: Callable[[np.ndarray], np.ndarray], noise: float
) -> None:
    """Raises ValueError: the rays of all marks meet if pixels are those of photos of another size,
    or turned."""

    def misfit(pixels: np.ndarray, size: float = 1.0) -> float:
        """RMS in pixels of the photos, of the numbers that points do not take up."""
        try:
            found = retriangulate(marks.replace(observations=observed(pixels))).problem
        except ProblemError:
            return np.inf
        left = 2 * len(pixels) - 3 * marks.num_points
        apart = size * float(np.sqrt(np.sum(_apart(found) ** 2) / left))
        return apart if np.isfinite(apart) else np.inf

    def scaled(size: float) -> float:
        return misfit(clicks.pixels / size, min(size, 1.0))

    given = misfit(clicks.pixels)
    x, y = clicks.pixels.T
    width, height = clicks.sizes.T
    turned = {
        "on their side": np.stack([y, height - x], axis=1),
        "on their other side": np.stack([width - y, x], axis=1),
        "upside down": np.stack([width - x, height - y], axis=1),
        "whose y goes up": np.stack([x, height - y], axis=1),
        "whose x and y are swapped": np.stack([y, x], axis=1),
    }
    bound = BETTER * given
    for what, pixels in turned.items():
        if misfit(pixels) < min(bound, MISFIT * noise):
            raise ValueError(
                f"the pixels seem to be those of photos {what}: they fit if this is undone"
            )
    misfits = [scaled(size) for size in SIZES]
    best = int(np.argmin(misfits))
    if not misfits[best] < 0.5 * given:
        return
    from scipy.optimize import minimize_scalar

    between = (SIZES[max(best - 1, 0)], SIZES[min(best + 1, len(SIZES) - 1)])
    nearest: Any = minimize_scalar(
        scaled, bounds=between, method="bounded", options={"xatol": 1e-5 * between[0]}
    )
    if nearest.fun < min(bound, MISFIT * noise):
        width, height = clicks.sizes[0].tolist()
        raise ValueError(
            f"the pixels seem to be those of photos of {nearest.x:.3g} times the size of the "
            "images: about "
            f"{nearest.x * width:.0f} x {nearest.x * height:.0f} instead of {width:g} x {height:g}"
        )


def places_texts(
    problem: BundleProblem, marks: Marks, met: Float[np.ndarray, "marks 3"]
) -> list[str]:
    """How measured places of marks differ from where a scene that measured positions placed has
    them.

    Args:
        problem: in the frame of the places.
        marks: with their places.
        met: where the rays of their pixels meet.

    Returns:
        One line, or none if they do not differ, or noise or a bent scene explains it."""
    away = met - marks.places
    around = np.concatenate([np.asarray(problem.points), geometry.camera_centers(problem.cameras)])
    bound = max(DEEPER * extent_of(around), MISFIT * _deviation_of_positions(problem))
    distance = np.linalg.norm(away, axis=1)
    shift = np.median(away, axis=0)
    moved = float(np.linalg.norm(shift))
    spread = float(np.median(np.linalg.norm(away - shift, axis=1)))
    if moved > bound and spread < SAME * moved:
        axes = ", ".join(
            f"{axis} {number:.3g}" for axis, number in zip("xyz", shift.tolist(), strict=True)
        )
        upright = abs(shift[2]) > UPRIGHT * moved
        what = (
            "heights above the ellipsoid and above the geoid, or of two units?"
            if upright
            else "two frames?"
        )
        return [
            f"the points lie {moved:.3g} from where position_priors have them, all alike ({axes}): "
            f"{what}"
        ]
    if np.median(distance) > bound:
        half = f"half of them by {np.median(distance):.3g} or more"
        return [
            f"the points do not lie where position_priors have them, {half}: another frame, axes "
            "or units?"
        ]
    covariances = marks.stddev[:, :, None] ** 2 * np.eye(3)
    wrong = wrong_places(marks.places, away, covariances)
    wrong = wrong[distance[wrong] > bound]
    if not len(wrong):
        return []
    return [
        "points are not where the scene has them: "
        f"{wrong_text(marks.names.__getitem__, wrong, away, covariances)}"
    ]


def _deviation_of_positions(problem: BundleProblem) -> float:
    """Median standard deviation of measured positions, scene units; 0 without any."""
    found = [0.0]
    for rows in problem.residuals.rows:
        if rows.residual.name in ("position_prior", "position"):
            whitening = np.asarray(rows.data[rows.residual.data.index("whitening")])
            found.append(float(np.median(1 / np.linalg.norm(whitening, axis=(1, 2)))))
    return np.sqrt(3) * max(found)
