"""Where a benchmark's problems come from: files, COLMAP models, downloaded problems and random scenes by name."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from jaxba.datasets.bal.paths import resolve
from jaxba.io import is_colmap, read_problem
from jaxba.io.files import display_name
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.scenes import SceneConfig, like, random_scene

SCENE_PREFIX = "scene:"
"""`scene:NAME` or `scene:NAME:SEED` stands for a random scene."""

_SAYS_NOTHING = re.compile(r"sparse|model|\d+", re.IGNORECASE)

EMBEDDED: dict[str, SceneConfig] = {
    "street-30": SceneConfig(cameras=30, points=1500, mean_track=4.5),
    "street-12-drift": SceneConfig(cameras=12, points=600, mean_track=4.5, start_drift=0.003),
    "photos-14": SceneConfig(cameras=14, points=1200, mean_track=4.0, trajectory="photos"),
    "orbit-10-noisy": SceneConfig(cameras=10, points=400, mean_track=5.0, trajectory="orbit", noise=2.0),
}
"""Scenes of the suite that runs where no problems are named."""


@dataclass(frozen=True)
class Source:
    """A problem that has a name and can be read when its turn comes."""

    name: str
    """Unique in a run."""

    family: str
    """Folder of a file, `scene` for a random one."""

    location: str
    """Path, or `scene:NAME:SEED`."""

    def read(self) -> BundleProblem:
        """Reads or makes the problem.

        Raises:
            ProblemError: bad input, in one line.
        """
        if not self.location.startswith(SCENE_PREFIX):
            return read_problem(self.location)
        name, seed = _scene(self.location)
        return random_scene(EMBEDDED.get(name) or like(name), seed)


def embedded_sources() -> list[Source]:
    """The synthetic suite."""
    return sources([f"{SCENE_PREFIX}{name}" for name in EMBEDDED])


def sources(locations: list[str]) -> list[Source]:
    """Names for locations, all different; missing files and unknown scenes are refused at once. What is named twice is
    one problem.

    A location such as ladybug-49, where no file is called so, is a downloaded problem of BAL.

    Raises:
        ProblemError: in one line.
    """
    found: list[Source] = []
    for location in locations:
        if location.startswith(SCENE_PREFIX):
            name, seed = _scene(location)
            if name not in EMBEDDED:
                like(name)
            label, family = (f"{name}-{seed}" if seed else name), "scene"
        else:
            name, location = location, resolve(location)
            path = Path(location)
            if not path.is_file() and not is_colmap(path):
                raise ProblemError(
                    f"{location}: {'a directory without a COLMAP model' if path.is_dir() else 'no such file'}"
                )
            label = re.sub(r"(\.(txt|out|bal))?(\.(bz2|gz|xz))?$", "", Path(name).name) or path.name
            if path.is_dir():
                label = _model_name(path)
            # stray bytes of a name have no place in reports and pictures
            label, family = display_name(label), display_name(path.resolve().parent.name)
        if any(_same(source.location, location) for source in found):
            continue
        taken = {source.name for source in found}
        if label in taken and f"{family}-{label}" not in taken:
            label = f"{family}-{label}"
        unique, count = label, 1
        while unique in taken:
            count += 1
            unique = f"{label}-{count}"
        found.append(Source(unique, family, location))
    return found


def _same(one: str, other: str) -> bool:
    if one.startswith(SCENE_PREFIX) or other.startswith(SCENE_PREFIX):
        return one == other
    return Path(one).resolve() == Path(other).resolve()


def _model_name(folder: Path) -> str:
    """Name of a COLMAP model: its folder's, with those above it as long as that says nothing: `garden-sparse-0`."""
    parts = list(folder.resolve().parts[1:]) or ["model"]
    count = next((k for k, part in enumerate(reversed(parts), 1) if not _SAYS_NOTHING.fullmatch(part)), len(parts))
    return "-".join(parts[-count:])


def _scene(location: str) -> tuple[str, int]:
    name, _, seed = location.removeprefix(SCENE_PREFIX).partition(":")
    if seed and not seed.isdigit():
        raise ProblemError(f"{location}: the seed must be a whole number, not {seed!r}")
    return name, int(seed or 0)
