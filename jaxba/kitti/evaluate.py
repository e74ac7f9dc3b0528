"""Errors of a problem and its solutions against the ground truth, and their trajectories for other tools."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.io import read_problem
from jaxba.io.files import StrPath, display_name, open_output, strip_compression
from jaxba.io.frames import Sidecar
from jaxba.kitti import trajectory
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.similarity import Similarity, umeyama


class Scores(NamedTuple):
    """Errors of one trajectory, in metres and degrees; see `trajectory`."""

    scale: float  # metres per unit of the trajectory
    absolute: trajectory.Errors
    relative: trajectory.RelativeErrors
    segments: trajectory.SegmentErrors | None


class Evaluated(NamedTuple):
    """A problem or solution and its errors."""

    name: str
    problem: BundleProblem
    poses: Float[np.ndarray, "cameras 3 4"]  # aligned with the truth, or with the first camera
    points: Float[np.ndarray, "points 3"]  # the same
    rms: float  # reprojection error, pixels
    scores: Scores | None


def score(
    poses: Float[np.ndarray, "cameras 3 4"],
    truth: Float[np.ndarray, "cameras 3 4"],
    lengths: tuple[float, ...] = trajectory.DEVKIT_LENGTHS,
) -> Scores:
    """All errors of a trajectory after its alignment. Raises ProblemError where it cannot be aligned."""
    similarity = umeyama(poses[:, :, 3], truth[:, :, 3])
    aligned = similarity.poses(poses)
    return Scores(
        similarity.scale,
        trajectory.absolute_errors(aligned, truth),
        trajectory.relative_errors(aligned, truth),
        trajectory.segment_errors(aligned, truth, lengths),
    )


def evaluate(
    paths: Sequence[StrPath],
    side: Sidecar,
    truth: Float[np.ndarray, "cameras 3 4"] | None,
    lengths: tuple[float, ...] = trajectory.DEVKIT_LENGTHS,
) -> list[Evaluated]:
    """A problem and its solutions, each aligned with the truth on its own; without a truth, with the first camera.

    Raises:
        ProblemError: a file cannot be read, has other cameras than the sidecar file, or cannot be aligned.
    """
    results = []
    for path in paths:
        problem = read_problem(path)
        if problem.num_cameras != len(side.frames):
            counts = f"{problem.num_cameras} cameras, the sidecar file names {len(side.frames)} frames"
            raise ProblemError(f"{display_name(path)}: has {counts}")
        poses, points = geometry.camera_poses(problem.cameras), np.asarray(problem.points)
        scores = None if truth is None else score(poses, truth, lengths)
        if truth is None:
            similarity = Similarity(1.0, poses[0, :, :3].T, -poses[0, :, :3].T @ poses[0, :, 3])
        else:
            similarity = umeyama(poses[:, :, 3], truth[:, :, 3])
        rms = float(np.sqrt(2 * geometry.cost(problem) / problem.num_observations))
        if not np.isfinite([rms, *(() if scores is None else _numbers(scores))]).all():
            raise ProblemError(f"{display_name(path)}: an error is not finite: a camera or point lies where it cannot")
        name = Path(strip_compression(path)).stem
        results.append(Evaluated(name, problem, similarity.poses(poses), similarity.points(points), rms, scores))
    return results


def _numbers(scores: Scores) -> list[float]:
    """All errors of a trajectory, in one list."""
    parts = (scores.absolute, scores.relative.translation, scores.relative.rotation, scores.segments or ())
    return [scores.scale, *(float(number) for part in parts for number in part)]


def as_json(results: Sequence[Evaluated], side: Sidecar) -> dict[str, Any]:
    """Results of `evaluate` for a JSON file."""
    return {
        "frames": list(side.frames),
        "results": [
            {
                "name": r.name,
                "cameras": r.problem.num_cameras,
                "points": r.problem.num_points,
                "observations": r.problem.num_observations,
                "rms_px": r.rms,
                **({} if r.scores is None else _scores_json(r.scores)),
            }
            for r in results
        ],
    }


def _scores_json(scores: Scores) -> dict[str, Any]:
    return {
        "scale": scores.scale,
        "ate_m": scores.absolute._asdict(),
        "rpe_translation_m": scores.relative.translation._asdict(),
        "rpe_rotation_deg": scores.relative.rotation._asdict(),
        "segments": None if scores.segments is None else scores.segments._asdict(),
    }


def write_poses(path: StrPath, poses: Float[np.ndarray, "cameras 3 4"]) -> None:
    """Writes 12 numbers per line and pose, as KITTI and evo read them. Raises ProblemError."""
    with open_output(path) as file:
        file.write("".join(" ".join(map(repr, row)) + "\n" for row in poses.reshape(-1, 12).tolist()).encode())
