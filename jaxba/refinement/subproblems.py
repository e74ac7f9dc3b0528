"""What is judged by itself: the whole problem, or every cluster of a decomposition.

The cost of a part is the sum over its observations, and a candidate is accepted or refused part by part. Numbers of
parts are arrays of one shape: none for the whole, one entry a cluster else.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.model.linearize import observation_costs, slot_frames
from jaxba.problem.options import StepOptions
from jaxba.refinement.midpoints import refine_from_starts
from jaxba.refinement.points import PreviousPoints, refine_points
from jaxba.structure.layout import Layout
from jaxba.structure.random_partitions import Partition
from jaxba.structure.segment_sums import point_sum, take, total, tree_sum


class PointSearch(NamedTuple):
    """How far embedded point iterations go."""

    iterations: int | Int[Array, ""]
    starts: Int[Array, ""]  # whether from rays, and from both places (`triangulate.refine_from_starts`)
    enough: Float[Array, ""]  # decrease of an iteration that is the last one


@runtime_checkable
class Subproblems(Protocol):
    """How a problem falls into parts."""

    @property
    def layout(self) -> Layout:
        """The problem's observations."""
        ...

    def terms(self, costs: Float[Array, " slots"], options: StepOptions) -> Float[Array, " terms"]:
        """The cost of every observation, in the pieces in which `refine` has it."""
        ...

    def refine(
        self,
        cameras: Float[Array, "9 cameras"],
        points: Float[Array, "3 points"],
        previous: PreviousPoints,
        options: StepOptions,
        search: PointSearch,
    ) -> tuple[Float[Array, "3 points"], Float[Array, " terms"]]:
        """The parts' own points after embedded iterations, if the options have any, and the cost in pieces."""
        ...

    def sums(self, terms: Float[Array, " terms"]) -> Float[Array, "*parts"]:
        """Sums pieces over every part."""
        ...

    def of_cameras(self, values: Array) -> Array:
        """The number of each camera's part, as far as broadcasting does not say it."""
        ...

    def of_points(self, values: Array) -> Array:
        """The number of each point's part; any for a point that several parts see."""
        ...


class Whole(NamedTuple):
    """One part. Costs are compared point by point where points are refined, as `refine_points` returns them."""

    layout: Layout

    def terms(self, costs: Float[Array, " slots"], options: StepOptions) -> Float[Array, " terms"]:
        """See `Subproblems`."""
        return point_sum(self.layout, costs[None])[0] if options.refinement.points else costs

    def refine(
        self,
        cameras: Float[Array, "9 cameras"],
        points: Float[Array, "3 points"],
        previous: PreviousPoints,
        options: StepOptions,
        search: PointSearch,
    ) -> tuple[Float[Array, "3 points"], Float[Array, " terms"]]:
        """See `Subproblems`."""
        if options.refinement.points:
            return _refined(self.layout, cameras, points, previous, options, search)
        return points, observation_costs(self.layout, cameras, points, options.loss)

    def sums(self, terms: Float[Array, " terms"]) -> Float[Array, ""]:
        """See `Subproblems`."""
        return total(terms)

    def of_cameras(self, values: Array) -> Array:
        """See `Subproblems`."""
        return values

    def of_points(self, values: Array) -> Array:
        """See `Subproblems`."""
        return values


class Clusters(NamedTuple):
    """The clusters of a partition. Points that several of them see stand still."""

    layout: Layout
    partition: Partition
    owner: Int[Array, " points"]
    """The cluster that alone sees a point; any for a separator."""

    @staticmethod
    def of(layout: Layout, partition: Partition) -> Clusters:
        """The parts of a partition."""
        seen = jnp.asarray(layout.slot_mask).astype(jnp.float32)
        labels = take(jnp.asarray(partition.label), layout.slot_camera) * seen
        sums = point_sum(layout, jnp.stack([labels, seen]))  # of equal whole numbers: the quotient is exact
        return Clusters(layout, partition, (sums[0] / jnp.maximum(sums[1], 1)).astype(jnp.int32))

    def terms(self, costs: Float[Array, " slots"], options: StepOptions) -> Float[Array, " slots"]:
        """See `Subproblems`."""
        return costs

    def refine(
        self,
        cameras: Float[Array, "9 cameras"],
        points: Float[Array, "3 points"],
        previous: PreviousPoints,
        options: StepOptions,
        search: PointSearch,
    ) -> tuple[Float[Array, "3 points"], Float[Array, " slots"]]:
        """See `Subproblems`."""
        if options.refinement.points:
            points, _ = _refined(self.layout, cameras, points, previous, options, search)
            points = jnp.where(self.partition.is_shared, previous.points, points)
        return points, observation_costs(self.layout, cameras, points, options.loss)

    def sums(self, terms: Float[Array, " slots"]) -> Float[Array, " clusters"]:
        """See `Subproblems`."""
        own_terms = jnp.where(self.layout.slot_mask, terms, 0)  # empty slots belong to some camera of another cluster
        per_camera = tree_sum(own_terms[:, None], self.layout.camera_levels)[:, 0]
        members = self.partition.members
        own = per_camera.at[members].get(mode="clip")
        return jnp.sum(jnp.where(members < self.layout.num_cameras, own, 0), axis=1)

    def of_cameras(self, values: Array) -> Array:
        """See `Subproblems`."""
        return take(values, self.partition.label)

    def of_points(self, values: Array) -> Array:
        """See `Subproblems`."""
        return take(values, self.owner)


def _refined(
    layout: Layout, cameras: Array, points: Array, previous: PreviousPoints, options: StepOptions, search: PointSearch
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    frames = slot_frames(layout, cameras)
    if options.refinement.starts == "step":
        return refine_points(layout, frames, points, options.loss, search.iterations, previous, search.enough)
    return refine_from_starts(layout, frames, points, options.loss, search.iterations, previous, *search[1:])
