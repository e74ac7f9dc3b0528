"""Priors in the linear model: residuals of cameras alone, and the normal equations that they add.

The residuals (problem/priors.py) depend on one camera each; a shared lens has those of its first camera only. They are
differentiated by forward mode in the coordinates of the camera Jacobian: left perturbation of the rotation,
translation, numbers of the lens.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxba.model import camera
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.priors import Priors
from jaxba.rotations import compose_left, rotation_matrix
from jaxba.structure.unknowns import Unknowns

PriorTerms = tuple[Float[Array, "cameras width width"], Float[Array, "cameras width"]]
"""Blocks and gradient that priors add to the normal equations of each camera, as those of `CameraSystem`."""


def costs_of(
    priors: Priors, unknowns: Unknowns, cameras: Float[Array, "parameters cameras"]
) -> Float[Array, " cameras"]:
    """The cost of the priors of each camera, pixels^2 by the weights."""
    position, others = _residuals(priors, unknowns, cameras)
    squared = jnp.sum(position * position, axis=0)
    loss = priors.position_loss
    return 0.5 * ((squared if loss.trivial else loss(squared)[0]) + jnp.sum(others * others, axis=0))


def prior_terms(
    unknowns: Unknowns, cameras: Float[Array, "parameters cameras"], *, alone: bool = False
) -> tuple[PriorTerms, ...]:
    """Hessian `J^T J` and gradient `J^T r` of the priors of each camera, weighted by the robust loss, if there are any.

    Args:
        unknowns: the priors, which numbers are part of a camera's block, and which are constant.
        cameras: current cameras.
        alone: whether cameras are optimised one by one, so that what they share is constant.
    """
    free = jnp.asarray(~np.array(unknowns.constant("free", alone=alone)))[:, None]
    return tuple(_terms(priors, unknowns, cameras, unknowns.free.where(free, False)) for priors in unknowns.priors)


def _terms(
    priors: Priors, unknowns: Unknowns, cameras: Float[Array, "parameters cameras"], free: Bool[Array, "width _"]
) -> PriorTerms:
    def at(step: Float[Array, "width cameras"]) -> tuple[Array, Array]:
        return _residuals(priors, unknowns, camera.moved(cameras, unknowns.expanded(step), unknowns))

    zero = jnp.zeros((unknowns.width, cameras.shape[1]), cameras.dtype)
    residual = at(zero)
    columns = [jax.jvp(at, (zero,), (zero.at[k].set(1),))[1] for k in range(unknowns.width)]
    weight = jnp.ones_like(zero[0])
    if not priors.position_loss.trivial:
        weight = priors.position_loss(jnp.sum(residual[0] * residual[0], axis=0))[1]
    blocks, gradient = 0.0, 0.0
    for part, scale in ((0, weight), (1, jnp.ones_like(weight))):
        rows = jnp.stack([column[part] for column in columns]) * free[:, None]  # [width, residuals, cameras]
        blocks = blocks + jnp.einsum("arc,brc,c->cab", rows, rows, scale, precision="highest")
        gradient = gradient + jnp.einsum("arc,rc,c->ca", rows, residual[part], scale, precision="highest")
    return jnp.asarray(blocks), jnp.asarray(gradient)


def _residuals(priors: Priors, unknowns: Unknowns, cameras: Float[Array, "parameters cameras"]) -> tuple[Array, Array]:
    """Whitened residuals of the position, [3, cameras], and of rotation and lens, [3 + numbers, cameras]."""
    angle_axis, translation = camera.poses(cameras, unknowns)
    rotation = rotation_matrix(angle_axis)
    center = -jnp.einsum("jic,jc->ic", rotation, translation, precision="highest")
    position = jnp.einsum("cij,jc->ic", priors.position_whitening, center - priors.positions.T, precision="highest")
    turned = compose_left(angle_axis, -jnp.asarray(priors.rotations.T))
    turned = jnp.einsum("cij,jc->ic", priors.rotation_whitening, turned, precision="highest")
    lens = cameras[POSE_SIZE : POSE_SIZE + priors.lenses.shape[1]]
    return position, jnp.concatenate([turned, priors.lens_weight.T * (lens - priors.lenses.T)])
