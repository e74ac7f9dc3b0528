"""Bundler models (`bundle.out`, version 0.3): cameras with rotation matrices, and for each point
the views of it.

The camera is BAL's: it looks down -z and `z = f (1 + k1 |p|^2 + k2 |p|^4) p` with `p = -P.xy /
P.z`, pixels from the image centre, y upwards. Source: Snavely, "Bundler v0.4 User's Manual",
https://www.cs.cornell.edu/~snavely/bundler/"""

from __future__ import annotations

from functools import partial

import numpy as np

from jaxba.io.bal import bal_only
from jaxba.io.encoding import text_pieces
from jaxba.io.files import StrPath, display_name, open_output
from jaxba.io.notes import note_origin
from jaxba.io.ply import POINT_COLOUR
from jaxba.io.text import Text, numbered, read_tracks
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import angle_axis, are_rotations, rotation_matrices
from jaxba.problem.labels import part_name
from jaxba.typing import LARGEST_COUNT

HEADER = b"# Bundle file v0.3"  # first line of every file of this version

_CAMERA = (
    "f",
    "k1",
    "k2",
    *(f"R{row}{column}" for row in "123" for column in "123"),
    "t1",
    "t2",
    "t3",
)


def read_bundler(path: StrPath) -> BundleProblem:
    """Reads a Bundler model of version 0.3, plain or compressed by bzip2, gzip or xz.

    Cameras that Bundler could not register (f = 0) are dropped and the others renumbered. Points
    are kept even when fewer than two cameras see them. Colours and key-point numbers are ignored.
    The path may be a pipe. Raises ProblemError: the file cannot be read or is no valid model, or a
    point is seen by an unregistered camera; one line that names the file and, where there is one,
    the line and the field."""
    text = Text(text_pieces(path), display_name(path))
    header = text.next_line()
    if header != HEADER:
        shown = ascii(header[:40].decode("latin-1"))
        raise ProblemError(
            f"{text.where}: {shown} is not the header {HEADER.decode()!r} of a Bundler file"
        )
    problem = _read(text)
    note_origin(path, np.asarray(problem.observations))
    return problem


def write_bundler(problem: BundleProblem, path: StrPath) -> None:
    """Writes a Bundler model of version 0.3; compressed if the name ends in `.bz2`, `.gz` or `.xz`.

    The file is replaced whole or not at all. Observations stand in the order of their points,
    rotations are matrices, and points are grey. Covariances, weights and shared intrinsics cannot
    be stored, as in BAL. Arrays are of NumPy or JAX. Raises ProblemError: the problem is not valid,
    a camera that sees points has focal length 0, which stands for cameras that are not registered,
    lenses are not BAL's, or the file cannot be written."""
    valid = bal_only(problem, path)
    cameras = np.asarray(valid.cameras)
    camera_index = np.asarray(valid.camera_index)
    lost = np.flatnonzero(
        (cameras[:, 6] == 0) & (np.bincount(camera_index, minlength=len(cameras)) > 0)
    )
    if lost.size:
        name = part_name(problem.labels, "image", lost[0])
        raise ProblemError(f"cannot write {display_name(path)}: {name} has focal length 0")
    order = np.argsort(valid.point_index, kind="stable")
    views = np.bincount(np.asarray(valid.point_index), minlength=valid.num_points).tolist()
    keys = numbered(camera_index)[order].tolist()
    pixels = valid.observations[order].tolist()
    rows = zip(camera_index[order].tolist(), keys, pixels, strict=True)
    colour = " ".join(map(str, POINT_COLOUR))
    with open_output(path) as file:
        file.write(HEADER + f"\n{valid.num_cameras} {valid.num_points}\n".encode())
        for camera, rotation in zip(
            cameras.tolist(), rotation_matrices(cameras[:, :3]).tolist(), strict=True
        ):
            parts = [camera[6:], *rotation, camera[3:6]]
            file.write("".join(" ".join(map(str, part)) + "\n" for part in parts).encode())
        for point, count in zip(np.asarray(valid.points).tolist(), views, strict=True):
            seen = "".join(
                f" {camera} {key} {x} {y}"
                for camera, key, (x, y) in (next(rows) for _ in range(count))
            )
            file.write(f"{point[0]} {point[1]} {point[2]}\n{colour}\n{count}{seen}\n".encode())


def _read(text: Text) -> BundleProblem:
    values = text.read_numbers(partial(_field, 0))
    text.need(2)
    num_cameras, num_points = text.integers(range(2), 1, LARGEST_COUNT).tolist()
    text.field = partial(_field, num_cameras)
    start = 2 + len(_CAMERA) * num_cameras
    text.need(start)
    cameras = values[2:start].reshape(-1, len(_CAMERA))
    points, camera_index, point_index, pixels, end = read_tracks(
        text, start, num_points, num_cameras
    )
    registered = _check_cameras(text, cameras, camera_index)
    rotations = cameras[registered, 3:12].reshape(-1, 3, 3)
    parameters = (angle_axis(rotations), cameras[registered, 12:], cameras[registered, :3])
    text.finish(end)
    new_index = np.cumsum(registered) - 1
    try:
        return BundleProblem.create(
            np.hstack(parameters), points, pixels, new_index[camera_index], point_index
        )
    except ProblemError as error:
        raise ProblemError(f"{text.name}: {error}") from error


def _check_cameras(text: Text, cameras: np.ndarray, camera_index: np.ndarray) -> np.ndarray:
    """Mask (cameras,) of registered cameras, after a check that they have rotations and that views
    name no others."""
    registered = cameras[:, 0] != 0
    used = np.bincount(camera_index, minlength=len(cameras)) > 0
    rotation = are_rotations(cameras[:, 3:12].reshape(-1, 3, 3))
    for start, complaint, bad in (
        (0, "stands for a camera that is not registered, but a view names it", used & ~registered),
        (3, "is the first number of a matrix that is no rotation", registered & ~rotation),
    ):
        if bad.any():
            text.fail(2 + len(_CAMERA) * int(bad.argmax()) + start, complaint)
    return registered


def _field(num_cameras: int, ordinal: int) -> str:
    """Description of the number at an ordinal, given how many cameras the file names (0 while that
    is read)."""
    if ordinal < 2:
        return f"number of {('cameras', 'points')[ordinal]}"
    camera, part = divmod(ordinal - 2, len(_CAMERA))
    return f"{_CAMERA[part]} of camera {camera}"
