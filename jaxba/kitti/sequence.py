"""A KITTI sequence on disk: images and their calibration.

Images are those of `image_0` to `image_3`, as in the odometry benchmark. Forms of the calibration:

| file | lines |
| --- | --- |
| `calib.txt` of the odometry benchmark | `P0: 12 numbers` to `P3:` |
| the same without names | 12 numbers each; the first line is P0, that of the left grey camera |
| `K.txt` | a 3 x 3 matrix, or one of 3 x 4 |

Source: Geiger et al. 2012, "Are we ready for autonomous driving?"; the readme of the development
kit."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxba.io.files import StrPath, display_name, visible
from jaxba.io.frames import Calibration, lines_of, numbers_of
from jaxba.problem.bundle_problem import ProblemError

FILES = ("calib.txt", "K.txt")  # in the order of the search


def calibration_files(folder: Path) -> list[Path]:
    """Where the calibration of a sequence's folder may be, in the order of the search."""
    return [folder / name for name in FILES]


def read_calibration(path: StrPath, camera: int = 0) -> Calibration:
    """Calibration of a camera from a file or a sequence's folder. Raises ProblemError: none, or
    malformed."""
    place: Path | None = Path(path)
    if place.is_dir():
        place = next((one for one in calibration_files(place) if one.is_file()), None)
    if place is None:
        name = display_name(path)
        known = " or ".join(FILES)
        raise ProblemError(f"{name}: has no calibration ({known}); --calibration names another")
    name = display_name(place)
    matrix = _matrix([line for _, line in lines_of(place)], name, camera)
    fx = float(matrix[0, 0])
    fy = float(matrix[1, 1])
    zeros = matrix[[0, 1, 2, 2], [1, 0, 0, 1]]
    if not (fx > 0 and fy > 0 and matrix[2, 2] == 1 and not zeros.any()):
        raise ProblemError(
            f"{name}: the matrix of camera {camera} is not [[f, 0, cx], [0, f, cy], [0, 0, 1]]"
        )
    offset = np.linalg.solve(matrix[:, :3], matrix[:, 3])
    return Calibration(fx, fy, float(matrix[0, 2]), float(matrix[1, 2]), tuple(offset.tolist()))


def _matrix(lines: list[str], name: str, camera: int) -> Float[np.ndarray, "3 4"]:
    """The matrix P of a camera from the lines of a file."""
    if any(":" in line for line in lines):
        rows = {key.strip(): rest for key, _, rest in (line.partition(":") for line in lines)}
        key = f"P{camera}"
        if key not in rows:
            raise ProblemError(f"{name}: has no line {key}:")
        return numbers_of(rows[key], 12, f"{name} {key}").reshape(3, 4)
    widths = {len(line.split()) for line in lines}
    if widths == {12}:
        if camera >= len(lines):
            raise ProblemError(
                f"{name}: has {len(lines)} lines of 12 numbers, none for camera {camera}"
            )
        return numbers_of(lines[camera], 12, f"{name} line {camera + 1}").reshape(3, 4)
    if len(lines) not in (1, 3):
        raise ProblemError(f"{name}: neither lines such as 'P0: 12 numbers' nor a 3 x 3 matrix")
    if len(lines) == 3 and widths == {4}:
        return numbers_of(" ".join(lines), 12, name).reshape(3, 4)
    matrix = np.eye(3, 4)
    matrix[:, :3] = numbers_of(" ".join(lines), 9, name).reshape(3, 3)
    return matrix


SUFFIXES = (".png", ".jpg", ".jpeg")

CAMERAS = range(4)  # KITTI's cameras: 0 and 1 are grey, 2 and 3 coloured


@dataclass(frozen=True)
class Sequence:
    """Some frames of a sequence."""

    folder: Path  # where the images are
    numbers: tuple[int, ...]  # number of each frame, ascending: the line of the poses' file, from 0
    images: tuple[Path, ...]  # file of each frame
    calibration: Calibration  # of all frames

    def __len__(self) -> int:
        return len(self.numbers)


def read_sequence(
    folder: StrPath, frames: str = ":", camera: int = 0, calibration: StrPath | None = None
) -> Sequence:
    """The frames of a range. No image is opened yet. Hidden files, such as a Mac's `._000000.png`,
    are no images. The range is `first:end` or `first:end:step` by frame number, the end not
    included, as a Python slice. Cameras 0 and 1 are KITTI's grey ones, 2 and 3 the coloured ones;
    `calibration` is the file of the camera matrix, if it is not that of the folder. Raises
    ProblemError: no folder, images or calibration, or a range outside the sequence."""
    root = Path(folder)
    name = display_name(folder)
    if not root.is_dir():
        raise ProblemError(f"{name}: no such folder")
    images = root / f"image_{camera}"
    if not images.is_dir():
        raise ProblemError(f"{name}: has no folder image_{camera}{_other_camera(root)}")
    found = _image_files(images)
    if not found:
        raise ProblemError(
            f"{display_name(images)}: holds no images ({', '.join(SUFFIXES)}){_other_camera(root)}"
        )
    numbered = {int(path.stem) if path.stem.isdecimal() else -1: path for path in found}
    if -1 in numbered or len(numbered) < len(found):
        bad = next((p for p in found if not p.stem.isdecimal()), found[0])
        raise ProblemError(
            f"{display_name(bad)}: the name of an image must be its frame's number, and no two the "
            "same"
        )
    chosen = [
        number for number in sorted(numbered) if number in _range(frames, name, max(numbered) + 1)
    ]
    if len(chosen) < 2:
        last = max(numbered)
        raise ProblemError(
            f"{name}: --frames {frames} leaves {len(chosen)} of frames {min(numbered)} to {last}, "
            "not 2"
        )
    return Sequence(
        images,
        tuple(chosen),
        tuple(numbered[number] for number in chosen),
        read_calibration(root if calibration is None else calibration, camera),
    )


def _image_files(folder: Path) -> list[Path]:
    """Images in a folder, without hidden files."""
    return [path for path in visible(folder) if path.suffix.lower() in SUFFIXES]


def _other_camera(root: Path) -> str:
    """A hint at the cameras that have images, as the end of a message."""
    there = [
        one
        for one in CAMERAS
        if (root / f"image_{one}").is_dir() and _image_files(root / f"image_{one}")
    ]
    if not there:
        return ""
    names = " and ".join(f"image_{one}" for one in there)
    return f"; images are in {names}: use --camera {' or '.join(map(str, there))}"


def _range(frames: str, name: str, count: int) -> range:
    match = re.fullmatch(r"(\d*):(\d*)(?::(\d+))?", frames.strip())
    if match is None or match[3] == "0":
        raise ProblemError(
            f"--frames must be first:end or first:end:step, such as 0:200, is {frames!r}"
        )
    first, end, step = (int(part) if part else None for part in match.groups())
    if end is not None and end > count:
        raise ProblemError(f"{name}: --frames {frames} ends after the last frame, {count - 1}")
    return range(*slice(first, end, step).indices(count))
