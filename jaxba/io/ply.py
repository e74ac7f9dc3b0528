"""PLY point clouds for viewers such as MeshLab or CloudCompare. Source: Turk 1994, "The PLY Polygon
File Format"."""

from __future__ import annotations

import numpy as np

from jaxba.io.files import StrPath, open_output
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import camera_centers

POINT_COLOUR = (192, 192, 192)  # grey, seen on black and on white
CAMERA_COLOUR = (0, 255, 0)  # green, as in the PLY files of Ceres' bundle adjuster

_VERTEX = np.dtype([("position", "<f8", 3), ("colour", "u1", 3)])


def write_ply(problem: BundleProblem, path: StrPath) -> None:
    """Writes the points (grey), then the camera centres (green), as coloured vertices in scene
    units.

    Vertices are binary, little-endian, and hold the float64 numbers exactly. The file is replaced
    whole or not at all; it is compressed if the name ends in `.bz2`, `.gz` or `.xz`. Arrays are of
    NumPy or JAX. Raises ProblemError: a point or camera centre is not finite, or the file cannot be
    written."""
    points = np.asarray(problem.points, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        centres = camera_centers(problem.cameras)
    for name, positions in (("point", points), ("centre of camera", centres)):
        bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
        if bad.size:
            raise ProblemError(f"{name} {bad[0]} is not finite: {positions[bad[0]].tolist()}")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {len(points)} points, then {len(centres)} camera centres",
        f"element vertex {len(points) + len(centres)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        "end_header",
    ]
    vertices = np.empty(len(points) + len(centres), dtype=_VERTEX)
    vertices["position"] = np.concatenate([points, centres])
    vertices["colour"][: len(points)], vertices["colour"][len(points) :] = (
        POINT_COLOUR,
        CAMERA_COLOUR,
    )
    with open_output(path) as file:
        file.write(("\n".join(header) + "\n").encode() + vertices.tobytes())
