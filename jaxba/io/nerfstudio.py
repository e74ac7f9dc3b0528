"""nerfstudio's `transforms.json`: the cameras of a problem, for radiance fields and Gaussian
splats.

A `transform_matrix` is from the camera to the world, and its camera is OpenGL's, as BAL's is: x to
the right, y up, -z ahead. The world is that of the problem, so there is no `applied_transform`;
nerfstudio turns it upright as it loads. Source: nerfstudio, `colmap_to_json` with
`keep_original_world_coordinate`, and nerfstudio_dataparser.py."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxba.io.colmap.files import read_model
from jaxba.io.colmap.model import Camera
from jaxba.io.colmap.poses import bal_poses
from jaxba.io.colmap.read import registered
from jaxba.io.colmap.write import create_model, with_problem
from jaxba.io.files import StrPath, display_name, open_output
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.camera_models import CAMERA_MODELS
from jaxba.problem.geometry import camera_poses
from jaxba.problem.hold import every_lens

KINDS = {
    **dict.fromkeys(
        ("BAL", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "OPENCV"
    ),
    **dict.fromkeys(
        ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "OPENCV_FISHEYE"
    ),
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
}
"""What nerfstudio calls the camera models that it has."""

IMAGES = "images"  # folder beside the file in which nerfstudio looks for the images


def write_transforms(problem: BundleProblem, path: StrPath, like: StrPath | None = None) -> None:
    """Writes the cameras of a problem as nerfstudio's `transforms.json`, without points.

    `like` is the COLMAP model that the problem was read from, whose names and sizes of images,
    principal points and images without observations the file gets; None: they are made up as by
    `write_colmap`. Raises ProblemError: as `write_colmap`, or a camera model that nerfstudio does
    not have."""
    target = display_name(path)
    model = (
        create_model(problem, target)
        if like is None
        else with_problem(read_model(like), problem, target)[0]
    )
    images = registered(model)[0]
    lenses = {
        camera: _lens(model.cameras[camera])
        for camera in sorted({image.camera for image in images})
    }
    alone = len(lenses) == 1  # then it stands before the frames
    kind = _kind((model.cameras[camera].model for camera in lenses), target)
    poses = camera_poses(bal_poses([image.pose for image in images])) * [1.0, -1.0, -1.0, 1.0]
    frames = [
        {"file_path": f"{IMAGES}/{image.name.decode('utf-8', 'replace')}", "colmap_im_id": image.id}
        | ({} if alone else lenses[image.camera])
        | {"transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        for image, pose in zip(images, poses, strict=True)
    ]
    document = {
        "camera_model": kind,
        **(next(iter(lenses.values())) if alone else {}),
        "frames": frames,
    }
    with open_output(path) as file:
        file.write(json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")


def check_transforms(problem: BundleProblem, path: StrPath) -> None:
    """Raises ProblemError: nerfstudio does not have a lens of the problem, or not beside the
    others."""
    lenses = every_lens(problem)
    used = np.unique(np.asarray(lenses.index))
    _kind((lenses.model_of(int(one)).name for one in used), display_name(path))


def _kind(models: Iterable[str], target: str) -> str:
    """The camera model of a file."""
    names = sorted(set(models))
    if lost := [name for name in names if name not in KINDS]:
        raise ProblemError(f"cannot write {target}: nerfstudio has no camera model {lost[0]}")
    if len(kinds := {KINDS[name] for name in names}) > 1:
        raise ProblemError(
            f"cannot write {target}: nerfstudio has one camera model in a file, not "
            f"{', '.join(names)}"
        )
    return kinds.pop()


def _lens(camera: Camera) -> dict[str, Any]:
    """A camera in nerfstudio's words."""
    numbers = dict(zip(CAMERA_MODELS[camera.model].parameters, camera.params, strict=True))
    bent = {name: value for name, value in numbers.items() if name[0] in "kp"}
    size = {"w": camera.width, "h": camera.height, "cx": numbers["cx"], "cy": numbers["cy"]}
    return {
        "fl_x": camera.focals[0],
        "fl_y": camera.focals[-1],
        **size,
        "k1": 0.0,
        "k2": 0.0,
        **bent,
    }
