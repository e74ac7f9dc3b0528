"""Index arrays that turn a sum over many rows into a few dense ones."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from scipy.sparse import csr_matrix

TREE_WIDTH = 8
"""Partial sums added at once on the higher levels of a tree."""


class Room(NamedTuple):
    """What a tree has room for, so that its shape does not depend on what it sums."""

    items: int
    """Most items of all targets together."""

    most: int
    """Most items of one target."""


def sum_tree(
    items: np.ndarray, counts: np.ndarray, empty: int, width: int, room: Room | None = None
) -> tuple[np.ndarray, ...]:
    """Index arrays that sum `items` into targets, `width` at a time, then `TREE_WIDTH` at a time.

    Args:
        items: row numbers, those of target 0 first, then those of target 1, ...
        counts: number of items of each target; zero is allowed.
        empty: a row that is known to be zero, for padding.
        width: items summed at once on the first level.
        room: makes the shapes follow from itself, the number of targets and the width alone.

    Returns:
        Arrays [targets, width]; level l + 1 indexes the sums of level l. Every level but the last ends with
        an all-padding row; the last has exactly one row a target, in order.

    Raises:
        ValueError: there is no room for the items.
    """
    levels = []
    space, most = room or Room(len(items), int(counts.max(initial=1)))
    if len(items) > space or counts.max(initial=0) > most:
        raise ValueError(f"no room for {len(items)} items, {counts.max(initial=0)} of one target, in {room}")
    while True:
        width = max(1, min(width, most))
        chunks = -(-counts // width)
        used, last = int(chunks.sum()), most <= width
        space = used if room is None else chunks_at_most(space, len(counts), width)
        rows = np.arange(len(counts)) if last else np.cumsum(chunks) - chunks
        total = len(counts) if last else space + 1
        target = np.repeat(np.arange(len(counts)), counts)
        rank = np.arange(len(items)) - np.repeat(np.cumsum(counts) - counts, counts)
        level = np.full((total, width), empty, np.int32)
        level[rows[target] + rank // width, rank % width] = items
        levels.append(level)
        if last:
            return tuple(levels)
        items, counts, empty = np.arange(used), chunks, total - 1
        most, width = -(-most // width), TREE_WIDTH


def sorted_by(keys: Int[np.ndarray, " n"], most: int) -> Int[np.ndarray, " n"]:
    """A stable `argsort` of numbers below `most`, in linear time: by counting, as a sparse matrix is transposed."""
    ones = np.ones(len(keys), np.int8)
    rows = csr_matrix((ones, keys, np.arange(len(keys) + 1, dtype=np.int32)), shape=(len(keys), most))
    return rows.tocsc().indices


def with_spare_row(levels: tuple[np.ndarray, ...], empty: int) -> tuple[np.ndarray, ...]:
    """The same tree with a row that is all padding on its first level; only a tree of one level may be without."""
    level, *others = levels
    if others:
        return levels
    spare = np.full((1, level.shape[1]), empty, np.int32)
    return np.concatenate([level, spare]), np.arange(len(level), dtype=np.int32)[:, None]


def fitting_width(counts: np.ndarray) -> int:
    """Items summed at once on the first level, so that least is read where most targets have few: padding counts."""
    return min(range(2, TREE_WIDTH + 1), key=lambda width: int((-(-counts // width)).sum()) * (width + 1))


def chunks_at_most(items: int, targets: int, width: int) -> int:
    """Most chunks of a width that items make, however they belong to targets: the sum of `ceil(count / width)`."""
    return min(items, (items + targets * (width - 1)) // width)
