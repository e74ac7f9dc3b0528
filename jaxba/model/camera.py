"""Projection and its derivatives.

    P = R X + t,   z = f (1 + k1 |p|^2 + k2 |p|^4) p,   p = -P.xy / P.z      BAL
                   z = model(P.x, -P.y, -P.z)                                others
                   (model/lens_models.py)

Arrays are components-first, [3, n], so that vector instructions of a CPU and coalesced reads of a
GPU run over observations. Rotation matrices are computed once per camera; what is computed per
observation has no sine, cosine or branch.

Source of the model: Agarwal et al. 2010, "Bundle Adjustment in the Large". Derivatives by a
rotation are those of the left perturbation `R <- exp(d) R`, Sola et al. 2018, "A micro Lie theory",
eqs. 143-146."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.model.lens_models import BAL_LENS, LensModel, ModelledLens, Projection
from jaxba.problem.camera_models import BAL
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.rotations import compose_left, rotation_matrix
from jaxba.runtime.fusion import compute_unfused, fusion_barrier
from jaxba.structure.segment_sums import take, take_each
from jaxba.structure.unknowns import BAL_UNKNOWNS, Unknowns
from jaxba.typing import AnyArray

EVERYWHERE = np.array(True)  # a mask that masks nothing; XLA removes it


class Frames(NamedTuple):
    """The camera of each observation: rotation matrix and the other parameters."""

    rotation: Float[Array, "3 3 ..."] | list[list[Array]]  # R, world to camera
    translation: Float[Array, "3 ..."] | list[Array]  # t, scene units
    lens: Float[Array, "numbers ..."] | list[Array]  # f (pixels), k1, k2 of BAL
    # M by rows, m: from the frame of a rig to the camera
    places: tuple[Float[Array, "12 ..."] | list[Array], ...] = ()
    which: tuple[Int[Array, "..."], ...] = ()  # position in the models, if there are several
    model: LensModel = BAL_LENS

    def at(self, index: Int[AnyArray, " n"]) -> Frames:
        """The frames of the cameras in `index`.

        Computed once per camera: a fusion barrier keeps XLA from computing rotations again for
        every index."""
        rotation = jnp.asarray(self.rotation).reshape(9, -1)
        rows = [row for place in self.places for row in place]
        table = fusion_barrier(jnp.stack([*rotation, *self.translation, *self.lens, *rows]))
        # not fused with its uses, in which a gather keeps the compiler from vectorising; one by
        # one, since a branch would copy an array of all
        table = compute_unfused(take_each, table, jnp.asarray(index), index=index)
        end = len(table) - len(rows)
        places = tuple(table[start : start + 12] for start in range(end, len(table), 12))
        which = tuple(take(one, jnp.asarray(index)) for one in self.which)
        rotation = [table[k : k + 3] for k in (0, 3, 6)]
        return Frames(rotation, table[9:12], table[12:end], places, which, self.model)


def frames(
    cameras: Float[Array, "parameters cameras"], unknowns: Unknowns = BAL_UNKNOWNS
) -> Frames:
    """Rotation matrices and intrinsics, once per camera and evaluation. `cameras` are pose and lens
    of each camera, and its extrinsics in a rig; `unknowns` knows their camera models, and whether
    they are in rigs."""
    lens = cameras[POSE_SIZE : POSE_SIZE + unknowns.lens_size]
    places = tuple(
        jnp.concatenate(
            [rotation_matrix(cameras[k : k + 3]).reshape(9, -1), cameras[k + 3 : k + POSE_SIZE]]
        )
        for k in unknowns.places
    )
    model = BAL_LENS if unknowns.models == (BAL,) else ModelledLens(unknowns.models)
    which = (jnp.asarray(unknowns.model),) if len(unknowns.models) > 1 else ()
    return Frames(rotation_matrix(cameras[:3]), cameras[3:6], lens, places, which, model)


def moved(
    cameras: Float[Array, "parameters cameras"],
    step: Float[Array, "parameters cameras"],
    unknowns: Unknowns,
) -> Float[Array, "parameters cameras"]:
    """Cameras after a step, `R <- exp(w) R` for rotations."""
    found = cameras + step
    for k in (0, *unknowns.places):
        rows = slice(k, k + 3)
        found = found.at[rows].set(compose_left(step[rows], cameras[rows]))
    return found


def poses(
    cameras: Float[Array, "parameters cameras"], unknowns: Unknowns
) -> tuple[Float[Array, "3 cameras"], Float[Array, "3 cameras"]]:
    """Angle-axis and translation of each camera, also of one in a rig: `M R_r` and `M t_r + m`
    (problem/rigs.py)."""
    angle_axis = cameras[:3]
    translation = cameras[3:6]
    for k in unknowns.places:
        turn = cameras[k : k + 3]
        shift = cameras[k + 3 : k + POSE_SIZE]
        turned = jnp.einsum("ijc,jc->ic", rotation_matrix(turn), translation, precision="highest")
        angle_axis = compose_left(turn, angle_axis)
        translation = turned + shift
    return angle_axis, translation


def project(
    frame: Frames,
    points: Float[Array, "3 ..."] | list[Array],
    mask: Bool[AnyArray, "..."] = EVERYWHERE,
) -> Projection:
    """Projects one point (scene units) through one camera per column. Where the mask is false, the
    projection and everything derived from it is exactly zero. Returns pixels and intermediate
    values, in lists. A point on the camera plane gives non-finite pixels; a point behind the camera
    is projected like any other, as in BAL."""
    rotated = [
        row[0] * points[0] + row[1] * points[1] + row[2] * points[2] for row in frame.rotation
    ]
    local = [rotated[k] + frame.translation[k] for k in range(3)]
    turned = ()
    for place in frame.places:
        p, q, r = local
        rows = [place[3 * i] * p + place[3 * i + 1] * q + place[3 * i + 2] * r for i in range(3)]
        local = [rows[k] + place[9 + k] for k in range(3)]
        turned += (rows,)
    x, y, z = local = frame.model.masked(local, mask)
    # masked twice: the derivative of the quotient, too, must not see the depth of an empty slot
    inverse = jnp.where(mask, 1 / jnp.where(mask, z, jnp.ones_like(z)), jnp.zeros_like(z))
    u = -x * inverse
    v = -y * inverse
    radius = u * u + v * v
    pixel, distortion = frame.model.pixels(
        list(frame.lens), frame.which, local, [u, v], radius, mask
    )
    return Projection(pixel, [u, v], inverse, radius, distortion, rotated, local, turned, mask)


def derivatives(
    frame: Frames, projection: Projection, columns: Sequence[int] | None = None
) -> tuple[list[list[Array]], list[list[Array]]]:
    """Jacobians of `project` by the camera (rotation on the manifold, translation, lens),
    [2][width] of [n], and by the point, [2][3] of [n]: columns, each of which is one fused
    expression. `projection` is what `project` returned for these cameras. `columns` are the numbers
    of the lens, and then of extrinsics, to differentiate by; None: all. By the chain rule `dz/dt =
    dz/dP`, `dz/dw = -dz/dP [R X]x` and `dz/dX = dz/dP R`."""
    rows, by_lens = frame.model.derivatives(list(frame.lens), frame.which, projection)
    by_number = [functools.partial(by_lens, k) for k in range(len(frame.lens))]
    for place, turned in zip(reversed(frame.places), reversed(projection.turned), strict=True):
        # left perturbation of M, and m
        by_extrinsics = [[*_by_rotation(row, turned), *row] for row in rows]
        by_number += [lambda pair=pair: pair for pair in zip(*by_extrinsics, strict=True)]
        rows = [
            [a * place[k] + b * place[3 + k] + c * place[6 + k] for k in range(3)]
            for a, b, c in rows
        ]
    columns = range(len(by_number)) if columns is None else columns
    zero = jnp.zeros_like(projection.radius)

    # of a block of residuals
    def of_number(k):
        return by_number[k]() if k < len(by_number) else (zero, zero)

    numbers = list(zip(*map(of_number, columns), strict=True)) or [(), ()]
    camera = [
        [*_by_rotation(row, projection.rotated), *row, *own]
        for row, own in zip(rows, numbers, strict=True)
    ]
    rotation = frame.rotation
    point = [
        [a * rotation[0][k] + b * rotation[1][k] + c * rotation[2][k] for k in range(3)]
        for a, b, c in rows
    ]
    return camera, point


def _by_rotation(row: list[Array], rotated: Float[Array, "3 ..."] | list[Array]) -> list[Array]:
    """`-row [q]x` for a rotated point q."""
    (a, b, c) = row
    (x, y, z) = rotated
    return [y * c - z * b, z * a - x * c, x * b - y * a]
