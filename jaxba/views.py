"""Observations with what they need to know, and sums over each point's, in one pass.

XLA on a CPU makes every vector of a program in a loop of its own, which computes anew, or reads anew from memory, what
vectors share. One reduction of many operands is one loop: it looks up an observation's camera, projects its point, and
adds all that is asked of it to that point's sums, and nothing is stored in between. That took a pass of
point iterations over 347,173 observations from 36 to 6 ms (docs/optimisations.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import prod
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxba import camera
from jaxba.barrier import materialized
from jaxba.layout import Layout
from jaxba.problem import AnyArray
from jaxba.sums import point_sum, take


class Views(NamedTuple):
    """Slots with their cameras and points, of any common shape."""

    frames: camera.Frames
    points: Float[Array, "3 ..."] | list[Array]
    mask: Bool[AnyArray, "..."]  # whether there is an observation
    pixels: Float[AnyArray, "2 ..."]
    whitening: Float[AnyArray, "2 2 ..."] | None
    stored: bool  # whether vectors that several others need are stored; else one loop makes all

    def projected(self) -> camera.Projection:
        """Where the points are seen."""
        projection = camera.project(self.frames, self.points, self.mask)
        return projection.stacked() if self.stored else projection

    def kept(self, rows: list[Array]) -> list[Array]:
        """The same vectors, which several others need."""
        return list(materialized(jnp.stack(rows))) if self.stored else rows


def all_views(layout: Layout, frames: camera.Frames, points: Float[Array, "3 points"]) -> Views:
    """All slots in their order; vectors are stored.

    Args:
        layout: slots.
        frames: of every slot.
        points: of the problem.
    """
    return Views(frames, take(points, layout.slot_point), layout.slot_mask, layout.pixels, layout.whitening, True)


Terms = Callable[..., list[Array]]
"""Makes vectors, which are to be summed, from `Views` and from what else there is to know of the same slots."""


def point_passes(
    layout: Layout, frames: camera.Frames, *, fused: bool = True
) -> Callable[..., list[Float[Array, " points"]]]:
    """What sums over each point's observations terms that follow from an observation, its camera and its point.

    Args:
        layout: slots.
        frames: of every camera.
        fused: one loop for each bucket of the layout. Else, and where the layout is padded, vectors are stored and then
            summed: a smaller program, which takes longer.

    Returns:
        A function of points, `Terms`, and any vectors over slots; its result is a vector over points for each term.
    """
    if not fused or layout.point_levels is not None:
        at_slots = frames.stored().at(layout.slot_camera).stacked()
        return lambda points, terms, *slots: list(
            point_sum(layout, jnp.stack(terms(all_views(layout, at_slots, points), *slots)))
        )
    stored = frames.stored()

    def one_pass(points: Float[Array, "3 points"], terms: Terms, *slots: Array) -> list[Float[Array, " points"]]:
        sums = []
        for cut, columns in _buckets(layout):
            mask, whitening = cut(layout.slot_mask), None if layout.whitening is None else cut(layout.whitening)
            own = [jnp.broadcast_to(row.reshape(mask.shape[0], 1, -1), mask.shape) for row in points[:, columns]]
            at_slots = stored.at(cut(layout.slot_camera))
            views = Views(at_slots, own, mask, cut(layout.pixels), whitening, False)
            sums.append(_sums_over_tracks(terms(views, *map(cut, slots))))
        return [jnp.concatenate(of_buckets) for of_buckets in zip(*sums, strict=True)]

    return one_pass


def _buckets(layout: Layout) -> Iterator[tuple[Callable[[AnyArray], Array], slice]]:
    """For each bucket what cuts its slots out of all, as [..., tiles, track, tile], and its points' columns."""
    slot = column = 0
    for tiles, length, tile in layout.buckets:

        def cut(values: AnyArray, begin: int = slot, shape: tuple[int, int, int] = (tiles, length, tile)) -> Array:
            return jnp.asarray(values)[..., begin : begin + prod(shape)].reshape(*values.shape[:-1], *shape)

        yield cut, slice(column, column + tiles * tile)
        slot, column = slot + tiles * length * tile, column + tiles * tile


def _sums_over_tracks(values: list[Float[Array, "tiles track tile"]]) -> list[Float[Array, " points"]]:
    """All sums over the tracks in one loop."""
    zeros = [jnp.zeros((), value.dtype) for value in values]
    add = lambda left, right: [a + b for a, b in zip(left, right, strict=True)]
    return [row.reshape(-1) for row in lax.reduce(values, zeros, add, (1,))]
