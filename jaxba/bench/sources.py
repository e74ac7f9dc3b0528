"""Problems of a benchmark by name or path: files, COLMAP models, downloaded BAL problems and random
scenes."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from jaxba.datasets.bal.paths import resolve
from jaxba.io import read_problem
from jaxba.io.files import display_name, strip_compression
from jaxba.io.formats import by_ending, holds_problem
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.facing import set_aside, without_views_of
from jaxba.scenes import DEFAULT_SCENES, random_scene, scene_like

SCENE_PREFIX = "scene:"  # prefix of a random scene: `scene:NAME` or `scene:NAME:SEED`
# folder names that do not identify a COLMAP model
_GENERIC_FOLDER = re.compile(r"sparse|model|\d+", re.IGNORECASE)


@dataclass(frozen=True)
class Source:
    """A named problem that has not been read yet."""

    name: str  # unique within a benchmark
    family: str  # name of the folder of a file; `scene` for a random scene
    location: str  # path, or `scene:NAME:SEED`
    # where its location does not say how
    make: Callable[[], BundleProblem] | None = field(default=None, compare=False)

    def read(self, *, strict: bool = False) -> BundleProblem:
        """Reads or generates the problem; `strict` as for `read_problem`. Raises ProblemError: one
        line."""
        if self.make is not None:
            return self.make()
        if not self.location.startswith(SCENE_PREFIX):
            problem = read_problem(self.location, strict=strict)
            return without_views_of(problem, set_aside(problem))  # of all solvers alike
        name, seed = _scene(self.location)
        return random_scene(DEFAULT_SCENES.get(name) or scene_like(name), seed)


def sources(locations: list[str]) -> list[Source]:
    """Checks that problems exist, and gives each a unique name. Locations are paths, random scenes
    (`scene:NAME:SEED`), or names of downloaded BAL problems such as ladybug-49, if there is no file
    of that name; duplicates count once. Raises ProblemError: a missing file or an unknown scene;
    the message is one line."""
    found: list[Source] = []

    def place(one):
        return one if one.startswith(SCENE_PREFIX) else Path(one).resolve()

    for location in locations:
        if location.startswith(SCENE_PREFIX):
            name, seed = _scene(location)
            if name not in DEFAULT_SCENES:
                scene_like(name)
            label = f"{name}-{seed}" if seed else name
            family = "scene"
        else:
            name = location
            location = resolve(location)
            path = Path(location)
            if not path.is_file() and not holds_problem(path):
                raise ProblemError(
                    f"{location}: "
                    f"{'a directory without a COLMAP model' if path.is_dir() else 'no such file'}"
                )
            label = Path(strip_compression(name)).name
            label = (Path(label).stem if by_ending(label) else label) or path.name
            if path.is_dir():
                label = _model_name(path)
            # reports and figures cannot show bytes that are not valid text
            label = display_name(label)
            family = display_name(path.resolve().parent.name)
        if place(location) in [place(source.location) for source in found]:
            continue
        taken = {source.name for source in found}
        if label in taken and f"{family}-{label}" not in taken:
            label = f"{family}-{label}"
        unique = label
        count = 1
        while unique in taken:
            count += 1
            unique = f"{label}-{count}"
        found.append(Source(unique, family, location))
    return found


def _model_name(folder: Path) -> str:
    """Name of a COLMAP model: that of its folder, after those above up to one not generic:
    `garden-sparse-0`."""
    parts = list(folder.resolve().parts[1:]) or ["model"]
    count = next(
        (k for k, part in enumerate(reversed(parts), 1) if not _GENERIC_FOLDER.fullmatch(part)),
        len(parts),
    )
    return "-".join(parts[-count:])


def _scene(location: str) -> tuple[str, int]:
    name, _, seed = location.removeprefix(SCENE_PREFIX).partition(":")
    if seed and not seed.isdigit():
        raise ProblemError(f"{location}: the seed must be a whole number, not {seed!r}")
    return name, int(seed or 0)
