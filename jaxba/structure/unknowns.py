"""What is unknown: the numbers of cameras and points that a solve moves, and which cameras share theirs.

Every camera has a block of unknowns: six of its pose, and those numbers of its lens that some lens optimises
(`columns`). What is constant has zero columns in the Jacobian; its gradient, and so its step, is then exactly zero.

Let T be the matrix that copies the parameters y of shared lenses (and the poses) to the cameras, `d = T y`. The damped
system `(H + D) d = -g` becomes

    T^T (H + D) T y = -T^T g.

T leaves points alone, so they are eliminated as usual. A factorisation has the shared lenses as a border of the reduced
camera system S (linear/border.py). Conjugate gradients work on S itself, between projections on the range of T: with
the orthogonal projector P, which averages over the cameras of a lens,

    P S P d = P b    has the solution    d = T y.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.camera_models import CameraModel
from jaxba.problem.frames import free_poses
from jaxba.problem.intrinsics import POSE_SIZE, lens_size
from jaxba.problem.labels import part_name
from jaxba.problem.priors import Priors
from jaxba.structure.agreement import Agreement, size_of
from jaxba.typing import AnyArray, ArrayRecord, register_pytree


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Unknowns(ArrayRecord):
    """The unknowns of a problem, where they are not just all numbers of all BAL cameras and points."""

    members: Bool[AnyArray, "cameras lenses"] | None
    """Whether an observed camera has this lens, for each lens that several observed cameras have; None if there is
    none."""

    frame: Int[AnyArray, " cameras"] | None
    """Frame of each camera; None if no observed cameras move together."""

    free: Bool[AnyArray, "width cameras"] | None
    """Which unknowns of each camera's block are optimised; None: all."""

    free_points: Bool[AnyArray, " points"] | None
    """Which points are optimised, in layout order; None: all."""

    model: Int[AnyArray, " cameras"] | None
    """Camera model of each camera, a position in `models`; None if there is only one."""

    priors: Priors | None
    """Priors, with a row for each camera also of what is known of lenses: a shared lens has its weight in one of them;
    None if there are none."""

    models: tuple[CameraModel, ...] | None = field(metadata={"static": True})
    """Camera models; None if all are BAL's."""

    all_shared: bool = field(metadata={"static": True})
    """Whether every observed camera has one of these lenses."""

    columns: tuple[int, ...] = field(metadata={"static": True})
    """Numbers of a lens that are part of a camera's block, ascending."""

    size: int = field(metadata={"static": True})
    """Number of all intrinsics of a camera, and of its extrinsics if it is in a rig."""

    in_rigs: bool = field(default=False, metadata={"static": True})
    """Whether poses are those of frames, and the last numbers of a camera its extrinsics (problem/rigs.py)."""

    @property
    def shared(self) -> bool:
        """Whether several cameras have a number in common: of a lens, or the pose of a frame."""
        return self.members is not None or self.frame is not None

    @property
    def width(self) -> int:
        """Number of unknowns in a camera's block."""
        return POSE_SIZE + len(self.columns)

    def index(self, cameras: int) -> Int[Array, "cameras width"]:
        """A number for each unknown of each camera's block, the same for those that are one, below cameras x width."""
        number, every = jnp.arange(self.width), jnp.arange(cameras)
        frame = every if self.frame is None else jnp.asarray(self.frame)
        lens = every
        if self.members is not None:
            members = jnp.asarray(self.members)
            first = jnp.argmax(members, axis=0)[jnp.argmax(members, axis=1)]  # the first camera with the same lens
            lens = jnp.where(jnp.any(members, axis=1), first, every)
        return jnp.where(number < POSE_SIZE, frame[:, None], lens[:, None]) * self.width + number

    def total(self, values: Float[Array, "cameras numbers"]) -> Float[Array, "lenses numbers"]:
        """Sums over the cameras of each shared lens: the product with `T^T`."""
        assert self.members is not None
        return jnp.matmul(self.members.T.astype(values.dtype), values, precision="highest")

    def spread(
        self, values: Float[Array, "lenses numbers"], own: Float[Array, "cameras numbers"]
    ) -> Float[Array, "cameras numbers"]:
        """The values of its shared lens for each camera that has one, its own for the others: the product with T."""
        assert self.members is not None
        at = jnp.argmax(jnp.asarray(self.members), axis=1)
        return jnp.where(jnp.any(self.members, axis=1)[:, None], values[at], own)

    def mean(self, values: Float[Array, "cameras numbers"]) -> Float[Array, "cameras numbers"]:
        """The mean over the cameras with the same lens."""
        count = jnp.sum(jnp.asarray(self.members), axis=0, dtype=values.dtype)
        return self.spread(self.total(values) / count[:, None], values)

    def project(self, x: Float[Array, "cameras width"]) -> Float[Array, "cameras width"]:
        """The orthogonal projection P on the range of T, without what is constant."""
        if self.free is not None:
            x = jnp.where(jnp.asarray(self.free).T, x, jnp.zeros_like(x))
        pose, lens = x[:, :POSE_SIZE], x[:, POSE_SIZE:]
        pose = pose if self.frame is None else self.frame_mean(pose)
        return jnp.concatenate([pose, lens if self.members is None else self.mean(lens)], axis=1)

    def frame_total(self, values: Float[Array, "cameras numbers"]) -> Float[Array, "cameras numbers"]:
        """Sums over the cameras of each frame, for each of its cameras."""
        assert self.frame is not None
        return jax.ops.segment_sum(values, self.frame, num_segments=len(values))[jnp.asarray(self.frame)]

    def frame_mean(self, values: Float[Array, "cameras numbers"]) -> Float[Array, "cameras numbers"]:
        """The mean over the cameras of each frame."""
        return self.frame_total(values) / self.frame_total(jnp.ones_like(values[:, :1]))

    def restricted(
        self, changes: Float[AnyArray, "*steps parameters cameras"]
    ) -> Float[AnyArray, "*steps width cameras"]:
        """The unknowns of changes of all numbers of cameras."""
        rows = [*range(POSE_SIZE), *(POSE_SIZE + column for column in self.columns)]
        return changes[..., np.array(rows), :]

    def expanded(self, step: Float[Array, "width ..."]) -> Float[Array, "parameters ..."]:
        """A step of camera blocks, with zeros for the numbers that are not part of them."""
        if len(self.columns) == self.size:
            return step
        zero, place = jnp.zeros_like(step[0]), {column: POSE_SIZE + k for k, column in enumerate(self.columns)}
        lens = [step[place[k]] if k in place else zero for k in range(self.size)]
        return jnp.concatenate([step[:POSE_SIZE], jnp.stack(lens)])


def unknowns_of(
    problem: BundleProblem,
    seen: Bool[np.ndarray, " cameras"],
    order: Int[np.ndarray, " points"],
    *,
    fixed: bool,
    agreement: Agreement | None = None,
) -> Unknowns | None:
    """The unknowns of a problem, for its layout.

    Args:
        problem: a checked problem, `in_frames` if it has rigs.
        seen: whether each camera has an observation; padding cameras have none.
        order: point of the problem at each position in layout order; out of range for padding.
        fixed: whether all intrinsics are constant.
        agreement: with the other shards of the problem, some of whose points may be constant.

    Returns:
        None if all numbers of all cameras and points are optimised, as in BAL.
    """
    lenses, constants = problem.lenses, problem.constants
    plain = lenses is None and constants is None and problem.priors is None and problem.rigs is None
    if plain and not fixed:
        return None
    count, in_rigs = problem.num_cameras, problem.rigs is not None
    index = np.arange(count) if lenses is None else np.asarray(lenses.index)
    lens_free = np.ones((count, lens_size(lenses)), bool) if lenses is None else np.asarray(lenses.free)[index]
    lens_free = lens_free & (not fixed)
    poses_free = free_poses(problem)
    lens_free = np.hstack([lens_free, poses_free[:, POSE_SIZE:]])
    columns = tuple(np.flatnonzero(lens_free.any(axis=0)).tolist())
    free_points = None
    if constants is not None and size_of(agreement, "constant points", int(np.asarray(constants.points).any())):
        free_points = np.append(~np.asarray(constants.points), True)[np.minimum(order, problem.num_points)]
    members = model = frame = None
    if in_rigs:
        frame = _frames(problem, seen[:count])
    shared, times = np.unique(index[seen[:count]], return_counts=True)
    shared = shared[times > 1]
    if lenses is not None and columns and len(shared):
        members = (index[:, None] == shared) & seen[:count, None]
    all_shared = bool((times > 1).all())
    free = np.hstack([poses_free[:, :POSE_SIZE], lens_free[:, columns]])
    models = None if lenses is None or lenses.all_bal else lenses.models
    if models is not None and len(models) > 1:
        assert lenses is not None
        assert lenses.model is not None
        model = np.asarray(lenses.model)[index]
    priors = None if problem.priors is None else _camera_priors(problem, index, seen)
    free_numbers = None if free.all() else free.T
    size = lens_free.shape[1]
    return Unknowns(
        members, frame, free_numbers, free_points, model, priors, models, all_shared, columns, size, in_rigs
    )


def _frames(problem: BundleProblem, seen: np.ndarray) -> Int[np.ndarray, " cameras"]:
    """The frame of each camera; unobserved cameras get frames of their own."""
    assert problem.rigs is not None
    frame = np.asarray(problem.rigs.frame).astype(np.int64)
    frame = np.where(seen, frame, frame.max(initial=0) + 1 + np.arange(len(frame)))
    _, frame = np.unique(frame, return_inverse=True)
    if problem.constants is not None:
        held = np.asarray(problem.constants.poses)[:, 3:]
        bad = np.flatnonzero(held.any(axis=1) & ~held.all(axis=1) & problem.rigs.turned)
        if bad.size:
            name = part_name(problem.labels, "image", int(bad[0]))
            raise ProblemError(f"part of the translation of {name} is constant, which is turned in its rig")
    return frame.astype(np.int32)


def _camera_priors(problem: BundleProblem, index: np.ndarray, seen: np.ndarray) -> Priors:
    """Cameras that nothing sees have no priors: they are not optimised."""
    priors = problem.priors
    assert priors is not None
    observed = np.flatnonzero(seen[: len(index)])
    first = np.zeros(len(index), bool)
    first[observed[np.unique(index[observed], return_index=True)[1]]] = True
    seen = seen[: len(index), None, None]
    return replace(
        priors,
        position_whitening=np.asarray(priors.position_whitening) * seen,
        rotation_whitening=np.asarray(priors.rotation_whitening) * seen,
        lenses=np.asarray(priors.lenses)[index],
        lens_weight=np.asarray(priors.lens_weight)[index] * first[:, None],
    )
