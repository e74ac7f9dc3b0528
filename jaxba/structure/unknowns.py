"""What is unknown: the numbers of cameras and points that a solve moves, and which cameras share
theirs.

Every camera has a block of unknowns: six of its pose, and those numbers of its lens that some lens
optimises (`columns`). What is constant has zero columns in the Jacobian; its gradient, and so its
step, is then exactly zero.

Let T be the matrix that copies the parameters y of shared lenses (and the poses) to the cameras, `d
= T y`. The damped system `(H + D) d = -g` becomes

    T^T (H + D) T y = -T^T g.

T leaves points alone, so they are eliminated as usual. A factorisation has the shared lenses as a
border of the reduced camera system S (linear/border.py). Conjugate gradients work on S itself,
between projections on the range of T: with the orthogonal projector P, which averages over the
cameras of a lens,

    P S P d = P b    has the solution    d = T y."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.camera_models import BAL, CameraModel
from jaxba.problem.frames import free_poses
from jaxba.problem.intrinsics import LENS_SIZE, POSE_SIZE, Lenses, lens_size
from jaxba.problem.labels import part_name
from jaxba.problem.options import Intrinsics
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.problem.row_owners import block_groups
from jaxba.structure.agreement import Agreement
from jaxba.structure.padding import Capacity
from jaxba.structure.sharing import Mask, Sharing
from jaxba.typing import AnyArray, ArrayRecord, register_pytree

NO_LENS = -1  # name of the lens of cameras without observations, in a padded layout


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Unknowns(ArrayRecord):
    """The unknowns of a problem: of cameras and points, which are optimised, and which are the
    same."""

    poses: Sharing  # cameras that move together: those of a frame
    lenses: Sharing  # observed cameras that have a lens in common of which something is optimised
    # of each block of residuals of one's own, which cameras have a row of it in common
    own: tuple[Sharing, ...]
    free: Mask  # which unknowns of each camera's block are optimised, [width, cameras]
    free_points: Mask  # which points are optimised, in layout order
    model: Int[AnyArray, " cameras"]  # camera model of each camera, a position in `models`
    models: tuple[CameraModel, ...] = field(metadata={"static": True})  # camera models
    # whether every observed camera shares a lens with others
    all_shared: bool = field(metadata={"static": True})
    # numbers of a lens, of extrinsics and of blocks of residuals that are part of a camera's block,
    # ascending
    columns: tuple[int, ...] = field(metadata={"static": True})
    lens_size: int = field(metadata={"static": True})  # number of all intrinsics of a camera
    # numbers of these blocks, the last ones of a camera
    own_sizes: tuple[int, ...] = field(metadata={"static": True})
    # whether poses are those of frames, extrinsics the last numbers
    in_rigs: bool = field(metadata={"static": True})

    @property
    def places(self) -> tuple[int, ...]:
        """First parameter of each pose of a camera after its first: of its extrinsics in a rig."""
        return (POSE_SIZE + self.lens_size,) * self.in_rigs

    @property
    def size(self) -> int:
        """Number of all intrinsics of a camera, of its extrinsics if it is in a rig, and of blocks
        of residuals."""
        return self.lens_size + EXTRINSICS_SIZE * self.in_rigs + sum(self.own_sizes)

    @property
    def shared(self) -> bool:
        """Whether several cameras have a number in common: of a lens, or the pose of a frame."""
        return any(sharing.several for sharing, _ in self.parts)

    @property
    def merged(self) -> bool:
        """Whether a factorisation merges rows and columns of what is shared, and has no lenses as a
        border."""
        return self.poses.several or (self.shared and bool(self.own))

    @property
    def parts(self) -> tuple[tuple[Sharing, int], ...]:
        """What shares the columns of a camera's block, in order, and how many these are."""
        lens = (self.lenses, len(self.columns) - sum(self.own_sizes))
        return (self.poses, POSE_SIZE), lens, *zip(self.own, self.own_sizes, strict=True)

    @property
    def width(self) -> int:
        """Number of unknowns in a camera's block."""
        return POSE_SIZE + len(self.columns)

    @property
    def numbers(self) -> Sharing:
        """Which unknowns of all blocks, flattened, are the same."""
        return Sharing.joined(*self.parts)

    def _each(self, name: str, x: Float[Array, "cameras width"]) -> Float[Array, "cameras width"]:
        if not self.shared:
            return x
        found = []
        start = 0
        for sharing, size in self.parts:
            found.append(getattr(sharing, name)(x[:, start : start + size]))
            start += size
        return jnp.concatenate(found, axis=1)

    def sums(self, x: Float[Array, "cameras width"]) -> Float[Array, "cameras width"]:
        """For each number the sum over the cameras that have it in common."""
        return self._each("sums", x)

    def shares(self, x: Float[Array, "cameras width"]) -> Float[Array, "cameras width"]:
        """An equal part of each number for each camera that has it in common with others."""
        return self._each("shares", x)

    def project(self, x: Float[Array, "cameras width"]) -> Float[Array, "cameras width"]:
        """The orthogonal projection P on the range of T, without what is constant."""
        return self._each("mean", self.free.where(x.T, 0).T)

    def constant(self, intrinsics: Intrinsics, *, alone: bool) -> tuple[bool, ...]:
        """Which columns of the blocks are constant for all cameras: with `fixed` intrinsics all of
        these; where cameras are optimised `alone`, one by one, what some of them share."""
        together = [alone and sharing.several for sharing, size in self.parts for _ in range(size)]
        fixed = [
            *[False] * POSE_SIZE,
            *(intrinsics == "fixed" and column < self.lens_size for column in self.columns),
        ]
        return tuple(one or other for one, other in zip(together, fixed, strict=True))

    def restricted(
        self, changes: Float[AnyArray, "*steps parameters cameras"]
    ) -> Float[AnyArray, "*steps width cameras"]:
        """The unknowns of changes of all numbers of cameras."""
        if len(self.columns) == self.size:
            return changes
        rows = [*range(POSE_SIZE), *(POSE_SIZE + column for column in self.columns)]
        return changes[..., np.array(rows), :]

    def expanded(self, step: Float[Array, "width ..."]) -> Float[Array, "parameters ..."]:
        """A step of camera blocks, with zeros for the numbers that are not part of them."""
        if len(self.columns) == self.size:
            return step
        zero = jnp.zeros_like(step[0])
        place = {column: POSE_SIZE + k for k, column in enumerate(self.columns)}
        lens = [step[place[k]] if k in place else zero for k in range(self.size)]
        return jnp.concatenate([step[:POSE_SIZE], jnp.stack(lens)])


def unknowns_of(
    problem: BundleProblem,
    seen: Bool[np.ndarray, " cameras"],
    order: Int[np.ndarray, " points"],
    *,
    fixed: bool,
    agreement: Agreement,
    capacity: Capacity | None = None,
) -> Unknowns:
    """The unknowns of a problem, for its layout. The problem is `in_frames` if it has rigs. `seen`:
    whether each camera has an observation; padding cameras have none. `order`: point of the problem
    at each position in layout order; out of range for padding. `fixed`: whether all intrinsics are
    constant. Some points of other shards may be constant (`agreement`). `capacity`: of a padded
    layout, whose shapes do not depend on what is constant and shared."""
    cameras = len(problem.cameras)
    points = len(problem.points)
    lenses = problem.lenses or Lenses(np.arange(cameras), np.ones((cameras, LENS_SIZE), bool))
    padding = len(seen) - cameras
    index = np.asarray(lenses.index)
    poses_free = free_poses(problem)
    own_sizes = problem.residuals.sizes
    own_free = np.ones((cameras, sum(own_sizes)), bool)
    # something may be constant in another problem of this shape
    may_hold = bool(capacity and (problem.lenses or problem.constants))
    lens_free = np.hstack(
        [np.asarray(lenses.free)[index] & (not fixed), poses_free[:, POSE_SIZE:], own_free]
    )
    columns = tuple(np.flatnonzero(lens_free.any(axis=0)).tolist())
    free = np.hstack([poses_free[:, :POSE_SIZE], lens_free[:, columns]])
    free = np.pad(free, ((0, padding), (0, 0)), constant_values=True)
    held = (
        np.zeros(points, bool)
        if problem.constants is None
        else np.asarray(problem.constants.points)
    )
    any_held = agreement.size("constant points", int(held.any()))
    apart = -1 - np.arange(len(seen))  # names of cameras that have nothing in common

    def padded(names):
        return np.where(seen, np.pad(names, (0, padding)), apart)

    lens_room = capacity.lenses if capacity else 0
    lens_names = (
        padded(index) if not lens_room else np.where(seen, np.pad(index, (0, padding)), NO_LENS)
    )
    shares = Sharing.of(lens_names)
    all_shared = bool(np.isin(shares.index, shares.owners)[seen].all())
    if lens_room:
        not_shared = 0 if all_shared else len(seen)
        shares = shares.with_room(lens_room, lens_room + not_shared + 1)  # and the one of `NO_LENS`
    model = np.zeros(cameras, np.int32) if lenses.model is None else np.asarray(lenses.model)[index]
    return Unknowns(
        poses=Sharing.of(apart if problem.rigs is None else padded(_frames(problem))),
        lenses=shares if len(columns) > sum(own_sizes) else Sharing.of(apart),
        own=tuple(Sharing.of(padded(group)) for group in block_groups(problem)),
        free=Mask(free.T, bool(free.all()) and not may_hold),
        free_points=Mask(
            np.append(~held, True)[np.minimum(order, points)], not (any_held or may_hold)
        ),
        model=np.pad(model, (0, padding)),
        models=lenses.models,
        all_shared=all_shared,
        columns=columns,
        lens_size=lens_size(lenses),
        own_sizes=own_sizes,
        in_rigs=problem.rigs is not None,
    )


def _frames(problem: BundleProblem) -> Int[np.ndarray, " cameras"]:
    """The frame of each camera."""
    assert problem.rigs is not None
    if problem.constants is not None:
        held = np.asarray(problem.constants.poses)[:, 3:]
        bad = np.flatnonzero(held.any(axis=1) & ~held.all(axis=1) & problem.rigs.turned)
        if bad.size:
            name = part_name(problem.labels, "image", int(bad[0]))
            raise ProblemError(
                f"part of the translation of {name} is constant, which is turned in its rig"
            )
    return np.asarray(problem.rigs.frame)


NONE_SHARED = Sharing.of(np.zeros(0, np.int32))
ALL_FREE = Mask(np.zeros(0, bool), True)

# those of BAL cameras, all of whose numbers are optimised, however many there are
BAL_UNKNOWNS = Unknowns(
    poses=NONE_SHARED,
    lenses=NONE_SHARED,
    own=(),
    free=ALL_FREE,
    free_points=ALL_FREE,
    model=np.zeros(0, np.int32),
    models=(BAL,),
    all_shared=False,
    columns=(0, 1, 2),
    lens_size=LENS_SIZE,
    own_sizes=(),
    in_rigs=False,
)
