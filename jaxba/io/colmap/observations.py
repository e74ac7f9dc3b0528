"""Which key-point of which image is of which point.

A model says so twice: a key-point names its point, and a point's track its key-points. A view counts where they agree.
Where a track names a wrong key-point of an image, or is empty, key-points are believed: each stands beside its pixel,
while numbers in tracks go wrong when key-points are sorted or dropped. All else that is said once is left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Shaped

from jaxba.io.colmap.model import KEY, NO_POINT, Image, Model
from jaxba.io.notes import counted


class Ordered(NamedTuple):
    """Registered images and points of a model, sorted by their ids."""

    model: Model
    images: list[Image]
    keys: Shaped[np.ndarray, " keys"]
    """Key-points of these images, one image after the other."""

    first_key: Int[np.ndarray, " images+1"]
    """Position of the first key-point of each image, and their number."""

    points: Shaped[np.ndarray, " points"]
    order: Int[np.ndarray, " points"]
    """Positions of the points in their file."""

    def key_name(self, key: int) -> str:
        """A key-point for messages, by its position."""
        image = int(np.searchsorted(self.first_key, key, side="right")) - 1
        return f"{self.images[image]}: key-point {key - self.first_key[image]}"

    def point_name(self, point: int) -> str:
        """A point for messages, by its position."""
        return f"point {self.points['id'][point]}"


class Views(NamedTuple):
    """Views: positions in an `Ordered`."""

    image: Int[np.ndarray, " views"]
    key: Int[np.ndarray, " views"]
    point: Int[np.ndarray, " views"]

    def of(self, chosen: Bool[np.ndarray, " views"] | Int[np.ndarray, " chosen"]) -> Views:
        """Some of the views."""
        return Views(self.image[chosen], self.key[chosen], self.point[chosen])


def ordered(model: Model, images: list[Image]) -> Ordered:
    """Sorts the points and joins the key-points of the registered images, which are sorted by id."""
    keys = [image.keys for image in images]
    order = np.argsort(model.points.heads["id"], kind="stable")
    return Ordered(
        model,
        images,
        np.concatenate(keys) if keys else np.empty(0, KEY),
        np.cumsum([0, *map(len, keys)]),
        model.points.heads[order],
        order,
    )


def find_views(table: Ordered) -> tuple[Views, list[str]]:
    """Views, sorted by point and then as in the tracks, and notes on what was mended or left out, one line each."""
    heads, elements = table.model.points.heads, table.model.points.tracks
    point = np.repeat(np.argsort(table.order), heads["length"].astype(np.int64))
    image, registered = _positions(np.array([image.id for image in table.images], np.uint32), elements["image"])
    first, index = np.append(table.first_key, 0), elements["key"].astype(np.int64)
    in_range = registered & (index < first[image + 1] - first[image])
    tracks = Views(image, np.where(in_range, first[image] + index, 0), point)
    agree = in_range.copy()
    agree[in_range] = table.keys["point"][tracks.key[in_range]] == table.points["id"][point[in_range]]
    stated, wrong = tracks.of(agree), registered & ~agree
    once = np.zeros(len(stated.key), bool)
    once[np.unique(stated.key, return_index=True)[1]] = True
    claims = _other_claims(table, stated.key)
    pair = lambda views: views.image * max(len(table.points), 1) + views.point
    without = (np.bincount(point, minlength=len(table.points)) == 0)[claims.point]
    mends = np.isin(pair(claims), pair(tracks.of(wrong)))
    mended = wrong & np.isin(pair(tracks), pair(claims.of(mends)))
    absent = ~np.isin(elements["image"], np.array(list(table.model.images), np.uint32))

    def name(at: int) -> str:
        seen = table.images[image[at]] if registered[at] else None
        where = f"image {elements['image'][at]}" if seen is None else str(seen)
        size = f", which has {len(seen.keys)}" if seen is not None and not in_range[at] else ""
        return f"{table.point_name(int(point[at]))}: key-point {elements['key'][at]} of {where}{size}"

    images, points = (table.model.file(part) for part in ("images", "points3D"))
    found = (
        (np.flatnonzero(mended), f"with a wrong key-point, where {images} is believed"),
        (np.flatnonzero(wrong & ~mended), "left out, of a key-point that is of another point or none"),
        (np.flatnonzero(absent), f"left out, of an image that {images} does not have"),
        (np.flatnonzero(agree)[~once], "left out, there twice"),
    )
    notes = [line for at, what in found for line in counted(points, at, "track element", what, name)]
    notes += _key_notes(table, claims.of(without), claims.of(~(mends | without)))
    parts = zip(stated.of(once), claims.of(mends | without), strict=True)
    views = Views(*(np.concatenate(part) for part in parts))
    return views.of(np.argsort(views.point, kind="stable")), notes


def _other_claims(table: Ordered, used: Int[np.ndarray, " used"]) -> Views:
    """What the other key-points say of existing points."""
    point, exists = _positions(table.points["id"], table.keys["point"])
    exists[used] = False
    key = np.flatnonzero(exists)
    image = np.repeat(np.arange(len(table.images)), np.diff(table.first_key))
    return Views(image[key], key, point[key])


def _key_notes(table: Ordered, untracked: Views, lost: Views) -> list[str]:
    model, points = table.model, table.model.file("points3D")
    exists = np.isin(table.keys["point"], table.points["id"])
    dangling = np.flatnonzero(~exists & (table.keys["point"] != NO_POINT))
    name = lambda key: f"{table.key_name(key)}, point {table.keys['point'][key]}"
    believed = f"without a track, where {model.file('images')} is believed"
    in_no_track = f"left out, in no track of {points}"
    no_point = f"left out, of a point that {points} does not have"
    return [
        *counted(points, np.unique(untracked.point), "point", believed, table.point_name),
        *counted(model.file("images"), lost.key, "key-point", in_no_track, name),
        *counted(model.file("images"), dangling, "key-point", no_point, name),
    ]


def _positions(ids: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of numbers among sorted ids (0 where they are not), and whether they are among them."""
    if not len(ids):
        return np.zeros(len(wanted), np.int64), np.zeros(len(wanted), bool)
    at = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    found = ids[at] == wanted
    return np.where(found, at, 0), found
