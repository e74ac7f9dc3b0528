"""Assignment of observations to slots: buckets of points by track length, or chunks of a fixed
capacity.

The track length of a point is its number of observations. Slots of a bucket are arranged in tiles
(structure/layout.py)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxba.structure.agreement import ALONE, Agreement
from jaxba.structure.padding import POINT_CHUNK, Capacity, room_for
from jaxba.structure.sum_trees import prefix_levels

# largest number of empty slots relative to observations, besides one point of padding
MAX_PADDING = 0.10

TILE = 8
"""Points per tile of a large bucket, as many as the widest vector registers hold. Without tiles a
pass took twice as long: it reads a memory stream per observation of a point, a whole bucket apart,
too many for prefetcher and TLB."""

# smaller buckets are a single tile: they fit the cache, and need no padding to a multiple of `TILE`
TILED_POINTS = 512
# what padding to tiles leaves
_MAX_BUCKET_PADDING = (1 + MAX_PADDING) / (1 + (TILE - 1) / TILED_POINTS) - 1
Bucket = tuple[int, int, int]  # number of tiles, slots per point, points per tile
# factor between the penalties per bucket that are tried, until the padding is small enough
PENALTY_FACTOR = 0.8
PENALTIES = 16  # number of penalties that are tried at once


class Slots(NamedTuple):
    """The assignment of observations, sorted by point, to slots."""

    slot: Int[np.ndarray, " observations"]  # of each observation
    point: Int[np.ndarray, " slots"]  # of each slot in layout order, for empty slots too
    points: Int[np.ndarray, " points"]  # see `Layout.points`
    buckets: tuple[Bucket, ...]  # see `Layout.buckets`
    levels: tuple[Int[np.ndarray, "_ _"], ...] | None  # see `Layout.point_levels`
    empty: int  # an empty slot


def bucket_slots(tracks: Int[np.ndarray, " points"], agreement: Agreement = ALONE) -> Slots:
    """Puts points of similar track length into buckets of shape `tiles x t x n`. Observations are
    sorted by point, and `tracks` are their numbers. The other shards of a problem (`agreement`)
    have the same buckets."""
    values = agreement.union("track lengths", 1 + np.flatnonzero(np.bincount(tracks)[1:]))
    own = np.bincount(tracks, minlength=int(values.max(initial=0)) + 1)[values]
    counts = np.array(
        [
            agreement.size(f"points of {length}", int(n))
            for length, n in zip(values, own, strict=True)
        ]
    )
    lengths = _bucket_lengths(values, counts)
    which = np.searchsorted(lengths, tracks)
    column = np.zeros(len(tracks), np.int64)  # index of a point in its bucket
    bucket_points = []
    slot_point = []
    offsets = []
    buckets = []
    slots = columns = 0
    for number, length in enumerate(lengths):
        members = np.flatnonzero((which == number) & (tracks > 0))
        column[members] = np.arange(len(members))
        wanted = max(1, agreement.size(f"bucket {number}", len(members)))
        wanted += number == 0  # one padding point, so that there always is an empty slot
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
    # slot of each point's first observation
    first = np.array(offsets)[which] + before * lengths[which] * tile + within
    start = np.cumsum(tracks) - tracks
    return Slots(
        slot=np.repeat(first - start * tile, tracks)
        + np.arange(int(tracks.sum())) * np.repeat(tile, tracks),
        point=np.concatenate(slot_point),
        points=np.concatenate(bucket_points),
        buckets=tuple(buckets),
        levels=None,
        empty=empty,
    )


def padded_slots(tracks: Int[np.ndarray, " points"], capacity: Capacity) -> Slots:
    """Puts points by descending track length into chunks of `POINT_CHUNK` slots, up to the
    capacity.

    The c-th chunk has slots c, c + chunks, ..., so that the sums of all chunks are dense. First
    come the first chunks of all points, then the second chunks of those that have one, and so on.
    Observations are sorted by point, and `tracks` are their numbers."""
    order = np.argsort(-tracks, kind="stable")[: np.count_nonzero(tracks)]
    members = np.full(capacity.points, capacity.points, np.int32)
    members[: len(order)] = order
    counts = -(-tracks[order] // POINT_CHUNK)
    column = np.arange(counts.sum())
    rank = column - np.repeat(np.cumsum(counts) - counts, counts)
    of_point = np.repeat(np.arange(len(order)), counts)  # sorted by point
    before = np.cumsum(np.bincount(rank)) - np.bincount(rank)  # chunks of lower ranks
    chunk = before[rank] + of_point
    chunks = capacity.observations // POINT_CHUNK
    # empty slots belong to an observed point, whose block can be factored
    chunk_point = np.zeros(chunks, np.int32)
    chunk_point[chunk] = of_point
    first = np.zeros(len(tracks), np.int64)  # position of each point's first chunk in `chunk`
    first[order] = np.cumsum(counts) - counts
    start = np.cumsum(tracks) - tracks
    within = np.arange(int(tracks.sum())) - np.repeat(start, tracks)
    at, row = np.divmod(within, POINT_CHUNK)
    all_counts = np.zeros(capacity.points, np.int64)
    all_counts[: len(order)] = counts
    room = room_for(all_counts, chunks, -(-capacity.cameras // POINT_CHUNK))
    return Slots(
        slot=row * chunks + chunk[np.repeat(first, tracks) + at],
        point=np.tile(chunk_point, POINT_CHUNK),
        points=members,
        buckets=(),
        levels=prefix_levels(chunk, all_counts, chunks - 1, room, first=1, loosest=capacity.fixed),
        empty=chunks - 1,
    )


def _bucket_lengths(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Largest track length of each bucket, for few buckets with little padding; from track lengths,
    ascending, and the number of points of each.

    Every bucket adds to the size of the compiled program, so that their number is penalised:
    dynamic programming over the distinct lengths minimises `slots + penalty * buckets`, for
    penalties that are lowered until the padding is within `_MAX_BUCKET_PADDING`."""
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
        ends = []
        end = len(values)
        while end:
            ends.append(end - 1)
            end = cut[enough[0], end]
        return values[ends[::-1]]
