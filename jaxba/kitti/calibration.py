"""The camera matrix of a sequence, in the forms that KITTI's releases and their relatives have.

| file | lines |
| --- | --- |
| `calib.txt` of the odometry benchmark | `P0: 12 numbers` to `P3:` |
| the same without names | 12 numbers each; the first line is P0, that of the left grey camera |
| `calib_cam_to_cam.txt` of the raw data, `perspective.txt` of KITTI-360 | `P_rect_00: 12 numbers` to `P_rect_03:` |
| `K.txt` | a 3 x 3 matrix, or one of 3 x 4 |

Source: Geiger et al. 2013, "Vision meets robotics: the KITTI dataset"; the readmes of the development kits.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxba.io.files import StrPath, display_name
from jaxba.io.frames import Calibration
from jaxba.io.poses import lines_of, numbers_of
from jaxba.problem.bundle_problem import ProblemError

FILES = ("calib.txt", "K.txt", "calib_cam_to_cam.txt", "perspective.txt")
"""Names of the files, in the order in which they are searched."""

ABOVE = ("calib_cam_to_cam.txt",)
"""Those that are also searched in the folder above: KITTI's raw data have one file for all drives of a day."""


def calibration_files(folder: Path) -> list[Path]:
    """Where the calibration of a sequence's folder may be, in the order of the search."""
    return [folder / name for name in FILES] + [folder.absolute().parent / name for name in ABOVE]


def read_calibration(path: StrPath, camera: int = 0) -> Calibration:
    """Calibration of a camera from a file or a sequence's folder. Raises ProblemError: none, or malformed."""
    place: Path | None = Path(path)
    if place.is_dir():
        place = next((one for one in calibration_files(place) if one.is_file()), None)
    if place is None:
        name, known = display_name(path), " or ".join(FILES)
        raise ProblemError(f"{name}: has no calibration ({known}); --calibration names another")
    name = display_name(place)
    matrix = _matrix([line for _, line in lines_of(place)], name, camera)
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    zeros = matrix[[0, 1, 2, 2], [1, 0, 0, 1]]
    if not (fx > 0 and fy > 0 and matrix[2, 2] == 1 and not zeros.any()):
        raise ProblemError(f"{name}: the matrix of camera {camera} is not [[f, 0, cx], [0, f, cy], [0, 0, 1]]")
    offset = np.linalg.solve(matrix[:, :3], matrix[:, 3])
    return Calibration(fx, fy, float(matrix[0, 2]), float(matrix[1, 2]), tuple(offset.tolist()))


def _matrix(lines: list[str], name: str, camera: int) -> Float[np.ndarray, "3 4"]:
    """The matrix P of a camera from the lines of a file."""
    if any(":" in line for line in lines):
        rows = {key.strip(): rest for key, _, rest in (line.partition(":") for line in lines)}
        keys = (f"P{camera}", f"P_rect_{camera:02d}")
        key = next((key for key in keys if key in rows), None)
        if key is None:
            raise ProblemError(f"{name}: has no line {keys[0]}: or {keys[1]}:")
        return numbers_of(rows[key], 12, f"{name} {key}").reshape(3, 4)
    widths = {len(line.split()) for line in lines}
    if widths == {12}:
        if camera >= len(lines):
            raise ProblemError(f"{name}: has {len(lines)} lines of 12 numbers, none for camera {camera}")
        return numbers_of(lines[camera], 12, f"{name} line {camera + 1}").reshape(3, 4)
    if len(lines) not in (1, 3):
        raise ProblemError(f"{name}: neither lines such as 'P0: 12 numbers' nor a 3 x 3 matrix")
    if len(lines) == 3 and widths == {4}:
        return numbers_of(" ".join(lines), 12, name).reshape(3, 4)
    matrix = np.eye(3, 4)
    matrix[:, :3] = numbers_of(" ".join(lines), 9, name).reshape(3, 3)
    return matrix
