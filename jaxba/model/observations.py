"""Observations with what they need to know, what follows from them, and sums of that over each point's."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxba.model import camera
from jaxba.runtime.fusion import compute_in_one_loop, fast_compilation, fusion_barrier
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import point_sums, take_each
from jaxba.typing import AnyArray


class Views(NamedTuple):
    """Slots with their cameras and points, of any common shape."""

    frames: camera.Frames
    points: Float[Array, "3 ..."]
    mask: Bool[AnyArray, "..."]  # whether there is an observation
    pixels: Float[AnyArray, "2 ..."]
    whitening: Float[AnyArray, "2 2 ..."] | None

    def projected(self) -> camera.Projection:
        """Where the points are seen; in haste stored, since every vector that needs it has a loop of its own then."""
        projection = camera.project(self.frames, self.points, self.mask)
        return projection.stacked() if fast_compilation.value else projection

    def kept(self, rows: list[Array]) -> list[Array]:
        """The same vectors, which several others need; in haste stored."""
        return list(fusion_barrier(jnp.stack(rows))) if fast_compilation.value else rows


Terms = Callable[..., list[Array]]
"""Makes vectors from `Views` and from what else there is to know of the same slots."""


def view_terms(
    layout: Layout, frames: camera.Frames, points: Float[Array, "3 points"], terms: Terms, *slots: Array
) -> list[Float[Array, " slots"]]:
    """Vectors over slots that follow from an observation, its camera and its point, made together.

    Args:
        layout: slots.
        frames: of every slot, stored (`linearize.slot_frames`).
        points: of the problem.
        terms: what they are.
        slots: what else they follow from.
    """
    at_slots = jnp.stack(take_each(points, layout.slot_point))
    return compute_in_one_loop(
        terms, Views(frames, at_slots, layout.slot_mask, layout.pixels, layout.whitening), *slots
    )


def point_passes(layout: Layout, frames: camera.Frames) -> Callable[..., list[Float[Array, " points"]]]:
    """What sums over each point's observations terms that follow from an observation, its camera and its point.

    Args:
        layout: slots.
        frames: of every slot, stored.

    Returns:
        A function of points, `Terms`, and any vectors over slots; its result is a vector over points for each term.
    """

    def one_pass(points: Float[Array, "3 points"], terms: Terms, *slots: Array) -> list[Float[Array, " points"]]:
        return point_sums(layout, view_terms(layout, frames, points, terms, *slots))

    return one_pass
