"""pycolmap's objects as problems, and what was found back into them.

Source: COLMAP 4.2, `BundleAdjustmentOptions`, `BundleAdjustmentConfig`."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from jaxba.io.colmap.memory import NAME, read_records, write_records
from jaxba.io.colmap.read import registered
from jaxba.io.colmap.write import check_points, mean_errors, with_cameras
from jaxba.io.pycolmap_config import chosen_part, constrained, without_views_behind
from jaxba.io.pycolmap_options import options_of
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.checks import shown
from jaxba.problem.geometry import COLMAP_FLIP, residuals
from jaxba.problem.hold import every_lens

OLDEST = "3.12"
"""The first pycolmap with rigs and frames."""

# pixels; a problem's are the key-points', but for the rounding of a principal point added to them
SAME_PIXEL = 1e-6


def from_pycolmap(reconstruction: Any, config: Any = None, options: Any = None) -> BundleProblem:
    """The problem of a `pycolmap.Reconstruction`, of pycolmap 3.12 or newer.

    Views of points behind their image are left out, as COLMAP's cost function gives them no
    residual; a `ProblemWarning` names images that face away from most of what they see.

    Args:
        reconstruction: read as `read_colmap` reads its files.
        config: a `pycolmap.BundleAdjustmentConfig`: images, variable and constant points, constant
            poses, lenses and sensors, and the gauge; the problem then holds what is seen of these
            alone. None: all images and points, and a free gauge.
        options: a `pycolmap.BundleAdjustmentOptions`, or a dictionary of its values, of which the
            `refine_` and `constant_` options and `min_track_length` count here, and the rest for
            `jaxba.bundle_adjustment`. None: COLMAP's defaults.

    Raises:
        ProblemError: as `read_colmap` and `part`; a `NothingObserved` where no view is left.
        ValueError: `config` names what is not in the problem, or an argument is of another kind."""
    check_reconstruction(reconstruction)
    options = options_of(options)
    problem = chosen_part(reconstruction, config, options)
    return constrained(without_views_behind(problem), reconstruction, config, options)


def check_reconstruction(reconstruction: Any) -> None:
    """Raises ValueError: no `pycolmap.Reconstruction`, or one of a pycolmap that is too old; one
    line."""
    if not hasattr(reconstruction, "write_binary"):
        raise ValueError(
            f"reconstruction must be a pycolmap.Reconstruction, not {shown(reconstruction)}"
        )
    if not hasattr(reconstruction, "rigs"):
        version = getattr(importlib.import_module("pycolmap"), "__version__", "another")
        raise ValueError(
            f"this needs pycolmap {OLDEST} or newer, which has rigs; installed is {version}"
        )


def any_far_off(problem: BundleProblem, reconstruction: Any) -> bool:
    """Whether a point is seen farther from its pixel than the diagonal of the image, where no step
    leads it back."""
    assert problem.labels is not None
    cameras = [reconstruction.camera(lens) for lens in problem.labels.lenses.tolist()]
    diagonals = np.array([np.hypot(camera.width, camera.height) for camera in cameras])
    lens = np.asarray(every_lens(problem).index)[problem.camera_index]
    return bool((np.linalg.norm(residuals(problem), axis=1) > diagonals[lens]).any())


def update(reconstruction: Any, problem: BundleProblem) -> None:
    """Gives a `pycolmap.Reconstruction` the poses, points, lenses and places in rigs of a problem
    that was made of it, and the errors of points all of whose observations the problem has; the
    rest of it stays. Raises ProblemError: the problem is another one's, or not finite; the
    reconstruction is as it was."""
    _check_is_of(reconstruction, problem)
    labels = problem.labels
    assert labels is not None
    check_points(problem, labels.points, NAME)
    model = read_records(reconstruction, labels.images.tolist())
    images, _ = registered(model)
    place = {image.id: image for image in images}
    of_problem = [place[number] for number in labels.images.tolist()]
    write_records(reconstruction, model, with_cameras(model, of_problem, problem, NAME))
    views = np.bincount(problem.point_index, minlength=problem.num_points).tolist()
    errors = mean_errors(problem.replace(whitening=None)).tolist()
    positions = np.asarray(problem.points, np.float64)
    for number, position, error, seen in zip(
        labels.points.tolist(), positions, errors, views, strict=True
    ):
        point = reconstruction.point3D(number)
        point.xyz = position
        if seen == point.track.length():
            point.error = error


def _check_is_of(reconstruction: Any, problem: BundleProblem) -> None:
    """Raises ProblemError: an image or a point of a problem is not in a reconstruction, or the
    first observation of an image is no key-point there."""
    labels = problem.labels
    same = labels is not None
    if labels is not None:
        same = all(map(reconstruction.exists_image, labels.images.tolist()))
        same = same and all(map(reconstruction.exists_point3D, labels.points.tolist()))
        same = same and _see_the_same(reconstruction, problem)
    if not same:
        raise ProblemError(f"cannot write {NAME}: the problem is not one of this reconstruction")


def _see_the_same(reconstruction: Any, problem: BundleProblem) -> bool:
    """Whether the first observation of each image of a problem is a key-point of that image and
    point."""
    labels = problem.labels
    assert labels is not None
    centered = every_lens(problem).all_bal
    cameras, first = np.unique(problem.camera_index, return_index=True)
    points = labels.points[problem.point_index[first]]
    pixels = np.asarray(problem.observations)[first]
    for number, point, pixel in zip(
        labels.images[cameras].tolist(), points.tolist(), pixels, strict=True
    ):
        image = reconstruction.image(number)
        if centered:
            camera = image.camera
            pixel = pixel * COLMAP_FLIP[:2] + [camera.principal_point_x, camera.principal_point_y]
        elements = reconstruction.point3D(point).track.elements
        keys = [
            image.point2D(element.point2D_idx).xy
            for element in elements
            if element.image_id == number
        ]
        if not any(np.abs(key - pixel).max() <= SAME_PIXEL for key in keys):
            return False
    return True
