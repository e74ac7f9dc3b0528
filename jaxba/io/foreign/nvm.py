"""VisualSFM's models (`.nvm`, version 3): images with focal length, pose and one distortion, then points with views.

    NVM_V3 [FixedK fx cx fy cy r]
    number of images, and for each: name, f, quaternion w x y z, centre x y z, r, 0
    number of points, and for each: x y z, red green blue, number of views, and for each: image, key-point, x, y

The camera looks down +z with y downwards; pixels are relative to the principal point. The distortion acts the other way
round than BAL's: the measured m becomes the undistorted `(1 + r |m|^2 / f^2) m`. `NVM_V3_R9T` has rotation matrices and
translations. Source: Wu, "VisualSFM: documentation", http://ccwu.me/vsfm/doc.html#nvm; for f^2 and R9T Wu et al.,
Multicore Bundle Adjustment, `SetNormalizedMeasurementDistortion` and `LoadNVM`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.encoding import text_pieces
from jaxba.io.files import StrPath, display_name
from jaxba.io.foreign.cameras import ForeignLens, assemble
from jaxba.io.notes import note, note_origin
from jaxba.io.text import Text, finite_numbers, read_tracks
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP, are_rotations, translations
from jaxba.typing import LARGEST_COUNT

HEADERS = (b"NVM_V3", b"NVM_V3_R9T")  # first words of the versions that are read
_SMALLEST_DETERMINANT = 1e-6  # of the derivative of the distortion; below it the image folds over itself

_FIELDS = ("f", "qw", "qx", "qy", "qz", "cx", "cy", "cz", "r", "0")
_FIELDS_R9T = ("f", *(f"R{row}{column}" for row in "123" for column in "123"), "tx", "ty", "tz", "r", "0")


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what is not finite then is refused or left out
def read_nvm(path: StrPath) -> BundleProblem:
    """Reads the first model of a VisualSFM file.

    An image without distortion is a camera of BAL, whose f, k1 and k2 are optimised. With one, its pixels are
    undistorted once and residuals weighted so that to first order they are those of the measured image; its f is
    optimised, k1 and k2 stay zero. With `FixedK` all intrinsics stay as they are. Raises ProblemError: the file cannot
    be read or is no valid model; one line that names the file and, where there is one, the line and the field."""
    text = Text(text_pieces(path), display_name(path))
    matrices, calibration = _header(text)
    images = _images(text, matrices)
    values = text.read_numbers(lambda _: "number of points")
    text.need(1)
    count = int(text.integers([0], 0, LARGEST_COUNT)[0])
    if not count:
        raise ProblemError(f"{text.name}: its first model has no points")
    points, camera_index, point_index, measured, end = read_tracks(text, 1, count, len(images))
    if end < values.size and values[end] > 0:  # the number of images of the next model, or 0
        note(path, "only the first model of the file is read")
    note_origin(path, measured)
    lenses, lens_of, coefficients = _lenses(images, calibration)
    focal = np.array([lens.focal for lens in lenses])
    of_views = lens_of[camera_index]
    pixels, whitening = _undistorted(measured, focal[of_views], coefficients[of_views])
    poses = _poses(images, matrices)
    return assemble(path, lenses, lens_of, *poses, points, pixels, camera_index, point_index, whitening)


def _lenses(
    images: Float[np.ndarray, "images numbers"], calibration: list[float] | None
) -> tuple[list[ForeignLens], Int[np.ndarray, " images"], Float[np.ndarray, " lenses"]]:
    """The lenses without distortion, the lens of each image, and r of each lens."""
    if calibration is not None:
        fx, _, fy, _, r = calibration
        return [ForeignLens("FixedK", (fx, fy), free=False)], np.zeros(len(images), np.int64), np.array([r])
    lenses = [
        ForeignLens(f"image {image}", (f, f), distortion={} if r else {"k1": 0.0, "k2": 0.0})
        for image, (f, *_, r, _) in enumerate(images.tolist())
    ]
    return lenses, np.arange(len(lenses)), images[:, -2]


def _undistorted(
    pixels: Float[np.ndarray, "n 2"], focal: Float[np.ndarray, "n 2"], r: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Undistorted pixels, NaN beyond the radius at which the image folds over itself, and the matrices that turn their
    residuals (y upwards) into those of the measured pixels to first order."""
    measured = pixels / focal
    square = r * (measured**2).sum(axis=1)
    determinant = (1 + square) * (1 + 3 * square)
    good = (1 + 3 * square > 0) & (determinant >= _SMALLEST_DETERMINANT) & np.isfinite(determinant)
    moved = np.where(good[:, None], focal * (1 + square)[:, None] * measured, np.nan)
    measured = measured * COLMAP_FLIP[:2]
    turned = 2 * r[:, None, None] * measured[:, :, None] * measured[:, None, :]
    derivative = np.where(good[:, None, None], (1 + square)[:, None, None] * np.eye(2) + turned, np.eye(2))
    return np.where(r[:, None] == 0, pixels, moved), np.linalg.inv(derivative)


def _poses(
    images: Float[np.ndarray, "images numbers"], matrices: bool
) -> tuple[Float[np.ndarray, "images 3 3"], Float[np.ndarray, "images 3"]]:
    """Rotations and translations of images."""
    if matrices:
        return images[:, 1:10].reshape(-1, 3, 3), images[:, 10:13]
    from scipy.spatial.transform import Rotation

    quaternions = images[:, [2, 3, 4, 1]]
    largest = np.abs(quaternions).max(axis=1, keepdims=True)  # without it squares overflow
    rotations = Rotation.from_quat(quaternions / largest).as_matrix()
    return rotations, translations(rotations, images[:, 5:8])


def _header(text: Text) -> tuple[bool, list[float] | None]:
    """Whether poses are rotation matrices and translations, and fx cx fy cy r of all images."""
    words, where = text.next_line().split(), text.where
    if not words or words[0] not in HEADERS:
        shown = ascii(b" ".join(words)[:40].decode("latin-1"))
        raise ProblemError(f"{where}: {shown} is not the header 'NVM_V3' of a VisualSFM file")
    if len(words) == 1:
        return words[0] == HEADERS[1], None
    if words[1] != b"FixedK" or len(words) != 7:
        raise ProblemError(f"{where}: after {words[0].decode()} there must be nothing, or FixedK and fx cx fy cy r")
    return words[0] == HEADERS[1], finite_numbers(words[2:], ("fx", "cx", "fy", "cy", "r"), where)


def _images(text: Text, matrices: bool) -> Float[np.ndarray, "images numbers"]:
    """The numbers of the images' lines."""
    line, where = text.next_line(), text.where
    if not line:
        raise ProblemError(f"{where}: the file ends before the number of images")
    count = finite_numbers([line], ("number of images",), where)[0]
    if not count.is_integer() or not 1 <= count <= LARGEST_COUNT:
        raise ProblemError(f"{where}: {count:g} is no number of images of a model")
    fields = _FIELDS_R9T if matrices else _FIELDS
    rows = []
    for image in range(int(count)):
        words, where = text.next_line().rsplit(maxsplit=len(fields)), text.where  # names may have blanks
        if not words:
            raise ProblemError(f"{where}: the file ends before image {image} of {count:g}")
        if len(words) != len(fields) + 1:
            raise ProblemError(f"{where}: image {image} has {len(words)} fields instead of {len(fields) + 1}")
        rows.append(finite_numbers(words[1:], fields, f"{where}: image {image}"))
        if matrices and not are_rotations(np.array(rows[-1][1:10]).reshape(1, 3, 3))[0]:
            raise ProblemError(f"{where}: image {image}: R11 to R33 are no rotation")
        if not matrices and not any(rows[-1][1:5]):
            raise ProblemError(f"{where}: image {image}: qw to qz are no rotation")
    return np.array(rows)
