"""How a step is added to the cameras.

A lens stretches what it shows by f, and its distortion, k1 and k2, is told per squared distance from the middle
*before* that. When f and all depths grow together, as they may where cameras move forwards or are far away, the image
stays as it is, but for distortion: k1 then has to grow with the square of f, k2 with its fourth power. In the numbers
of the file such a valley is bent; in f and the distortion per pixel, `k1 / f^2` and `k2 / f^4`, it is straight. Both
agree to first order, so the linear model is the same, and so is damping, but a long step along such a valley stays on
its floor. Measured: docs/game-tried.md, "Straighter valleys".
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.model import camera
from jaxba.problem.options import StepOptions
from jaxba.structure.layout import Layout

LARGEST_ZOOM = 0.3
"""Relative change of a focal length beyond which distortions are added as they are: the fourth power of a first-order
step means nothing there. With 0.1 instead less was gained, no limit at all was as good (docs/game-tried.md)."""


def move_cameras(
    layout: Layout, cameras: Float[Array, "9 cameras"], step: Float[Array, "9 cameras"], options: StepOptions
) -> Float[Array, "9 cameras"]:
    """Adds a step; on the manifold the rotation becomes `exp(step) R`, in pixels the distortion is added per pixel.

    Args:
        layout: knows which numbers of a lens stay.
        cameras: where they are.
        step: in the coordinates of the options.
        options: `rotation`, `lens_step` and `intrinsics`.
    """
    moved = cameras + step
    if options.coordinates.rotation == "manifold":
        moved = moved.at[:3].set(camera.compose_left(step[:3], cameras[:3]))
    if options.coordinates.lens_step == "file" or options.intrinsics == "fixed":
        return moved
    growth = step[6] / cameras[6]
    near = jnp.abs(growth) <= LARGEST_ZOOM  # false where there is no focal length
    for row, power in ((7, 2), (8, 4)):
        # (k / f^power + its first-order change) times the new f^power
        kept = (1 + growth) ** power * (moved[row] - power * growth * cameras[row])
        free = near if layout.lenses is None else near & layout.lenses.free[row - 6]
        moved = moved.at[row].set(jnp.where(free, kept, moved[row]))
    return moved


def step_between(
    cameras: Float[Array, "9 cameras"], moved: Float[Array, "9 cameras"], options: StepOptions
) -> Float[Array, "9 cameras"]:
    """What `move_cameras` has to add to get from one place to the other, to first order."""
    change = moved - cameras
    if options.coordinates.rotation == "manifold":
        turn = camera.left_jacobian(cameras[:3])
        change = change.at[:3].set(jnp.einsum("ijc,jc->ic", turn, change[:3], precision="highest"))
    return change
