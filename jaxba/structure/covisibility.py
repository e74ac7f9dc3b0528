"""Which pairs of observations multiply into which block of the reduced camera system.

Observations are named by their place in the order of the cameras (structure/layout.py): a block reads two short
stretches of memory then, where its observations would be scattered over all slots.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxba.structure.camera_ordering import MIN_BAND_CAMERAS, Band, band_of, camera_order, is_banded
from jaxba.structure.padding import Capacity, room_for
from jaxba.structure.sum_trees import TREE_WIDTH, Room, chunks_at_most, sorted_by, sum_tree
from jaxba.typing import AnyArray, register_pytree

PAIR_CHUNKS = (4, 8)
"""Candidate numbers of pairs multiplied at once for a block of the reduced camera system."""

PAIR_BATCH = 2048
"""Most chunks multiplied at once: bounds the gathered operands to 7 MB and the products to 1.3 MB, which stay in
cache."""

MOST_COUNTED = 1 << 18
"""Numbers of blocks, empty ones included, up to which pairs are counted for each: the counts stay in the cache."""

PAIR_ITEM_COST = 1.5
"""Cost of one partial 9 x 9 block, in pairs; decides between few long and many short chunks."""


@register_pytree
@dataclass(frozen=True)
class PairLayout:
    """Which observations multiply into which block of the reduced camera system (lower triangle)."""

    left: Int[AnyArray, "batches chunks width"]
    """Place of the view by the block row's camera."""

    right: Int[AnyArray, "batches chunks width"]
    """Place of the view of the same point by the block column's camera."""

    sums: Int[AnyArray, "batches partial width_of_sums"]
    """Chunks of the batch that are summed at once: those of one block. The last one of a batch is all padding."""

    levels: tuple[Int[AnyArray, "_ _"], ...]
    """Tree from the partial sums of all batches to blocks; the last block is always zero."""

    block_camera: Int[AnyArray, " blocks"]
    """Camera of a block on the diagonal; the number of cameras for the others."""

    block_row: Int[AnyArray, " blocks"]
    """Camera of a block's rows."""

    block_column: Int[AnyArray, " blocks"]
    """Camera of a block's columns."""

    product_levels: tuple[Int[AnyArray, "_ _"], ...]
    """Tree to cameras from the products of blocks with their columns, then of mirrored blocks with their rows."""

    diagonal: Int[AnyArray, " cameras"]
    """Number of each camera's block on the diagonal."""

    table: Int[AnyArray, "cameras cameras"] | None
    """Block number of (row, column) in the lower triangle, the zero block elsewhere; for a dense factorisation."""

    band: Band | None
    """Where a band is factored instead."""


def pair_layout(
    camera: np.ndarray,
    place: np.ndarray,
    tracks: np.ndarray,
    start: np.ndarray,
    cameras: int,
    empty: int,
    *,
    factor: bool,
    banded: bool = True,
    capacity: Capacity | None = None,
) -> PairLayout:
    """Lists all pairs of observations of one point, sorted by the block they add to.

    Args:
        camera: of each observation; those of one point stand together.
        place: of each observation among the rows that are to be multiplied.
        tracks: observations of each point.
        start: number of each point's first observation.
        cameras: number of cameras.
        empty: a place whose row is zero.
        factor: whether the system will be factored.
        banded: whether it may be factored as a band, where that is cheaper.
        capacity: makes all shapes follow from it: every block of the lower triangle is there, and no band.
    """
    camera, place = camera.astype(np.int32), place.astype(np.int32)
    left, right = _pairs_of_tracks(tracks, start)
    rows, columns = camera[left], camera[right]
    # a camera that sees a point twice: both orders add to the same diagonal block
    twice = np.flatnonzero(rows == columns)
    twice = twice[left[twice] != right[twice]]
    if twice.size:
        left, right = np.concatenate([left, right[twice]]), np.concatenate([right, left[twice]])
        rows, columns = np.concatenate([rows, columns[twice]]), np.concatenate([columns, rows[twice]])
    rank, reach = np.arange(cameras), cameras
    if capacity is None and factor and banded and cameras >= MIN_BAND_CAMERAS:
        there = np.zeros((cameras, cameras), bool)
        there[rows, columns] = True
        row, column = np.nonzero(there)
        rank, reach = camera_order(row, column, cameras)
    banded = banded and is_banded(cameras, reach)
    if banded:  # from here on cameras go by their rank, and the lower triangle is that of the ranks
        ranks = rank.astype(np.int32)
        rows, columns = ranks[rows], ranks[columns]
        swap = rows < columns
        left, right = np.where(swap, right, left), np.where(swap, left, right)
        rows, columns = np.maximum(rows, columns), np.minimum(rows, columns)
    else:
        rank = np.arange(cameras)
    blocks = _Blocks.of(rows, columns, cameras)
    if capacity is not None:
        blocks = blocks.with_all(cameras)
    names, counts, order = blocks
    diagonal = np.arange(cameras, dtype=np.int64) * (cameras + 1)
    room = None if capacity is None else room_for(counts, capacity.pairs, capacity.points)
    number_of = lambda w: int((-(-counts // w)).sum()) if room is None else chunks_at_most(room.items, len(names), w)
    width = min(PAIR_CHUNKS, key=lambda w: number_of(w) * (w + PAIR_ITEM_COST))
    width = max(1, min(width, int(counts.max()) if room is None else room.most))
    chunks = -(-counts // width)
    # where each pair goes, in the order of the blocks: those of a block stand together, and begin a row
    shift = width * (np.cumsum(chunks) - chunks) - (np.cumsum(counts) - counts)
    position = np.repeat(shift.astype(np.int32), counts) + np.arange(len(left), dtype=np.int32)
    most = int(chunks.sum()) if room is None else number_of(width)  # chunks for which there is room
    batches = max(1, -(-most // (PAIR_BATCH - 1)))
    batch = max(1, -(-most // batches))  # chunks of a batch; one more is all padding
    position += position // (width * batch) * width
    padded = []
    for side in (left, right):
        array = np.full(batches * (batch + 1) * width, empty, np.int32)
        array[position] = place[side[order]]
        padded.append(array.reshape(batches, batch + 1, width))
    sums, levels = _batch_sums(chunks, batches, batch, None if room is None else -(-room.most // width))
    table = None
    if factor and not banded:
        table = np.full(cameras * cameras, len(names), np.int32)
        table[names] = np.arange(len(names))
        table = table.reshape(cameras, cameras)
    by_rank = np.argsort(rank)
    on_diagonal = np.searchsorted(names, diagonal)[rank]
    block_camera = np.full(len(names) + 1, cameras, np.int32)
    block_camera[on_diagonal] = np.arange(cameras)
    block_row, block_column = (np.append(by_rank[part], 0).astype(np.int32) for part in np.divmod(names, cameras))
    mirrored = np.flatnonzero(block_row[:-1] != block_column[:-1])
    targets = np.concatenate([block_row[:-1], block_column[mirrored]])
    items = np.concatenate([np.arange(len(names)), len(names) + 1 + mirrored])
    by_target = np.argsort(targets, kind="stable")
    return PairLayout(
        left=padded[0],
        right=padded[1],
        sums=sums,
        levels=levels,
        block_camera=block_camera,
        block_row=block_row,
        block_column=block_column,
        product_levels=sum_tree(items[by_target], np.bincount(targets, minlength=cameras), len(names), TREE_WIDTH),
        diagonal=on_diagonal.astype(np.int32),
        table=table,
        band=band_of(names, rank, reach) if banded else None,
    )


def _pairs_of_tracks(
    tracks: Int[np.ndarray, " points"], start: Int[np.ndarray, " starts"]
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """All pairs of observations of one point, the later or same one first; points of equal track length together."""
    lengths = np.bincount(tracks)
    total = int(lengths @ (np.arange(len(lengths)) * np.arange(1, len(lengths) + 1) // 2))
    left, right = np.empty(total, np.int32), np.empty(total, np.int32)
    first, point, pair = start[sorted_by(tracks, len(lengths))].astype(np.int32), int(lengths[0]), 0
    for length in np.flatnonzero(lengths[1:]) + 1:
        count = np.arange(1, length + 1, dtype=np.int32)
        later = np.repeat(count - 1, count)
        earlier = np.arange(len(later), dtype=np.int32) - np.repeat(np.cumsum(count, dtype=np.int32) - count, count)
        own = first[point : point + lengths[length], None]
        shape, end = (len(own), len(later)), pair + len(own) * len(later)
        np.add(own, later, out=left[pair:end].reshape(shape))
        np.add(own, earlier, out=right[pair:end].reshape(shape))
        point, pair = point + len(own), end
    return left, right


def _batch_sums(
    chunks: Int[np.ndarray, " blocks"], batches: int, batch: int, most: int | None
) -> tuple[Int[np.ndarray, "batches partial width"], tuple[Int[np.ndarray, "_ _"], ...]]:
    """What is summed within each batch, and the tree from there to the blocks and one more that is empty.

    Args:
        chunks: of each block, one block after the other.
        batches: number of batches.
        batch: chunks of each.
        most: chunks of a block at most, where all shapes are to follow from that and the numbers above; else None.
    """
    block = np.repeat(np.arange(len(chunks)), chunks)
    home, place = np.divmod(np.arange(len(block)), batch)
    run = (np.diff(block, prepend=-1) != 0) | (place == 0)  # chunks of one block within one batch begin here
    within = _since(run)
    begins = within % TREE_WIDTH == 0
    owner, target = home[begins], block[begins]  # of each partial sum
    counts = np.bincount(owner, minlength=batches)
    partial = int(counts.max()) if most is None else chunks_at_most(batch, len(chunks), TREE_WIDTH)
    number = _since(np.diff(owner, prepend=-1) != 0)
    sums = np.full((batches, partial + 1, TREE_WIDTH), batch, np.int32)
    sums[home, number[np.cumsum(begins) - 1], within % TREE_WIDTH] = place
    room = None
    if most is not None:
        touched = min(batches, (most - 1) // batch + 2)  # batches among which the chunks of one block can be
        room = Room(batches * partial, chunks_at_most(most, touched, TREE_WIDTH))
    counts = np.bincount(target, minlength=len(chunks) + 1)
    return sums, sum_tree(owner * (partial + 1) + number, counts, batches * (partial + 1) - 1, TREE_WIDTH, room)


def _since(marks: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """How many places each one is past the last mark; the first is marked."""
    first = np.flatnonzero(marks)
    return np.arange(len(marks)) - np.repeat(first, np.diff(first, append=len(marks)))


class _Blocks(NamedTuple):
    """Which blocks of the lower triangle there are, and which pairs add to them."""

    names: Int[np.ndarray, " blocks"]
    """`row * cameras + column`, sorted; all on the diagonal are there."""

    counts: Int[np.ndarray, " blocks"]
    """Pairs of each."""

    order: Int[np.ndarray, " pairs"]
    """Pairs in the order of their blocks, and as they were given within one."""

    @classmethod
    def of(cls, rows: Int[np.ndarray, " pairs"], columns: Int[np.ndarray, " pairs"], cameras: int) -> _Blocks:
        """Sorts pairs by the block of each."""
        diagonal = np.arange(cameras, dtype=np.int64) * (cameras + 1)
        if cameras**2 <= MOST_COUNTED:
            keys = rows * np.int32(cameras) + columns
            counts = np.bincount(keys, minlength=cameras**2)
            listed = counts > 0
            listed[diagonal] = True
            names = np.flatnonzero(listed)
            return cls(names, counts[names], sorted_by(keys, cameras**2))
        # by column, then by row
        order = sorted_by(columns, cameras)
        order = order[sorted_by(rows[order], cameras)]
        names = rows[order].astype(np.int64) * cameras + columns[order]
        first = np.flatnonzero(np.diff(names, prepend=-1))
        counts = np.diff(first, append=len(names))
        return cls(names[first], counts, order).with_these(diagonal)

    def with_these(self, wanted: Int[np.ndarray, " more"]) -> _Blocks:
        """The same with further blocks, to which no pair adds."""
        names = np.union1d(self.names, wanted)
        counts = np.zeros(len(names), np.int64)
        counts[np.searchsorted(names, self.names)] = self.counts
        return self._replace(names=names, counts=counts)

    def with_all(self, cameras: int) -> _Blocks:
        """The same with every block of the lower triangle."""
        return self.with_these(np.ravel_multi_index(np.tril_indices(cameras), (cameras, cameras)))
