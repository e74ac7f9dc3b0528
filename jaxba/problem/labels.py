"""What a file calls the parts of a problem: names and ids of its images, ids of its lenses and
points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Int, Integer

from jaxba.problem.image_names import named_images
from jaxba.typing import ArrayRecord

Part = Literal["image", "lens", "point"]


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

    marks: tuple[str, ...] = ()
    """Names of the last points, which a survey has (problem/marks.py)."""

    def of(self, cameras: Any, points: Any) -> Labels:
        """Those of some cameras and points."""
        names = np.array(self.names, object)[cameras].tolist()
        marks = (
            [self.mark(at) for at in np.arange(len(self.points))[points].tolist()]
            if self.marks
            else []
        )
        return replace(
            self,
            names=tuple(names),
            images=self.images[cameras],
            points=self.points[points],
            marks=tuple(name for name in marks if name),
        )

    def mark(self, point: int) -> str:
        """Name of a point that a survey has; empty for others."""
        number = point - (len(self.points) - len(self.marks))
        return self.marks[number] if number >= 0 else ""

    def positions(self, kind: Part, wanted: Iterable[int | str]) -> Int[np.ndarray, " wanted"]:
        """Positions of parts by id, of images also by name, as `named_images` understands it.
        Raises ValueError: there is no such part, or there are several; one line."""
        ids = {"image": self.images, "lens": self.lenses, "point": self.points}[kind]
        known: dict[int | str, int] = {number: at for at, number in enumerate(ids.tolist())}
        wanted = list(wanted)
        named = named_images(
            [one for one in wanted if isinstance(one, str) and kind == "image"], self.names
        )
        known |= named.positions
        missing = [one for one in wanted if isinstance(one, bool) or one not in known]
        if missing:
            more = f", and {len(missing) - 1} more" if len(missing) > 1 else ""
            example = (
                f"; there is {self.names[0]!r}"
                if isinstance(missing[0], str) and kind == "image"
                else ""
            )
            doubt = named.doubts.get(str(missing[0]), "")
            what = f"there is no {'camera' if kind == 'lens' else kind} {missing[0]!r}{more}"
            raise ValueError(doubt or what + example)
        return np.array([known[one] for one in wanted], np.int64)


def part_name(labels: Labels | None, kind: Part, at: Any) -> str:
    """What a message calls a part of a problem: by its name and id, or by its position where
    nothing has labels."""
    if labels is None:
        return f"{'camera' if kind == 'image' else kind} {at}"
    if kind == "image":
        return f"image {labels.images[at]} ({labels.names[at]})"
    if kind == "lens":
        return f"camera {labels.lenses[at]}"
    return f"point {labels.mark(int(at)) or labels.points[at]}"


def part_names(
    labels: Labels | None, kind: Part, which: Int[np.ndarray, " n"], named: int = 1
) -> str:
    """The same for some parts of a kind; of more than `named` the first ones."""
    more = f" and {len(which) - named} more" if len(which) > named else ""
    return ", ".join(part_name(labels, kind, at) for at in which[:named]) + more
