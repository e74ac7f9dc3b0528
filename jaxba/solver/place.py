"""From a problem to the one that is computed with, and back: without views that do not count, near
the origin, and of frames in the place of cameras in rigs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.lm.records import LMState
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, check_is_problem
from jaxba.problem.constants import Constants
from jaxba.problem.facing import without_views_of
from jaxba.problem.frames import in_frames, out_of_frames
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import StepOptions
from jaxba.problem.preprocess import far_middle, shift
from jaxba.problem.rigs import with_unseen_of_frames
from jaxba.runtime import process
from jaxba.runtime.numerics import refuse_traces
from jaxba.structure.layout import Layout
from jaxba.structure.residual_slots import laid_out, with_block_values
from jaxba.typing import AnyArray

NO_CAMERAS = np.zeros(0, int)  # no cameras


class Placed(NamedTuple):
    """A problem where it is computed."""

    counted: BundleProblem
    """The problem without the views of images that face away (problem/facing.py), where it was."""

    offset: Float[np.ndarray, "3"]
    """The middle of a scene far from the origin, scene units; zero for others. It was
    subtracted."""

    here: BundleProblem
    """The same problem near the origin, `in_frames` if it has rigs, `laid_out` if it has residuals
    of one's own."""

    def after(
        self, layout: Layout, order: Int[AnyArray, " points"], state: LMState, options: StepOptions
    ) -> BundleProblem:
        """The counted problem with the parameters of a state; what was not optimised is copied
        exactly. `layout` is that of `here`, or of a shard of it; `order` has the point of the
        problem at each position of `state.points`."""
        far = self.offset.any()
        problem = shift(self.counted, -self.offset) if far else self.counted
        points = np.array(problem.points, np.float64)
        # others pad, or stand for rows of residuals
        seen = np.flatnonzero(np.asarray(layout.camera_seen)[: problem.num_cameras])
        cameras = np.array(self.here.cameras, np.float64)[: problem.num_cameras]
        cameras[seen] = np.asarray(state.cameras, np.float64).T[seen]
        lenses = problem.lenses
        rigs = problem.rigs
        residuals = self.counted.residuals
        if residuals:
            cameras, own = np.split(cameras, [cameras.shape[1] - sum(residuals.sizes)], axis=1)
            residuals = with_block_values(problem, residuals, own)
        if lenses is not None:  # unobserved cameras follow the others with their lens
            lens = np.asarray(lenses.index)
            used, first = np.unique(lens[seen], return_index=True)
            follows = np.isin(lens, used)
            cameras[follows, 6:] = cameras[seen[first[np.searchsorted(used, lens[follows])]], 6:]
        if self.here.rigs is not None:
            cameras, rigs = out_of_frames(problem, cameras)
        if options.intrinsics == "fixed":
            cameras[:, 6:] = problem.cameras[:, 6:]
        elif lenses is not None:
            cameras[:, 6:] = np.where(
                np.asarray(lenses.free)[lens], cameras[:, 6:], problem.cameras[:, 6:]
            )
        if rigs is not None:
            cameras = with_unseen_of_frames(rigs, cameras, seen)
        order = np.asarray(order)
        real = order < len(points)
        points[order[real]] = np.asarray(state.points, np.float64).T[real]
        found = problem.replace(cameras=cameras, points=points, rigs=rigs)
        constants = problem.constants
        if constants is None:
            return (shift(found, self.offset) if far else found).replace(residuals=residuals)
        poses = np.asarray(constants.poses)
        found = shift(_with_constants(found, problem, constants, poses), self.offset).replace(
            residuals=residuals
        )
        # bit for bit: parts of a translation are constant only where the rotation is, else those of
        # the shifted scene
        return _with_constants(found, self.counted, constants, poses & poses[:, :1])


def placed(problem: BundleProblem, away: Int[np.ndarray, " away"] = NO_CAMERAS) -> Placed:
    """Places a problem, without the views of the cameras `away`."""
    counted = without_views_of(problem, away)
    offset = far_middle(counted)
    return Placed(counted, offset, laid_out(in_frames(shift(counted, -offset))))


def check_problem(problem: BundleProblem) -> None:
    """First of all in every public function of a problem that computes with JAX. Raises ValueError:
    it is no problem. Raises TypeError: JAX traces it. Raises ProblemError: it has neither
    observations nor other residuals. Raises RuntimeError: the process was forked from one in which
    JAX had started."""
    check_is_problem(problem)
    if not problem.num_observations and not problem.residuals:
        raise ProblemError("the problem has no observations")
    refuse_traces(vars(problem))
    process.refuse_fork()


def _with_constants(
    found: BundleProblem, given: BundleProblem, constants: Constants, poses: np.ndarray
) -> BundleProblem:
    """A problem with the constant points of another one, and these numbers of its poses."""
    cameras = np.array(found.cameras)
    points = np.asarray(constants.points)[:, None]
    cameras[:, :POSE_SIZE] = np.where(poses, given.cameras[:, :POSE_SIZE], cameras[:, :POSE_SIZE])
    return found.replace(cameras=cameras, points=np.where(points, given.points, found.points))
