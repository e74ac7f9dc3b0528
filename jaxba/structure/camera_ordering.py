"""Orders of the cameras that gather the reduced camera system around its diagonal.

A sequence of frames sees every point for a short while, so that in the right order of the cameras the system is a
narrow band, and so is its Cholesky factor: `n b^2` operations instead of `n^3 / 3`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxba.typing import AnyArray, register_pytree

MAX_BAND_SHARE = 1 / 3
"""A band of `b` of `n` cameras is factored as one if `b / n` is below this. The two factorisations run at the same
speed an operation (47 GFLOP/s on two cores), so that they break even at 1 / sqrt(6) = 0.41."""

MIN_BAND_CAMERAS = 64
"""Smaller systems are factored dense, in one or two milliseconds."""

TILE_CAMERAS = 11
"""Cameras factored at once. From 4 to 11 the time was the same, larger tiles waste operations on the band's edge."""


@register_pytree
@dataclass(frozen=True)
class Band:
    """The reduced camera system cut into tiles of `m` cameras, of which a row holds `span` up to the diagonal."""

    blocks: Int[AnyArray, "tiles m columns"]
    """Block number of (camera of the tile row, camera of the row's tiles); the zero block elsewhere."""

    camera: Int[AnyArray, "tiles m"]
    """Camera at each place; the number of cameras in the padding."""

    place: Int[AnyArray, " cameras"]
    """Place of each camera, counted through all tiles."""


def camera_order(
    rows: Int[np.ndarray, " blocks"], columns: Int[np.ndarray, " blocks"], cameras: int
) -> tuple[Int[np.ndarray, " cameras"], int]:
    """The better of the given order and reverse Cuthill-McKee's.

    Args:
        rows: camera of each block's rows.
        columns: camera of its columns; one triangle is enough.
        cameras: number of cameras.

    Returns:
        The rank of each camera, and the largest distance in rank of two cameras that share a point.

    Source: Cuthill and McKee 1969; reversed by George 1971.
    """
    given = np.arange(cameras)
    width = int(np.abs(rows - columns).max(initial=0))
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(cameras, cameras))
    rank = np.empty(cameras, np.int64)
    rank[reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)] = given
    other = int(np.abs(rank[rows] - rank[columns]).max(initial=0))
    return (rank, other) if other < width else (given, width)


def is_banded(cameras: int, width: int) -> bool:
    """Whether a band factorisation is worth its overhead."""
    return cameras >= MIN_BAND_CAMERAS and width < MAX_BAND_SHARE * cameras


def band_of(
    names: Int[np.ndarray, " blocks"], rank: Int[np.ndarray, " cameras"], width: int, tile: int = TILE_CAMERAS
) -> Band:
    """Places blocks in tiles.

    Args:
        names: `row * cameras + column` in ranks, sorted, lower triangle; the position is the block's number.
        rank: of each camera.
        width: largest `row - column`.
        tile: cameras a tile.
    """
    cameras = len(rank)
    tiles = -(-cameras // tile)
    before = min(-(-width // tile), tiles - 1)  # tiles left of the diagonal one
    blocks = np.full((tiles, tile, (before + 1) * tile), len(names), np.int32)
    row, column = np.divmod(names, cameras)
    at = row // tile
    blocks[at, row % tile, column - (at - before) * tile] = np.arange(len(names))
    camera = np.full(tiles * tile, cameras, np.int32)
    camera[rank] = np.arange(cameras)
    return Band(blocks, camera.reshape(tiles, tile), rank.astype(np.int32))
