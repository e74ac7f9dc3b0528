"""Summation trees: index arrays that sum rows into targets by a few gathers and dense sums, without
scatter.

Level by level, rows of one target are summed in chunks of fixed width; the partial sums are the
rows of the next level. The sums themselves are computed by `segment_sums.tree_sum`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxba.structure.agreement import ALONE, Agreement

TREE_WIDTH = 8  # width of the chunks on all levels but the first


class Room(NamedTuple):
    """Upper bounds from which the shapes of a tree follow, so that they do not depend on the
    data."""

    items: int  # largest number of items of all targets together
    most: int  # largest number of items of one target
    # whether these are the numbers of the data themselves, so that shapes depend on them
    exact: bool = False

    @classmethod
    def of(cls, counts: Int[np.ndarray, " targets"]) -> Room:
        """Exactly that of targets with so many items."""
        return cls(int(counts.sum()), int(counts.max(initial=1)), exact=True)

    def chunks(self, items: int, counts: Int[np.ndarray, " targets"], width: int) -> int:
        """The chunks of targets with so many items or, unless exact, room for any numbers of at
        most `items` in all."""
        return (
            int((-(-counts // width)).sum())
            if self.exact
            else chunks_at_most(items, len(counts), width)
        )


def sum_tree(
    items: np.ndarray,
    counts: np.ndarray,
    empty: int,
    width: int,
    room: Room | None = None,
    agreement: Agreement = ALONE,
) -> tuple[np.ndarray, ...]:
    """The summation tree of `items`, with chunks of `width` on the first level and of `TREE_WIDTH`
    on the others. Returns index arrays [chunks, width], one per level; those of level l + 1 index
    the sums of level l. Every level but the last ends with a row of padding; the last one has
    exactly one row per target, in order. Raises ValueError: the items exceed the room.

    Args:
        items: row indices, those of target 0 first, then those of target 1, ...
        counts: number of items of each target; may be zero.
        empty: index of a row of zeros, for padding.
        width: chunk width on the first level.
        room: bounds from which the shapes follow, together with the number of targets and the
            width; None: the shapes follow from the data.
        agreement: with the trees of other shards, which have the same shapes."""
    levels = []
    room = room or Room.of(counts)
    space, most, _ = room
    if len(items) > space or counts.max(initial=0) > most:
        raise ValueError(
            f"no room for {len(items)} items, {counts.max(initial=0)} of one target, in {room}"
        )
    most = agreement.size("most", most)
    while True:
        width = max(1, min(width, most))
        chunks = -(-counts // width)
        last = most <= width
        space = room.chunks(space, counts, width)
        space = agreement.size(f"level {len(levels)}", space)
        rows = np.arange(len(counts)) if last else np.cumsum(chunks) - chunks
        total = len(counts) if last else space + 1
        target = np.repeat(np.arange(len(counts)), counts)
        rank = np.arange(len(items)) - np.repeat(np.cumsum(counts) - counts, counts)
        level = np.full((total, width), empty, np.int32)
        level[rows[target] + rank // width, rank % width] = items
        levels.append(level)
        if last:
            return tuple(levels)
        items = np.arange(int(chunks.sum()))
        counts = chunks
        empty = total - 1
        most = -(-most // width)
        width = TREE_WIDTH


# most targets that have an item of a rank, relative to all items; the last suffices always
PREFIX_SHARES = (
    lambda rank: min(1 / (2 * rank + 2), 1 / rank**2) if rank > 1 else 1 / (rank + 1),
    lambda rank: 1 / (2 * rank + 2) if rank > 1 else 1 / (rank + 1),
    lambda rank: 1 / (rank + 1),
)


def prefix_levels(
    items: np.ndarray,
    counts: np.ndarray,
    empty: int,
    room: Room,
    first: int = 0,
    *,
    tightest: int = 0,
    loosest: bool = False,
) -> tuple[Int[np.ndarray, "_ _"], ...]:
    """Index arrays that sum the items of targets with descending counts: rank by rank, over
    prefixes of the targets.

    The targets that have an r-th item are a prefix of the targets. A level holds ranks r, r + 1,
    ..., 2 r - 1, a row each, for the prefix of rank r. The lengths of prefixes follow from the
    room, by the first of `PREFIX_SHARES` that suffices. Raises ValueError: the items exceed the
    room.

    Args:
        items: row indices, those of target 0 first, then those of target 1, ...
        counts: number of items of each target, in descending order.
        empty: index of a row of zeros, for padding.
        room: bounds from which the shapes follow, together with the number of targets.
        first: first rank that is listed. Rank 0 is listed for all targets.
        tightest: number of the first of `PREFIX_SHARES` that is tried.
        loosest: whether it is the last one in any case."""
    if len(items) > room.items or counts.max(initial=0) > room.most:
        raise ValueError(
            f"no room for {len(items)} items, {counts.max(initial=0)} of one target, in {room}"
        )
    ranks = [first]
    while ranks[-1] < room.most:
        ranks.append(max(1, 2 * ranks[-1]))
    begins = ranks[:-1]
    ends = ranks[1:]
    present = [np.count_nonzero(counts > rank) for rank in begins]
    for share in PREFIX_SHARES[-1:] if loosest else PREFIX_SHARES[tightest:]:
        lengths = [
            min(len(counts), int(room.items * share(rank))) if rank else len(counts)
            for rank in begins
        ]
        if all(n <= length for n, length in zip(present, lengths, strict=True)):
            break
    start = np.cumsum(counts) - counts
    levels = []
    for begin, end, length in zip(begins, ends, lengths, strict=True):
        if not length:  # and so are all further ones
            break
        rank = np.arange(begin, end)[:, None]
        listed = rank < counts[:length]
        level = np.full(listed.shape, empty, np.int32)
        level[listed] = items[(start[:length] + rank)[listed]]
        levels.append(level)
    return tuple(levels)


def sorted_by(keys: Int[np.ndarray, " n"], most: int) -> Int[np.ndarray, " n"]:
    """Stable `argsort` of integers from 0 to below `most`.

    NumPy sorts 16 bits in linear time, by radix; larger keys are sorted together with their
    positions in one integer, for which its fastest sort need not be stable. Both take a tenth of
    the time of its stable sort of 32 bits."""
    if most <= 1 << 16:
        return np.argsort(keys.astype(np.uint16), kind="stable").astype(np.int32)
    bits = len(keys).bit_length()
    pairs = (keys.astype(np.int64) << bits) | np.arange(len(keys))
    pairs.sort()
    return (pairs & ((1 << bits) - 1)).astype(np.int32)


def with_spare_row(levels: tuple[np.ndarray, ...], empty: int) -> tuple[np.ndarray, ...]:
    """The same tree, with a row of padding on its first level. Only a tree of one level may lack
    it."""
    level, *others = levels
    if others:
        return levels
    spare = np.full((1, level.shape[1]), empty, np.int32)
    return np.concatenate([level, spare]), np.arange(len(level), dtype=np.int32)[:, None]


def fitting_width(counts: np.ndarray) -> int:
    """The chunk width of the first level that reads the fewest rows, padding included."""
    return min(
        range(2, TREE_WIDTH + 1), key=lambda width: int((-(-counts // width)).sum()) * (width + 1)
    )


def chunks_at_most(items: int, targets: int, width: int) -> int:
    """Upper bound on the number of chunks, `sum ceil(count / width)`, for any distribution of items
    over targets."""
    return min(items, (items + targets * (width - 1)) // width)
