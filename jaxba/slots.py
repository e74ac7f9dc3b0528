"""Which slot holds which observation: buckets by track length, or one row of slots of a given size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxba.padding import Capacity, room_for
from jaxba.trees import TREE_WIDTH, sum_tree

MAX_PADDING = 0.10
"""Largest share of slots that may be empty because track lengths share a bucket (design, section 3)."""

CHEAPER = 0.8
"""Factor on the price of a bucket while more than that is empty."""


class Slots(NamedTuple):
    """Where the observations of a layout are; they are sorted by point."""

    slot: Int[np.ndarray, " observations"]
    """Slot of each observation."""

    point: Int[np.ndarray, " slots"]
    """Column of the point of each slot, empty ones included."""

    members: tuple[Int[np.ndarray, " _"], ...]
    """Problem index of the point of each column, by bucket; padding repeats an index out of range."""

    buckets: tuple[tuple[int, int], ...]
    """(slots per point, points) of each bucket; none where points are summed by a tree."""

    levels: tuple[Int[np.ndarray, "_ _"], ...] | None
    """Tree from slots to columns; None where there are buckets."""

    empty: int
    """A slot without observation."""


def bucket_slots(tracks: Int[np.ndarray, " points"], point: Int[np.ndarray, " observations"]) -> Slots:
    """Puts points of similar track length into buckets of `t x n` slots.

    Args:
        tracks: observations of each point.
        point: of each observation, sorted.
    """
    start = np.concatenate([[0], np.cumsum(tracks)])
    lengths = _bucket_lengths(tracks)
    which = np.searchsorted(lengths, tracks)
    column = np.zeros(len(tracks), np.int64)  # column of a point in its bucket
    bucket_points, offsets, columns_before = [], [], []
    slots = columns = 0
    for number, length in enumerate(lengths):
        members = np.flatnonzero((which == number) & (tracks > 0))
        column[members] = np.arange(len(members))
        if number == 0:  # one empty point, so that there always is an empty slot
            members = np.append(members, len(tracks))
        bucket_points.append(members.astype(np.int32))
        offsets.append(slots)
        columns_before.append(columns)
        slots += length * len(members)
        columns += len(members)
    size = np.array([len(members) for members in bucket_points])
    step = np.arange(len(point)) - start[point]
    slot_point = np.concatenate(
        [
            np.tile(np.arange(len(members), dtype=np.int32) + before, length)
            for members, length, before in zip(bucket_points, lengths, columns_before, strict=True)
        ]
    )
    return Slots(
        slot=np.array(offsets)[which[point]] + step * size[which[point]] + column[point],
        point=slot_point,
        members=tuple(bucket_points),
        buckets=tuple((int(length), len(members)) for length, members in zip(lengths, bucket_points, strict=True)),
        levels=None,
        empty=int(len(bucket_points[0]) - 1),  # the first bucket's empty point
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
    below `MAX_PADDING`: every bucket is a part of the program, and costs time to compile.
    """
    values, counts = np.unique(tracks[tracks > 0], return_counts=True)
    total = int(values @ counts)
    before = np.concatenate([[0], np.cumsum(counts)])
    price = total * MAX_PADDING
    while True:
        best = np.zeros(len(values) + 1)
        cut = np.zeros(len(values) + 1, int)
        for end in range(1, len(values) + 1):
            cost = best[:end] + values[end - 1] * (before[end] - before[:end]) + price
            cut[end] = np.argmin(cost)
            best[end] = cost[cut[end]]
        ends, end = [], len(values)
        while end:
            ends.append(end - 1)
            end = cut[end]
        if best[-1] - price * len(ends) <= (1 + MAX_PADDING) * total:
            return values[ends[::-1]]
        price *= CHEAPER
