"""BAL files, the text format of "Bundle Adjustment in the Large".

The numbers, separated by any whitespace, are: the counts of cameras, points and observations; for each observation its
camera, its point, and its x and y in pixels; for each camera 9 numbers; for each point 3. Covariances cannot be stored.
Source: Agarwal et al. 2010, https://grail.cs.washington.edu/projects/bal/"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from jaxba.io.encoding import read_text
from jaxba.io.files import StrPath, display_name, open_output
from jaxba.io.notes import note_origin
from jaxba.io.text import Text
from jaxba.problem.bundle_problem import CAMERA_SIZE, POINT_SIZE, BundleProblem, ProblemError
from jaxba.typing import LARGEST_COUNT

_COUNTS = ("cameras", "points", "observations")
_OBSERVATION = ("camera index", "point index", "x", "y")
_CAMERA = ("rotation x", "rotation y", "rotation z", "translation x", "translation y", "translation z", "f", "k1", "k2")


def read_bal(path: StrPath) -> BundleProblem:
    """Reads a BAL file, plain or compressed by bzip2, gzip or xz (recognised by its first bytes).

    Decimal numbers are rounded correctly, so a problem that is written and read back is the same bit by bit. The path
    may be a pipe. Raises ProblemError: the file cannot be read or is no valid problem; one line that names the file
    and, where there is one, the line and the field."""
    problem = _read(Text(read_text(path), display_name(path)))
    note_origin(path, np.asarray(problem.observations))
    return problem


def write_bal(problem: BundleProblem, path: StrPath) -> None:
    """Writes a BAL file that reads back bit by bit; compressed if the name ends in `.bz2`, `.gz` or `.xz`.

    The file is replaced whole or not at all. BAL cannot store covariances, weights, shared intrinsics or what is
    constant: these are **not** written, and the problem reads back without whitening and with free intrinsics of its
    own for every camera. Arrays are of NumPy or JAX; float32 is written as the float64 of the same value. Raises
    ProblemError: the problem is not valid, for example not finite, has lenses that are not BAL's, or the file cannot be
    written."""
    valid = bal_only(problem, path)
    index = (valid.camera_index.tolist(), valid.point_index.tolist(), valid.observations.tolist())
    with open_output(path) as file:
        file.write(f"{valid.num_cameras} {valid.num_points} {valid.num_observations}\n".encode())
        file.writelines(f"{camera} {point} {x} {y}\n".encode() for camera, point, (x, y) in zip(*index, strict=True))
        for numbers in (valid.cameras, valid.points):
            file.writelines(f"{number}\n".encode() for number in numbers.ravel().tolist())


def bal_only(problem: BundleProblem, path: StrPath) -> BundleProblem:
    """What a file of BAL's cameras holds of a problem, checked. Raises ProblemError."""
    check_bal_lenses(problem, path)
    arrays = (problem.cameras, problem.points, problem.observations, problem.camera_index, problem.point_index)
    return BundleProblem.create(*arrays)


def check_bal_lenses(problem: BundleProblem, path: StrPath) -> None:
    """Raises a ProblemError if a file of BAL's cameras cannot hold a problem."""
    if problem.lenses is not None and not problem.lenses.all_bal:
        names = ", ".join(model.name for model in problem.lenses.models)
        raise ProblemError(f"cannot write {display_name(path)}: it would hold BAL's lenses only, not {names}")


def _read(text: Text) -> BundleProblem:
    values = text.read_numbers(partial(_field, ()))
    text.need(3)
    num_cameras, num_points, num_observations = counts = text.integers(range(3), 1, LARGEST_COUNT).tolist()
    text.field = partial(_field, counts)
    first = 3 + 4 * np.arange(min(num_observations, (len(values) - 3) // 4))
    camera_index = text.integers(first, 0, num_cameras - 1)
    point_index = text.integers(first + 1, 0, num_points - 1)
    ends = np.cumsum([3, 4 * num_observations, CAMERA_SIZE * num_cameras, POINT_SIZE * num_points]).tolist()
    text.need(ends[-1])
    text.finish(ends[-1])
    observations, cameras, points = (values[start:end] for start, end in pairwise(ends))
    try:
        return BundleProblem.create(
            cameras.reshape(-1, CAMERA_SIZE),
            points.reshape(-1, POINT_SIZE),
            observations.reshape(-1, 4)[:, 2:],
            camera_index,
            point_index,
        )
    except ProblemError as error:
        raise ProblemError(f"{text.name}: {error}") from error


def _field(counts: Sequence[int], ordinal: int) -> str:
    """Description of the number at an ordinal, given the counts of the header (none while it is being read)."""
    if ordinal < 3:
        return f"number of {_COUNTS[ordinal]}"
    cameras, _, observations = counts
    at = ordinal - 3
    if at < 4 * observations:
        return f"{_OBSERVATION[at % 4]} of observation {at // 4}"
    at -= 4 * observations
    if at < CAMERA_SIZE * cameras:
        return f"{_CAMERA[at % CAMERA_SIZE]} of camera {at // CAMERA_SIZE}"
    at -= CAMERA_SIZE * cameras
    return f"{'xyz'[at % POINT_SIZE]} of point {at // POINT_SIZE}"
