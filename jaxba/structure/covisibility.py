"""Co-visibility: the pairs of observations of one point that form each block of the reduced camera
system.

A pair of observations of one point by cameras j and k adds a product to block (j, k). Observations
are referred to by their camera-sorted index (structure/layout.py): a block then reads two short
ranges of memory, while its slots are scattered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from jaxba.structure.agreement import ALONE, Agreement
from jaxba.structure.camera_ordering import MIN_BAND_CAMERAS, Band, band_of, camera_order, is_banded
from jaxba.structure.padding import Capacity, room_for
from jaxba.structure.sum_trees import (
    TREE_WIDTH,
    Room,
    chunks_at_most,
    prefix_levels,
    sorted_by,
    sum_tree,
)
from jaxba.typing import AnyArray, register_pytree

# candidate chunk widths: pairs of one block that are multiplied and summed together
PAIR_CHUNKS = (4, 8)
# most chunks per batch: gathered operands of 7 MB and products of 1.3 MB stay in the cache
PAIR_BATCH = 2048
# cost of one partial 9 x 9 block in units of a pair, measured; it decides the chunk width
PAIR_ITEM_COST = 1.5


@register_pytree
@dataclass(frozen=True)
class PairLayout:
    """The pairs of observations of each block of the reduced camera system, lower triangle."""

    # camera-sorted index of the observation by the camera of the rows
    left: Int[AnyArray, "batches chunks width"]
    # the same of the same point by the camera of the block's columns
    right: Int[AnyArray, "batches chunks width"]
    # chunks of a batch that belong to one block and are summed together. The last row of a batch is
    # padding.
    sums: Int[AnyArray, "batches partial width_of_sums"]
    # summation tree from the partial sums of all batches to blocks; the last block is always zero.
    # With fixed capacity instead the ranks of partial sums that are added
    # (`sum_trees.prefix_levels`), and blocks are sorted by their number of partial sums.
    levels: tuple[Int[AnyArray, "_ _"], ...]
    # number of batches that hold pairs, with fixed capacity; None for all
    used: Int[AnyArray, ""] | None
    # camera of each diagonal block; the number of cameras for other blocks
    block_camera: Int[AnyArray, " blocks"]
    block_row: Int[AnyArray, " blocks"]  # camera of the rows of each block
    block_column: Int[AnyArray, " blocks"]  # camera of the columns of each block
    # summation tree to cameras of `S x`: from the products of blocks, followed by those of
    # transposed blocks
    product_levels: tuple[Int[AnyArray, "_ _"], ...]
    diagonal: Int[AnyArray, " cameras"]  # index of the diagonal block of each camera
    # index of the block of (row, column) in the lower triangle, else of the zero block; for a dense
    # factorisation
    table: Int[AnyArray, "cameras cameras"] | None
    # for a band factorisation instead; None if the system is not factored as a band
    band: Band | None


def pair_layout(
    camera: np.ndarray,
    row_index: np.ndarray,
    tracks: np.ndarray,
    cameras: int,
    empty: int,
    *,
    factor: bool,
    banded: bool = True,
    capacity: Capacity | None = None,
    agreement: Agreement = ALONE,
) -> PairLayout:
    """Lists all pairs of observations of one point, sorted by the block that they add to.

    Observations are sorted by point; each has its `camera` and its row among those that are
    multiplied (its camera-sorted index). `tracks` are the numbers of observations of each point.
    Observations by cameras that are constant add nothing and need not be among them. `empty` is the
    index of a row of zeros. `factor`: whether the system will be factored; `banded`: whether as a
    band, where that is cheaper. With a `capacity` all shapes follow from that: every block of the
    lower triangle is listed, and no band is used. The other shards of a problem (`agreement`) have
    the same blocks."""
    camera = camera.astype(np.int32)
    row_index = row_index.astype(np.int32)
    left, right = _pairs_of_tracks(tracks)
    rows = camera[left]
    columns = camera[right]
    # if a camera sees a point twice, both orders of the pair add to the same diagonal block
    twice = np.flatnonzero(rows == columns)
    twice = twice[left[twice] != right[twice]]
    if twice.size:
        left, right = np.concatenate([left, right[twice]]), np.concatenate([right, left[twice]])
        rows, columns = (
            np.concatenate([rows, columns[twice]]),
            np.concatenate([columns, rows[twice]]),
        )
    others = np.divmod(
        agreement.others("blocks", lambda: rows.astype(np.int64) * cameras + columns), cameras
    )
    rank = np.arange(cameras)
    reach = cameras
    if factor and banded and capacity is None:
        rank, reach = _band_order((rows, columns), others, cameras)
    banded = is_banded(cameras, reach)
    # from here on rows and columns are ranks of cameras, and the lower triangle is that of the
    # ranks
    if banded:
        ranks = rank.astype(np.int32)
        rows = ranks[rows]
        columns = ranks[columns]
        swap = rows < columns
        left, right = np.where(swap, right, left), np.where(swap, left, right)
        rows, columns = np.maximum(rows, columns), np.minimum(rows, columns)
    listed = rank[others[0]], rank[others[1]]
    if capacity is not None:
        listed = np.tril_indices(cameras)
    listed = np.maximum(*listed) * np.int64(cameras) + np.minimum(*listed)
    keys, counts, order = _sorted_by_block(rows, columns, cameras, listed)
    room = (
        Room.of(counts) if capacity is None else room_for(counts, capacity.pairs, capacity.points)
    )
    # smaller ones, of which the last is rarely full
    largest = PAIR_BATCH if capacity is None else -(-PAIR_BATCH // 2)

    def number_of(width):
        return agreement.size(f"chunks of {width}", room.chunks(room.items, counts, width))

    width = min(PAIR_CHUNKS, key=lambda w: number_of(w) * (w + PAIR_ITEM_COST))
    width = max(1, min(width, agreement.size("pairs", room.most)))
    chunks = -(-counts // width)
    # position of each pair in the chunks: pairs of one block are contiguous, and a block starts a
    # new chunk
    shift = width * (np.cumsum(chunks) - chunks) - (np.cumsum(counts) - counts)
    position = np.repeat(shift.astype(np.int32), counts) + np.arange(len(left), dtype=np.int32)
    batches = max(1, -(-number_of(width) // (largest - 1)))
    # chunks of a batch, without the one that is padding
    batch = max(1, -(-number_of(width) // batches))
    used = None if capacity is None else np.array(max(1, -(-int(chunks.sum()) // batch)), np.int32)
    position += position // (width * batch) * width
    padded = []
    for side in (left, right):
        array = np.full(batches * (batch + 1) * width, empty, np.int32)
        array[position] = row_index[side[order]]
        padded.append(array.reshape(batches, batch + 1, width))
    most_of_block = None if capacity is None else -(-room.most // width)
    loosest = bool(capacity and capacity.fixed)
    sums, levels, by_sums = _batch_sums(
        chunks, batches, batch, most_of_block, agreement, loosest=loosest
    )
    keys = keys[by_sums]
    table = None
    if factor and not banded:
        table = np.full(cameras * cameras, len(keys), np.int32)
        table[keys] = np.arange(len(keys))
        table = table.reshape(cameras, cameras)
    row, column = np.divmod(keys, cameras)
    on_diagonal = np.empty(cameras, np.int32)
    on_diagonal[row[row == column]] = np.flatnonzero(row == column)
    on_diagonal = on_diagonal[rank]
    block_camera = np.full(len(keys) + 1, cameras, np.int32)
    block_camera[on_diagonal] = np.arange(cameras)
    by_rank = np.argsort(rank)
    block_row, block_column = (
        np.append(by_rank[part], 0).astype(np.int32) for part in (row, column)
    )
    return PairLayout(
        left=padded[0],
        right=padded[1],
        sums=sums,
        levels=levels,
        used=used,
        block_camera=block_camera,
        block_row=block_row,
        block_column=block_column,
        product_levels=_product_levels(block_row[:-1], block_column[:-1], cameras),
        diagonal=on_diagonal,
        table=table,
        band=band_of(keys, rank, reach) if banded else None,
    )


def _band_order(
    blocks: tuple[np.ndarray, np.ndarray], others: tuple[np.ndarray, np.ndarray], cameras: int
) -> tuple[Int[np.ndarray, " cameras"], int]:
    """Rank of each camera and bandwidth where the blocks are a band, else the given order and all
    cameras."""
    given = np.arange(cameras)
    if cameras < MIN_BAND_CAMERAS:
        return given, cameras
    covisible = np.zeros((cameras, cameras), bool)
    covisible[blocks] = covisible[others] = True
    row, column = np.nonzero(covisible)
    rank, reach = camera_order(row, column, cameras)
    return (rank, reach) if is_banded(cameras, reach) else (given, cameras)


def _product_levels(
    row: Int[np.ndarray, " blocks"], column: Int[np.ndarray, " blocks"], cameras: int
) -> tuple[Int[np.ndarray, "_ _"], ...]:
    """`PairLayout.product_levels` for the cameras of blocks."""
    mirrored = np.flatnonzero(row != column)
    targets = np.concatenate([row, column[mirrored]])
    items = np.concatenate([np.arange(len(row)), len(row) + 1 + mirrored])
    by_target = np.argsort(targets, kind="stable")
    return sum_tree(items[by_target], np.bincount(targets, minlength=cameras), len(row), TREE_WIDTH)


def _pairs_of_tracks(
    tracks: Int[np.ndarray, " points"],
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """All pairs of observations of one point, the later (or same) one first; points are grouped by
    track length."""
    lengths = np.bincount(tracks, minlength=1)
    start = np.cumsum(tracks) - tracks
    total = int(lengths @ (np.arange(len(lengths)) * np.arange(1, len(lengths) + 1) // 2))
    left = np.empty(total, np.int32)
    right = np.empty(total, np.int32)
    first = start[sorted_by(tracks, len(lengths))].astype(np.int32)
    point = int(lengths[0])
    pair = 0
    for length in np.flatnonzero(lengths[1:]) + 1:
        count = np.arange(1, length + 1, dtype=np.int32)
        later = np.repeat(count - 1, count)
        earlier = np.arange(len(later), dtype=np.int32) - np.repeat(
            np.cumsum(count, dtype=np.int32) - count, count
        )
        own = first[point : point + lengths[length], None]
        shape = (len(own), len(later))
        end = pair + len(own) * len(later)
        np.add(own, later, out=left[pair:end].reshape(shape))
        np.add(own, earlier, out=right[pair:end].reshape(shape))
        point = point + len(own)
        pair = end
    return left, right


def _batch_sums(
    chunks: Int[np.ndarray, " blocks"],
    batches: int,
    batch: int,
    most: int | None,
    agreement: Agreement = ALONE,
    *,
    loosest: bool = False,
) -> tuple[
    Int[np.ndarray, "batches partial width"],
    tuple[Int[np.ndarray, "_ _"], ...],
    Int[np.ndarray, " blocks"],
]:
    """Partial sums within each batch, how these are summed to the blocks and one more that is
    empty, and their order. `chunks` are numbers of chunks of blocks, which are contiguous, `batch`
    is that of a batch, `most` the largest of a block, if all shapes shall follow from these;
    `loosest`: whether there is room for the worst case."""
    block = np.repeat(np.arange(len(chunks)), chunks)
    own_batch, position = np.divmod(np.arange(len(block)), batch)
    # first chunk of a block within a batch
    is_start = (np.diff(block, prepend=-1) != 0) | (position == 0)
    within = _since(is_start)
    starts_sum = within % TREE_WIDTH == 0
    # batch and block of each partial sum
    sum_batch = own_batch[starts_sum]
    target = block[starts_sum]
    counts = np.bincount(sum_batch, minlength=batches)
    partial = agreement.size("partial", int(counts.max()))
    # nearly always a batch has sums of few blocks; at worst it has as many sums as chunks
    if most is not None:
        bound = chunks_at_most(batch, len(chunks), TREE_WIDTH)
        usual = min(bound, batch // TREE_WIDTH + 5 * len(chunks) // (2 * batches) + 1)
        partial = usual if partial <= usual and not loosest else bound
    number = _since(np.diff(sum_batch, prepend=-1) != 0)
    sums = np.full((batches, partial + 1, TREE_WIDTH), batch, np.int32)
    sums[own_batch, number[np.cumsum(starts_sum) - 1], within % TREE_WIDTH] = position
    items = sum_batch * (partial + 1) + number
    empty = batches * (partial + 1) - 1
    counts = np.bincount(target, minlength=len(chunks) + 1)
    if most is None:
        levels = sum_tree(items, counts, empty, TREE_WIDTH, agreement=agreement.within("sums"))
        return sums, levels, np.arange(len(chunks))
    # most batches over which the chunks of one block are spread
    touched = min(batches, (most - 1) // batch + 2)
    room = Room(batches * partial, chunks_at_most(most, touched, TREE_WIDTH))
    order = np.argsort(-counts, kind="stable")
    items = items[np.argsort(np.argsort(order)[target], kind="stable")]
    # the tightest share holds for about half of all problems, and spares little: there are few
    # blocks
    levels = prefix_levels(items, counts[order], empty, room, tightest=1, loosest=loosest)
    return sums, levels, order[:-1]


def _since(marks: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Distance of each position from the last mark before it; the first position is marked."""
    first = np.flatnonzero(marks)
    return np.arange(len(marks)) - np.repeat(first, np.diff(first, append=len(marks)))


def _sorted_by_block(
    rows: Int[np.ndarray, " pairs"],
    columns: Int[np.ndarray, " pairs"],
    cameras: int,
    listed: Int[np.ndarray, " more"],
) -> tuple[Int[np.ndarray, " blocks"], Int[np.ndarray, " blocks"], Int[np.ndarray, " pairs"]]:
    """Keys `row * cameras + column` of non-zero blocks, sorted, their numbers of pairs, and pairs
    sorted by block.

    Blocks on the diagonal and those of the keys `listed` are there also if they have no pairs. The
    sort is stable."""
    listed = np.append(listed, np.arange(cameras, dtype=np.int64) * (cameras + 1))
    pair_keys = rows.astype(np.int64) * cameras + columns
    order = sorted_by(pair_keys, cameras**2)
    keys = pair_keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    every = np.union1d(keys[first], listed)
    counts = np.zeros(len(every), np.int64)
    counts[np.searchsorted(every, keys[first])] = np.diff(first, append=len(keys))
    return every, counts, order
