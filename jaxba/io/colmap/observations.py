"""Which key-point of which image is of which point.

A model says so twice: a key-point names its point, and a point's track its key-points. Key-points
are believed, as in COLMAP's bundle adjustment: each stands beside its pixel, numbers in tracks go
wrong when key-points are sorted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int, Shaped

from jaxba.io.colmap.model import KEY, NO_POINT, Image, Model
from jaxba.io.notes import counted
from jaxba.io.text import grouped

_SPARSEST = 8  # ids of so many numbers for each that is there are looked up in a table

Views = Int[np.ndarray, "3 _"]  # image, key-point and point of each view: positions in an `Ordered`


class Ordered(NamedTuple):
    """Registered images and points of a model, sorted by their ids."""

    model: Model
    images: list[Image]
    keys: Shaped[np.ndarray, " keys"]  # key-points of these images, one image after the other
    # position of the first key-point of each image, and their number
    first_key: Int[np.ndarray, " images+1"]
    points: Shaped[np.ndarray, " points"]
    order: Int[np.ndarray, " points"]  # positions of the points in their file

    def key_name(self, key: int) -> str:
        """A key-point for messages, by its position."""
        image = int(np.searchsorted(self.first_key, key, side="right")) - 1
        return f"{self.images[image]}: key-point {key - self.first_key[image]}"

    def point_name(self, point: int) -> str:
        """A point for messages, by its position."""
        return f"point {self.points['id'][point]}"


def ordered(model: Model, images: list[Image]) -> Ordered:
    """Sorts the points and joins the key-points of the registered images, which are sorted by
    id."""
    keys = [image.keys for image in images]
    order = np.argsort(model.points["id"], kind="stable")
    first = np.cumsum([0, *map(len, keys)], dtype=np.int32)
    return Ordered(
        model, images, np.concatenate([np.empty(0, KEY), *keys]), first, model.points[order], order
    )


def find_views(table: Ordered) -> tuple[Views, list[str]]:
    """Views, sorted by point and key-point, and notes on what was left out and where tracks say
    something else."""
    point, exists = _positions(table.points["id"], table.keys["point"])
    key = np.flatnonzero(exists).astype(np.int32)
    key = key[grouped(point[key], len(table.points))]
    owner = np.repeat(np.arange(len(table.images), dtype=np.int32), np.diff(table.first_key))
    views = np.stack([owner[key], key, point[key]])
    del owner, key, point  # large
    dangling = np.flatnonzero(~exists & (table.keys["point"] != NO_POINT))

    def name(key):
        return f"{table.key_name(key)}, point {table.keys['point'][key]}"

    no_point = f"left out, of a point that {table.model.file('points3D')} does not have"
    return views, _track_notes(table, views) + counted(
        table.model.file("images"), dangling, "key-point", no_point, name
    )


def _track_notes(table: Ordered, views: Views) -> list[str]:
    """Lines on points whose tracks are not those of their key-points; none if tracks were not
    read."""
    heads = table.model.points
    elements = table.model.tracks
    if elements is None:
        return []
    point = np.repeat(np.argsort(table.order).astype(np.int32), heads["length"].astype(np.int64))
    image, registered = _positions(
        np.array([image.id for image in table.images], np.uint32), elements["image"]
    )
    first = table.first_key
    index = elements["key"]
    same = registered & (index < np.append(np.diff(first), 0).astype(index.dtype)[image])
    place = np.where(same, first[image] + index.astype(np.int32), 0)
    same[same] = table.keys["point"][place[same]] == table.points["id"][point[same]]
    absent = ~np.isin(elements["image"], np.array(list(table.model.images), np.uint32))
    wrong = np.flatnonzero(registered & ~same)
    unnamed = np.ones(len(table.keys), bool)
    unnamed[place[same]] = False
    unnamed = views[2, unnamed[views[1]]]

    def element(at: int) -> str:
        seen = table.images[image[at]] if registered[at] else None
        where = f"image {elements['image'][at]}" if seen is None else str(seen)
        size = (
            f", which has {len(seen.keys)}"
            if seen is not None and index[at] >= len(seen.keys)
            else ""
        )
        return f"{table.point_name(int(point[at]))}: key-point {index[at]} of {where}{size}"

    def differing(at: int) -> str:
        of_point = wrong[point[wrong] == at]
        return element(int(of_point[0])) if len(of_point) else table.point_name(at)

    images, points = (table.model.file(part) for part in ("images", "points3D"))
    believed = f"with another track than key-points say, where {images} is believed"
    left_out = f"left out, of an image that {images} does not have"
    return [
        *counted(points, np.union1d(point[wrong], unnamed), "point", believed, differing),
        *counted(points, np.flatnonzero(absent), "track element", left_out, element),
    ]


def _positions(ids: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of numbers among sorted ids (0 where they are not), and whether they are among
    them."""
    if not len(ids):
        return np.zeros(len(wanted), np.int32), np.zeros(len(wanted), bool)
    span = int(ids[-1]) - int(ids[0]) + 1
    if span <= _SPARSEST * len(ids):
        table = np.full(span + 1, -1, np.int32)
        table[ids - ids[0]] = np.arange(len(ids))
        # one below the first becomes very large
        at = table[np.minimum(wanted - ids[0], np.array(span, ids.dtype))]
        found = at >= 0
    else:
        at = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1).astype(np.int32)
        found = ids[at] == wanted
    at[~found] = 0
    return at, found
