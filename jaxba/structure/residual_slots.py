"""Rows of residuals as observations, so that everything that is summed over observations is summed
over them, too.

An observation has one camera and one point, and a slot for its two residuals (structure/layout.py).
A row of n numbers is laid out as n / 2 observations of its camera and its point, without pixels.
What a row lacks is made up for by zero columns: a row without a camera has some camera that sees
its point, one without a point has a new point of its own.

A row of two cameras is split by a variable v, for each pair of residuals a new point. With `r + a +
b` for the residual and its first-order changes by the two cameras,

    min_v  |sqrt(2) (r/2 + a + v)|^2 + |sqrt(2) (r/2 + b - v)|^2  =  |r + a + b|^2

so that eliminating v like any point gives the block of the two cameras. Damping also holds v, by
the share lambda. A row of two points is split in the same way by numbers of the pose of a new
camera."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.constants import Constants
from jaxba.problem.residuals import SECOND, Residuals, Rows
from jaxba.problem.row_owners import block_groups, owners_of
from jaxba.structure.agreement import Agreement
from jaxba.typing import AnyArray, ArrayRecord, register_pytree

NOWHERE = 2**30  # a slot out of range


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class ResidualSlots(ArrayRecord):
    """Rows of one residual in a layout."""

    rows: Rows  # the function and its data
    cameras: tuple[Int[AnyArray, " rows"], ...]  # one or two cameras of each row
    # one or two points of each row, in layout order; any if it takes none
    points: tuple[Int[AnyArray, " rows"], ...]
    # slots of each row: of each pair of numbers, and each of its one or two cameras or points; out
    # of range where there is none
    slots: Int[AnyArray, "pairs ends rows"]
    # for each unknown of the function first and last number of its block among a camera's
    # parameters; (0, 0) where it is no block
    places: tuple[tuple[int, int], ...] = field(metadata={"static": True})


def laid_out(problem: BundleProblem) -> BundleProblem:
    """A problem `in_frames` with its blocks after the numbers of cameras, and observations that
    stand for its residuals after those of pixels, with new points and cameras where they need them.
    Without residuals it is the problem itself. Raises ProblemError: see `owners_of`."""
    residuals = problem.residuals
    if not residuals:
        return problem
    camera = [np.asarray(problem.camera_index)]
    point = [np.asarray(problem.point_index)]
    observations = problem.num_observations
    points = problem.num_points
    cameras = problem.num_cameras
    found = []
    groups = block_groups(problem)
    sees = np.zeros(problem.num_points + 1, int)  # the last for no point
    sees[point[0]] = camera[0]
    for rows in residuals.rows:
        owners = owners_of(problem, rows, groups)
        pairs = -(-rows.size // 2)
        shape = (len(rows), pairs, max(len(owners.cameras), len(owners.points)))
        own = [np.where(c < 0, sees[p], c) for c, p in itertools.product(*owners)]
        at = [np.where(p < 0, points + np.arange(len(rows)), p) for p in owners.points]
        if len(owners.points) == 2:  # a camera for all numbers
            own = [cameras + np.arange(len(rows))] * 2
        at = np.stack(at, axis=1)[:, None]
        if len(owners.cameras) == 2:  # a point for each pair of numbers
            at = points + np.arange(len(rows) * pairs).reshape(-1, pairs, 1)
        own = np.stack(own, axis=1)[:, None]
        points, cameras = (
            max(x, int(y.max(initial=-1)) + 1) for x, y in ((points, at), (cameras, own))
        )
        camera.append(np.broadcast_to(own, shape).ravel())
        point.append(np.broadcast_to(at, shape).ravel())
        size = len(camera[-1])
        found.append(replace(rows, observation=observations + np.arange(size).reshape(shape)))
        observations += size
    more = observations - problem.num_observations
    extra = points - problem.num_points

    def rest(x, count):
        return np.concatenate(
            [np.asarray(x), np.zeros((count, *np.shape(x)[1:]), np.asarray(x).dtype)]
        )

    new = np.arange(cameras - problem.num_cameras)
    groups = [np.append(own, -cameras + new) for own in groups]
    # new ones have the lens of the first
    every = np.append(np.arange(problem.num_cameras), 0 * new)
    held = problem.constants
    rigs = problem.rigs
    pairs = zip(residuals.blocks, groups, strict=True)
    blocks = (
        np.where((own >= 0)[:, None], np.asarray(x)[np.maximum(own, 0)], 0.0) for x, own in pairs
    )
    if held is not None:
        held = Constants(rest(held.poses, len(new)), rest(held.points, extra))
    if rigs is not None:
        rigs = replace(
            rigs.of(every),
            frame=np.append(rigs.frame, np.max(rigs.frame) + 1 + new).astype(np.int32),
        )
    return problem.replace(
        cameras=np.hstack([np.asarray(problem.cameras)[every], *blocks]),
        points=rest(problem.points, extra),
        observations=rest(problem.observations, more),
        camera_index=np.concatenate(camera).astype(np.int32),
        point_index=np.concatenate(point).astype(np.int32),
        whitening=None if problem.whitening is None else rest(problem.whitening, more),
        lenses=None if problem.lenses is None else problem.lenses.of(every),
        constants=held,
        rigs=rigs,
        residuals=replace(residuals, rows=tuple(found), groups=tuple(groups)),
    )


def stands_for_rows(problem: BundleProblem) -> Bool[np.ndarray, " observations"]:
    """Which observations have no pixels, but stand for rows of residuals."""
    found = np.zeros(problem.num_observations, bool)
    for rows in problem.residuals.rows:
        found[rows.observation[rows.observation >= 0]] = True
    return found


def with_block_values(
    problem: BundleProblem, residuals: Residuals, values: Float[np.ndarray, "cameras numbers"]
) -> Residuals:
    """Residuals with the values of their blocks after a solve, from the numbers of cameras."""
    blocks = []
    start = 0
    for block, group in zip(residuals.blocks, block_groups(problem), strict=True):
        after = np.array(block)
        known = group >= 0
        after[group[known]] = values[known, start : start + block.shape[1]]
        blocks.append(after)
        start += block.shape[1]
    return replace(residuals, blocks=tuple(blocks))


def residual_slots(
    problem: BundleProblem,
    slot: Int[np.ndarray, " sorted"],
    sorted_observations: Int[np.ndarray, " sorted"],
    points: Int[np.ndarray, " points"],
    agreement: Agreement,
) -> tuple[ResidualSlots, ...]:
    """Rows of a problem that is `laid_out`. `slot` is that of each of the sorted observations,
    `sorted_observations` are their positions in the problem, `points` the points at each position
    in layout order, and `agreement` is that with the other shards of the problem."""
    residuals = problem.residuals
    if not residuals:
        return ()
    slot_of = np.zeros(len(slot), np.int32)
    slot_of[sorted_observations] = slot
    order = np.zeros(problem.num_points + 1, np.int32)
    order[np.minimum(points, problem.num_points)] = np.arange(len(points))
    ends = problem.cameras.shape[1] - sum(residuals.sizes) + np.cumsum([0, *residuals.sizes])
    places = {name: (int(ends[k]), int(ends[k + 1])) for k, name in enumerate(residuals.names)}
    found = []
    for number, rows in enumerate(residuals.rows):
        if len(rows.observation) != len(rows):
            raise ValueError("a problem with residuals is laid out by jaxba.prepare")
        kept = np.arange(agreement.size(f"rows {number}", len(rows)))
        lost = kept >= len(rows)
        rows = rows.of(np.where(lost, 0, kept))
        observation = np.where(lost[:, None, None], -1, rows.observation)
        own = np.where(observation < 0, NOWHERE, slot_of[observation]).astype(np.int32)
        # both ends of a row of two points have the same camera
        own_cameras = slice(2 if len(rows.points) == 1 else 1)
        camera = np.asarray(problem.camera_index)[observation.max(axis=1)[:, own_cameras]]
        found.append(
            ResidualSlots(
                rows=rows,
                cameras=tuple(camera.T),
                points=tuple(order[np.maximum(own, 0)] for own in rows.points),
                slots=np.moveaxis(own, 0, 2),
                places=tuple(
                    places.get(name.removesuffix(SECOND), (0, 0)) for name in rows.residual.unknowns
                ),
            )
        )
    return tuple(found)
