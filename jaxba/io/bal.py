"""BAL files, the text format of "Bundle Adjustment in the Large".

The numbers, separated by any whitespace, are: the counts of cameras, points and observations; for
each observation its camera, its point, and its x and y in pixels; for each camera 9 numbers; for
each point 3. Covariances cannot be stored. Source: Agarwal et al. 2010,
https://grail.cs.washington.edu/projects/bal/"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from jaxba.io.decimals import number_lines, observation_lines
from jaxba.io.encoding import text_pieces
from jaxba.io.files import StrPath, display_name, open_output
from jaxba.io.notes import note_origin
from jaxba.io.text import Text
from jaxba.problem.bundle_problem import (
    CAMERA_SIZE,
    POINT_SIZE,
    BundleProblem,
    ProblemError,
    check_is_problem,
)
from jaxba.typing import LARGEST_COUNT

_BLOCK_ROWS = 1 << 18  # observations, or numbers, that are written at once
_COUNTS = ("cameras", "points", "observations")
_OBSERVATION = ("camera index", "point index", "x", "y")
_CAMERA = (
    "rotation x",
    "rotation y",
    "rotation z",
    "translation x",
    "translation y",
    "translation z",
    "f",
    "k1",
    "k2",
)


def read_bal(path: StrPath) -> BundleProblem:
    """Reads a BAL file, plain or compressed by bzip2, gzip or xz (recognised by its first bytes).

    Decimal numbers are rounded correctly, so a problem that is written and read back is the same
    bit by bit. The text is read in blocks: beyond the problem it takes memory for a few of them.
    The path may be a pipe. Raises ProblemError: the file cannot be read or is no valid problem; one
    line that names the file and, where there is one, the line and the field."""
    problem = _read(Text(text_pieces(path), display_name(path)))
    note_origin(path, np.asarray(problem.observations))
    return problem


def write_bal(problem: BundleProblem, path: StrPath) -> None:
    """Writes a BAL file that reads back bit by bit; compressed if the name ends in `.bz2`, `.gz` or
    `.xz`.

    Numbers have the fewest digits that do, those of large problems with exponents (`6.25e1`).

    The file is replaced whole or not at all. BAL cannot store covariances, weights, shared
    intrinsics or what is constant: these are **not** written, and the problem reads back without
    whitening and with free intrinsics of its own for every camera. Arrays are of NumPy or JAX;
    float32 is written as the float64 of the same value. Raises ProblemError: the problem is not
    valid, for example not finite, has lenses that are not BAL's, or the file cannot be written."""
    valid = bal_only(problem, path)
    columns = [
        np.asarray(one) for one in (valid.camera_index, valid.point_index, valid.observations)
    ]
    with open_output(path) as file:
        file.write(f"{valid.num_cameras} {valid.num_points} {valid.num_observations}\n".encode())
        for start in range(0, valid.num_observations, _BLOCK_ROWS):
            file.write(
                observation_lines(*(column[start : start + _BLOCK_ROWS] for column in columns))
            )
        for numbers in (np.ravel(valid.cameras), np.ravel(valid.points)):
            for start in range(0, len(numbers), _BLOCK_ROWS):
                file.write(number_lines(numbers[start : start + _BLOCK_ROWS]))


def bal_only(problem: BundleProblem, path: StrPath) -> BundleProblem:
    """What a file of BAL's cameras holds of a problem, checked. Raises ProblemError."""
    check_is_problem(problem)
    check_bal_lenses(problem, path)
    arrays = (
        problem.cameras,
        problem.points,
        problem.observations,
        problem.camera_index,
        problem.point_index,
    )
    return BundleProblem.create(*arrays)


def check_bal_lenses(problem: BundleProblem, path: StrPath) -> None:
    """Raises a ProblemError if a file of BAL's cameras cannot hold a problem."""
    if problem.lenses is not None and not problem.lenses.all_bal:
        names = ", ".join(model.name for model in problem.lenses.models)
        raise ProblemError(
            f"cannot write {display_name(path)}: it would hold BAL's lenses only, not {names}"
        )


def _read(text: Text) -> BundleProblem:
    counts: list[int] = []
    ends = [3]
    camera_index = np.empty(0, np.int32)
    point_index = np.empty(0, np.int32)
    pixels = np.empty((0, 2))
    cameras = np.empty((0, CAMERA_SIZE))
    points = np.empty((0, POINT_SIZE))
    for block in text.number_blocks(partial(_field, ())):
        counts += text.integers(range(block.start, min(block.stop, 3)), 1, LARGEST_COUNT).tolist()
        if len(counts) < 3:
            continue
        text.field = partial(_field, counts)
        ends = np.cumsum(
            [3, 4 * counts[2], CAMERA_SIZE * counts[0], POINT_SIZE * counts[1]]
        ).tolist()
        start, stop = (min(max(ends[0], at), ends[1]) - 3 for at in (block.start, block.stop))
        for array in (camera_index, point_index, pixels):
            _make_room(array, -(-stop // 4), counts[2])
        for part, target in enumerate((camera_index, point_index, *pixels.T)):
            first = start + (part - start) % 4
            ordinals = range(3 + first, 3 + stop, 4)
            found = text.integers(ordinals, 0, counts[part] - 1) if part < 2 else text.at(ordinals)
            target[first // 4 : first // 4 + len(found)] = found
        for array, total, begin, end in zip(
            (cameras, points), counts, ends[1:], ends[2:], strict=False
        ):
            start, stop = (min(max(begin, at), end) for at in (block.start, block.stop))
            _make_room(array, -((begin - stop) // array.shape[1]), total)
            array.ravel()[start - begin : stop - begin] = text.at(range(start, stop))
        if block.stop > ends[-1]:
            break
    text.need(ends[-1] if len(counts) == 3 else 3)
    text.finish(ends[-1])
    try:
        return BundleProblem.create(cameras, points, pixels, camera_index, point_index)
    except ProblemError as error:
        raise ProblemError(f"{text.name}: {error}") from error


def _make_room(array: np.ndarray, rows: int, total: int) -> None:
    """Makes an array, of which there are no views, as long as so many rows of at most a total need.
    It doubles: what a header says counts for nothing before the numbers are there."""
    if rows > len(array):
        array.resize((min(total, max(rows, 2 * len(array))), *array.shape[1:]), refcheck=False)


def _field(counts: Sequence[int], ordinal: int) -> str:
    """Description of the number at an ordinal, given the counts of the header (none while it is
    being read)."""
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
