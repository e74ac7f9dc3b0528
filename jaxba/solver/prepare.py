"""Preparation of a solve: place the problem, choose the solver, lay out the observations; and back
to a problem."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxba.damping import DampingPolicy
from jaxba.damping.policy import check_policy
from jaxba.damping.policy_check import check_traceable
from jaxba.damping.registry import GUARDED
from jaxba.lm.records import LMState
from jaxba.lm.step import state_of
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.facing import set_aside
from jaxba.problem.options import StepOptions
from jaxba.runtime import distributed, process
from jaxba.runtime.compilation import CompileClock, compile_and_run, program
from jaxba.runtime.numerics import numerics
from jaxba.solver.choose import choose_linear_solver
from jaxba.solver.diagnosis import explain_start
from jaxba.solver.estimate import estimate, is_long, iteration_seconds
from jaxba.solver.names import resolve_policy
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.place import Placed, check_problem, placed
from jaxba.solver.sharded import Shards, num_parts
from jaxba.structure.layout import Layout, build_layout
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.padding import Capacity, capacity_of, padded_parameters
from jaxba.typing import AnyArray, ArrayRecord

DEFAULT_POLICY = GUARDED  # name of the default damping policy

PADDED_CAMERAS = 64
PADDED_OBSERVATIONS = 60_000
"""Largest problem that is padded by default. Measured: iterations take 1.1 to 1.4 times as long up
to there, but twice with 2,000 observations; with 77 cameras 1.2 to 1.5 times."""


@dataclass(frozen=True, eq=False, repr=False)
class Setup(ArrayRecord):
    """A solve before its initial state is computed."""

    problem: BundleProblem
    """The problem as it was given."""

    away: Int[np.ndarray, " away"]
    """Cameras whose views are left out (problem/facing.py)."""

    placed: Placed
    """The problem that is solved, where it is computed."""

    layout: Layout
    """Observations and index arrays, on the device; of shards that of the first one."""

    options: StepOptions
    """Step options, with the chosen linear solver; static and hashable."""

    policy: DampingPolicy
    """The damping policy."""

    capacity: Capacity | None
    """Sizes to which the problem was padded; None if it was not."""

    start: tuple[Float[AnyArray, "cameras parameters"], Float[AnyArray, "points 3"]]
    """Cameras and points at the start, placed and padded."""

    dtype: np.dtype[Any]
    """Type of the parameters of the solve."""

    setup_s: float
    """Seconds for the layout and the transfer to the device."""

    shards: Shards | None
    """The problem divided among devices; None for one device."""

    def initial(self, call: Callable[..., Any]) -> LMState:
        """The initial state. `call` runs its program, or compiles it (`ParallelCompilation`)."""
        initial = program(state_of, "options", "dtype", level="quick")
        return call(initial, self.layout, *self.start, self.options, self.dtype)

    def check_cost(self, state: LMState) -> None:
        """Raises a ProblemError that names an observation if the cost of the initial state is not
        finite."""
        if not np.isfinite(float(state.cost)):
            raise ProblemError(explain_start(self.problem, self.options.loss, self.dtype))

    def problem_at(self, state: LMState) -> BundleProblem:
        """The problem with the parameters of a state, as NumPy float64; what is not optimised is
        copied exactly."""
        # of several shards
        points = np.moveaxis(distributed.to_host(state.points), -2, 0).reshape(3, -1)
        order = self.layout.points if self.shards is None else self.shards.order
        found = self.placed.after(self.layout, order, state._replace(points=points), self.options)
        if not len(self.away):
            return found
        parts = {name: getattr(found, name) for name in ("cameras", "points", "rigs", "residuals")}
        return self.problem.replace(**parts)


@dataclass(frozen=True, eq=False, repr=False)
class Prepared(Setup):
    """Arguments of `jaxba.solve_loop` and `jaxba.lm_step` for a problem."""

    state: LMState
    """Initial parameters in layout order, on the device, and their cost."""

    compile_s: float
    """Seconds for the compilation of the program of the initial state."""


def prepare(
    problem: BundleProblem,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
) -> Prepared:
    """Everything that a solve does before its first iteration, for callers that jit, vmap or time
    the loop themselves.

    Arrays are float64 unless the options say float32. To use them, enable 64 bits in JAX with
    `jax.config.update("jax_enable_x64", True)` or `jax.enable_x64(True)`. The problem is the start
    of the optimisation; `policy` and `options` are as for `solve`. Raises ValueError, ProblemError:
    as `solve`."""
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
    capacity: Capacity | None = None,
    *,
    in_parts: bool = False,
    tell: Callable[[str], None] | None = None,
) -> Setup:
    """`prepare` without the initial state. Arguments and errors as there.

    `away`: whose views are left out, if that is decided. `capacity`: to which sizes it is padded,
    if that is decided;
    the layout then stays on the host. `in_parts`: whether a device may compute a large problem part
    by part. `tell` is called with what a long solve takes, before it is laid out."""
    check_problem(problem)
    options = checked_options(options)
    if isinstance(policy, str):
        policy, options = resolve_policy(policy, options)
    check_policy(policy)
    check_traceable(policy)
    step = options.step_options(policy)
    away = set_aside(problem) if away is None else away
    devices = distributed.use_devices(options.devices)
    dtype = np.dtype("float32" if options.dtype == "float32" else "float64")
    with numerics(dtype):
        started = time.perf_counter()
        found = placed(problem, away)
        here = found.here
        if problem.rigs is not None:  # cameras of a frame stay together
            step = replace(
                step,
                coordinates=replace(step.coordinates, rotation="manifold"),
                refinement=replace(step.refinement, camera_rounds=0, pattern_moves=0),
            )
        observations = ObservationOrder.of(here)
        asked = options.linear_solver
        given = bool(capacity)
        may_pad = len(devices) == 1 and not step.method and asked in ("auto", "explicit")
        if may_pad and not given and _pads(observations, options):
            capacity = capacity_of(here, observations)
        # `auto` depends on exact sizes, so that problems of one capacity might get different
        # programs; up
        if capacity:
            asked = "explicit"  # to the largest capacity it is never slow
        step = choose_linear_solver(here, step, asked, observations)
        parts = num_parts(here, step, len(devices)) if in_parts else 1
        needs = estimate(len(observations.order), devices=len(devices), in_parts=parts > 1)
        needs.check(dtype.name)
        if tell and is_long(
            iteration_s := iteration_seconds(here, step, observations, in_parts=parts > 1)
        ):
            tell(needs.told(dtype.name, iteration_s))
        shards = None if len(devices) * parts == 1 else Shards(here, step, devices, dtype, parts)
        if parts > 1:
            process.return_memory()
        grid = capacity is None  # else a shape would depend on more than the capacity
        layout = (
            shards.first if shards else build_layout(here, step, capacity, observations, grid=grid)
        )
        layout = layout if shards or given else jax.device_put(layout)
        start = (
            (here.cameras, here.points) if capacity is None else padded_parameters(here, capacity)
        )
        setup_s = time.perf_counter() - started
    return Setup(
        problem, away, found, layout, step, policy, capacity, start, dtype, setup_s, shards
    )


def _pads(observations: ObservationOrder, options: SolveOptions) -> bool:
    """Whether sizes are to be padded, if they can be."""
    if options.pad is not None:
        return options.pad
    small = (
        observations.num_cameras <= PADDED_CAMERAS
        and len(observations.order) <= PADDED_OBSERVATIONS
    )
    return small and options.compilation != "full"
