"""The pixel of a point in the frame of its camera, and its derivatives: BAL's by formulas, others'
by forward mode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.problem.camera_models import CameraModel
from jaxba.typing import AnyArray

Pair = tuple[Array, Array]

Which = tuple[Int[Array, "..."], ...]  # position of each camera's model, if there are several
# `dz/dP`, [2][3], and `dz/d number k of the lens`
Rows = tuple[list[list[Array]], Callable[[int], Pair]]


class Projection(NamedTuple):
    """A projected point, with the intermediate values that its derivatives need."""

    pixel: Float[Array, "2 ..."] | list[Array]  # f d p
    direction: Float[Array, "2 ..."] | list[Array]  # p = -P.xy / P.z
    # 1 / P.z; negative in front of the camera, zero where masked
    inverse_depth: Float[Array, "..."]
    radius: Float[Array, "..."]  # |p|^2
    distortion: Float[Array, "..."]  # d = 1 + k1 |p|^2 + k2 |p|^4 of BAL, else 1
    rotated: Float[Array, "3 ..."] | list[Array]  # R X
    local: Float[Array, "3 ..."] | list[Array]  # P; (0, 0, -1) where masked and not BAL's
    turned: tuple[Float[Array, "3 ..."] | list[Array], ...]  # P - m of a camera in a rig
    mask: Bool[AnyArray, "..."]  # as given

    def stacked(self) -> Projection:
        """The same with arrays in place of lists."""
        names = ("pixel", "direction", "rotated", "local")
        arrays = {name: jnp.stack(list(getattr(self, name))) for name in names}
        return self._replace(**arrays, turned=tuple(jnp.stack(list(rows)) for rows in self.turned))


@jax.tree_util.register_static
@dataclass(frozen=True)
class BalLens:
    """BAL's model, with `d = 1 + k1 |p|^2 + k2 |p|^4` and its derivative `e = k1 + 2 k2 |p|^2` by
    `|p|^2`:

    dz/dp = f (d I + 2 e p p^T)      dp/dP = -[I | p] / P.z      dz/d(f, k1, k2) = (d, f |p|^2, f
    |p|^4) p"""

    def masked(self, local: list[Array], mask: AnyArray) -> list[Array]:
        """Points that may be projected: BAL's formulas are finite wherever the inverse depth is."""
        return local

    def pixels(
        self,
        lens: list[Array],
        which: Which,
        local: list[Array],
        direction: list[Array],
        radius: Array,
        mask: AnyArray,
    ) -> tuple[list[Array], Array]:
        """The pixel and the distortion d."""
        focal, k1, k2 = lens
        distortion = 1 + radius * (k1 + k2 * radius)
        scale = focal * distortion
        return [scale * x for x in direction], distortion

    def undistorted(
        self, lens: list[Array], which: Which, pixels: list[Array], iterations: int
    ) -> list[Array]:
        """The points of the plane z = -1 that are seen at the pixels, by fixed-point iterations."""
        focal, k1, k2 = lens
        scaled = plane = [row.astype(focal.dtype) / focal for row in pixels]
        for _ in range(iterations):
            squared = plane[0] * plane[0] + plane[1] * plane[1]
            factor = 1 / (1 + squared * (k1 + squared * k2))
            plane = [row * factor for row in scaled]
        return plane

    def derivatives(self, lens: list[Array], which: Which, projection: Projection) -> Rows:
        """Of the pixel by the point in the camera's frame, and by the numbers of the lens."""
        u, v = projection.direction
        radius = projection.radius
        distortion = projection.distortion
        focal, k1, k2 = lens
        slope = 2 * (k1 + 2 * k2 * radius)
        scale = -focal * projection.inverse_depth
        cross = scale * slope * u * v
        radial = scale * (distortion + slope * radius)
        by_local = [
            [scale * (distortion + slope * u * u), cross, radial * u],
            [cross, scale * (distortion + slope * v * v), radial * v],
        ]

        def by_lens(k: int) -> Pair:
            factor = distortion if k == 0 else focal * radius if k == 1 else focal * radius * radius
            return factor * u, factor * v

        return by_local, by_lens


@jax.tree_util.register_static
@dataclass(frozen=True)
class ModelledLens:
    """Any camera models: `z = model(P.x, -P.y, -P.z)` (problem/camera_models.py)."""

    models: tuple[CameraModel, ...]

    def masked(self, local: list[Array], mask: AnyArray) -> list[Array]:
        """Points that may be projected: (0, 0, -1) where masked."""
        return [
            jnp.where(mask, row, value) for row, value in zip(local, (0.0, 0.0, -1.0), strict=True)
        ]

    def pixels(
        self,
        lens: list[Array],
        which: Which,
        local: list[Array],
        direction: list[Array],
        radius: Array,
        mask: AnyArray,
    ) -> tuple[list[Array], Array]:
        """The pixel, and a distortion of one."""
        pixel = self.pixel(which, lens, *local)
        return [jnp.where(mask, row, jnp.zeros_like(row)) for row in pixel], jnp.ones_like(radius)

    def pixel(self, which: Which, lens: list[Array], x: Array, y: Array, z: Array) -> Pair:
        """Pixel of a point x, y, z (scene units) in the frame of each camera, in BAL's axes.
        `which` is the model of each camera, and `lens` has the numbers of the lenses."""
        last = self.models[-1]
        pixel = last.project(lens[: len(last)], x, -y, -z)
        for number, model in enumerate(self.models[:-1]):
            own = model.project(lens[: len(model)], x, -y, -z)
            pixel = tuple(
                jnp.where(which[0] == number, *pair) for pair in zip(own, pixel, strict=True)
            )
        return pixel[0], pixel[1]

    def undistorted(
        self, lens: list[Array], which: Which, pixels: list[Array], iterations: int
    ) -> list[Array]:
        """The points of the plane z = -1 that are seen at the pixels, by Newton's method from the
        optical axis."""
        depth = -jnp.ones_like(lens[0])

        def pixel_at(x, y):
            return self.pixel(which, lens, x, y, depth)

        x = jnp.zeros_like(lens[0])
        y = jnp.zeros_like(lens[0])
        for _ in range(iterations):
            found, by_x = jax.jvp(lambda x, y=y: pixel_at(x, y), (x,), (jnp.ones_like(x),))
            _, by_y = jax.jvp(lambda y, x=x: pixel_at(x, y), (y,), (jnp.ones_like(y),))
            u, v = (value - pixel for value, pixel in zip(found, pixels, strict=True))
            inverse = 1 / (by_x[0] * by_y[1] - by_x[1] * by_y[0])
            x = x - inverse * (by_y[1] * u - by_y[0] * v)
            y = y - inverse * (by_x[0] * v - by_x[1] * u)
        return [x, y]

    def derivatives(self, lens: list[Array], which: Which, projection: Projection) -> Rows:
        """By forward mode, one number at a time: each derivative then has only the terms that
        depend on it."""
        local = list(projection.local)

        def rate(function: Callable[[Array], Pair], at: Array) -> Pair:
            rates = jax.jvp(function, (at,), (jnp.ones_like(at),))[1]
            first, second = (jnp.where(projection.mask, row, jnp.zeros_like(row)) for row in rates)
            return first, second

        def by_place(k: int) -> Pair:
            def place(at):
                return [at if n == k else row for n, row in enumerate(local)]

            return rate(lambda at: self.pixel(which, lens, *place(at)), local[k])

        def by_lens(k: int) -> Pair:
            return rate(
                lambda at: self.pixel(which, [*lens[:k], at, *lens[k + 1 :]], *local), lens[k]
            )

        places = [by_place(k) for k in range(3)]
        return [[place[row] for place in places] for row in range(2)], by_lens


LensModel = BalLens | ModelledLens

BAL_LENS = BalLens()
