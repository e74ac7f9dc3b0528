"""COLMAP's reprojection error for Ceres, and what its Python bindings lack. Needs the extra `ceres`.

The cost function is C++, so that Ceres does not call Python in its inner loops. The camera model is COLMAP's RADIAL
with parameters `[f, cx, cy, k1, k2]`, and the pose `[quaternion xyzw, translation]` is one parameter block. COLMAP's
camera looks along +z with y downwards: it is BAL's camera rotated by pi about x.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.problem import geometry

try:
    # in this order: pycolmap returns objects of pyceres' types
    import pyceres
    import pycolmap
    import pycolmap.cost_functions
except ModuleNotFoundError:
    raise ImportError("this needs pyceres and pycolmap: pip install jaxba[ceres]") from None

pyceres.logging.minloglevel = pyceres.logging.Level.ERROR.value  # a failed factorisation is only a rejected step

POSE_SIZE, LENS_SIZE = 7, 5  # numbers of parameters of a pose and of a RADIAL camera
PRINCIPAL_POINT = (1, 2)  # indices of cx and cy among the parameters of a RADIAL camera

SMALLEST_DEPTH = float(np.finfo(np.float64).eps)
"""COLMAP sets the residual of a point to zero if its depth is smaller than this."""


def backend(mode: str) -> str:
    """Name and versions of the library for `Record.backend`, e.g. `pyceres 2.6 (Ceres 2.2.0, dense)`."""
    return f"pyceres {pyceres.__version__} (Ceres {pyceres.__ceres_version__}, {mode})"


def reprojection(pixel: Float[np.ndarray, " 2"]) -> Any:
    """COLMAP's reprojection error of a RADIAL camera, in C++. Its parameter blocks are point, pose and camera."""
    return pycolmap.cost_functions.ReprojErrorCost(pycolmap.CameraModelId.RADIAL, pixel)


@functools.cache
def pose_manifold() -> Any:
    """The 6-dimensional manifold of a pose: unit quaternions times translations.

    Neither package can create one from Python (pyceres 2.6, pycolmap 4.2.1), so it is taken from a bundle adjuster of
    two images and one point. That problem and the object which `get_manifold` returns both own the manifold and would
    free it twice. Therefore both are kept until the process ends, which costs a few kilobytes.
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


class TwoSidedReprojection(pyceres.CostFunction):
    """The reprojection error of `reprojection`, also for points behind their camera, as BAL defines it.

    It is evaluated in Python and therefore slow. It is used only for the few observations that COLMAP ignores.
    """

    def __init__(self, pixel: Float[np.ndarray, " 2"]) -> None:
        super().__init__()
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([3, POSE_SIZE, LENS_SIZE])
        self.pixel = pixel

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """`f (1 + k1 r + k2 r^2) p + c - z` with `p = P.xy / P.z` and `r = |p|^2`, and the requested Jacobians."""
        point, pose, (f, cx, cy, k1, k2) = parameters
        v, w = pose[:3], pose[3]
        turned = np.cross(v, point)
        local = point + 2 * (w * turned + np.cross(v, turned)) + pose[4:]
        with np.errstate(all="ignore"):
            p = geometry.perspective(local[None])[0]
            r = p @ p
            distortion = geometry.radial_distortion(r, k1, k2)
            residuals[:] = f * distortion * p + (cx, cy) - self.pixel
            if jacobians is None:
                return True
            by_p = f * (distortion * np.eye(2) + 2 * (k1 + 2 * k2 * r) * np.outer(p, p))
            by_local = by_p @ np.column_stack([np.eye(2), -p]) / local[2]
        of_v, of_point, of_turned = geometry.cross_matrices(np.stack([v, point, turned]))
        rotation = np.eye(3) + 2 * (w * of_v + of_v @ of_v)
        by_vector = -2 * (w * of_point + of_turned + of_v @ of_point)
        by_pose = by_local @ np.column_stack([by_vector, 2 * turned, np.eye(3)])
        by_lens = np.column_stack([distortion * p, np.eye(2), f * r * p, f * r * r * p])
        for target, value in zip(jacobians, (by_local @ rotation, by_pose, by_lens), strict=True):
            if target is not None:
                target[:] = value.ravel()
        return True
