"""Evaluation of functions of an observation, its camera and its point: per slot, and summed over
each point.

The functions are written once, for a `Views`; here they are evaluated in one fused loop over all
slots."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxba.model import camera
from jaxba.runtime.fusion import compute_in_one_loop, fast_compilation
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import point_sums_of, take_each
from jaxba.typing import AnyArray


class Views(NamedTuple):
    """Observation slots with their cameras and points, of any common shape."""

    frames: camera.Frames
    points: Float[Array, "3 ..."]
    mask: Bool[AnyArray, "..."]  # whether there is an observation
    pixels: Float[AnyArray, "2 ..."]
    whitening: Float[AnyArray, "2 2 ..."] | None

    def projected(self) -> camera.Projection:
        """The projections of the points.

        Materialised under fast compilation, where each vector computed from them has a loop of its
        own."""
        projection = camera.project(self.frames, self.points, self.mask)
        return projection.stacked() if fast_compilation.value else projection


Terms = Callable[..., list[Array]]  # of `Views` and further vectors over the same slots


def view_terms(
    layout: Layout,
    frames: camera.Frames,
    points: Float[Array, "3 points"],
    terms: Terms,
    *slots: Array,
) -> list[Float[Array, " slots"]]:
    """Evaluates a function of an observation, its camera and its point for every slot, in one loop.
    Returns a vector over slots for each term. `frames` are the cameras of every slot, materialised
    (`linearize.slot_frames`), `points` are the current ones, and `slots` are further arguments of
    the function, vectors over slots."""
    return compute_in_one_loop(terms, _views(layout, frames, points), *slots)


def _views(layout: Layout, frames: camera.Frames, points: Float[Array, "3 points"]) -> Views:
    at_slots = jnp.stack(take_each(points, layout.slot_point))
    return Views(frames, at_slots, layout.slot_mask, layout.pixels, layout.whitening)


def point_passes(
    layout: Layout, frames: camera.Frames
) -> Callable[..., list[Float[Array, " points"]]]:
    """`view_terms` summed over the observations of each point, as a function of the points. Returns
    a function of points, `Terms` and further vectors over slots, which returns a vector over points
    for each term."""

    def one_pass(
        points: Float[Array, "3 points"], terms: Terms, *slots: Array
    ) -> list[Float[Array, " points"]]:
        return point_sums_of(layout, terms, _views(layout, frames, points), *slots)

    return one_pass
