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


class _Tracks(NamedTuple):
    """Elements of all tracks, with positions in an `Ordered`."""

    views: Views
    registered: Bool[np.ndarray, " elements"]
    in_range: Bool[np.ndarray, " elements"]
    agree: Bool[np.ndarray, " elements"]


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
    tracks = _read_tracks(table)
    stated = tracks.views.of(tracks.agree)
    once = np.zeros(len(stated.key), bool)
    once[np.unique(stated.key, return_index=True)[1]] = True
    claims = _other_claims(table, stated.key)
    wrong = tracks.registered & ~tracks.agree
    pair = lambda views: views.image * max(len(table.points), 1) + views.point
    without = (np.bincount(tracks.views.point, minlength=len(table.points)) == 0)[claims.point]
    mends = np.isin(pair(claims), pair(tracks.views.of(wrong)))
    mended = wrong & np.isin(pair(tracks.views), pair(claims.of(mends)))
    repeated = np.flatnonzero(tracks.agree)[~once]
    notes = [
        *_track_notes(table, tracks, mended, wrong & ~mended, repeated),
        *_key_notes(table, claims.of(without), claims.of(~(mends | without))),
    ]
    parts = zip(stated.of(once), claims.of(mends | without), strict=True)
    views = Views(*(np.concatenate(part) for part in parts))
    return views.of(np.argsort(views.point, kind="stable")), notes


def _read_tracks(table: Ordered) -> _Tracks:
    heads, tracks = table.model.points.heads, table.model.points.tracks
    rank = np.empty(len(table.order), np.int64)
    rank[table.order] = np.arange(len(rank))
    point = np.repeat(rank, heads["length"].astype(np.int64))
    image, registered = _positions(np.array([image.id for image in table.images], np.uint32), tracks["image"])
    first, index = np.append(table.first_key, 0), tracks["key"].astype(np.int64)
    in_range = registered & (index < first[image + 1] - first[image])
    key = np.where(in_range, first[image] + index, 0)
    agree = in_range.copy()
    agree[in_range] = table.keys["point"][key[in_range]] == table.points["id"][point[in_range]]
    return _Tracks(Views(image, key, point), registered, in_range, agree)


def _other_claims(table: Ordered, used: Int[np.ndarray, " used"]) -> Views:
    """What the other key-points say of existing points."""
    point, exists = _positions(table.points["id"], table.keys["point"])
    exists[used] = False
    key = np.flatnonzero(exists)
    image = np.repeat(np.arange(len(table.images)), np.diff(table.first_key))
    return Views(image[key], key, point[key])


def _track_notes(
    table: Ordered,
    tracks: _Tracks,
    mended: Bool[np.ndarray, " elements"],
    stray: Bool[np.ndarray, " elements"],
    repeated: Int[np.ndarray, " repeated"],
) -> list[str]:
    model, elements = table.model, table.model.points.tracks
    absent = ~np.isin(elements["image"], np.array(list(model.images), np.uint32))

    def name(at: int) -> str:
        image, _, point = (int(part[at]) for part in tracks.views)
        registered = tracks.registered[at]
        where = str(table.images[image]) if registered else f"image {elements['image'][at]}"
        beyond = registered and not tracks.in_range[at]
        size = f", which has {len(table.images[image].keys)}" if beyond else ""
        return f"{table.point_name(point)}: key-point {elements['key'][at]} of {where}{size}"

    images = model.file("images")
    found = (
        (np.flatnonzero(mended), f"with a wrong key-point, where {images} is believed"),
        (np.flatnonzero(stray), "left out, of a key-point that is of another point or none"),
        (np.flatnonzero(absent), f"left out, of an image that {images} does not have"),
        (repeated, "left out, there twice"),
    )
    return [line for at, what in found for line in counted(model.file("points3D"), at, "track element", what, name)]


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
