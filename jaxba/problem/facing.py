"""Images that face away from their points: which they are, and a problem without their views.

A perspective lens sees a point behind it where the mirror image of the point in front of it would
be. Such a view has a residual and a slope like any other, but no step leads from there to the
front. A few of them do no harm: point iterations bring points back. An image that is turned round
pulls all others after it.

Half of the views is a border with room on both sides. Measured: starts of random scenes twelve
times as far away as usual have at most 13% of an image's views behind it, Ladybug-49 1.2%, images
turned by 100 degrees 66% or more."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Bool, Int

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemWarning
from jaxba.problem.labels import part_names

NAMED = 3  # most images that a message names

_OFF_AXIS = np.array([0.1, 0.2, 1.0])


def views_behind(problem: BundleProblem) -> Bool[np.ndarray, " observations"]:
    """Observations of points behind their camera; none of lenses that tell it from its mirror
    image, as fisheyes."""
    return (geometry.depths(problem) <= 0) & _sees_mirrored(problem)[
        np.asarray(problem.camera_index)
    ]


def facing_away(problem: BundleProblem) -> Int[np.ndarray, " away"]:
    """Cameras with more than half of their views behind them.

    None if at least half of the observed cameras have that: then the scene is mirrored, of another
    convention, or too far from a solution for poses to be told from points."""
    views = np.bincount(problem.camera_index, minlength=problem.num_cameras)
    behind = np.bincount(problem.camera_index[views_behind(problem)], minlength=problem.num_cameras)
    away = np.flatnonzero(2 * behind > views)
    return away if 2 * len(away) < np.count_nonzero(views) else away[:0]


def set_aside(problem: BundleProblem) -> Int[np.ndarray, " away"]:
    """`facing_away`, with a ProblemWarning that names these cameras: a solve leaves their views
    out."""
    away = facing_away(problem)
    if len(away):
        warnings.warn(aside_text(problem, away), ProblemWarning, stacklevel=3)
    return away


def aside_text(problem: BundleProblem, away: Int[np.ndarray, " away"]) -> str:
    """How many views of which images are left out since they lie behind, one line."""
    views = int(np.isin(problem.camera_index, away).sum())
    whose = f"{len(away)} images that face"
    stay = "their poses stay as they are"
    if len(away) == 1:
        whose = "an image that faces"
        stay = "its pose stays as it is"
    if problem.rigs is not None:
        stay = "only a rig moves them" if len(away) > 1 else "only its rig moves it"
    names = part_names(problem.labels, "image", away, NAMED)
    return f"left out {views} observations of {whose} away from them ({names}); {stay}"


def without_views_of(problem: BundleProblem, away: Int[np.ndarray, " away"]) -> BundleProblem:
    """The problem without the observations of some cameras. Cameras and points keep their
    places."""
    return problem.subset(~np.isin(problem.camera_index, away)) if len(away) else problem


def _sees_mirrored(problem: BundleProblem) -> Bool[np.ndarray, " cameras"]:
    """Cameras whose lens has the same pixel for a point and its mirror image."""
    every = np.arange(problem.num_cameras)
    if problem.lenses is None or problem.lenses.all_bal:
        return np.ones(len(every), bool)
    with np.errstate(all="ignore"):
        front, back = (
            geometry.pixels(problem, every, np.tile(sign * _OFF_AXIS, (len(every), 1)))
            for sign in (1, -1)
        )
    return np.asarray((front == back).all(axis=1))
