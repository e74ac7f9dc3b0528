"""Index arrays that turn a sum over many rows into a few dense ones."""

from __future__ import annotations

import numpy as np

TREE_WIDTH = 8
"""Partial sums added at once on the higher levels of a tree."""


def sum_tree(items: np.ndarray, counts: np.ndarray, empty: int, width: int) -> tuple[np.ndarray, ...]:
    """Index arrays that sum `items` into targets, `width` at a time, then `TREE_WIDTH` at a time.

    Args:
        items: row numbers, those of target 0 first, then those of target 1, ...
        counts: number of items of each target; zero is allowed.
        empty: a row that is known to be zero, for padding.
        width: items summed at once on the first level.

    Returns:
        Arrays [targets, width]; level l + 1 indexes the sums of level l. Every level but the last ends with
        an all-padding row; the last has exactly one row a target, in order.
    """
    levels = []
    while True:
        width = max(1, min(width, int(counts.max(initial=1))))
        chunks = -(-counts // width)
        last = bool((chunks <= 1).all())
        rows = np.arange(len(counts)) if last else np.cumsum(chunks) - chunks
        total = len(counts) if last else int(chunks.sum()) + 1
        target = np.repeat(np.arange(len(counts)), counts)
        rank = np.arange(len(items)) - np.repeat(np.cumsum(counts) - counts, counts)
        level = np.full((total, width), empty, np.int32)
        level[rows[target] + rank // width, rank % width] = items
        levels.append(level)
        if last:
            return tuple(levels)
        items, counts, empty, width = np.arange(total - 1), chunks, total - 1, TREE_WIDTH
