"""Observations with what they need to know, and sums over each point's."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxba import camera
from jaxba.barrier import materialized
from jaxba.layout import Layout
from jaxba.problem import AnyArray
from jaxba.sums import point_sums, take_each
from jaxba.together import in_haste, together


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
    return Views(
        frames, jnp.stack(take_each(points, layout.slot_point)), layout.slot_mask, layout.pixels, layout.whitening, True
    )


Terms = Callable[..., list[Array]]
"""Makes vectors from `Views` and from what else there is to know of the same slots."""


def view_terms(
    layout: Layout,
    frames: camera.Frames,
    points: Float[Array, "3 points"],
    terms: Terms,
    *slots: Array,
) -> list[Float[Array, " slots"]]:
    """Vectors over slots that follow from an observation, its camera and its point, made together.

    Args:
        layout: slots.
        frames: of every slot, stored.
        points: of the problem.
        terms: what they are.
        slots: what else they follow from.
    """
    views = all_views(layout, frames, points)
    if in_haste.value:
        return terms(views, *slots)

    def of_views(
        frames: camera.Frames,
        points: Array,
        mask: AnyArray,
        pixels: AnyArray,
        whitening: AnyArray | None,
        *slots: Array,
    ) -> list[Array]:
        return terms(Views(frames, points, mask, pixels, whitening, False), *slots)

    return together(of_views, *views[:-1], *slots)


def point_passes(layout: Layout, frames: camera.Frames) -> Callable[..., list[Float[Array, " points"]]]:
    """What sums over each point's observations terms that follow from an observation, its camera and its point.

    Args:
        layout: slots.
        frames: of every camera.

    Returns:
        A function of points, `Terms`, and any vectors over slots; its result is a vector over points for each term.
    """
    at_slots = frames.stored().at(layout.slot_camera).stacked()

    def one_pass(points: Float[Array, "3 points"], terms: Terms, *slots: Array) -> list[Float[Array, " points"]]:
        return point_sums(layout, view_terms(layout, at_slots, points, terms, *slots))

    return one_pass
