"""What a file calls the parts of a problem: names and ids of its images, ids of its lenses and points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Int, Integer

from jaxba.typing import ArrayRecord


@dataclass(frozen=True, eq=False, repr=False)
class Labels(ArrayRecord):
    """Names and ids of the parts of a problem, in its order."""

    names: tuple[str, ...]
    """Names of images."""

    images: Int[np.ndarray, " cameras"]
    """Ids of images."""

    lenses: Int[np.ndarray, " lenses"]
    """Ids of lenses; COLMAP calls them cameras."""

    points: Integer[np.ndarray, " points"]
    """Ids of points."""

    def images_at(self, wanted: Iterable[int | str]) -> Int[np.ndarray, " wanted"]:
        """Positions of images by name or id.

        Raises:
            ValueError: there is no such image; one line.
        """
        return _at({**_by_id(self.images), **{name: at for at, name in enumerate(self.names)}}, wanted, "image")

    def lenses_at(self, wanted: Iterable[int | str]) -> Int[np.ndarray, " wanted"]:
        """Positions of lenses by id. Raises as `images_at`."""
        return _at(_by_id(self.lenses), wanted, "camera")

    def points_at(self, wanted: Iterable[int | str]) -> Int[np.ndarray, " wanted"]:
        """Positions of points by id. Raises as `images_at`."""
        return _at(_by_id(self.points), wanted, "point")


Part = Literal["image", "lens", "point"]


def part_name(labels: Labels | None, kind: Part, at: int | np.integer) -> str:
    """What a message calls a part of a problem: by its name and id, or by its position where nothing has labels."""
    if labels is None:
        return f"{'camera' if kind == 'image' else kind} {at}"
    if kind == "image":
        return f"image {labels.images[at]} ({labels.names[at]})"
    return f"camera {labels.lenses[at]}" if kind == "lens" else f"point {labels.points[at]}"


def part_names(labels: Labels | None, kind: Part, which: Int[np.ndarray, " n"], named: int = 1) -> str:
    """The same for some parts of a kind; of more than `named` the first ones."""
    more = f" and {len(which) - named} more" if len(which) > named else ""
    return ", ".join(part_name(labels, kind, at) for at in which[:named]) + more


def _by_id(ids: Integer[np.ndarray, " n"]) -> dict[int | str, int]:
    return {int(number): at for at, number in enumerate(ids)}


def _at(known: dict[int | str, int], wanted: Iterable[int | str], what: str) -> np.ndarray:
    wanted = list(wanted)
    missing = [one for one in wanted if isinstance(one, bool) or one not in known]
    if missing:
        more = f", and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ValueError(f"there is no {what} {missing[0]!r}{more}")
    return np.array([known[one] for one in wanted], np.int64)
