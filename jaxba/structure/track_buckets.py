"""Which slot holds which observation: buckets by track length, cut into tiles, or one row of slots of a given size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxba.structure.padding import Capacity, room_for
from jaxba.structure.sum_trees import TREE_WIDTH, sum_tree

MAX_PADDING = 0.10
"""Largest share of slots that may be empty (design, section 3); one point of padding is there besides."""

TILE = 8
"""Points whose slots stand together in a large bucket. A pass over a bucket's points reads as many places at once as
they have observations; where these are a whole bucket apart, neither the caches' prefetching nor their tables of pages
keep up: a pass took twice as long (docs/optimisations.md). As many numbers fit the widest vectors."""

TILED_POINTS = 512
"""Smaller buckets are one tile: what a pass over them reads is in the cache, and nothing is lost to rounding."""

_SHARED = (1 + MAX_PADDING) / (
    1 + (TILE - 1) / TILED_POINTS
) - 1  # what is left of it where track lengths share a bucket

Bucket = tuple[int, int, int]
"""Tiles, slots of a point, points of a tile."""

CHEAPER = 0.8
"""Factor on the price of a bucket while more than that is empty."""

PRICES = 16
"""Prices that are tried at once."""


class Slots(NamedTuple):
    """Where the observations of a layout are; they are sorted by point."""

    slot: Int[np.ndarray, " observations"]
    """Slot of each observation."""

    point: Int[np.ndarray, " slots"]
    """Column of the point of each slot, empty ones included."""

    members: tuple[Int[np.ndarray, " _"], ...]
    """Problem index of the point of each column, by bucket; padding repeats an index out of range."""

    buckets: tuple[Bucket, ...]
    """Empty where points are summed by a tree."""

    levels: tuple[Int[np.ndarray, "_ _"], ...] | None
    """Tree from slots to columns; None where there are buckets."""

    empty: int
    """A slot without observation."""


def bucket_slots(tracks: Int[np.ndarray, " points"]) -> Slots:
    """Puts points of similar track length into buckets of `tiles x t x n` slots.

    Args:
        tracks: observations of each point; they are sorted by point.
    """
    lengths = _bucket_lengths(tracks)
    which = np.searchsorted(lengths, tracks)
    column = np.zeros(len(tracks), np.int64)  # column of a point in its bucket
    bucket_points, slot_point, offsets, buckets = [], [], [], []
    slots = columns = 0
    for number, length in enumerate(lengths):
        members = np.flatnonzero((which == number) & (tracks > 0))
        column[members] = np.arange(len(members))
        wanted = len(members) + (number == 0)  # one empty point, so that there always is an empty slot
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
    before, place = np.divmod(column, tile)
    first = np.array(offsets)[which] + before * lengths[which] * tile + place  # slot of each point's first observation
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
    """Observations in their order, then empty slots up to the capacity; points that somebody observes likewise."""
    seen = np.flatnonzero(tracks)
    column = np.zeros(len(tracks), np.int32)
    column[seen] = np.arange(len(seen))
    members = np.full(capacity.points, capacity.points, np.int32)
    members[: len(seen)] = seen
    # empty slots belong to a point that is there, whose block can be factored
    slot_point = np.zeros(capacity.observations, np.int32)
    slot_point[: len(point)] = column[point]
    slot, empty = np.arange(len(point)), capacity.observations - 1
    counts = np.zeros(capacity.points, np.int64)
    counts[: len(seen)] = tracks[seen]
    room = room_for(counts, capacity.observations, capacity.cameras)
    levels = sum_tree(slot, counts, empty, _first_width(room.most), room)
    return Slots(slot, slot_point, (members,), (), levels, empty)


def _first_width(most: int) -> int:
    """Slots of a point summed at once: so few levels of the tree follow, all with a row for every point."""
    if most <= TREE_WIDTH:
        return most
    return min(max(TREE_WIDTH // 2, -(-most // TREE_WIDTH)), 2 * TREE_WIDTH)


def _bucket_lengths(tracks: np.ndarray) -> np.ndarray:
    """Largest track length of each bucket: few buckets with little padding.

    Dynamic programme over the distinct lengths. A bucket has a price, in slots, which is lowered until padding stays
    below the share: every bucket is a part of the program, and costs time to compile.
    """
    values, counts = np.unique(tracks[tracks > 0], return_counts=True)
    total = int(values @ counts)
    before = np.concatenate([[0], np.cumsum(counts)])
    slots = values[:, None] * (before[1:, None] - before[:-1]).astype(float)  # by the bucket's last and first length
    prices = total * _SHARED * CHEAPER ** np.arange(PRICES)
    each = np.arange(PRICES)
    while True:
        best = np.zeros((PRICES, len(values) + 1))
        filled = np.zeros_like(best)  # the same without prices
        cut = np.zeros(best.shape, int)  # where the last bucket begins
        for end in range(1, len(values) + 1):
            cost = best[:, :end] + slots[end - 1, :end]
            cut[:, end] = begin = cost.argmin(axis=1)
            best[:, end] = cost[each, begin] + prices
            filled[:, end] = filled[each, begin] + slots[end - 1, begin]
        enough = np.flatnonzero(filled[:, -1] <= (1 + _SHARED) * total)
        if not len(enough):
            prices *= CHEAPER**PRICES
            continue
        ends, end = [], len(values)
        while end:
            ends.append(end - 1)
            end = cut[enough[0], end]
        return values[ends[::-1]]
