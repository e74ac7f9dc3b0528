"""PLY point clouds for viewers such as MeshLab or CloudCompare. Source: Turk 1994, "The PLY Polygon File Format"."""

from __future__ import annotations

import numpy as np

from jaxba.io.files import StrPath, open_output
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import camera_centers

POINT_COLOUR = (192, 192, 192)
"""Grey, seen on black and on white."""

CAMERA_COLOUR = (0, 255, 0)
"""Green, as in the PLY files of Ceres' bundle adjuster."""

_VERTEX = np.dtype([("position", "<f8", 3), ("colour", "u1", 3)])
_WRITE_ROWS = 1 << 15


def write_ply(problem: BundleProblem, path: StrPath, *, ascii: bool = False) -> None:
    """Writes the points (grey), then the camera centres (green), as coloured vertices in scene units.

    The file is replaced whole or not at all; it is compressed if the name ends in `.bz2`, `.gz` or `.xz`.

    Args:
        problem: of NumPy or JAX arrays.
        path: the file, replaced if it exists.
        ascii: text instead of little-endian binary. Both hold the float64 numbers exactly.

    Raises:
        ProblemError: a point or camera centre is not finite, or the file cannot be written.
    """
    points = np.asarray(problem.points, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        centres = camera_centers(problem.cameras)
    for name, positions in (("point", points), ("centre of camera", centres)):
        bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
        if bad.size:
            raise ProblemError(f"{name} {bad[0]} is not finite: {positions[bad[0]].tolist()}")
    header = [
        "ply",
        f"format {'ascii' if ascii else 'binary_little_endian'} 1.0",
        f"comment {len(points)} points, then {len(centres)} camera centres",
        f"element vertex {len(points) + len(centres)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        "end_header",
    ]
    with open_output(path) as file:
        file.write(("\n".join(header) + "\n").encode())
        for positions, colour in ((points, POINT_COLOUR), (centres, CAMERA_COLOUR)):
            tail = "{} {} {}\n".format(*colour)
            for start in range(0, len(positions), _WRITE_ROWS):
                rows = positions[start : start + _WRITE_ROWS]
                if ascii:
                    file.write("".join([f"{x} {y} {z} {tail}" for x, y, z in rows.tolist()]).encode())
                else:
                    vertices = np.empty(len(rows), dtype=_VERTEX)
                    vertices["position"], vertices["colour"] = rows, colour
                    file.write(vertices.tobytes())
