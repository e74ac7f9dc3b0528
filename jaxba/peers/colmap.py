"""A problem as one of Ceres and back, with COLMAP's reprojection error. Needs the extra `ceres`.

The cost function is C++, so that Ceres does not call Python in its inner loops. The camera model is
COLMAP's RADIAL with parameters `[f, cx, cy, k1, k2]`, and the pose `[quaternion xyzw, translation]`
is one parameter block. COLMAP's camera looks along +z with y downwards: it is BAL's camera rotated
by pi about x."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP as FLIP
from jaxba.problem.geometry import bal_rotations, colmap_quaternions

try:
    # in this order: pycolmap returns objects of pyceres' types
    import pyceres
    import pycolmap
    import pycolmap.cost_functions
except ModuleNotFoundError:
    raise ImportError("this needs pyceres and pycolmap: pip install jaxba[ceres]") from None

# a failed factorisation is only a rejected step
pyceres.logging.minloglevel = pyceres.logging.Level.ERROR.value

POSE_SIZE, LENS_SIZE = 7, 5  # numbers of parameters of a pose and of a RADIAL camera
PRINCIPAL_POINT = (1, 2)  # indices of cx and cy among the parameters of a RADIAL camera
SMALLEST_DEPTH = float(np.finfo(np.float64).eps)  # below it COLMAP sets a point's residual to zero


def backend(mode: str) -> str:
    """Name and versions of the library for `Record.backend`, e.g. `pyceres 2.6 (Ceres 2.2.0,
    dense)`."""
    return f"pyceres {pyceres.__version__} (Ceres {pyceres.__ceres_version__}, {mode})"


def reprojection(pixel: Float[np.ndarray, " 2"]) -> Any:
    """COLMAP's reprojection error of a RADIAL camera, in C++. Its parameter blocks are point, pose
    and camera."""
    return pycolmap.cost_functions.ReprojErrorCost(pycolmap.CameraModelId.RADIAL, pixel)


@functools.cache
def pose_manifold() -> Any:
    """The 6-dimensional manifold of a pose: unit quaternions times translations.

    Neither package can create one from Python (pyceres 2.6, pycolmap 4.2.1), so it is taken from a
    bundle adjuster of two images and one point. That problem and the object which `get_manifold`
    returns both own the manifold and would free it twice. Therefore both are kept until the process
    ends, which costs a few kilobytes."""
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(camera_id=1, model="RADIAL", width=1, height=1, params=[1.0, 0, 0, 0, 0])
    model.add_camera_with_trivial_rig(lens)
    config = pycolmap.BundleAdjustmentConfig()
    for number in (1, 2):
        image = pycolmap.Image(
            name=str(number), keypoints=np.zeros((1, 2)), camera_id=1, image_id=number
        )
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
    """The reprojection error of `reprojection`, also for points behind their camera, as BAL defines
    it.

    It is evaluated in Python and therefore slow. It is used only for the few observations that
    COLMAP ignores."""

    def __init__(self, pixel: Float[np.ndarray, " 2"]) -> None:
        super().__init__()
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([3, POSE_SIZE, LENS_SIZE])
        self.pixel = pixel

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """`f (1 + k1 r + k2 r^2) p + c - z` with `p = P.xy / P.z` and `r = |p|^2`, and the
        requested Jacobians."""
        point, pose, (f, cx, cy, k1, k2) = parameters
        v = pose[:3]
        w = pose[3]
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


class ColmapProblem:
    """The parameters as NumPy arrays, and a `pyceres.Problem` that changes them in place.

    Each camera has its own pose, f, k1 and k2. The principal point is constant and the gauge is
    free. An observation whose point is not in front of its camera at the start gets the cost
    function `TwoSidedReprojection`, since COLMAP's would be zero. `count_behind` does the same for
    points that move behind their camera later.

    Ceres holds raw pointers into `poses`, `lenses` and `points`, and to the cost functions. This
    object owns all of them, so it must live for as long as `ceres` is used."""

    def __init__(self, problem: BundleProblem) -> None:
        """Copies the parameters. Raises ProblemError: covariances, lenses, constants, priors or
        rigs."""
        parts = problem.whitening, problem.lenses, problem.constants, problem.rigs
        if problem.residuals or any(part is not None for part in parts):
            raise ProblemError(
                "Ceres as a peer takes no covariances, lenses, constants, priors or rigs"
            )
        self.start = problem
        self.poses, self.lenses, self.points = _parameters(problem)
        self.pixels = np.asarray(problem.observations, np.float64) * FLIP[:2]
        self.ceres = pyceres.Problem()
        self._points, self._poses, self._lenses = (
            list(self.points),
            list(self.poses),
            list(self.lenses),
        )
        self._manifolds = (
            pose_manifold(),
            pyceres.SubsetManifold(LENS_SIZE, list(PRINCIPAL_POINT)),
        )
        self._costs: list[Any] = [None] * problem.num_observations
        self._residuals: list[Any] = [None] * problem.num_observations
        # whether the cost function of an observation is the one in Python, shape `(observations,)`
        self.in_python = geometry.depths(problem) < SMALLEST_DEPTH
        for observation, behind in enumerate(self.in_python):
            self._add_observation(observation, TwoSidedReprojection if behind else reprojection)
        self.observing = np.unique(problem.camera_index)  # cameras that have observations
        for camera in self.observing:
            self.ceres.set_manifold(self._poses[camera], self._manifolds[0])
            self.ceres.set_manifold(self._lenses[camera], self._manifolds[1])

    def _add_observation(self, observation: int, cost: Any) -> None:
        camera = self.start.camera_index[observation]
        point = self.start.point_index[observation]
        self._costs[observation] = cost(self.pixels[observation])
        blocks = [self._points[point], self._poses[camera], self._lenses[camera]]
        self._residuals[observation] = self.ceres.add_residual_block(
            self._costs[observation], None, blocks
        )

    def count_behind(self, behind: Bool[np.ndarray, " observations"]) -> int:
        """Replaces cost functions of observations of points that moved behind their camera; returns
        how many."""
        new = np.flatnonzero(behind & ~self.in_python).tolist()
        for observation in new:
            self.ceres.remove_residual_block(self._residuals[observation])
            self._add_observation(observation, TwoSidedReprojection)
        self.in_python[new] = True
        return len(new)

    def parameters(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Copies of `poses`, `lenses` and `points`."""
        return self.poses.copy(), self.lenses.copy(), self.points.copy()

    def restore(self, parameters: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        """Sets the parameters to what `parameters` returned, in place."""
        for block, old in zip((self.poses, self.lenses, self.points), parameters, strict=True):
            block[:] = old

    def bundle(self) -> BundleProblem:
        """The problem at the current parameters. Cameras without observations are unchanged."""
        cameras: Any = np.array(self.start.cameras, np.float64)
        poses = self.poses[self.observing]
        lenses = self.lenses[self.observing]
        cameras[self.observing] = np.hstack(
            [bal_rotations(poses[:, :4]), poses[:, 4:] * FLIP, lenses[:, [0, 3, 4]]]
        )
        return self.start.replace(cameras=cameras, points=self.points.copy())


def _parameters(problem: BundleProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New arrays of poses `(cameras, 7)`, lenses `(cameras, 5)` and points `(points, 3)` in
    COLMAP's convention."""
    cameras = np.asarray(problem.cameras, np.float64)
    lenses = np.zeros((len(cameras), LENS_SIZE))
    lenses[:, [0, 3, 4]] = cameras[:, 6:]
    poses = np.hstack([colmap_quaternions(cameras[:, :3]), cameras[:, 3:6] * FLIP])
    return poses, lenses, np.array(problem.points, np.float64, order="C")
