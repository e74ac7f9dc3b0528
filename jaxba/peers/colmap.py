"""COLMAP's cost functions for Ceres, and what their Python bindings lack. Needs the extra `ceres`.

Ceres then runs without Python inside. The camera is COLMAP's RADIAL `[f, cx, cy, k1, k2]` with a pose `[quaternion
xyzw, translation]` in one block, looking down +z with y downwards: BAL's camera turned by pi about x.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import numpy as np
from jaxtyping import Float

try:
    # in this order: pycolmap hands out pyceres' types
    import pyceres
    import pycolmap
    import pycolmap.cost_functions
except ModuleNotFoundError:
    raise ImportError("this needs pyceres and pycolmap: pip install jaxba[ceres]") from None

pyceres.logging.minloglevel = pyceres.logging.Level.ERROR.value  # a failed factorisation is a rejected step, no news

POSE_SIZE, LENS_SIZE = 7, 5
"""Numbers of a pose and of a RADIAL camera."""

PRINCIPAL_POINT = (1, 2)
"""Where cx and cy stand in a RADIAL camera."""

SMALLEST_DEPTH = float(np.finfo(np.float64).eps)
"""COLMAP takes the residual of a point that is less far in front of its camera as zero."""


def backend(mode: str) -> str:
    """The library in the words of a record, e.g. `pyceres 2.6 (Ceres 2.2.0, dense)`."""
    return f"pyceres {pyceres.__version__} (Ceres {pyceres.__ceres_version__}, {mode})"


def reprojection(pixel: Float[np.ndarray, " 2"]) -> Any:
    """COLMAP's reprojection error of a RADIAL camera, in C++; its blocks are a point, a pose and a camera."""
    return pycolmap.cost_functions.ReprojErrorCost(pycolmap.CameraModelId.RADIAL, pixel)


@functools.cache
def pose_manifold() -> Any:
    """The manifold of a pose: unit quaternions times translations, 6 dimensions.

    Neither package lets Python make one (pyceres 2.6, pycolmap 4.2.1), so it is borrowed from a bundle adjuster of two
    images and one point. Both that problem and the handle which `get_manifold` returns believe that they own it, and
    would free it twice: they are kept for ever, a few kilobytes in a process.
    """
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(camera_id=1, model="RADIAL", width=1, height=1, params=[1.0, 0, 0, 0, 0])
    model.add_camera_with_trivial_rig(lens)
    config = pycolmap.BundleAdjustmentConfig()
    for number in (1, 2):
        image = pycolmap.Image(name=str(number), keypoints=np.zeros((1, 2)), camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        config.add_image(number)
    track = pycolmap.Track([pycolmap.TrackElement(number, 0) for number in (1, 2)])
    model.add_point3D(np.array([0.0, 0.0, 1.0]), track)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    problem = adjuster.problem
    frame: Any = model.frame(model.image(1).frame_id)
    manifold = problem.get_manifold(frame.rig_from_world.params)
    for kept in (model, adjuster, problem, manifold):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(kept))
    return manifold


class AnySide(pyceres.CostFunction):
    """The same error for a point on either side of its camera, as BAL counts it.

    Python evaluates it, so it is for the few observations that COLMAP's would leave out.
    """

    def __init__(self, pixel: Float[np.ndarray, " 2"]) -> None:
        super().__init__()
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([3, POSE_SIZE, LENS_SIZE])
        self.pixel = pixel

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """`f (1 + k1 r + k2 r^2) p + c - z` with `p = P.xy / P.z`, `r = |p|^2`, and its derivatives where asked for."""
        point, pose, (f, cx, cy, k1, k2) = parameters
        v, w = pose[:3], pose[3]
        turned = np.cross(v, point)
        local = point + 2 * (w * turned + np.cross(v, turned)) + pose[4:]
        with np.errstate(all="ignore"):
            p = local[:2] / local[2]
            r = p @ p
            distortion = 1 + r * (k1 + k2 * r)
            residuals[:] = f * distortion * p + (cx, cy) - self.pixel
            if jacobians is None:
                return True
            by_p = f * (distortion * np.eye(2) + 2 * (k1 + 2 * k2 * r) * np.outer(p, p))
            by_local = by_p @ np.column_stack([np.eye(2), -p]) / local[2]
        rotation = np.eye(3) + 2 * (w * _cross(v) + _cross(v) @ _cross(v))
        by_vector = -2 * (w * _cross(point) + _cross(turned) + _cross(v) @ _cross(point))
        by_pose = by_local @ np.column_stack([by_vector, 2 * turned, np.eye(3)])
        by_lens = np.column_stack([distortion * p, np.eye(2), f * r * p, f * r * r * p])
        for target, value in zip(jacobians, (by_local @ rotation, by_pose, by_lens), strict=True):
            if target is not None:
                target[:] = value.ravel()
        return True


def _cross(v: np.ndarray) -> np.ndarray:
    """The matrix `[v]x`."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
