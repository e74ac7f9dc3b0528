"""Errors of a problem and its solutions against the ground truth, and their trajectories for other tools."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.io import read_problem
from jaxba.io.files import StrPath, display_name, open_output, strip_compression
from jaxba.io.frames import Sidecar
from jaxba.kitti import trajectory_errors
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.similarity import Similarity, umeyama


def score(
    poses: Float[np.ndarray, "cameras 3 4"],
    truth: Float[np.ndarray, "cameras 3 4"],
    lengths: tuple[float, ...] = trajectory_errors.DEVKIT_LENGTHS,
) -> dict[str, Any]:
    """A trajectory's errors after alignment, metres and degrees (`trajectory_errors`). Raises ProblemError."""
    similarity = umeyama(poses[:, :, 3], truth[:, :, 3])
    aligned = similarity.poses(poses)
    translation, rotation = trajectory_errors.relative_errors(aligned, truth)
    segments = trajectory_errors.segment_errors(aligned, truth, lengths)
    return {
        "scale": similarity.scale,  # metres per unit of the trajectory
        "ate_m": trajectory_errors.absolute_errors(aligned, truth)._asdict(),
        "rpe_translation_m": translation._asdict(),
        "rpe_rotation_deg": rotation._asdict(),
        "segments": segments and segments._asdict(),
    }


def evaluate(
    paths: Sequence[StrPath],
    side: Sidecar,
    truth: Float[np.ndarray, "cameras 3 4"] | None,
    lengths: tuple[float, ...] = trajectory_errors.DEVKIT_LENGTHS,
) -> list[tuple[dict[str, Any], Float[np.ndarray, "cameras 3 4"], Float[np.ndarray, "points 3"]]]:
    """A problem and its solutions, each aligned with the truth on its own; without a truth, with the first camera.
    Returns of each: name, sizes, reprojection error and, with a truth, `score`; its aligned poses and points. Raises
    ProblemError: a file cannot be read, has other cameras than the sidecar file, or cannot be aligned."""
    results = []
    for path in paths:
        problem = read_problem(path)
        if problem.num_cameras != len(side.frames):
            counts = f"{problem.num_cameras} cameras, the sidecar file names {len(side.frames)} frames"
            raise ProblemError(f"{display_name(path)}: has {counts}")
        poses, points = geometry.camera_poses(problem.cameras), np.asarray(problem.points)
        numbers = {
            "name": Path(strip_compression(path)).stem,
            "cameras": problem.num_cameras,
            "points": problem.num_points,
            "observations": problem.num_observations,
            "rms_px": float(np.sqrt(2 * geometry.cost(problem) / problem.num_observations)),
            **({} if truth is None else score(poses, truth, lengths)),
        }
        try:
            json.dumps(numbers, allow_nan=False)
        except ValueError:
            raise ProblemError(
                f"{display_name(path)}: an error is not finite: a camera or point lies where it cannot"
            ) from None
        if truth is None:
            similarity = Similarity(1.0, poses[0, :, :3].T, -poses[0, :, :3].T @ poses[0, :, 3])
        else:
            similarity = umeyama(poses[:, :, 3], truth[:, :, 3])
        results.append((numbers, similarity.poses(poses), similarity.points(points)))
    return results


def write_poses(path: StrPath, poses: Float[np.ndarray, "cameras 3 4"]) -> None:
    """Writes 12 numbers per line and pose, as KITTI and evo read them. Raises ProblemError."""
    with open_output(path) as file:
        file.write("".join(" ".join(map(repr, row)) + "\n" for row in poses.reshape(-1, 12).tolist()).encode())
