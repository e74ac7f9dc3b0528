"""A problem divided among devices: layouts of its shards that have equal shapes.

Points are dealt to the shards by descending track length, so that each has nearly the same number of points of every
length, and of observations. Sizes of arrays and lists of blocks must be the same in all shards; they follow from data,
so that layouts are built again with what was found (`Agreement`), until nothing changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.structure.agreement import Agreement
from jaxba.structure.devices import AXIS
from jaxba.structure.layout import Layout, layout_for

MAX_ROUNDS = 8
"""Most times that layouts are built until they agree; three or four suffice."""


def deal_points(tracks: Int[np.ndarray, " points"], shards: int) -> list[Int[np.ndarray, " _"]]:
    """The observed points of each shard, ascending: dealt by track length, forwards and backwards in turns."""
    order = np.argsort(-tracks, kind="stable")[: np.count_nonzero(tracks)]
    turn, position = np.divmod(np.arange(len(order)), shards)
    shard = np.where(turn % 2 == 0, position, shards - 1 - position)
    return [np.sort(order[shard == number]) for number in range(shards)]


def shard_of(problem: BundleProblem, points: Int[np.ndarray, " kept"]) -> BundleProblem:
    """The problem with all cameras and these points, ascending, and their observations."""
    own = np.zeros(problem.num_points, bool)
    own[points] = True
    return problem.subset(own[problem.point_index], points=points)


def sharded_layout(
    shards: list[BundleProblem], options: StepOptions, merge: Callable[[list[dict]], list[dict]] = lambda found: found
) -> list[Layout]:
    """The layouts of shards, of equal shapes.

    Args:
        shards: of one problem, `in_frames` if it has rigs.
        options: of the step.
        merge: from what was found here to what was found in all processes.
    """
    known: dict[str, Any] = {}
    for _ in range(MAX_ROUNDS):
        agreements = [Agreement(known) for _ in shards]
        layouts = [layout_for(shard, options, agreement=one) for shard, one in zip(shards, agreements, strict=True)]
        found = Agreement.merged(merge([one.found for one in agreements]))
        if Agreement.same(found, known):
            return [replace(layout, axis=AXIS) for layout in layouts]
        known = found
    raise RuntimeError("the layouts of shards do not agree")
