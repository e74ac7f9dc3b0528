"""Trajectory errors of a problem and its solutions against the ground truth, after a similarity
alignment.

A trajectory is a stack of camera-to-world poses `[R | c]`, shape (poses, 3, 4), in the order of
time. Definitions are those of evo (`evo_ape -a -s`, `evo_rpe -a -s`) and of the KITTI odometry
development kit; each function names its own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba.io import read_problem
from jaxba.io.files import StrPath, display_name, open_output, strip_compression
from jaxba.io.frames import Sidecar
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.similarity import Poses, Similarity, umeyama

DEVKIT_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Metres. Source: `lengths` in the development kit's evaluate_odometry.cpp."""

DEVKIT_STEP = 10  # segments start at every tenth pose. Source: `step_size` there


class Errors(NamedTuple):
    """Statistics of non-negative errors."""

    rmse: float
    mean: float
    median: float
    largest: float


class SegmentErrors(NamedTuple):
    """The development kit's averages over all segments."""

    translation: float  # percent of the segment's length
    rotation: float  # degrees per metre
    segments: int


def absolute_errors(aligned: Poses, truth: Poses) -> Errors:
    """Distances between camera centres, in units of the truth; `rmse` is the ATE, as `evo_ape -a
    -s` prints it.

    Source: Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", section
    IV.B."""
    return _statistics(np.linalg.norm(aligned[:, :, 3] - truth[:, :, 3], axis=1))


def relative_errors(aligned: Poses, truth: Poses) -> tuple[Errors, Errors]:
    """Errors of the motion from each pose to the next, `(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`; evo's RPE
    with a delta of one.

    The estimate must have the truth's scale; its rotation and position do not matter. Returns the
    errors of translations, in units of the truth, and of rotations, degrees."""
    error = _motion(_motion(truth[:-1], truth[1:]), _motion(aligned[:-1], aligned[1:]))
    return _statistics(np.linalg.norm(error[:, :, 3], axis=1)), _statistics(_angles(error))


def segment_errors(
    aligned: Poses, truth: Poses, lengths: tuple[float, ...] = DEVKIT_LENGTHS
) -> SegmentErrors | None:
    """Errors over segments of the true path, per metre; None if the path is too short for all of
    them.

    A segment of length L goes from every tenth pose to the first that is more than L farther along
    the true path.

    Source: evaluate_odometry.cpp of the development kit (`calcSequenceErrors`)."""
    steps = np.linalg.norm(np.diff(truth[:, :, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    pairs = []
    for first in range(0, len(truth), DEVKIT_STEP):
        for length in lengths:
            last = int(np.searchsorted(distance, distance[first] + length, side="right"))
            if last < len(truth):
                pairs.append((first, last, length))
    if not pairs:
        return None
    first, last = (np.array([pair[k] for pair in pairs]) for k in (0, 1))
    length = np.array([pair[2] for pair in pairs])
    error = _motion(_motion(aligned[first], aligned[last]), _motion(truth[first], truth[last]))
    translation = np.linalg.norm(error[:, :, 3], axis=1) / length
    rotation = _angles(error) / length
    return SegmentErrors(100 * float(translation.mean()), float(rotation.mean()), len(pairs))


def path_length(poses: Poses) -> float:
    """Length of the path through all centres."""
    return float(np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1).sum())


def _statistics(errors: np.ndarray) -> Errors:
    return Errors(
        float(np.sqrt((errors**2).mean())),
        float(errors.mean()),
        float(np.median(errors)),
        float(errors.max()),
    )


def _motion(first: Poses, second: Poses) -> Poses:
    """`first^-1 second` of every pair."""
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(first), 1, 4))
    square = [np.concatenate([poses, last], axis=1) for poses in (first, second)]
    return np.linalg.solve(*square)[:, :3]


def _angles(poses: Poses) -> Float[np.ndarray, " poses"]:
    """Rotation angles in degrees."""
    return np.rad2deg(Rotation.from_matrix(poses[:, :, :3]).magnitude())


def score(
    poses: Float[np.ndarray, "cameras 3 4"], truth: Float[np.ndarray, "cameras 3 4"]
) -> dict[str, Any]:
    """A trajectory's errors after alignment, metres and degrees. Raises ProblemError."""
    similarity = umeyama(poses[:, :, 3], truth[:, :, 3])
    aligned = similarity.poses(poses)
    translation, rotation = relative_errors(aligned, truth)
    segments = segment_errors(aligned, truth)
    return {
        "scale": similarity.scale,  # metres per unit of the trajectory
        "ate_m": absolute_errors(aligned, truth)._asdict(),
        "rpe_translation_m": translation._asdict(),
        "rpe_rotation_deg": rotation._asdict(),
        "segments": segments and segments._asdict(),
    }


def evaluate(
    paths: Sequence[StrPath],
    side: Sidecar,
    truth: Float[np.ndarray, "cameras 3 4"] | None,
) -> list[tuple[dict[str, Any], Float[np.ndarray, "cameras 3 4"]]]:
    """A problem and its solutions, each aligned with the truth on its own; without a truth, with
    the first camera. Returns of each: name, sizes, reprojection error and, with a truth, `score`;
    and its aligned poses. Raises ProblemError: a file cannot be read, has other cameras than the
    sidecar file, or cannot be aligned."""
    results = []
    for path in paths:
        problem = read_problem(path)
        if problem.num_cameras != len(side.frames):
            counts = (
                f"{problem.num_cameras} cameras, the sidecar file names {len(side.frames)} frames"
            )
            raise ProblemError(f"{display_name(path)}: has {counts}")
        poses = geometry.camera_poses(problem.cameras)
        numbers = {
            "name": Path(strip_compression(path)).stem,
            "cameras": problem.num_cameras,
            "points": problem.num_points,
            "observations": problem.num_observations,
            "rms_px": float(np.sqrt(2 * geometry.cost(problem) / problem.num_observations)),
            **({} if truth is None else score(poses, truth)),
        }
        try:
            json.dumps(numbers, allow_nan=False)
        except ValueError:
            raise ProblemError(
                f"{display_name(path)}: an error is not finite: a camera or point lies where it "
                "cannot"
            ) from None
        if truth is None:
            similarity = Similarity(1.0, poses[0, :, :3].T, -poses[0, :, :3].T @ poses[0, :, 3])
        else:
            similarity = umeyama(poses[:, :, 3], truth[:, :, 3])
        results.append((numbers, similarity.poses(poses)))
    return results


def write_poses(path: StrPath, poses: Float[np.ndarray, "cameras 3 4"]) -> None:
    """Writes 12 numbers per line and pose, as KITTI and evo read them. Raises ProblemError."""
    with open_output(path) as file:
        file.write(
            "".join(
                " ".join(map(repr, row)) + "\n" for row in poses.reshape(-1, 12).tolist()
            ).encode()
        )
