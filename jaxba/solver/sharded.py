"""The solve loop of a divided problem: among devices, and in parts that a device computes one after
the other.

Points are divided among the devices of a mesh with their observations; cameras, the state of the
policy and all decisions are on every device. The step is the same as on one device: what is summed
over points or observations is summed over devices, too (structure/devices.py). On each of them a
large problem is divided once more, into parts of which one at a time is linearised, summed and
forgotten (runtime/parts.py).

Points are dealt to the shards by descending track length, so that each has nearly the same number
of points of every length, and of observations. Sizes of arrays and lists of blocks must be the same
in all shards; they follow from data, so that layouts are built again with what was found
(`Agreement`), until nothing changes."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
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
from jaxba.runtime import distributed, process
from jaxba.runtime.compilation import ParallelCompilation, compile_and_run, program
from jaxba.runtime.jit import jit
from jaxba.runtime.parts import in_turns
from jaxba.solver.iteration import Carry, begin, iterate, problem_info
from jaxba.solver.loop import loop_from
from jaxba.structure.agreement import Agreement, merged, same
from jaxba.structure.devices import DEVICES, PARTS
from jaxba.structure.layout import Layout, build_layout
from jaxba.structure.sum_trees import sorted_by

_DIVIDED = PartitionSpec(DEVICES)
_EVERYWHERE = PartitionSpec()
_STATE: Any = _EVERYWHERE, _DIVIDED, _EVERYWHERE
_REST: Any = (_EVERYWHERE,) * 4
_CARRY = Carry(LMState(*_STATE), *_REST)
"""Where the parts of a carry are: points are divided, all else is on every device."""

_DIFFER: Any = False, True, False
_ALIKE: Any = (False,) * 4
_IN_PARTS = Carry(LMState(*_DIFFER), *_ALIKE)
"""Which of them differ between the parts of a device."""

LARGE = 500_000
"""Observations of a device from which on it computes in parts."""

PART = 60_000
"""Observations of a part on a CPU, whose arrays of floats, 1 kB an observation, stay near the
cores. Measured: 15 to 60 thousand are as fast, 120 thousand take a sixth longer; each has index
arrays for all cameras and clusters."""

PART_OF_CAMERA = 8
"""Observations of a part for each camera, whose sums every part adds to."""

MAX_ROUNDS = 8  # most times that layouts are built until they agree; three or four suffice


class Shards:
    """A problem divided among devices, and the programs of its loop."""

    layout: Layout
    """Layouts of all shards, of equal shapes, along a leading axis that is divided among the
    devices, and one of the parts of a device where they differ."""

    first: Layout
    """The layout of this process's first shard, on the host."""

    static: dict[str, Any]
    """Static arguments of the programs."""

    order: Int[np.ndarray, " points"]
    """The point of the problem at each position of all shards in layout order; the number of points
    for padding."""

    def __init__(
        self,
        problem: BundleProblem,
        options: StepOptions,
        devices: Sequence[jax.Device],
        dtype: np.dtype[Any],
        parts: int = 1,
    ) -> None:
        """Deals the points, builds the layouts of this process, and places them on its devices,
        each with so many parts. The problem is `in_frames` if it has rigs; the devices are those of
        all processes. Raises ProblemError: the method of the options works on one device only, or
        there are too few points."""
        check_plain(options, ProblemError, devices=True)
        self._devices = devices
        self._programs = ParallelCompilation()
        self._mesh = Mesh(np.array(devices), (DEVICES,))
        dealt = deal_points(
            problem, parts * len(devices), [rows.points for rows in problem.residuals.rows]
        )
        if len(devices) == 1:  # rows of residuals keep points together, perhaps in fewer parts
            dealt = [points for points in dealt if len(points)]
            parts = len(dealt)
        self._parts = parts
        if not min(map(len, dealt)):
            raise ProblemError(f"{len(devices)} devices are more than there are observed points")
        here = [points for k, points in enumerate(dealt) if _is_here(devices[k // parts])]
        layouts = sharded_layout(shards_of(problem, here), options, distributed.gather)
        axes = (PARTS,) * (parts > 1) + (DEVICES,) * (len(devices) > 1)
        layouts = [replace(layout, axes=axes) for layout in layouts]
        self.first = layouts[0]
        orders = [
            _order(layout, points, problem) for layout, points in zip(layouts, here, strict=True)
        ]
        columns = list(zip(*map(jax.tree.leaves, layouts), strict=True))

        def alike(one):
            return self.in_parts and all(np.array_equal(one[0], x) for x in one[1:])

        differ = [{k for k, one in enumerate(columns) if not alike(one)}]
        differ = set().union(*distributed.gather(differ))
        apart = tuple(k in differ for k in range(len(columns)))
        # the program of one iteration
        self._once = program(_run.__wrapped__, "mesh", "options", "differ", "length")
        self.static = {
            "mesh": self._mesh if len(devices) > 1 else None,
            "options": options,
            "differ": apart,
        }
        placed = [
            self._placed(list(one), differs) for one, differs in zip(columns, apart, strict=True)
        ]
        self.layout = jax.tree.unflatten(jax.tree.structure(layouts[0]), placed)
        self.order = distributed.to_host(self._placed(orders)).reshape(-1)
        known = np.append(np.asarray(problem.points, dtype), np.zeros((1, 3), dtype), axis=0)
        self._points = self._placed([np.ascontiguousarray(known[order].T) for order in orders])
        cameras = np.ascontiguousarray(np.asarray(problem.cameras, dtype).T)
        self._cameras = jax.device_put(cameras, NamedSharding(self._mesh, _EVERYWHERE))

    @property
    def in_parts(self) -> bool:
        """Whether a device has several parts."""
        return self._parts > 1

    def _placed(self, leaves: list[Any], apart: bool = True) -> Array:
        """Arrays of this process's shards as one with a leading axis, each entry on its device, and
        one of the parts of a device, if these are apart."""
        here = [device for device in self._devices if _is_here(device)]
        each = self._parts
        rows = [leaves[k * each : (k + 1) * each] for k in range(len(here))]
        rows = [np.stack(row) if apart and each > 1 else np.asarray(row[0]) for row in rows]
        shape = (len(self._devices), *rows[0].shape)
        placed = [jax.device_put(row[None], device) for row, device in zip(rows, here, strict=True)]
        return jax.make_array_from_single_device_arrays(
            shape, NamedSharding(self._mesh, _DIVIDED), placed
        )

    def begin(self, policy: DampingPolicy, limit: Int[np.ndarray, ""]) -> Carry:
        """The carry before the first iteration."""
        given = self.layout, self._cameras, self._points, policy, limit, *self.static.values()
        return compile_and_run(program(_begin, *self.static), *given)

    def run(
        self,
        carry: Carry,
        policy: DampingPolicy,
        tolerances: Tolerances,
        limit: Int[np.ndarray, ""],
        length: int = 0,
    ) -> tuple[Carry, StepInfo]:
        """The whole loop, with a record of the given length; without a length one iteration."""
        given = self.layout, carry, policy, tolerances, limit
        if length:
            return _run(*given, **self.static, length=length)
        return self._programs.run(self._once, *given, *self.static.values(), 0)

    def compile(self, *given: Any) -> None:
        """Compiles the program of one iteration, for the arguments of `run`."""
        with self._programs as compile_program:
            compile_program(self._once, self.layout, *given, *self.static.values(), 0)
        process.return_memory()  # of the compiler


def _is_here(device: jax.Device) -> bool:
    return device.process_index == jax.process_index()


def _order(
    layout: Layout, points: Int[np.ndarray, " own"], problem: BundleProblem
) -> Int[np.ndarray, " points"]:
    """The point of the problem at each position of a shard."""
    return np.append(points, problem.num_points)[np.minimum(layout.points, len(points))]


def _own(layout: Layout) -> Layout:
    """The layout of this device, inside of a program."""
    return jax.tree.map(lambda leaf: leaf[0], layout)


def _on_own(
    function: Callable[..., Any], differ: tuple[bool, ...], layout: Layout, *given: Any, parts: Any
) -> Any:
    """`function` of the layout of this device and more, part by part if it has some. `parts` says
    which of the arguments and which of the results differ between parts."""
    if PARTS not in layout.axes:
        return function(layout, *given)
    of_layout = jax.tree.unflatten(jax.tree.structure(layout), differ)
    return in_turns(function, PARTS, (layout, *given), (of_layout, *parts[0]), parts[1])


def _divided(carry: Carry, points: Callable[[Array], Array]) -> Carry:
    return carry._replace(state=carry.state._replace(points=points(carry.state.points)))


def _begin(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "devices *parts 3 points"],
    policy: DampingPolicy,
    limit: Int[Array, ""],
    mesh: Mesh | None,
    options: StepOptions,
    differ: tuple[bool, ...],
) -> Carry:
    def start(layout: Layout, cameras: Array, points: Array, policy: Any, limit: Array) -> Carry:
        def first(layout: Layout, cameras: Array, points: Array) -> Carry:
            state = LMState(cameras, points, cost(layout, cameras, points, options.loss))
            return begin(problem_info(layout, state, options, limit), policy, state)

        carry = _on_own(
            first, differ, _own(layout), cameras, points[0], parts=((False, True), _IN_PARTS)
        )
        return _divided(carry, lambda x: x[None])

    places = _DIVIDED, _EVERYWHERE, _DIVIDED, _EVERYWHERE, _EVERYWHERE
    return _on_all(start, mesh, places, _CARRY)(layout, cameras, points, policy, limit)


@functools.partial(jit, static_argnames=("mesh", "options", "differ", "length"))
def _run(
    layout: Layout,
    carry: Carry,
    policy: DampingPolicy,
    tolerances: Tolerances,
    limit: Int[Array, ""],
    mesh: Mesh | None,
    options: StepOptions,
    differ: tuple[bool, ...],
    length: int,
) -> tuple[Carry, StepInfo]:
    def on_one(
        layout: Layout, carry: Carry, policy: Any, tolerances: Tolerances, limit: Array
    ) -> tuple[Carry, Any]:
        def run(layout: Layout, carry: Carry) -> tuple[Carry, Any]:
            given = layout, carry, policy, tolerances, options
            return loop_from(*given, length, limit) if length else iterate(*given, limit)

        parts = (_IN_PARTS,), (_IN_PARTS, False)
        carry, found = _on_own(
            run, differ, _own(layout), _divided(carry, lambda x: x[0]), parts=parts
        )
        return _divided(carry, lambda x: x[None]), found

    places = _DIVIDED, _CARRY, _EVERYWHERE, _EVERYWHERE, _EVERYWHERE
    return _on_all(on_one, mesh, places, (_CARRY, _EVERYWHERE))(
        layout, carry, policy, tolerances, limit
    )


def _on_all(
    function: Callable[..., Any], mesh: Mesh | None, given: Any, found: Any
) -> Callable[..., Any]:
    """The function on every device of the mesh, or on the only one. `given` and `found` say where
    arguments and results are."""
    if mesh is None:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=given, out_specs=found, check_vma=False)


def num_parts(problem: BundleProblem, options: StepOptions, devices: int) -> int:
    """In how many parts each device computes a problem; one if it is not worth it. Only conjugate
    gradients that do not form the reduced camera system need nothing of all parts at once."""
    if options.linear_solver != "implicit" or options.method or jax.default_backend() != "cpu":
        return 1
    if problem.num_observations < LARGE * devices:
        return 1
    return max(
        1, problem.num_observations // (devices * max(PART, PART_OF_CAMERA * problem.num_cameras))
    )


def deal_points(
    problem: BundleProblem, shards: int, together: Sequence[Sequence[Int[np.ndarray, " _"]]] = ()
) -> list[Int[np.ndarray, " _"]]:
    """The observed points of each shard, ascending: dealt by track length, in each turn by their
    cameras, so that a shard has few of them; but together those that a row of a residual has."""
    tracks = np.bincount(problem.point_index, minlength=problem.num_points)
    camera = np.bincount(
        problem.point_index, problem.camera_index, problem.num_points
    ) / np.maximum(tracks, 1)
    order = np.argsort(-tracks, kind="stable")[: np.count_nonzero(tracks)]
    turn = np.arange(len(order)) // shards
    order = order[np.lexsort((camera[order], turn))]
    of_point = np.full(len(tracks), -1)
    of_point[order] = np.arange(len(order)) - shards * turn
    pairs = [own for own in together if len(own) == 2]
    if pairs:
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        first, second = (np.concatenate([own[k] for own in pairs]) for k in range(2))
        graph = coo_array((np.ones(len(first)), (first, second)), (len(tracks), len(tracks)))
        _, group = connected_components(graph, directed=False)
        of_point = np.where(
            of_point < 0, -1, of_point[np.unique(group, return_index=True)[1]][group]
        )
    return _groups(of_point, shards)


def _groups(group: Int[np.ndarray, " n"], groups: int) -> list[Int[np.ndarray, " _"]]:
    """The positions of each group, ascending; those of none have -1."""
    order = sorted_by(group + 1, groups + 1)
    return np.split(order, np.cumsum(np.bincount(group + 1, minlength=groups + 1))[:-1])[1:]


def shards_of(
    problem: BundleProblem, dealt: Sequence[Int[np.ndarray, " _"]]
) -> list[BundleProblem]:
    """For each of disjoint sets of points, ascending, the problem with all cameras, and their
    observations."""
    number = np.full(problem.num_points, -1, np.int32)
    for k, points in enumerate(dealt):
        number[points] = k
    own = _groups(number[problem.point_index], len(dealt))

    def mask(one):
        return np.isin(np.arange(problem.num_observations), one) if problem.residuals else one

    return [
        problem.subset(mask(one), points=points) for one, points in zip(own, dealt, strict=True)
    ]


def sharded_layout(
    shards: list[BundleProblem],
    options: StepOptions,
    merge: Callable[[list[dict]], list[dict]] = lambda found: found,
) -> list[Layout]:
    """The layouts of shards of one problem, `in_frames` if it has rigs, of equal shapes. `merge`
    gives what was found in all processes for what was found here."""
    known: dict[str, Any] = {}
    common: dict[str, Any] = {}
    with ThreadPoolExecutor(process.threads()) as threads:
        for number in range(MAX_ROUNDS):
            common = {} if number < 2 else common  # the first round knows no totals
            agreements = [Agreement(known, common) for _ in shards]

            def build(shard, one):
                return build_layout(shard, options, agreement=one)

            layouts = list(threads.map(build, shards, agreements))
            found = merged(merge([merged([one.found for one in agreements], {})]), known)
            if same(found, known):
                return [replace(layout, axes=(DEVICES,)) for layout in layouts]
            del layouts  # before there are others
            known = found
    raise RuntimeError("the layouts of shards do not agree")
