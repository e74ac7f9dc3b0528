"""Names of images as other files have them: with other folders, case or endings than those of the
problem."""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

_DRIVE = re.compile(r"^[A-Za-z]:")
_ENDING = re.compile(r"\.[A-Za-z][A-Za-z0-9]{0,4}$")


class NamedImages(NamedTuple):
    """Which images names mean."""

    positions: dict[str, int]
    """The image of each name that means one."""

    doubts: dict[str, str]
    """Why each name that may mean several images, or the same one as another name, means none."""


def named_images(wanted: Iterable[str], names: Sequence[str]) -> NamedImages:
    """Which images names of a file mean.

    A name means the image that is called the same. If there is none, it means the image whose path
    ends in the same part: between `/` or `\\`, then also in another case, then also with another
    ending (`.JPG`, `.tif`, or none). Where several do, it is the one with most of the path in
    common. Another name for the same image must not be nearer to it.

    Args:
        wanted: names of a file.
        names: those of the images of a problem, in its order.

    Returns:
        Their images, and those of names that may mean several. Other names are in neither."""
    exact = {name: at for at, name in enumerate(names)}
    wanted = list(dict.fromkeys(wanted))
    positions = {name: exact[name] for name in wanted if name in exact}
    doubts: dict[str, str] = {}
    for form in (_same_case, _any_case, _without_ending):
        rest = [name for name in wanted if name not in positions]
        if not rest:
            break
        doubts = _match(rest, wanted, names, form, positions)
    return NamedImages(positions, doubts)


def last_part(name: str) -> str:
    """The name of a file without its folders, on any system."""
    parts = _parts(name)
    return parts[-1] if parts else name


def _match(
    rest: Sequence[str],
    wanted: Sequence[str],
    names: Sequence[str],
    form: Callable[[str], str],
    positions: dict[str, int],
) -> dict[str, str]:
    """Adds the images of names whose last parts have the same form to `positions`; returns the
    doubts of others.

    Args:
        rest: names that have no image yet.
        wanted: all names of the file.
        names: those of the images.
        form: what parts of paths are compared by.
        positions: images of names so far."""
    images = _Paths([_path(name, form) for name in names])
    asked = _Paths([_path(name, form) for name in wanted])
    doubts = {}
    given = set(positions.values())
    for name in rest:
        nearest = images.nearest(_path(name, form))
        if len(nearest) > 1:
            doubts[name] = _doubt([names[at] for at in nearest], last_part(name))
        if len(nearest) != 1 or nearest[0] in given:
            continue
        image = nearest[0]
        same = [wanted[at] for at in asked.nearest(images.paths[image])]
        if same == [name]:
            positions[name] = image
        elif name in same:
            doubts[name] = _doubt(same, names[image])
    return doubts


def _doubt(names: Sequence[str], called: str) -> str:
    more = f" and {len(names) - 2} more" if len(names) > 2 else ""
    return f"{names[0]} and {names[1]}{more} may both be {called}: give more of the path"


class _Paths:
    """Paths, by what they end in."""

    def __init__(self, paths: Sequence[tuple[str, ...]]):
        self.paths = paths
        self._ending: defaultdict[tuple[str, ...], list[int]] = defaultdict(list)
        for at, path in enumerate(paths):
            for first in range(len(path)):
                self._ending[path[first:]].append(at)

    def nearest(self, path: tuple[str, ...]) -> list[int]:
        """Those that have most of a path in common, from its end; of these the path itself, if it
        is there."""
        for first in range(len(path)):
            alike = self._ending.get(path[first:], [])
            if alike:
                same = [at for at in alike if self.paths[at] == path]
                return same or alike
        return []


def _path(name: str, form: Callable[[str], str]) -> tuple[str, ...]:
    """The parts of a name in a form; only of the last one the ending matters."""
    parts = _parts(name)
    folders = [part if form is _same_case else _any_case(part) for part in parts[:-1]]
    return (*folders, *(form(part) for part in parts[-1:]))


def _parts(name: str) -> list[str]:
    """Folders and file of a name, without a drive of Windows."""
    return [
        part for part in re.split(r"[/\\]", _DRIVE.sub("", name.strip())) if part not in ("", ".")
    ]


def _same_case(part: str) -> str:
    return part


def _any_case(part: str) -> str:
    return unicodedata.normalize("NFC", part).casefold()


def _without_ending(part: str) -> str:
    return _any_case(_ENDING.sub("", part))
