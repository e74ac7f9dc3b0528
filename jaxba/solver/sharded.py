"""The solve loop on several devices, as one program.

Points are divided among the devices of a mesh with their observations; cameras, the state of the policy and all
decisions are on every device. The step is the same as on one device: what is summed over points or observations is
summed over devices, too (structure/devices.py).

Points are dealt to the shards by descending track length, so that each has nearly the same number of points of every
length, and of observations. Sizes of arrays and lists of blocks must be the same in all shards; they follow from data,
so that layouts are built again with what was found (`Agreement`), until nothing changes."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, Int

from jaxba.damping import DampingPolicy
from jaxba.lm.method import check_plain
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.termination import Tolerances
from jaxba.model.linearize import cost
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.options import StepOptions
from jaxba.runtime import distributed
from jaxba.runtime.jit import jit
from jaxba.solver.iteration import Carry, begin, iterate, problem_info
from jaxba.solver.loop import loop_from
from jaxba.structure.agreement import Agreement, merged, same
from jaxba.structure.devices import AXIS
from jaxba.structure.layout import Layout, build_layout

_DIVIDED, _EVERYWHERE = PartitionSpec(AXIS), PartitionSpec()
_STATE: Any = _EVERYWHERE, _DIVIDED, _EVERYWHERE
_REST: Any = (_EVERYWHERE,) * 4
_CARRY = Carry(LMState(*_STATE), *_REST)
"""Where the parts of a carry are: points are divided, all else is on every device."""

MAX_ROUNDS = 8  # most times that layouts are built until they agree; three or four suffice


class Shards:
    """A problem divided among devices, and the programs of its loop."""

    layout: Layout
    """Layouts of all shards, of equal shapes, along a leading axis that is divided among the devices."""

    first: Layout
    """The layout of this process's first shard, on the host."""

    order: Int[np.ndarray, " points"]
    """The point of the problem at each position of all shards in layout order; the number of points for padding."""

    def __init__(
        self, problem: BundleProblem, options: StepOptions, devices: Sequence[jax.Device], dtype: np.dtype[Any]
    ) -> None:
        """Deals the points, builds the layouts of this process, and places them on its devices. The problem is
        `in_frames` if it has rigs; the devices are those of all processes. Raises ProblemError: the method of the
        options works on one device only, or there are too few points."""
        check_plain(options, ProblemError, devices=True)
        self._options, self._devices = options, devices
        self._mesh = Mesh(np.array(devices), (AXIS,))
        tracks = np.bincount(problem.point_index, minlength=problem.num_points)
        dealt = deal_points(tracks, len(devices), [rows.points for rows in problem.residuals.rows])
        if not len(dealt[-1]):
            raise ProblemError(f"{len(devices)} devices are more than there are observed points")
        own = [shard_of(problem, points) for points, device in zip(dealt, devices, strict=True) if _is_here(device)]
        layouts = sharded_layout(own, options, distributed.gather)
        self.layout, self.first = self._placed(layouts), layouts[0]
        here = [points for points, device in zip(dealt, devices, strict=True) if _is_here(device)]
        orders = [_order(layout, points, problem) for layout, points in zip(layouts, here, strict=True)]
        self.order = distributed.to_host(self._placed(orders)).reshape(-1)
        known = np.append(np.asarray(problem.points, dtype), np.zeros((1, 3), dtype), axis=0)
        self._points = self._placed([np.ascontiguousarray(known[order].T) for order in orders])
        cameras = np.ascontiguousarray(np.asarray(problem.cameras, dtype).T)
        self._cameras = jax.device_put(cameras, NamedSharding(self._mesh, _EVERYWHERE))

    def _placed(self, trees: list[Any]) -> Any:
        """Pytrees of this process's shards as arrays with a leading axis, each entry on its device."""
        here = [device for device in self._devices if _is_here(device)]
        sharding = NamedSharding(self._mesh, _DIVIDED)

        def placed(*leaves: Any) -> Array:
            parts = [jax.device_put(np.asarray(leaf)[None], device) for leaf, device in zip(leaves, here, strict=True)]
            shape = (len(self._devices), *np.shape(leaves[0]))
            return jax.make_array_from_single_device_arrays(shape, sharding, parts)

        return jax.tree.map(placed, *trees)

    def begin(self, policy: DampingPolicy, limit: Int[np.ndarray, ""]) -> Carry:
        """The carry before the first iteration."""
        given = self.layout, self._cameras, self._points, policy, limit
        return _begin(*given, mesh=self._mesh, options=self._options)

    def run(
        self, carry: Carry, policy: DampingPolicy, tolerances: Tolerances, limit: Int[np.ndarray, ""], length: int = 0
    ) -> tuple[Carry, StepInfo]:
        """The whole loop, with a record of the given length; without a length one iteration."""
        given = self.layout, carry, policy, tolerances, limit
        return _run(*given, mesh=self._mesh, options=self._options, length=length)


def _is_here(device: jax.Device) -> bool:
    return device.process_index == jax.process_index()


def _order(layout: Layout, points: Int[np.ndarray, " own"], problem: BundleProblem) -> Int[np.ndarray, " points"]:
    """The point of the problem at each position of a shard."""
    return np.append(points, problem.num_points)[np.minimum(layout.points, len(points))]


def _own(layout: Layout) -> Layout:
    """The layout of this device, inside of a program."""
    return jax.tree.map(lambda leaf: leaf[0], layout)


def _divided(carry: Carry, points: Callable[[Array], Array]) -> Carry:
    return carry._replace(state=carry.state._replace(points=points(carry.state.points)))


@functools.partial(jit, static_argnames=("mesh", "options"))
def _begin(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "shards 3 points"],
    policy: DampingPolicy,
    limit: Int[Array, ""],
    *,
    mesh: Mesh,
    options: StepOptions,
) -> Carry:
    def start(layout: Layout, cameras: Array, points: Array, policy: Any, limit: Array) -> Carry:
        layout, points = _own(layout), points[0]
        state = LMState(cameras, points, cost(layout, cameras, points, options.loss))
        carry = begin(problem_info(layout, state, options, limit), policy, state)
        return _divided(carry, lambda x: x[None])

    places = _DIVIDED, _EVERYWHERE, _DIVIDED, _EVERYWHERE, _EVERYWHERE
    on_all = jax.shard_map(start, mesh=mesh, in_specs=places, out_specs=_CARRY, check_vma=False)
    return on_all(layout, cameras, points, policy, limit)


@functools.partial(jit, static_argnames=("mesh", "options", "length"))
def _run(
    layout: Layout,
    carry: Carry,
    policy: DampingPolicy,
    tolerances: Tolerances,
    limit: Int[Array, ""],
    *,
    mesh: Mesh,
    options: StepOptions,
    length: int,
) -> tuple[Carry, StepInfo]:
    def on_one(layout: Layout, carry: Carry, policy: Any, tolerances: Tolerances, limit: Array) -> tuple[Carry, Any]:
        given = _own(layout), _divided(carry, lambda x: x[0]), policy, tolerances, options
        carry, found = loop_from(*given, length, limit) if length else iterate(*given, limit)
        return _divided(carry, lambda x: x[None]), found

    places = _DIVIDED, _CARRY, _EVERYWHERE, _EVERYWHERE, _EVERYWHERE
    on_all = jax.shard_map(on_one, mesh=mesh, in_specs=places, out_specs=(_CARRY, _EVERYWHERE), check_vma=False)
    return on_all(layout, carry, policy, tolerances, limit)


def deal_points(
    tracks: Int[np.ndarray, " points"], shards: int, together: Sequence[Sequence[Int[np.ndarray, " _"]]] = ()
) -> list[Int[np.ndarray, " _"]]:
    """The observed points of each shard, ascending: dealt by track length, forwards and backwards in turns; but
    together those that a row of a residual has."""
    order = np.argsort(-tracks, kind="stable")[: np.count_nonzero(tracks)]
    turn, position = np.divmod(np.arange(len(order)), shards)
    shard = np.where(turn % 2 == 0, position, shards - 1 - position)
    of_point = np.full(len(tracks), -1)
    of_point[order] = shard
    pairs = [own for own in together if len(own) == 2]
    if pairs:
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        first, second = (np.concatenate([own[k] for own in pairs]) for k in range(2))
        graph = coo_array((np.ones(len(first)), (first, second)), (len(tracks), len(tracks)))
        _, group = connected_components(graph, directed=False)
        of_point = np.where(of_point < 0, -1, of_point[np.unique(group, return_index=True)[1]][group])
    return [np.flatnonzero(of_point == number) for number in range(shards)]


def shard_of(problem: BundleProblem, points: Int[np.ndarray, " kept"]) -> BundleProblem:
    """The problem with all cameras and these points, ascending, and their observations."""
    own = np.zeros(problem.num_points, bool)
    own[points] = True
    return problem.subset(own[problem.point_index], points=points)


def sharded_layout(
    shards: list[BundleProblem], options: StepOptions, merge: Callable[[list[dict]], list[dict]] = lambda found: found
) -> list[Layout]:
    """The layouts of shards of one problem, `in_frames` if it has rigs, of equal shapes. `merge` gives what was found
    in all processes for what was found here."""
    known: dict[str, Any] = {}
    for _ in range(MAX_ROUNDS):
        agreements = [Agreement(known) for _ in shards]
        layouts = [build_layout(shard, options, agreement=one) for shard, one in zip(shards, agreements, strict=True)]
        found = merged(merge([one.found for one in agreements]))
        if same(found, known):
            return [replace(layout, axes=(AXIS,)) for layout in layouts]
        known = found
    raise RuntimeError("the layouts of shards do not agree")
