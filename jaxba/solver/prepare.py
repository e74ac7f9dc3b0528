"""Preparation of a solve: from a problem to layout, initial state and resolved options; and back to a problem."""

from __future__ import annotations

import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping import DampingPolicy
from jaxba.lm.records import LMState
from jaxba.lm.step import initial_state
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.options import StepOptions
from jaxba.problem.preprocess import far_middle, shift
from jaxba.runtime import process
from jaxba.runtime.compilation import CompileClock, compile_and_run, program
from jaxba.solver.cost_model import choose_linear_solver
from jaxba.solver.names import resolve_policy
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.structure.conventions import items_first
from jaxba.structure.layout import Layout, layout_for
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.padding import Capacity, capacity_of, padded_parameters, with_padded_solver

DEFAULT_POLICY = "learned"
"""Name of the default damping policy."""

POLICY_PARTS = ("min_gain", "init", "propose")
"""What every damping policy has (`DampingPolicy`)."""


@dataclass(frozen=True)
class Prepared:
    """Arguments of `jaxba.solve_loop` and `jaxba.lm_step` for a problem."""

    layout: Layout
    """Observations and index arrays, on the device."""

    state: LMState
    """Initial parameters in layout order, on the device, and their cost."""

    options: StepOptions
    """Step options, with the chosen linear solver; static and hashable."""

    policy: DampingPolicy
    """The damping policy."""

    problem: BundleProblem
    """The problem as it was given."""

    capacity: Capacity | None
    """Sizes to which the problem was padded; None if it was not."""

    offset: np.ndarray | None
    """Translation by which the scene was moved to the origin, scene units; None if it was not."""

    setup_s: float
    """Seconds for the layout and the transfer to the device."""

    compile_s: float
    """Seconds for the compilation of the program of the initial state."""

    def problem_at(self, state: LMState) -> BundleProblem:
        """The problem with the parameters of a state, as NumPy float64; what is not optimised is copied exactly."""
        if self.offset is None:
            return write_back(self.problem, self.layout, state, self.options)
        return shift(write_back(shift(self.problem, -self.offset), self.layout, state, self.options), self.offset)


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
    options = checked_options(options)
    if not isinstance(problem, BundleProblem):
        raise ValueError(f"problem must be a BundleProblem, as jaxba.read_problem returns it, not {problem!r}")
    if isinstance(policy, str):
        policy, options = resolve_policy(policy, options)
    _check_policy(policy)
    step = options.step_options(policy)
    capacity, asked = None, options.linear_solver
    observations = ObservationOrder.of(problem)
    if options.pad:
        capacity, asked = with_padded_solver(capacity_of(problem, observations), step, asked)
    step = choose_linear_solver(problem, step, asked, observations)
    dtype = jnp.dtype("float32" if options.dtype == "float32" else "float64")
    with jax.enable_x64(options.dtype != "float32"), process.single_blas_thread():
        started = time.perf_counter()
        offset = far_middle(problem)
        here = problem if offset is None else shift(problem, -offset)
        with CompileClock() as clock:
            layout = jax.device_put(layout_for(here, step, capacity, observations))
            initial = program(initial_state, "options", "dtype", level="quick")
            begin = here if capacity is None else padded_parameters(here, capacity)
            state = jax.block_until_ready(compile_and_run(initial, layout, begin, step, dtype))
        setup_s = max(0.0, time.perf_counter() - started - clock.seconds)
        if not np.isfinite(float(state.cost)):
            raise ProblemError(explain_start(problem))
    return Prepared(layout, state, step, policy, problem, capacity, offset, setup_s, clock.seconds)


def _check_policy(policy: object) -> None:
    """Raises a ValueError that says what a policy lacks."""
    missing = [name for name in POLICY_PARTS if not hasattr(policy, name)]
    if isinstance(policy, type) or len(missing) == len(POLICY_PARTS):
        raise ValueError(f"policy must be the name of a policy or a policy, not {policy!r}")
    name = type(policy).__name__
    if missing:
        raise ValueError(f"policy {name} has no {' and no '.join(missing)} (see jaxba.DampingPolicy)")
    if jax.tree_util.treedef_is_leaf(jax.tree.structure(policy)):
        raise ValueError(f"policy {name} is no pytree: decorate its dataclass with jax.tree_util.register_dataclass")


def explain_start(problem: BundleProblem) -> str:
    """A one-line message that names the observation for which the initial cost is not finite."""
    with np.errstate(all="ignore"):
        bad = np.flatnonzero(~np.isfinite(geometry.residuals(problem)).all(axis=1))
    if not bad.size:
        return "the cost at the start overflows"
    camera, point = (int(index[bad[0]]) for index in (problem.camera_index, problem.point_index))
    others = f" (and {bad.size - 1} more)" if bad.size > 1 else ""
    return (
        f"the cost at the start is not finite: observation {bad[0]}{others}, point {point} lies on the plane of camera "
        f"{camera} or its projection overflows"
    )


def write_back(problem: BundleProblem, layout: Layout, state: LMState, options: StepOptions) -> BundleProblem:
    """The problem with optimised parameters, in its own order; what was not optimised is copied exactly.

    Args:
        problem: the problem at the start.
        layout: its layout.
        state: optimised parameters in layout order.
        options: whether intrinsics were fixed.
    """
    cameras, points = np.array(problem.cameras, np.float64), np.array(problem.points, np.float64)
    seen = np.flatnonzero(layout.camera_seen)  # padding cameras are not seen
    cameras[seen] = items_first(np.asarray(state.cameras, np.float64))[seen]
    if options.intrinsics == "fixed":
        cameras[:, 6:] = problem.cameras[:, 6:]
    elif problem.lenses is not None:  # unobserved cameras follow the others with their lens
        lens = np.asarray(problem.lenses.index)
        used, first = np.unique(lens[seen], return_index=True)
        follows = np.isin(lens, used)
        cameras[follows, 6:] = cameras[seen[first[np.searchsorted(used, lens[follows])]], 6:]
        cameras[:, 6:] = np.where(np.asarray(problem.lenses.free)[lens], cameras[:, 6:], problem.cameras[:, 6:])
    order = np.concatenate([np.asarray(members) for members in layout.bucket_points])
    real = order < problem.num_points
    points[order[real]] = items_first(np.asarray(state.points, np.float64))[real]
    return problem.replace(cameras=cameras, points=points)
