"""Assignment of observations to slots: buckets of points by track length, or a fixed number of slots.

The track length of a point is its number of observations. Slots of a bucket are arranged in tiles
(structure/layout.py).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxba.structure.padding import Capacity, room_for
from jaxba.structure.sum_trees import TREE_WIDTH, sum_tree

MAX_PADDING = 0.10
"""Largest number of empty slots relative to observations, besides one point of padding."""

TILE = 8
"""Points per tile of a large bucket, as many as the widest vector registers hold. A pass over the points reads one
memory stream per observation of a point; without tiles these are a whole bucket apart, too many for the prefetcher and
the TLB: a pass was measured to take twice as long."""

TILED_POINTS = 512
"""Smaller buckets are a single tile: they fit the cache, and need no padding to a multiple of `TILE`."""

_MAX_BUCKET_PADDING = (1 + MAX_PADDING) / (1 + (TILE - 1) / TILED_POINTS) - 1
"""The part of `MAX_PADDING` that is left, after padding to tiles, for different track lengths in one bucket."""

Bucket = tuple[int, int, int]
"""Number of tiles, slots per point, points per tile."""

PENALTY_FACTOR = 0.8
"""Factor between the penalties per bucket that are tried, until the padding is small enough."""

PENALTIES = 16
"""Number of penalties that are tried at once."""


class Slots(NamedTuple):
    """The assignment of observations, sorted by point, to slots."""

    slot: Int[np.ndarray, " observations"]
    """Slot of each observation."""

    point: Int[np.ndarray, " slots"]
    """Point of each slot in layout order, for empty slots too."""

    members: tuple[Int[np.ndarray, " _"], ...]
    """Index in the problem of the points in layout order, by bucket; padding points have an index out of range."""

    buckets: tuple[Bucket, ...]
    """Shape of each bucket; empty if points are summed by a tree."""

    levels: tuple[Int[np.ndarray, "_ _"], ...] | None
    """Summation tree from slots to points in layout order; None for buckets."""

    empty: int
    """An empty slot."""


def bucket_slots(tracks: Int[np.ndarray, " points"]) -> Slots:
    """Puts points of similar track length into buckets of shape `tiles x t x n`.

    Args:
        tracks: number of observations of each point; observations are sorted by point.
    """
    lengths = _bucket_lengths(tracks)
    which = np.searchsorted(lengths, tracks)
    column = np.zeros(len(tracks), np.int64)  # index of a point in its bucket
    bucket_points, slot_point, offsets, buckets = [], [], [], []
    slots = columns = 0
    for number, length in enumerate(lengths):
        members = np.flatnonzero((which == number) & (tracks > 0))
        column[members] = np.arange(len(members))
        wanted = len(members) + (number == 0)  # one padding point, so that there always is an empty slot
        tile = TILE if wanted >= TILED_POINTS else wanted
        tiles = -(-wanted // tile)
        if number == 0:
            empty = int(len(members) // tile * length * tile + len(members) % tile)
        padding = np.full(tiles * tile - len(members), len(tracks))
        bucket_points.append(np.concatenate([members, padding]).astype(np.int32))
        own = np.arange(columns, columns + tiles * tile, dtype=np.int32).reshape(tiles, 1, tile)
        slot_point.append(np.repeat(own, length, axis=1).ravel())
        offsets.append(slots)
        buckets.append((tiles, int(length), tile))
        slots += tiles * length * tile
        columns += tiles * tile
    tile = np.array([tile for _, _, tile in buckets])[which]
    before, within = np.divmod(column, tile)
    first = np.array(offsets)[which] + before * lengths[which] * tile + within  # slot of each point's first observation
    start = np.cumsum(tracks) - tracks
    return Slots(
        slot=np.repeat(first - start * tile, tracks) + np.arange(int(tracks.sum())) * np.repeat(tile, tracks),
        point=np.concatenate(slot_point),
        members=tuple(bucket_points),
        buckets=tuple(buckets),
        levels=None,
        empty=empty,
    )


def padded_slots(
    tracks: Int[np.ndarray, " points"], point: Int[np.ndarray, " observations"], capacity: Capacity
) -> Slots:
    """Observations in their order, then empty slots up to the capacity; likewise for the observed points.

    Args:
        tracks: number of observations of each point.
        point: point of each observation, sorted.
        capacity: sizes to pad to.
    """
    seen = np.flatnonzero(tracks)
    column = np.zeros(len(tracks), np.int32)
    column[seen] = np.arange(len(seen))
    members = np.full(capacity.points, capacity.points, np.int32)
    members[: len(seen)] = seen
    # empty slots belong to an observed point, whose block can be factored
    slot_point = np.zeros(capacity.observations, np.int32)
    slot_point[: len(point)] = column[point]
    slot, empty = np.arange(len(point)), capacity.observations - 1
    counts = np.zeros(capacity.points, np.int64)
    counts[: len(seen)] = tracks[seen]
    room = room_for(counts, capacity.observations, capacity.cameras)
    levels = sum_tree(slot, counts, empty, _first_width(room.most), room)
    return Slots(slot, slot_point, (members,), (), levels, empty)


def _first_width(most: int) -> int:
    """Chunk width of the first level, chosen for few levels: each has a row for every point."""
    if most <= TREE_WIDTH:
        return most
    return min(max(TREE_WIDTH // 2, -(-most // TREE_WIDTH)), 2 * TREE_WIDTH)


def _bucket_lengths(tracks: np.ndarray) -> np.ndarray:
    """Largest track length of each bucket, for few buckets with little padding.

    Every bucket adds to the size of the compiled program, so that their number is penalised: dynamic programming over
    the distinct lengths minimises `slots + penalty * buckets`, for penalties that are lowered until the padding is
    within `_MAX_BUCKET_PADDING`.
    """
    values, counts = np.unique(tracks[tracks > 0], return_counts=True)
    total = int(values @ counts)
    before = np.concatenate([[0], np.cumsum(counts)])
    # slots of a bucket, by its last and first length
    slots = values[:, None] * (before[1:, None] - before[:-1]).astype(float)
    penalties = total * _MAX_BUCKET_PADDING * PENALTY_FACTOR ** np.arange(PENALTIES)
    each = np.arange(PENALTIES)
    while True:
        best = np.zeros((PENALTIES, len(values) + 1))
        filled = np.zeros_like(best)  # slots alone, without penalties
        cut = np.zeros(best.shape, int)  # where the last bucket begins
        for end in range(1, len(values) + 1):
            cost = best[:, :end] + slots[end - 1, :end]
            cut[:, end] = begin = cost.argmin(axis=1)
            best[:, end] = cost[each, begin] + penalties
            filled[:, end] = filled[each, begin] + slots[end - 1, begin]
        enough = np.flatnonzero(filled[:, -1] <= (1 + _MAX_BUCKET_PADDING) * total)
        if not len(enough):
            penalties *= PENALTY_FACTOR**PENALTIES
            continue
        ends, end = [], len(values)
        while end:
            ends.append(end - 1)
            end = cut[enough[0], end]
        return values[ends[::-1]]
