"""Retraction: how a camera step is added to the current cameras.

Rotations: `R <- exp(w) R`, or addition of angle-axis vectors. Intrinsics: addition to (f, k1, k2),
or to (f, k1 / f^2, k2 / f^4); those of other camera models than BAL's are always added as they are.

The distortion parameters k1 and k2 multiply powers of the *normalised* image radius. If f and all
depths grow together, which hardly changes the image when cameras move forwards or are far away, the
distortion in pixels stays the same only if k1 grows with f^2 and k2 with f^4. In (f, k1, k2) such a
valley of the cost is curved; in f and the distortion per pixel, (k1 / f^2, k2 / f^4), it is
straight, and a long step stays on its floor. To first order the two agree."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxba.model import camera
from jaxba.problem.camera_models import BAL
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import StepOptions
from jaxba.rotations import left_jacobian
from jaxba.structure.layout import Layout

# relative change of f beyond which k1, k2 are added as they are. With 0.1 less gain
MAX_FOCAL_CHANGE = 0.3


def move_cameras(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    step: Float[Array, "parameters cameras"],
    options: StepOptions,
) -> Float[Array, "parameters cameras"]:
    """Adds a step to cameras, in the coordinates of the options."""
    unknowns = layout.unknowns
    on_manifold = options.coordinates.rotation == "manifold"
    moved = camera.moved(cameras, step, unknowns) if on_manifold else cameras + step
    plain = options.coordinates.lens_step == "file" or options.intrinsics == "fixed"
    if plain or unknowns.models != (BAL,):
        return moved
    growth = step[6] / cameras[6]
    near = jnp.abs(growth) <= MAX_FOCAL_CHANGE  # false for a focal length of zero
    for row, power in ((7, 2), (8, 4)):
        # (k / f^power + its change to first order) times the new f^power
        kept = (1 + growth) ** power * (moved[row] - power * growth * cameras[row])
        if row - POSE_SIZE not in unknowns.columns:
            continue
        free = unknowns.free.row(POSE_SIZE + unknowns.columns.index(row - POSE_SIZE)).where(
            near, False
        )
        moved = moved.at[row].set(jnp.where(free, kept, moved[row]))
    return moved


def keep_focal_signs(
    before: Float[Array, "parameters cameras"], after: Float[Array, "parameters cameras"]
) -> Bool[Array, " cameras"]:
    """Whether the focal length of each camera keeps its sign; false where it becomes zero.

    A mirrored image can fit for a while, and the iterations do not lead back; no file of cameras
    may hold one. A camera that had no focal length may get any, and numbers that are not finite
    pass, since their cost is none."""
    return ~(jnp.sign(before[6]) * jnp.sign(after[6]) <= 0) | (before[6] == 0)


def step_between(
    cameras: Float[Array, "parameters cameras"],
    moved: Float[Array, "parameters cameras"],
    options: StepOptions,
) -> Float[Array, "parameters cameras"]:
    """The step for which `move_cameras` leads from `cameras` to `moved`, to first order."""
    change = moved - cameras
    if options.coordinates.rotation == "manifold":
        jacobian = left_jacobian(cameras[:3])
        change = change.at[:3].set(
            jnp.einsum("ijc,jc->ic", jacobian, change[:3], precision="highest")
        )
    return change
