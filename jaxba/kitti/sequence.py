"""A KITTI sequence on disk: images, calibration, times.

Images are searched in `image_0` (odometry benchmark), `image_00/data` (raw data) and `image_00/data_rect` (KITTI-360),
times in `times.txt` and in `timestamps.txt` beside the images' folder. Source: Geiger et al. 2012, "Are we ready for
autonomous driving?", 2013, "Vision meets robotics"; Liao et al. 2022, "KITTI-360".
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxba.io.files import StrPath, display_name, visible
from jaxba.io.frames import Calibration
from jaxba.io.poses import lines_of, numbers_of
from jaxba.kitti.calibration import calibration_files, read_calibration
from jaxba.problem.bundle_problem import ProblemError

SUFFIXES = (".png", ".jpg", ".jpeg")

CAMERAS = range(4)
"""KITTI's cameras: 0 and 1 are grey, 2 and 3 coloured."""


_STAMP = re.compile(r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)(\.\d+)?")
"""A time of the raw data, such as 2011-09-26 13:02:25.964389445."""


@dataclass(frozen=True)
class Sequence:
    """Some frames of a sequence."""

    folder: Path
    """Where the images are."""

    numbers: tuple[int, ...]
    """Number of each frame, ascending: the line of the poses' file, from 0."""

    images: tuple[Path, ...]
    """File of each frame."""

    calibration: Calibration
    """Of all frames."""

    times: Float[np.ndarray, " frames"] | None = None
    """Seconds, where the folder has them."""

    def __len__(self) -> int:
        return len(self.numbers)

    def only(self, numbers: np.ndarray) -> Sequence:
        """The frames with these numbers.

        Raises:
            ProblemError: fewer than two are left.
        """
        kept = np.flatnonzero(np.isin(self.numbers, numbers))
        if len(kept) < 2:
            raise ProblemError(f"{display_name(self.folder)}: {len(kept)} of its frames have a pose, not 2")
        return replace(
            self,
            numbers=tuple(self.numbers[at] for at in kept),
            images=tuple(self.images[at] for at in kept),
            times=None if self.times is None else self.times[kept],
        )


def read_sequence(folder: StrPath, frames: str = ":", camera: int = 0, calibration: StrPath | None = None) -> Sequence:
    """The frames of a range. No image is opened yet. Hidden files, such as a Mac's `._000000.png`, are no images.

    Args:
        folder: of the sequence.
        frames: `first:end` or `first:end:step` by frame number, the end not included, as a Python slice.
        camera: 0 and 1 are KITTI's grey cameras, 2 and 3 the coloured ones.
        calibration: file of the camera matrix, if it is not that of the folder.

    Raises:
        ProblemError: no folder, images or calibration, or a range outside the sequence.
    """
    root, name = Path(folder), display_name(folder)
    if not root.is_dir():
        raise ProblemError(f"{name}: no such folder")
    images = _images_folder(root, camera)
    if images is None:
        raise ProblemError(f"{name}: has no folder image_{camera} or image_{camera:02d}/data{_other_camera(root)}")
    found = _image_files(images)
    if not found:
        raise ProblemError(f"{display_name(images)}: holds no images ({', '.join(SUFFIXES)}){_other_camera(root)}")
    numbered = {int(path.stem) if path.stem.isdecimal() else -1: path for path in found}
    if -1 in numbered or len(numbered) < len(found):
        bad = next((p for p in found if not p.stem.isdecimal()), found[0])
        raise ProblemError(f"{display_name(bad)}: the name of an image must be its frame's number, and no two the same")
    chosen = [number for number in sorted(numbered) if number in _range(frames, name, max(numbered) + 1)]
    if len(chosen) < 2:
        last = max(numbered)
        raise ProblemError(f"{name}: --frames {frames} leaves {len(chosen)} of frames {min(numbered)} to {last}, not 2")
    times = next((path for path in _times_files(root, images) if path.is_file()), None)
    return Sequence(
        images,
        tuple(chosen),
        tuple(numbered[number] for number in chosen),
        read_calibration(root if calibration is None else calibration, camera),
        None if times is None else read_times(times, chosen),
    )


def files_of(folder: StrPath, images: Path) -> list[Path]:
    """Where calibration and times of a sequence may be.

    Args:
        folder: of the sequence.
        images: the folder of its images.
    """
    return [*calibration_files(Path(folder)), *_times_files(Path(folder), images)]


def _times_files(root: Path, images: Path) -> list[Path]:
    return [root / "times.txt", images.parent / "timestamps.txt"]


def _images_folder(root: Path, camera: int) -> Path | None:
    """Folder of a camera's images, in the layout of any release; the first that holds images, if one does."""
    raw = root / f"image_{camera:02d}"
    there = [place for place in (root / f"image_{camera}", raw / "data", raw / "data_rect", raw) if place.is_dir()]
    return next((place for place in there if _image_files(place)), there[0] if there else None)


def _image_files(folder: Path) -> list[Path]:
    """Images in a folder, without hidden files."""
    return [path for path in visible(folder) if path.suffix.lower() in SUFFIXES]


def _other_camera(root: Path) -> str:
    """A hint at the cameras that have images, as the end of a message."""
    there = [(one, folder) for one in CAMERAS if (folder := _images_folder(root, one)) and _image_files(folder)]
    if not there:
        return ""
    names = " and ".join(str(folder.relative_to(root)) for _, folder in there)
    return f"; images are in {names}: use --camera {' or '.join(str(one) for one, _ in there)}"


def _range(frames: str, name: str, count: int) -> range:
    match = re.fullmatch(r"(\d*):(\d*)(?::(\d+))?", frames.strip())
    if match is None or match[3] == "0":
        raise ProblemError(f"--frames must be first:end or first:end:step, such as 0:200, is {frames!r}")
    first, end, step = (int(part) if part else None for part in match.groups())
    if end is not None and end > count:
        raise ProblemError(f"{name}: --frames {frames} ends after the last frame, {count - 1}")
    return range(*slice(first, end, step).indices(count))


def read_times(path: Path, numbers: list[int]) -> Float[np.ndarray, " frames"]:
    """Times of frames, seconds: line N of a file is that of frame N, seconds or a date with a time.

    Dates are counted from the first line, so that no digits are lost.

    Raises:
        ProblemError: the file cannot be read, has too few lines, or one of them is no time.
    """
    lines = lines_of(path)
    if max(numbers) >= len(lines):
        raise ProblemError(f"{display_name(path)}: has no time for frame {max(numbers)}")
    where = lambda at: f"{display_name(path)} line {lines[at][0]}"
    if not _STAMP.fullmatch(lines[0][1]):
        return np.array([numbers_of(lines[at][1], 1, where(at))[0] for at in numbers])
    start, fraction = _stamp(lines[0][1], where(0))
    stamps = [_stamp(lines[at][1], where(at)) for at in numbers]
    return np.array([(time - start).total_seconds() + (part - fraction) for time, part in stamps])


def _stamp(text: str, where: str) -> tuple[datetime, float]:
    """Whole seconds of a date with a time, and the fraction of the last one."""
    match = _STAMP.fullmatch(text)
    try:
        if match is not None:
            return datetime.fromisoformat(match[1]), float(match[2] or 0)
    except ValueError:  # a thirteenth month
        pass
    raise ProblemError(f"{where}: is no date and time")
