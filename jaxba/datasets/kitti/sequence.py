"""A KITTI odometry sequence on disk: images, calibration, times, poses.

Layout of a folder: `image_0/000000.png ...` (or image_1 to image_3), `calib.txt`, optionally `times.txt`. Source:
Geiger et al. 2012, "Are we ready for autonomous driving?", and the readme of the odometry development kit.
"""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxba.io.files import StrPath, display_name, reason
from jaxba.problem.bundle_problem import ProblemError

CALIBRATION_FILES = ("calib.txt", "K.txt")
"""Searched in this order: the development kit's lines `P0: 12 numbers`, or a bare 3 x 3 matrix."""

SUFFIXES = (".png", ".jpg", ".jpeg")

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG file."""

GREY_BITS = 8
"""Bits per pixel of the images in which key-points are detected."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of `R R^T - I` in a file of poses; KITTI writes 7 digits."""


@dataclass(frozen=True)
class Calibration:
    """A pinhole camera without distortion, as rectified images have it."""

    fx: float
    """Focal length in pixels, horizontally."""

    fy: float
    """The same, vertically."""

    cx: float
    """Principal point in pixels relative to the centre of the first pixel, to the right."""

    cy: float
    """The same, downwards."""

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of camera 0 in the frame of this camera, metres: `K^-1` times the last column of `P`."""

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def rays(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Directions `(X / Z, Y / Z)` of pixels; x to the right, y down, z forward."""
        return (np.asarray(pixels, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]


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


def read_sequence(folder: StrPath, frames: str = ":", camera: int = 0, calibration: StrPath | None = None) -> Sequence:
    """The frames of a range. No image is opened yet.

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
    images = root / f"image_{camera}"
    if not images.is_dir():
        raise ProblemError(f"{name}: has no folder image_{camera}")
    found = sorted(path for path in images.iterdir() if path.suffix.lower() in SUFFIXES)
    if not found:
        raise ProblemError(f"{display_name(images)}: holds no images ({', '.join(SUFFIXES)})")
    numbered = {int(path.stem) if path.stem.isdecimal() else -1: path for path in found}
    if -1 in numbered or len(numbered) < len(found):
        bad = next((p for p in found if not p.stem.isdecimal()), found[0])
        raise ProblemError(f"{display_name(bad)}: the name of an image must be its frame's number, and no two the same")
    chosen = [number for number in sorted(numbered) if number in _range(frames, name, max(numbered) + 1)]
    if len(chosen) < 2:
        last = max(numbered)
        raise ProblemError(f"{name}: --frames {frames} leaves {len(chosen)} of frames {min(numbered)} to {last}, not 2")
    return Sequence(
        images,
        tuple(chosen),
        tuple(numbered[number] for number in chosen),
        read_calibration(root, camera) if calibration is None else _calibration(Path(calibration), camera),
        _times(root / "times.txt", chosen),
    )


def read_calibration(folder: Path, camera: int = 0) -> Calibration:
    """Calibration of a camera from its sequence's folder.

    Raises:
        ProblemError: there is none, or it is malformed.
    """
    for name in CALIBRATION_FILES:
        if (folder / name).exists():
            return _calibration(folder / name, camera)
    raise ProblemError(f"{display_name(folder)}: has no calibration ({' or '.join(CALIBRATION_FILES)})")


def read_poses(path: StrPath) -> Float[np.ndarray, "frames 3 4"]:
    """Poses of camera 0, camera to world, in metres, from a file of 12 numbers per line and frame (3 x 4, row by row).

    Raises:
        ProblemError: the file cannot be read, a line is malformed or holds no rotation.
    """
    name = display_name(path)
    lines = [line for line in _text(Path(path)).splitlines() if line.strip()]
    if not lines:
        raise ProblemError(f"{name}: holds no poses")
    poses = np.array([_numbers(line, 12, f"{name} line {i + 1}") for i, line in enumerate(lines)]).reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        bad = np.flatnonzero(~((error <= ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0)))
    if bad.size:
        raise ProblemError(f"{name} line {bad[0] + 1}: the left 3 x 3 numbers are no rotation")
    u, _, vt = np.linalg.svd(rotations)  # to full precision
    return np.concatenate([u @ vt, poses[:, :, 3:]], axis=2)


def poses_of(
    poses: Float[np.ndarray, "all 3 4"], numbers: tuple[int, ...], calibration: Calibration, name: str
) -> Float[np.ndarray, "frames 3 4"]:
    """Camera-to-world poses of this camera at the frames with these numbers.

    The centre of camera 0 is at `offset` in the frame of this camera, so their paths differ.

    Raises:
        ProblemError: there are fewer poses than frames.
    """
    if max(numbers) >= len(poses):
        raise ProblemError(f"{name}: has {len(poses)} poses, none for frame {max(numbers)}")
    chosen = poses[list(numbers)].copy()
    chosen[:, :, 3] -= chosen[:, :, :3] @ np.array(calibration.offset)
    return chosen


def _range(frames: str, name: str, count: int) -> range:
    match = re.fullmatch(r"(\d*):(\d*)(?::(\d+))?", frames.strip())
    if match is None or match[3] == "0":
        raise ProblemError(f"--frames must be first:end or first:end:step, such as 0:200, is {frames!r}")
    first, end, step = (int(part) if part else None for part in match.groups())
    if end is not None and end > count:
        raise ProblemError(f"{name}: --frames {frames} ends after the last frame, {count - 1}")
    return range(*slice(first, end, step).indices(count))


def _calibration(path: Path, camera: int) -> Calibration:
    name = display_name(path)
    text = _text(path)
    lines = [line for line in text.splitlines() if line.strip()]
    if not any(":" in line for line in lines):
        matrix = np.eye(3, 4)
        if len(lines) not in (1, 3):
            raise ProblemError(f"{name}: neither lines such as 'P0: 12 numbers' nor a 3 x 3 matrix")
        matrix[:, :3] = _numbers(text, 9, name).reshape(3, 3)
    else:
        rows = {key.strip(): rest for key, _, rest in (line.partition(":") for line in lines)}
        if f"P{camera}" not in rows:
            raise ProblemError(f"{name}: has no line P{camera}:")
        matrix = _numbers(rows[f"P{camera}"], 12, f"{name} P{camera}").reshape(3, 4)
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    zeros = matrix[[0, 1, 2, 2], [1, 0, 0, 1]]
    if not (fx > 0 and fy > 0 and matrix[2, 2] == 1 and not zeros.any()):
        raise ProblemError(f"{name}: the matrix of camera {camera} is not [[f, 0, cx], [0, f, cy], [0, 0, 1]]")
    offset = np.linalg.solve(matrix[:, :3], matrix[:, 3])
    return Calibration(fx, fy, float(matrix[0, 2]), float(matrix[1, 2]), tuple(offset.tolist()))


def _times(path: Path, numbers: list[int]) -> np.ndarray | None:
    if not path.exists():
        return None
    lines = _text(path).split("\n")
    if max(numbers) >= len(lines):
        raise ProblemError(f"{display_name(path)}: has no time for frame {max(numbers)}")
    return np.array([_numbers(lines[i], 1, f"{display_name(path)} line {i + 1}")[0] for i in numbers])


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ProblemError(f"{display_name(path)}: cannot be read: {reason(error)}") from None
    except UnicodeDecodeError:
        raise ProblemError(f"{display_name(path)}: is no text") from None


def _numbers(text: str, count: int, where: str) -> np.ndarray:
    words = text.split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        raise ProblemError(f"{where}: holds something that is no number") from None
    if len(numbers) != count:
        raise ProblemError(f"{where}: has {len(numbers)} numbers instead of {count}")
    if not np.isfinite(numbers).all():
        raise ProblemError(f"{where}: holds a number that is not finite")
    return numbers


Reader = Callable[[int], np.ndarray]
"""Grey image of a frame by its position in the sequence, shape (height, width), uint8."""


def image_reader(sequence: Sequence) -> Reader:
    """A reader of grey images, which must all have the size of the first one.

    Images of 16 bits are shifted to the right by `spare_bits`.

    Raises:
        ImportError: OpenCV is missing.
        ProblemError: (when called) an image cannot be read or has another size.
    """
    shape: list[tuple[int, ...]] = []
    spare: list[int] = []

    def read(index: int) -> np.ndarray:
        image = _decode(sequence.images[index])
        if not shape:
            shape.append(image.shape if index == 0 else _decode(sequence.images[0]).shape)
        if image.shape != shape[0]:
            sizes = [f"{s[1]} x {s[0]}" for s in (image.shape, shape[0])]
            raise ProblemError(f"{display_name(sequence.images[index])}: is {sizes[0]} pixels, the first is {sizes[1]}")
        if image.dtype != np.uint8:
            spare[:] = spare or [spare_bits(sequence)]
            image = np.minimum(image >> spare[0], 2**GREY_BITS - 1).astype(np.uint8)
        return image

    return read


def spare_bits(sequence: Sequence) -> int:
    """Number of low bits to drop from every image, so that the first one fits into 8 bits.

    Cameras of 10 or 12 bits leave the highest bits of their 16-bit images empty.

    Raises:
        ProblemError: the first image cannot be read.
    """
    first = _decode(sequence.images[0])
    return GREY_BITS if first.dtype == np.uint8 else max(int(first.max()).bit_length() - GREY_BITS, 0)


def _decode(path: Path) -> np.ndarray:
    """Grey image of a file, shape (height, width), uint8 or uint16."""
    from jaxba.datasets.kitti.opencv import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise ProblemError(f"{display_name(path)}: cannot be read: {reason(error)}") from None
    complete = (
        _is_complete_png(data) if path.suffix.lower() == ".png" else bool(data)
    )  # for a damaged one libpng prints warnings
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if complete else None
    if image is None:
        raise ProblemError(f"{display_name(path)}: is no image that can be decoded")
    return np.asarray(image)


def _is_complete_png(data: bytes) -> bool:
    """Whether the bytes are a complete PNG file, and all its chunks have the right checksums.

    Source: the PNG specification (ISO/IEC 15948), section 5.3: length, name, content, CRC-32 of name and content.
    """
    at = len(PNG_SIGNATURE)
    if data[:at] != PNG_SIGNATURE:
        return False
    while len(data) >= at + 12:
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False


def stamp(path: StrPath) -> str:
    """Key of an image file that changes with it: absolute path, size and modification time."""
    status = os.stat(path)
    return f"{os.path.abspath(path)} {status.st_size} {status.st_mtime_ns}"
