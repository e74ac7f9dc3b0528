"""Stochastic domain decomposition (DeepLM's, "ddlm"): clusters of cameras optimised beside each other.

One round: points that several clusters see stand still, so that clusters share neither a variable nor a residual. Each
takes a damped step of its own cameras and of the points that it alone sees, with the embedded iterations, camera rounds
and trials of any other step (`refinement/trial.py`), and keeps it only if its own cost falls. Then cameras stand still
and every separator takes a damped step of its own, or embedded iterations, kept under the same condition. The cost of
the whole can only fall. The next round draws other clusters.

Lambda is one number a round, for clusters and separators. With `block_steps` above one, a cluster that fails multiplies
it for itself.

Source: Huang et al. 2021, "DeepLM", section 4. The authors' code holds the pieces but not the schedule of rounds, which
is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.linear.cholesky3 import cholesky3
from jaxba.linear.schur import (
    Coordinates,
    back_substitute,
    camera_system,
    damping_diagonal,
    eliminate_points,
    largest_gradient,
)
from jaxba.lm.damped_step import Step
from jaxba.methods.deeplm import image
from jaxba.methods.stba import solve_clusters
from jaxba.model.linearize import Linearization, linearize, point_terms, slot_frames
from jaxba.model.observations import point_passes, view_terms
from jaxba.problem.options import StepOptions
from jaxba.refinement.points import Home, refine_points
from jaxba.refinement.subproblems import Clusters
from jaxba.refinement.trial import NEGLIGIBLE, best_trial
from jaxba.structure.layout import Layout
from jaxba.structure.random_partitions import Partition
from jaxba.structure.segment_sums import take, total

LOCAL_FACTOR = 4.0
"""Factor on a cluster's own lambda after its step failed."""

LEAST_SHARE = 1 / 64
"""Share of a round in which no cluster was accepted, not zero because policies look at its logarithm."""


class Round(NamedTuple):
    """What a round did."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, ""]  # pixels squared
    predicted: Float[Array, ""]  # decrease that linear models promised: of accepted trials, and of whole refused steps
    gain: Float[Array, ""]  # what clusters that were accepted gained, over that
    slope: Float[Array, ""]  # -g.d
    curvature: Float[Array, ""]  # d.H d
    gradient_max: Float[Array, ""]  # before the round
    share: Float[Array, ""]  # of their steps that clusters took, weighted by what each promised at full length
    repairs: Int[Array, ""]  # camera rounds, further trials and pattern moves of the cluster that took most
    accepted: Bool[Array, ""]


class _Carry(NamedTuple):
    cameras: Array
    points: Array
    dampings: Float[Array, " clusters"]
    predicted: Array
    gained: Array
    offered: Array
    taken: Array
    repairs: Int[Array, " clusters"]
    slope: Array
    curvature: Array
    gradient_max: Array


def decomposed_round(
    layout: Layout,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, ""],
    damping: Float[Array, ""],
    partition: Partition,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
) -> Round:
    """One round of one partition.

    Args:
        layout: slots, with pairs.
        cameras: present cameras.
        points: present points.
        cost: their cost, pixels squared.
        damping: lambda.
        partition: of this round.
        options: `block_steps` steps of the clusters, what is embedded in them, and what separators do after them.
        min_gain: a cluster's step is accepted if its cost falls and its gain ratio exceeds this.
    """
    parts = Clusters.of(layout, partition)

    def body(count: Array, carry: _Carry) -> _Carry:
        linear = linearize(layout, carry.cameras, carry.points, options.loss)
        step = _cluster_steps(parts, linear, carry.cameras, carry.dampings, options)
        before = parts.sums(linear.costs)
        trial = best_trial(parts, carry.cameras, carry.points, before, linear.present, step, options, min_gain)
        good, whole = trial.accepted, step.predicted(jnp.ones_like(before))
        possible = jnp.isfinite(whole)
        sum_of = lambda values: jnp.sum(jnp.where(possible, values, 0))
        good_point = parts.of_points(good) & ~jnp.asarray(partition.separator)
        return _Carry(
            jnp.where(parts.of_cameras(good), trial.cameras, carry.cameras),
            jnp.where(good_point, trial.points, carry.points),
            jnp.where(good, carry.dampings, LOCAL_FACTOR * carry.dampings),
            carry.predicted + sum_of(jnp.where(good, trial.predicted, whole)),
            carry.gained + sum_of(jnp.where(good, trial.gain * trial.predicted, 0)),
            carry.offered + jnp.sum(jnp.where(possible, whole, jnp.inf)),
            carry.taken + sum_of(jnp.where(good, trial.share * whole, 0)),
            carry.repairs + trial.repairs,
            carry.slope + sum_of(step.slope),
            carry.curvature + sum_of(step.slope - step.damped),
            jnp.where(count == 0, step.gradient_max, carry.gradient_max),
        )

    zero = jnp.zeros_like(cost)
    dampings = jnp.full(partition.members.shape[0], damping)
    none = jnp.zeros(dampings.shape, jnp.int32)
    start = _Carry(cameras, points, dampings, zero, zero, zero, zero, none, zero, zero, zero)
    end = lax.fori_loop(0, options.block_steps, body, start)
    moved, after = _separators(layout, end.cameras, end.points, damping, partition, options)
    # points alone may lower the cost a little where every cluster was refused, which is no sign of convergence
    share = jnp.where(end.offered - end.taken > NEGLIGIBLE * cost, end.taken / end.offered, 1)
    return Round(
        end.cameras,
        moved,
        jnp.minimum(after, cost),
        end.predicted,
        jnp.where(end.predicted > 0, end.gained / end.predicted, 0),  # no cluster's matrix could be factored
        end.slope,
        end.curvature,
        end.gradient_max,
        jnp.clip(share, LEAST_SHARE, 1),
        jnp.max(end.repairs),
        after < cost,
    )


def _cluster_steps(
    parts: Clusters,
    linear: Linearization,
    cameras: Array,
    dampings: Float[Array, " clusters"],
    options: StepOptions,
) -> Step:
    """Steps of all clusters, separators standing still; the gradient is that of the whole problem.

    A cluster whose factorisation failed stands still, and its slope is nan.
    """
    layout, partition = parts.layout, parts.partition
    coordinates, of_camera = Coordinates.of(cameras, options), parts.of_cameras(dampings)
    eliminated = eliminate_points(layout, linear, parts.of_points(dampings), options)
    free = take(jnp.where(partition.separator, 0, 1).astype(cameras.dtype), layout.slot_point)
    projected = [[free * entry for entry in row] for row in eliminated.projected]
    eliminated = eliminated._replace(projected=projected)
    system = camera_system(layout, linear, eliminated, coordinates, of_camera[:, None], options)
    moves = solve_clusters(layout, linear, eliminated, system, system.right, partition)
    # what is no number would spread: empty slots belong to some camera, and padding reads them
    finite = jnp.all(jnp.isfinite(moves), axis=1).at[partition.members].get(mode="fill", fill_value=True)
    solved = jnp.all(finite, axis=1)
    moves = jnp.where(layout.camera_seen[:, None] & parts.of_cameras(solved)[:, None], moves, 0)
    point_moves = jnp.stack(back_substitute(layout, linear, eliminated, moves))
    point_moves = jnp.where(partition.separator | ~parts.of_points(solved), 0, point_moves)
    moved = image(layout, linear, moves, point_moves)
    slopes = parts.sums(-(linear.residual[0] * moved[0] + linear.residual[1] * moved[1]))
    slopes = jnp.where(solved, slopes, jnp.nan)
    curvatures = parts.sums(moved[0] * moved[0] + moved[1] * moved[1])
    gradient_max = largest_gradient(eliminated, system, coordinates)
    none = jnp.zeros((), jnp.int32), jnp.zeros_like(gradient_max)
    return Step(coordinates.given(moves).T, point_moves, slopes, slopes - curvatures, gradient_max, *none)


def _separators(
    layout: Layout, cameras: Array, points: Array, damping: Array, partition: Partition, options: StepOptions
) -> tuple[Float[Array, "3 points"], Float[Array, ""]]:
    """Every separator after its embedded iterations, or a damped step where there are none; the cost after that."""
    frames = slot_frames(layout, cameras)
    one_pass = point_passes(layout, frames)
    terms = lambda views: point_terms(views, options.loss)[:10]
    *entries, before = one_pass(points, terms)
    if options.refine_points:
        (inverse_depth,) = view_terms(layout, frames, points, lambda views: [views.projected().inverse_depth])
        home = Home.of(layout, points, inverse_depth)
        refined, costs = refine_points(layout, frames, points, options.loss, options.refine_points, home)
        costs = jnp.where(partition.separator, costs, before)
        return jnp.where(partition.separator, refined, points), total(costs)
    matrix = entries[:6]
    for place in (0, 2, 5):
        matrix[place] = matrix[place] + damping_diagonal(matrix[place], damping, options)
    factor = cholesky3(matrix)
    step = jnp.stack(factor.backward(factor.forward(entries[6:])))
    trial = points - jnp.where(partition.separator, step, 0)
    costs = one_pass(trial, terms)[9]
    better = costs < before
    return jnp.where(better, trial, points), total(jnp.where(better, costs, before))
