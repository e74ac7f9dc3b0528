"""Measured positions of images as COLMAP has them, for pycolmap 3.12 to 4.2.

Source: COLMAP 4.2, `PosePriorBundleAdjuster`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.pycolmap_options import loss_of
from jaxba.problem.alignment import alignment
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import camera_centers
from jaxba.problem.losses import Loss
from jaxba.problem.measured import with_position_priors
from jaxba.problem.similarity import Similarity


class Measured(NamedTuple):
    """Measured positions of images."""

    positions: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    images: Int[np.ndarray, " n"]  # where they are in the problem
    loss: Loss


def measured_positions(
    problem: BundleProblem, config: Any, prior_options: Any, priors: Any
) -> Measured:
    """What COLMAP's pose priors and their options say of the images of a config. Raises ValueError:
    nothing, or one is in degrees."""
    assert problem.labels is not None
    by_image = priors
    if not isinstance(priors, Mapping):
        by_image = {prior.corr_data_id.id: prior for prior in priors}
    known = set(config.images) & set(problem.labels.images.tolist())
    used = {
        image: prior
        for image, prior in by_image.items()
        if image in known and np.isfinite(prior.position).all()
    }
    if not used:
        raise ValueError("pose_priors: no image of the config has a position")
    for image, prior in used.items():
        if prior.coordinate_system.name == "WGS84":
            raise ValueError(
                f"pose_priors: the position of image {image} is in degrees: convert it to metres"
            )
    fallback = getattr(prior_options, "prior_position_fallback_stddev", 1.0) ** 2 * np.eye(3)
    covariances = []
    for prior in used.values():
        known_covariance = np.isfinite(prior.position_covariance).all()
        covariances.append(prior.position_covariance if known_covariance else fallback)
    return Measured(
        positions=np.array([prior.position for prior in used.values()], np.float64),
        covariances=np.array(covariances, np.float64),
        images=problem.labels.positions("image", used),
        loss=_prior_loss(prior_options),
    )


def _prior_loss(options: Any) -> Loss:
    """The loss of pose priors; COLMAP 3 has Cauchy's only."""
    if hasattr(options, "use_robust_loss_on_prior_position"):
        kind = "CAUCHY" if options.use_robust_loss_on_prior_position else "TRIVIAL"
        return loss_of(kind, options.prior_position_loss_scale)
    ceres = options.ceres
    return loss_of(ceres.prior_position_loss_function_type.name, ceres.prior_position_loss_scale)


def alignment_to(problem: BundleProblem, measured: Measured) -> Similarity:
    """The similarity that moves a problem to measured positions. Raises ProblemError: as
    `alignment`."""
    centers = camera_centers(problem.cameras)[measured.images]
    similarity, _ = alignment(centers, measured.positions, measured.covariances)
    return similarity


def with_positions(problem: BundleProblem, measured: Measured) -> BundleProblem:
    """A problem in the frame of measured positions, with them as priors. Raises: as
    `with_position_priors`."""
    return with_position_priors(
        problem,
        measured.positions,
        measured.covariances,
        images=measured.images.tolist(),
        loss=measured.loss,
        align=False,
    )
