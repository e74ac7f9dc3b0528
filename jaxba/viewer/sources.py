"""What the viewer shows, from files: problems, recordings, COLMAP's colours, images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxba.datasets.bal.paths import resolve
from jaxba.io import is_colmap, read_problem
from jaxba.io.colmap.read import Looks, read_colmap_with_looks
from jaxba.io.files import StrPath, display_name, sidecar_path
from jaxba.io.frames import Sidecar, read_sidecar
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.viewer.recording import ENDING, Recording, read_recording, still

SMALL_SIDE = 480  # pixels of the longer side of an image that is not chosen


@dataclass(frozen=True)
class Shown:
    """A problem or a recorded solve, and what is known of its looks."""

    name: str
    recording: Recording
    looks: Looks | None = None  # colours, sizes and principal points, if known
    names: tuple[str, ...] | None = None  # names of images
    images: Path | None = None  # folder of the images

    @property
    def problem(self) -> BundleProblem:
        """The problem at the start, of a recording thinned."""
        return self.recording.problem

    def name_of(self, camera: int) -> str:
        """What an image is called, in characters that every page can hold."""
        if self.names is None:
            return f"image {camera}"
        return self.names[camera].encode("utf-8", "surrogateescape").decode("utf-8", "replace")

    def size(self, camera: int) -> tuple[float, float]:
        """Width and height of an image, pixels; 0 if it is not at hand."""
        return self._opened(camera, lambda image: (float(image.width), float(image.height))) or (
            0.0,
            0.0,
        )

    def image(
        self, camera: int, side: int = SMALL_SIDE
    ) -> UInt8[np.ndarray, "height width 3"] | None:
        """An image, its longer side at most so many pixels, with white margins that put its
        principal point in the middle; None if it is not at hand."""

        def small(image: Any) -> np.ndarray:
            image.draft("RGB", (2 * side, 2 * side))  # of a JPEG no more than is needed
            image.thumbnail((side, side))
            pixels = np.asarray(image.convert("RGB"))
            if self.looks is None or not self.looks.sizes[camera].all():
                return pixels
            lack = np.rint(
                (1 - 2 * self.looks.principal[camera] / self.looks.sizes[camera]) * image.size
            ).astype(int)
            (left, top) = np.maximum(lack, 0)
            (right, bottom) = np.maximum(-lack, 0)
            return np.pad(pixels, ((top, bottom), (left, right), (0, 0)), constant_values=255)

        return self._opened(camera, small)

    def _opened(self, camera: int, use: Callable[[Any], Any]) -> Any:
        """What `use` makes of an image; None if it is not at hand."""
        if self.images is None or self.names is None:
            return None
        from PIL import Image

        try:
            with Image.open(self.images / self.names[camera]) as image:
                return use(image)
        except (OSError, ValueError):
            return None


def shown(what: BundleProblem | Recording, name: str) -> Shown:
    """What is shown of a problem or a recording without a file."""
    recording = what if isinstance(what, Recording) else still(what)
    labels = recording.problem.labels
    return Shown(name, recording, names=labels and labels.names)


def open_all(paths: Sequence[str], images: str | None = None) -> list[Shown]:
    """Opens problems in any format that is read, names of downloaded BAL problems, or recordings;
    `images` is the folder of the images. Raises ProblemError: a file cannot be read; one line."""
    found = [_open(path) for path in paths]
    sides = [_sidecar(path, one) for path, one in zip(paths, found, strict=True)]
    return [_with_frames(one, sides, images) for one in found]


def _open(path: str) -> Shown:
    name = Path(path.rstrip("/")).name or path
    if path.endswith(ENDING):
        return shown(read_recording(path), name.removesuffix(ENDING))
    path = resolve(path)
    if is_colmap(path):
        problem, looks = read_colmap_with_looks(path)
        return replace(shown(problem, name), looks=looks)
    return shown(read_problem(path), name)


def _sidecar(path: str, one: Shown) -> Sidecar | None:
    """The file of frames beside a problem of `jaxba-kitti`, or beside the one that was solved."""
    for place in (path, one.recording.source):
        if place and sidecar_path(place).is_file():
            return read_sidecar(place)
    return None


def _with_frames(one: Shown, sides: Sequence[Sidecar | None], images: StrPath | None) -> Shown:
    """With names and images of a problem of `jaxba-kitti`; the files of one sequence share a
    sidecar."""
    count = one.problem.num_cameras
    side = next((side for side in sides if side is not None and len(side.frames) == count), None)
    if side is not None and one.names is None:
        one = replace(one, names=tuple(f"{frame:06d}.png" for frame in side.frames))
    if images is not None:
        if one.names is None:
            raise ProblemError(f"--images: {display_name(one.name)} does not name its images")
        one = replace(one, images=Path(images))
    if side is not None and one.looks is None:
        principal = np.tile([side.calibration.cx, side.calibration.cy], (count, 1))
        one = replace(
            one,
            looks=Looks(None, np.array([one.size(camera) for camera in range(count)]), principal),
        )
    return one
