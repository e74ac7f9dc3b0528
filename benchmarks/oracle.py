"""The look-ahead oracle on real problems: how many iterations a better choice of lambda could save.

    python -m benchmarks.oracle [PROBLEM ...] [--solver learned+refine0] [--iterations 40]

Compares beam search over lambda, greedy search, a learned solver and Ceres' rule, all with the step of the learned
solver, and `classic` and `ceres` with plain steps. The tables show the iterations until the cost is within 1e-3, 1e-4
and 1e-6 of the lowest cost of any of them (or of the file `--best`), and the iterations to convergence. Never counts as
100, also if the search had fewer iterations. The search ends when no state of its beam improves by 1e-6, relatively. An
iteration of the search takes `width x grid` linear solves and counts as one.

`oracle` does the same for the scenes of a bank (`benchmarks.game`), with all states of a beam in one batched program.
Real problems are too large for that, so `search` steps the states one after the other.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from benchmarks.suite import real_problems
from jaxba import DampingPolicy, LMState, SolveOptions, StepOptions, initial_state, lm_step, make_policy, solve
from jaxba.bench.sources import sources
from jaxba.cli.common import prepare_process
from jaxba.damping.learned import LearnedPolicy
from jaxba.game.groups import step_groups
from jaxba.game.random_scenes import SceneClass
from jaxba.game.rollout import Trajectories
from jaxba.game.scene_bank import Bank
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import StepInfo
from jaxba.lm.step import state_at
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime import process
from jaxba.solver.choose import choose_linear_solver
from jaxba.solver.names import parse_solver
from jaxba.structure.layout import build_layout

GRID = tuple(10.0**decade for decade in (-8, -7, -6, -5, -4, -3, -2, -1, 0))
"""Lambdas tried from every state."""

WIDTH = 4
"""States kept."""

TOLERANCES = (1e-3, 1e-4, 1e-6)
LIMIT = 100

_step = jax.jit(lm_step, static_argnames=("options",))


def main() -> None:
    """Prints a Markdown row for each problem, and the geometric means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problem", nargs="*", help="as for jaxba-bench; default: all real problems")
    parser.add_argument("--solver", default="learned", help="a learned solver, whose step is used")
    parser.add_argument("--iterations", type=int, default=40, help="limit of the iterations of the search")
    parser.add_argument("--best", type=Path, help="file of best known costs, lines of `NAME COST`")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    prepare_process()
    policy, solve_options = parse_solver(args.solver).build()
    options = solve_options.step_options(policy)
    if not isinstance(policy, LearnedPolicy):
        parser.error(f"--solver {args.solver}: not a learned solver")
    known = dict(line.split() for line in args.best.read_text().splitlines()) if args.best else {}
    rules = {
        args.solver: (policy, solve_options),
        "ceres, same step": (make_policy("ceres"), solve_options),
        **{name: (make_policy(name), SolveOptions()) for name in ("ceres", "classic")},
    }
    names = (f"beam of {WIDTH}", "greedy", *rules)
    print("| problem |" + "".join(f" {name} |" for name in names) + "\n| --- |" + " --- |" * len(names))
    rows = []
    for source in sources(args.problem or real_problems()):
        problem = source.read()
        with process.single_blas_thread():
            runs = [search(problem, options, policy.min_gain, args.iterations, width) for width in (WIDTH, 1)]
            runs += [_play(problem, *rule) for rule in rules.values()]
        best = min(float(known.get(source.name, np.inf)), *(run.costs[-1] for run in runs))
        rows.append([[*(_reached(run.costs, best * (1 + t)) for t in TOLERANCES), run.stopped] for run in runs])
        cells = (" / ".join("never" if n == LIMIT else str(n) for n in row) for row in rows[-1])
        print(f"| {source.name} | " + " | ".join(cells) + " |", flush=True)
    means = np.exp(np.log(np.array(rows, float)).mean(axis=0))
    print("| geometric mean | " + " | ".join(" / ".join(f"{x:.2f}" for x in row) for row in means) + " |")


class Run(NamedTuple):
    """Result of a solve or a search."""

    costs: np.ndarray
    """Lowest cost at the start and after each iteration, pixels squared."""

    stopped: int
    """Iterations to convergence; the limit if it did not converge."""


def search(problem: BundleProblem, options: StepOptions, min_gain: float, iterations: int, width: int) -> Run:
    """Beam search over lambda. It ends early when no state of the beam improves by 1e-6, relatively.

    Args:
        problem: the problem.
        options: the step.
        min_gain: gain ratio that an accepted step exceeds.
        iterations: limit of iterations.
        width: number of states that are kept; 1 is greedy search.
    """
    options = choose_linear_solver(problem, options, "auto")
    layout = jax.device_put(build_layout(problem, options))
    start = jax.jit(initial_state, static_argnums=(2, 3))(layout, problem, options, jnp.dtype("float64"))
    number = lambda x: jnp.asarray(x, start.cost.dtype)
    take: Callable[[LMState, float, int], LMState] = lambda state, damping, turn: _step(
        layout, state, number(damping), options, number(min_gain), jnp.asarray(turn, jnp.int32)
    )[0]
    beam, costs = [start], [float(start.cost)]
    for turn in range(iterations):
        after = [take(state, damping, turn) for state in beam for damping in GRID]
        distinct = {float(state.cost): state for state in (*after, *beam)}  # a rejected step leaves the state as it was
        before, beam = beam, [distinct[cost] for cost in sorted(distinct)[:width]]
        costs.append(float(beam[0].cost))
        pairs = zip(before, beam, strict=False)
        if len(before) == len(beam) and all(float(new.cost) > float(old.cost) * (1 - 1e-6) for old, new in pairs):
            return Run(np.array(costs), turn + 1)
    return Run(np.array(costs), LIMIT)


def beam_search(
    step: Callable[[LMState, Array], tuple[LMState, StepInfo]],
    start: LMState,
    iterations: int,
    width: int = WIDTH,
    grid: tuple[float, ...] = GRID,
) -> Float[Array, " _"]:
    """Lowest accepted cost after each number of iterations, the start first.

    Args:
        step: one LM iteration from a state with a lambda; pure.
        start: first state.
        iterations: linear solves in a row.
        width: states kept after each iteration. States of equal cost come last, since they are mostly the same state.
        grid: lambdas.
    """
    pairs = [(state, damping) for state in range(width) for damping in range(len(grid))]
    parent = jnp.array([pair[0] for pair in pairs])
    dampings = jnp.asarray(grid, start.cost.dtype)[jnp.array([pair[1] for pair in pairs])]
    beam = jax.tree.map(lambda x: jnp.broadcast_to(x, (width, *x.shape)), start)
    beam = beam._replace(cost=beam.cost.at[1:].set(jnp.inf))

    def body(beam: LMState, _: None) -> tuple[LMState, Array]:
        origin = jax.tree.map(lambda x: x[parent], beam)
        after, info = step_groups(step, origin, dampings)
        alive = info.accepted & jnp.isfinite(origin.cost)
        costs = jnp.concatenate([jnp.where(alive, after.cost, jnp.inf), beam.cost])
        order = jnp.argsort(costs)
        duplicate = jnp.concatenate([jnp.zeros(1, bool), jnp.diff(costs[order]) <= 0])
        best = order[jnp.argsort(jnp.where(duplicate, jnp.inf, costs[order]))[:width]]
        kept = jax.tree.map(lambda new, old: jnp.concatenate([new, old])[best], after, beam)
        beam = kept._replace(cost=costs[best])
        return beam, beam.cost[0]

    costs = lax.scan(body, beam, None, length=iterations)[1]
    return jnp.concatenate([start.cost[None], costs])


@functools.partial(jax.jit, static_argnames=("kind", "options", "iterations", "width", "grid"))
def _search(
    kind: SceneClass, bank: Bank, options: StepOptions, iterations: int, width: int, grid: tuple[float, ...]
) -> Array:
    layout = class_layout(kind, options)

    def one(scene: Bank) -> Array:
        seen = with_scene(layout, scene.scenes.pixels, scene.scenes.mask)
        start = state_at(scene.scenes.cameras, scene.scenes.points, scene.initial_cost, options)
        step = lambda state, damping: lm_step(seen, state, damping, options)
        return beam_search(step, start, iterations, width, grid)

    return lax.map(one, bank)


def oracle(
    kind: SceneClass,
    bank: Bank,
    options: StepOptions,
    iterations: int,
    width: int = WIDTH,
    grid: tuple[float, ...] = GRID,
) -> Trajectories:
    """The search on every scene of a bank; the lambdas of the best sequence are not returned."""
    costs = np.asarray(_search(kind, bank, options, iterations, width, grid))
    count = len(costs)
    return Trajectories(costs, np.zeros_like(costs[:, 1:]), np.full(count, iterations), np.zeros(count, bool))


def _play(problem: BundleProblem, policy: DampingPolicy, options: SolveOptions) -> Run:
    solution = solve(problem, policy, replace(options, max_iterations=LIMIT, compilation="full"))
    costs = np.append(solution.initial_cost, solution.history.cost)
    return Run(costs, solution.iterations if solution.converged else LIMIT)


def _reached(costs: np.ndarray, target: float) -> int:
    """Iterations until the cost is at most `target`, at least 1; the limit if that never happens."""
    return max(1, int(np.argmax(costs <= target))) if costs[-1] <= target else LIMIT


if __name__ == "__main__":
    main()
