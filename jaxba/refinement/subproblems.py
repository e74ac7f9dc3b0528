"""Subproblems whose candidates are accepted separately: the whole problem, or the clusters of a partition.

The cost of a subproblem is the sum over its observations, and its candidate is accepted or rejected on its own. Arrays
with the dimension `*parts` are scalars for the whole problem and have one entry per cluster otherwise.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.model.linearize import Reference, observation_costs, prior_costs, slot_frames
from jaxba.problem.options import StepOptions
from jaxba.refinement.midpoints import refine_from_starts
from jaxba.refinement.points import PreviousPoints, refine_points
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.random_partitions import Partition
from jaxba.structure.segment_sums import point_sum, take, total, tree_sum


class PointSearch(NamedTuple):
    """Parameters of embedded point iterations for one candidate."""

    iterations: int | Int[Array, ""]
    starts: Int[Array, ""]  # where points start: 0, 1 or 2 (`midpoints.refine_from_starts`)
    min_decrease: Float[Array, ""]  # stop after an iteration that lowers the cost by no more than this, pixels^2


@runtime_checkable
class Subproblems(Protocol):
    """Decomposition of a problem into parts that are accepted separately."""

    @property
    def layout(self) -> Layout:
        """The problem's observations."""
        ...

    def terms(self, reference: Reference, previous: PreviousPoints, options: StepOptions) -> Float[Array, " terms"]:
        """Terms of the cost before the step, one to one with those of `refine`: of observations, or of points."""
        ...

    def refine(
        self,
        cameras: Float[Array, "parameters cameras"],
        points: Float[Array, "3 points"],
        previous: PreviousPoints,
        options: StepOptions,
        search: PointSearch,
    ) -> tuple[Float[Array, "3 points"], Float[Array, " terms"]]:
        """The points after embedded iterations, if the options have any, and the terms of the cost there."""
        ...

    def sums(self, terms: Float[Array, " terms"]) -> Float[Array, "*parts"]:
        """Sums terms over every part."""
        ...

    def all_cameras(self, holds: Bool[Array, " cameras"]) -> Bool[Array, "*parts"]:
        """Whether something holds for every camera of each part."""
        ...

    def of_cameras(self, values: Array) -> Array:
        """The value of each camera's part, or a scalar that broadcasts."""
        ...

    def of_points(self, values: Array) -> Array:
        """The value of each point's part, or a scalar that broadcasts; arbitrary for shared points."""
        ...


class Whole(NamedTuple):
    """The whole problem as one part. The terms of its cost are those of points if points are refined, else of slots."""

    layout: Layout

    def terms(self, reference: Reference, previous: PreviousPoints, options: StepOptions) -> Float[Array, " terms"]:
        """See `Subproblems`."""
        terms = previous.costs if options.refinement.points else reference.costs
        return jnp.concatenate([terms, *reference.prior_costs])

    def refine(
        self,
        cameras: Float[Array, "parameters cameras"],
        points: Float[Array, "3 points"],
        previous: PreviousPoints,
        options: StepOptions,
        search: PointSearch,
    ) -> tuple[Float[Array, "3 points"], Float[Array, " terms"]]:
        """See `Subproblems`."""
        if options.refinement.points:
            points, terms = _refined(self.layout, cameras, points, previous, options, search)
        else:
            terms = observation_costs(self.layout, cameras, points, options.loss)
        return points, jnp.concatenate([terms, *prior_costs(self.layout, cameras)])

    def sums(self, terms: Float[Array, " terms"]) -> Float[Array, ""]:
        """See `Subproblems`."""
        return sum_over_devices(self.layout, total(terms))

    def all_cameras(self, holds: Bool[Array, " cameras"]) -> Bool[Array, ""]:
        """See `Subproblems`."""
        return jnp.all(holds)

    def of_cameras(self, values: Array) -> Array:
        """See `Subproblems`."""
        return values

    def of_points(self, values: Array) -> Array:
        """See `Subproblems`."""
        return values


class Clusters(NamedTuple):
    """The clusters of a partition. Shared points are held fixed. The terms of the cost are those of slots."""

    layout: Layout
    partition: Partition
    owner: Int[Array, " points"]
    """The only cluster that sees a point; arbitrary for shared points."""

    @staticmethod
    def of(layout: Layout, partition: Partition) -> Clusters:
        """The clusters of a partition as subproblems."""
        seen = jnp.asarray(layout.slot_mask).astype(jnp.float32)
        labels = take(jnp.asarray(partition.label), layout.slot_camera) * seen
        sums = point_sum(layout, jnp.stack([labels, seen]))  # sums of equal integers: the quotient is exact
        return Clusters(layout, partition, (sums[0] / jnp.maximum(sums[1], 1)).astype(jnp.int32))

    def terms(self, reference: Reference, previous: PreviousPoints, options: StepOptions) -> Float[Array, " slots"]:
        """See `Subproblems`."""
        return reference.costs

    def refine(
        self,
        cameras: Float[Array, "parameters cameras"],
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
        # empty slots have some camera, perhaps of another cluster
        own_terms = jnp.where(self.layout.slot_mask, terms, 0)
        per_camera = tree_sum(own_terms[:, None], self.layout.camera_levels)[:, 0]
        members = self.partition.members
        own = per_camera.at[members].get(mode="clip")
        return jnp.sum(jnp.where(members < self.layout.num_cameras, own, 0), axis=1)

    def all_cameras(self, holds: Bool[Array, " cameras"]) -> Bool[Array, " clusters"]:
        """See `Subproblems`."""
        return jnp.all(holds.at[self.partition.members].get(mode="fill", fill_value=True), axis=1)

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
        return refine_points(layout, frames, points, options.loss, search.iterations, previous, search.min_decrease)
    return refine_from_starts(layout, frames, points, options.loss, search.iterations, previous, *search[1:])
