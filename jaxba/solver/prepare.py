"""Preparation of a solve: from a problem to layout, initial state and resolved options; and back to a problem."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from jaxba.damping import DampingPolicy
from jaxba.damping.policy import observes_prices
from jaxba.damping.registry import GUARDED
from jaxba.lm.records import LMState, Prices
from jaxba.lm.step import initial_state
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.facing import set_aside, without_views_of
from jaxba.problem.frames import in_frames, out_of_frames
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import StepOptions
from jaxba.problem.preprocess import far_middle, shift
from jaxba.problem.rigs import with_unseen_of_frames
from jaxba.runtime import distributed, process
from jaxba.runtime.compilation import CompileClock, compile_and_run, program
from jaxba.runtime.numerics import numerics, refuse_traces
from jaxba.solver.cost_model import choose_linear_solver, prices
from jaxba.solver.diagnosis import explain_start
from jaxba.solver.names import resolve_policy
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.sharded import Shards
from jaxba.structure.conventions import items_first
from jaxba.structure.layout import Layout, layout_for
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.padding import Capacity, capacity_of, padded_parameters, with_padded_solver
from jaxba.typing import ArrayRecord

DEFAULT_POLICY = GUARDED
"""Name of the default damping policy."""

PADDED_CAMERAS, PADDED_OBSERVATIONS = 64, 60_000
"""Largest problem that is padded by default. Measured: iterations take 1.1 to 1.4 times as long up to there, but twice
with 2,000 observations; with 77 cameras 1.2 to 1.5 times."""

POLICY_PARTS = ("min_gain", "init", "propose")
"""What every damping policy has (`DampingPolicy`)."""


@dataclass(frozen=True, eq=False, repr=False)
class Setup(ArrayRecord):
    """A solve before its initial state is computed."""

    problem: BundleProblem
    """The problem as it was given."""

    counted: BundleProblem
    """The problem that is solved: without the views of `away`."""

    away: Int[np.ndarray, " away"]
    """Cameras whose views are left out (problem/facing.py)."""

    layout: Layout
    """Observations and index arrays, on the device."""

    options: StepOptions
    """Step options, with the chosen linear solver; static and hashable."""

    policy: DampingPolicy
    """The damping policy."""

    capacity: Capacity | None
    """Sizes to which the problem was padded; None if it was not."""

    offset: np.ndarray | None
    """Translation by which the scene was moved to the origin, scene units; None if it was not."""

    start: BundleProblem
    """The parameters at the start, shifted and padded."""

    dtype: np.dtype[Any]
    """Type of the parameters of the solve."""

    prices: Prices
    """Of the work of an iteration, NumPy scalars; the default ones for a policy that does not observe them."""

    setup_s: float
    """Seconds for the layout and the transfer to the device."""

    shards: Shards | None
    """The problem divided among devices; None for one device, then `layout` is the first shard's."""

    def initial(self, call: Callable[..., Any]) -> LMState:
        """The initial state. `call` runs its program, or compiles it (`ParallelCompilation`)."""
        initial = program(initial_state, "options", "dtype", level="quick")
        return call(initial, self.layout, self.start, self.options, self.dtype)

    def check_cost(self, state: LMState) -> None:
        """Raises a ProblemError that names an observation if the cost of the initial state is not finite."""
        if not np.isfinite(float(state.cost)):
            here = self.problem if self.offset is None else shift(self.problem, -self.offset)
            raise ProblemError(explain_start(here, self.options.loss, self.dtype))

    def problem_at(self, state: LMState) -> BundleProblem:
        """The problem with the parameters of a state, as NumPy float64; what is not optimised is copied exactly."""
        found = self._counted_at(state)
        return self.problem.replace(cameras=found.cameras, points=found.points, rigs=found.rigs)

    def _counted_at(self, state: LMState) -> BundleProblem:
        order = layout_order(self.layout) if self.shards is None else self.shards.order.reshape(-1)
        points = np.asarray(distributed.to_host(state.points), np.float64)
        points = points if self.shards is None else np.moveaxis(points, 0, 1).reshape(3, -1)
        state = state._replace(points=points)
        if self.offset is None:
            return write_back(self.counted, self.layout, order, state, self.options)
        moved = shift(self.counted, -self.offset)
        found = shift(write_back(moved, self.layout, order, state, self.options), self.offset)
        return found.replace(**_exact(self.counted, found))


@dataclass(frozen=True, eq=False, repr=False)
class Prepared(Setup):
    """Arguments of `jaxba.solve_loop` and `jaxba.lm_step` for a problem."""

    state: LMState
    """Initial parameters in layout order, on the device, and their cost."""

    compile_s: float
    """Seconds for the compilation of the program of the initial state."""


def prepare(
    problem: BundleProblem, policy: str | DampingPolicy = DEFAULT_POLICY, options: SolveOptions | None = None
) -> Prepared:
    """Everything that a solve does before its first iteration, for callers that jit, vmap or time the loop themselves.

    Arrays are float64 unless the options say float32. To use them, enable 64 bits in JAX with
    `jax.config.update("jax_enable_x64", True)` or `jax.enable_x64(True)`.

    Args:
        problem: start of the optimisation.
        policy: as for `solve`.
        options: as for `solve`.

    Raises:
        ValueError, ProblemError: as `solve`.
    """
    setup = set_up(problem, policy, options)
    if setup.shards is not None:
        raise ProblemError("prepare is for one device; jaxba.solve divides a problem among several")
    with numerics(setup.dtype), CompileClock() as clock:
        state = jax.block_until_ready(setup.initial(compile_and_run))
    setup.check_cost(state)
    return Prepared(**vars(setup), state=state, compile_s=clock.seconds)


def set_up(
    problem: BundleProblem,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
    away: Int[np.ndarray, " away"] | None = None,
) -> Setup:
    """`prepare` without the initial state. Arguments and errors as there; `away`: whose views are left out, if that is
    decided."""
    check_problem(problem)
    options = checked_options(options)
    if isinstance(policy, str):
        policy, options = resolve_policy(policy, options)
    _check_policy(policy)
    given, away = problem, set_aside(problem) if away is None else away
    problem = without_views_of(given, away)
    step = options.step_options(policy)
    if problem.rigs is not None:  # cameras of a frame stay together
        step = replace(
            step,
            coordinates=replace(step.coordinates, rotation="manifold"),
            refinement=replace(step.refinement, camera_rounds=0, pattern_moves=0),
        )
    devices = distributed.use_devices(options.devices)
    capacity, asked = None, options.linear_solver
    observations = ObservationOrder.of(problem)
    if len(devices) == 1 and _pads(problem, options):
        capacity, asked = with_padded_solver(capacity_of(problem, observations), step, asked)
    step = choose_linear_solver(problem, step, asked, observations, len(devices))
    dtype = np.dtype("float32" if options.dtype == "float32" else "float64")
    with numerics(dtype):
        started = time.perf_counter()
        offset = far_middle(problem)
        here = in_frames(problem if offset is None else shift(problem, -offset))
        shards = None if len(devices) == 1 else Shards(here, step, devices, dtype)
        layout = jax.device_put(layout_for(here, step, capacity, observations)) if shards is None else shards.first
        start = here if capacity is None else padded_parameters(here, capacity)
        known = prices(problem, step, observations) if observes_prices(policy) else Prices()
        known = jax.tree.map(lambda x: np.asarray(x, dtype), known)
        setup_s = time.perf_counter() - started
    return Setup(given, problem, away, layout, step, policy, capacity, offset, start, dtype, known, setup_s, shards)


def check_problem(problem: BundleProblem) -> None:
    """First of all in every public function of a problem that computes with JAX.

    Raises:
        ValueError: it is no problem.
        TypeError: JAX traces it.
        RuntimeError: the process was forked from one in which JAX had started.
    """
    if not isinstance(problem, BundleProblem):
        raise ValueError(f"problem must be a BundleProblem, as jaxba.read_problem returns it, not {problem!r}")
    refuse_traces(problem)
    process.refuse_fork()


def _pads(problem: BundleProblem, options: SolveOptions) -> bool:
    """Whether sizes are to be padded, if they can be."""
    if options.pad is not None:
        return options.pad
    small = problem.num_cameras <= PADDED_CAMERAS and problem.num_observations <= PADDED_OBSERVATIONS
    return small and options.compilation != "full"


def _check_policy(policy: object) -> None:
    """Raises a ValueError that says what a policy lacks."""
    missing = [name for name in POLICY_PARTS if not hasattr(policy, name)]
    if isinstance(policy, type) or len(missing) == len(POLICY_PARTS):
        raise ValueError(f"policy must be the name of a policy or a policy, not {policy!r}")
    name = type(policy).__name__
    if missing:
        raise ValueError(f"policy {name} has no {' and no '.join(missing)} (see jaxba.DampingPolicy)")
    structure = jax.tree.structure(policy)
    if jax.tree_util.treedef_is_leaf(structure):
        raise ValueError(f"policy {name} is no pytree: decorate its dataclass with jaxba.register_pytree")
    for other, seen in _structures.items():
        if other is not type(policy) and seen == structure:  # see `register_pytree`
            raise ValueError(
                f"policy {name} cannot be told from policy {other.__name__} of this process, whose compiled program "
                "might run in its place: decorate it with jaxba.register_pytree, not with JAX's register_dataclass"
            )
    _structures[type(policy)] = structure


_structures: dict[type, Any] = {}
"""The last structure of a policy of each class, for `_check_policy`."""


def _exact(problem: BundleProblem, found: BundleProblem) -> dict[str, np.ndarray]:
    """Cameras and points of a problem that was shifted and back, where what is constant is as it was bit for bit. Parts
    of a translation are constant only where the rotation is: else they are those of the shifted scene."""
    cameras, points = np.array(found.cameras), np.array(found.points)
    if problem.constants is not None:
        poses = np.asarray(problem.constants.poses)
        constant = poses & poses[:, :1]
        cameras[:, :POSE_SIZE] = np.where(constant, problem.cameras[:, :POSE_SIZE], cameras[:, :POSE_SIZE])
        points = np.where(np.asarray(problem.constants.points)[:, None], problem.points, points)
    return {"cameras": cameras, "points": points}


def layout_order(layout: Layout) -> Int[np.ndarray, " points"]:
    """The point of the problem at each position in layout order; out of range for padding."""
    return np.concatenate([np.asarray(members) for members in layout.bucket_points])


def write_back(
    problem: BundleProblem, layout: Layout, order: Int[np.ndarray, " points"], state: LMState, options: StepOptions
) -> BundleProblem:
    """The problem with optimised parameters, in its own order; what was not optimised is copied exactly.

    Args:
        problem: the problem at the start.
        layout: its layout.
        order: the point of the problem at each position of `state.points`.
        state: optimised parameters in layout order.
        options: whether intrinsics were fixed.
    """
    points = np.array(problem.points, np.float64)
    seen = np.flatnonzero(layout.camera_seen)  # padding cameras are not seen
    in_rigs = layout.unknowns.in_rigs
    cameras = np.array(in_frames(problem).cameras if in_rigs else problem.cameras, np.float64)
    cameras[seen] = items_first(np.asarray(state.cameras, np.float64))[seen]
    if problem.lenses is not None:  # unobserved cameras follow the others with their lens
        lens = np.asarray(problem.lenses.index)
        used, first = np.unique(lens[seen], return_index=True)
        follows = np.isin(lens, used)
        cameras[follows, 6:] = cameras[seen[first[np.searchsorted(used, lens[follows])]], 6:]
    rigs = problem.rigs
    if in_rigs:
        cameras, rigs = out_of_frames(problem, cameras)
    if options.intrinsics == "fixed":
        cameras[:, 6:] = problem.cameras[:, 6:]
    elif problem.lenses is not None:
        cameras[:, 6:] = np.where(np.asarray(problem.lenses.free)[lens], cameras[:, 6:], problem.cameras[:, 6:])
    if rigs is not None:
        cameras = with_unseen_of_frames(rigs, cameras, seen)
    real = order < problem.num_points
    points[order[real]] = items_first(np.asarray(state.points, np.float64))[real]
    if problem.constants is not None:
        constant = np.asarray(problem.constants.poses)
        cameras[:, :POSE_SIZE] = np.where(constant, problem.cameras[:, :POSE_SIZE], cameras[:, :POSE_SIZE])
        points = np.where(np.asarray(problem.constants.points)[:, None], problem.points, points)
    return problem.replace(cameras=cameras, points=points, rigs=rigs)
