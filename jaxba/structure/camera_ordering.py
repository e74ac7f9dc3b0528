"""Orderings of the cameras that make the reduced camera system a band matrix.

In an image sequence every point is seen for a few frames only. In the right order of the cameras
the reduced camera system is then a narrow band of width b, and so is its Cholesky factor: `n b^2`
operations instead of `n^3 / 3`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from jaxba.typing import AnyArray, register_pytree

MAX_BAND_FRACTION = 1 / 3  # most `b / n` for a band of b; as fast as dense at 0.41 without overhead
MIN_BAND_CAMERAS = 64  # smaller systems are factored dense, which takes one or two milliseconds
# cameras per tile. The same time from 4 to 11; larger tiles waste operations at the band's edge
TILE_CAMERAS = 11


@register_pytree
@dataclass(frozen=True)
class Band:
    """The reduced camera system in tiles of `m` cameras; a row of tiles ends with the one on the
    diagonal."""

    # block of (camera of the tile row, of the row's tiles); zero if none
    blocks: Int[AnyArray, "tiles m columns"]
    # camera at each position of the ordering; the number of cameras in the padding
    camera: Int[AnyArray, "tiles m"]
    # position of each camera in the ordering, counted through all tiles
    rank: Int[AnyArray, " cameras"]


def camera_order(
    rows: Int[np.ndarray, " blocks"], columns: Int[np.ndarray, " blocks"], cameras: int
) -> tuple[Int[np.ndarray, " cameras"], int]:
    """The given or the reverse Cuthill-McKee ordering, whichever has the smaller bandwidth. `rows`
    and `columns` are the cameras of the rows and of the columns of each non-zero block; one
    triangle is enough. Returns the rank (position) of each camera, and the bandwidth: the largest
    difference in rank of two cameras that see a point in common. Source: Cuthill and McKee 1969;
    reversed by George 1971."""
    given = np.arange(cameras)
    width = int(np.abs(rows - columns).max(initial=0))
    linked = np.zeros((cameras, cameras), bool)
    linked[rows, columns] = linked[columns, rows] = True
    rank = np.empty(cameras, np.int64)
    rank[reverse_cuthill_mckee(linked)] = given
    other = int(np.abs(rank[rows] - rank[columns]).max(initial=0))
    return (rank, other) if other < width else (given, width)


def reverse_cuthill_mckee(linked: Bool[np.ndarray, "nodes nodes"]) -> Int[np.ndarray, " nodes"]:
    """The nodes of a symmetric graph in the reverse Cuthill-McKee ordering.

    A breadth-first search from a node of least degree, which takes the new neighbours of a node by
    increasing degree; reversed. The same order as SciPy's, whose import takes longer than this for
    a thousand cameras."""
    degree = (linked.sum(axis=1) + linked.diagonal()).astype(np.int32)
    order = np.empty(len(linked), np.int64)
    found = 0
    waiting = np.ones(len(linked), bool)
    for seed in np.argsort(degree):
        if not waiting[seed]:
            continue
        order[found], waiting[seed], done, found = seed, False, found, found + 1
        while done < found:
            new = np.flatnonzero(linked[order[done]] & waiting)
            order[found : found + len(new)] = new[np.argsort(degree[new], kind="stable")]
            waiting[new] = False
            done = done + 1
            found = found + len(new)
    return order[::-1]


def is_banded(cameras: int, width: int) -> bool:
    """Whether a system of bandwidth `width` is factored as a band."""
    return cameras >= MIN_BAND_CAMERAS and width < MAX_BAND_FRACTION * cameras


def band_of(
    keys: Int[np.ndarray, " blocks"],
    rank: Int[np.ndarray, " cameras"],
    width: int,
    tile: int = TILE_CAMERAS,
) -> Band:
    """Arranges the blocks of a band matrix in tiles. `keys` are `row * cameras + column` of each
    block in ranks, sorted, lower triangle; `rank` is the position of each camera, `width` the
    bandwidth, the largest `row - column`, and `tile` the number of cameras per tile."""
    cameras = len(rank)
    tiles = -(-cameras // tile)
    before = min(-(-width // tile), tiles - 1)  # tiles left of the diagonal one
    blocks = np.full((tiles, tile, (before + 1) * tile), len(keys), np.int32)
    row, column = np.divmod(keys, cameras)
    at = row // tile
    blocks[at, row % tile, column - (at - before) * tile] = np.arange(len(keys))
    camera = np.full(tiles * tile, cameras, np.int32)
    camera[rank] = np.arange(cameras)
    return Band(blocks, camera.reshape(tiles, tile), rank.astype(np.int32))
