"""Recipes: policies that often end in different minima. Side by side, the lowest end wins.

Which ones, and in which order, is measured on windows of real problems (`python -m benchmarks.recipes`): each is the
one that adds most to those before it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from jaxba.damping import DampingPolicy
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import check_count
from jaxba.runtime import process
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.prepare import DEFAULT_POLICY
from jaxba.solver.solve import Solution, solve
from jaxba.solver.time_limit import TimeLimit

RECIPES = (DEFAULT_POLICY, "ceres+embedded", "nielsen+embedded")
"""The policy that is asked for takes the place of the first one."""


def solve_recipes(
    problem: BundleProblem,
    count: int = len(RECIPES),
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
) -> list[Solution]:
    """Solves a problem with a policy, and with the next ones of `RECIPES`, `count` in all, on as many cores. Returns
    all solutions; `min(found, key=lambda one: one.final_cost)` is the best. Each compiles a program of its own. A limit
    of time (`Tolerances.seconds`) is that of all together. Raises as `solve`; ValueError: there are not so many
    recipes."""
    check_count("count", count, 1)
    if count > len(RECIPES):
        raise ValueError(f"there are 1 to {len(RECIPES)} recipes, not {count}")
    options = checked_options(options)
    limit = TimeLimit(options)
    with ThreadPoolExecutor(process.threads()) as pool:
        return list(pool.map(lambda one: solve(problem, one, limit.rest(options)), (policy, *RECIPES[1:count])))
