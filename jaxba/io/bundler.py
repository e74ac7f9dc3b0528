"""Bundler models (`bundle.out`, version 0.3): cameras with rotation matrices, and for each point the views of it.

The camera is BAL's: it looks down -z and `z = f (1 + k1 |p|^2 + k2 |p|^4) p` with `p = -P.xy / P.z`, pixels from the
image centre, y upwards. Source: Snavely, "Bundler v0.4 User's Manual", https://www.cs.cornell.edu/~snavely/bundler/
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain

import numpy as np

from jaxba.io.files import READ_ERRORS, StrPath, display_name, open_input, reason
from jaxba.io.text import NumberReader
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import angle_axis
from jaxba.typing import LARGEST_COUNT

HEADER = b"# Bundle file v0.3"
"""First line of every file of this version."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of `R R^T - I` that still counts as rounding; Bundler writes 11 digits, other programs fewer."""

_CAMERA = ("f", "k1", "k2", *(f"R{row}{column}" for row in "123" for column in "123"), "t1", "t2", "t3")
_POINT = ("x", "y", "z", "red", "green", "blue", "number of views")
_VIEW = ("camera index", "key", "x", "y")


def read_bundler(path: StrPath) -> BundleProblem:
    """Reads a Bundler model of version 0.3, plain or compressed by bzip2, gzip or xz.

    Cameras that Bundler could not register (f = 0) are dropped and the others renumbered. Points are kept even when
    fewer than two cameras see them. Colours and key-point numbers are ignored.

    Args:
        path: the file; may be a pipe.

    Raises:
        ProblemError: the file cannot be read or is no valid model, or a point is seen by an unregistered camera; one
            line that names the file and, where there is one, the line and the field.
    """
    name = display_name(path)
    with open_input(path) as blocks:
        numbers = _after_header(blocks, name)
        reader = NumberReader(numbers, name, partial(_field, 0, ()), line=2)
        return _read(reader)


def _after_header(blocks: Iterator[bytes], name: str) -> Iterator[bytes]:
    """The blocks after the first line, which must be the header."""
    line = b""
    try:
        while b"\n" not in line and len(line) <= len(HEADER) + 2 and (block := next(blocks, None)) is not None:
            line += block
    except READ_ERRORS as error:
        raise ProblemError(f"{name} line 1: cannot read on: {reason(error)}") from error
    line, _, rest = line.partition(b"\n")
    if line.strip() != HEADER:
        shown = ascii(line[:40].decode("latin-1"))
        raise ProblemError(f"{name} line 1: {shown} is not the header {HEADER.decode()!r} of a Bundler file")
    return chain([rest], blocks)


def _read(reader: NumberReader) -> BundleProblem:
    values = reader.peek_all()
    starts: list[int] = []

    def need(end: int) -> None:
        if end > values.size:
            reader.missing()

    need(2)
    num_cameras, num_points = reader.integers(range(2), values[:2], 1, LARGEST_COUNT).tolist()
    reader.field = partial(_field, num_cameras, starts)
    position = 2 + len(_CAMERA) * num_cameras
    need(position)
    cameras = values[2:position].reshape(-1, len(_CAMERA))
    for _ in range(num_points):
        starts.append(position)
        need(position + len(_POINT))
        views = float(values[position + 6])
        if not 0 <= views <= LARGEST_COUNT or not views.is_integer():
            reader.integers([position + 6], values[position + 6 : position + 7], 0, LARGEST_COUNT)
        position += len(_POINT) + len(_VIEW) * int(views)
        need(position)
    first_view = np.array(starts) + len(_POINT)
    views = values[first_view - 1].astype(np.int64)
    before = np.cumsum(views) - views
    at = np.repeat(first_view - 4 * before, views) + 4 * np.arange(views.sum())
    camera_index = reader.integers(at, values[at], 0, num_cameras - 1)
    if not camera_index.size:
        raise ProblemError(f"{reader.name}: no camera sees a point")
    registered = _check_cameras(reader, cameras, camera_index)
    rotations = cameras[registered, 3:12].reshape(-1, 3, 3)
    parameters = (angle_axis(rotations), cameras[registered, 12:], cameras[registered, :3])
    points = values[first_view[:, None] - len(_POINT) + np.arange(3)]
    observations = values[at[:, None] + [2, 3]]
    reader.skip(position)
    reader.finish()
    new_index = np.cumsum(registered) - 1
    point_index = np.repeat(np.arange(num_points), views)
    try:
        return BundleProblem.create(np.hstack(parameters), points, observations, new_index[camera_index], point_index)
    except ProblemError as error:
        raise ProblemError(f"{reader.name}: {error}") from error


def _check_cameras(reader: NumberReader, cameras: np.ndarray, camera_index: np.ndarray) -> np.ndarray:
    """Mask (cameras,) of registered cameras, after a check that they have rotations and that views name no others."""
    registered = cameras[:, 0] != 0
    used = np.bincount(camera_index, minlength=len(cameras)) > 0
    rotations = cameras[:, 3:12].reshape(-1, 3, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        residual = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        rotation = (residual <= ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0)
    for start, complaint, bad in (
        (0, "stands for a camera that is not registered, but a view names it", used & ~registered),
        (3, "is the first number of a matrix that is no rotation", registered & ~rotation),
    ):
        if bad.any():
            reader.fail(2 + len(_CAMERA) * int(bad.argmax()) + start, complaint)
    return registered


def _field(num_cameras: int, starts: Sequence[int], ordinal: int) -> str:
    """Description of the number at an ordinal; `starts` are the ordinals of the first numbers of points."""
    if ordinal < 2:
        return f"number of {('cameras', 'points')[ordinal]}"
    camera, part = divmod(ordinal - 2, len(_CAMERA))
    if camera < num_cameras:
        return f"{_CAMERA[part]} of camera {camera}"
    point = bisect_right(starts, ordinal) - 1
    at = ordinal - starts[point]
    if at < len(_POINT):
        return f"{_POINT[at]} of point {point}"
    view, part = divmod(at - len(_POINT), len(_VIEW))
    return f"{_VIEW[part]} of view {view} of point {point}"
