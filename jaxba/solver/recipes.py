"""Recipes: policies that often end in different minima. Side by side, the lowest end wins.

Which ones, and in which order, is measured on windows of real problems (`python -m
benchmarks.recipes`): each is the one that adds most to those before it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

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
    """Solves a problem with several policies, on as many cores. Each compiles a program of its own.

    Args:
        problem: the start of all solves.
        count: number of policies, from 1 to that of `RECIPES`.
        policy: the first policy; the others are the next ones of `RECIPES`, which bring their own
            refinement and coordinates.
        options: as for `solve`. A limit of time (`Tolerances.seconds`) is that of all solves
            together.

    Returns:
        All solutions; `min(solutions, key=lambda solution: solution.final_cost)` is the best.

    Raises: as `solve`; ValueError: there are not so many recipes."""
    check_count("count", count, 0)
    if not 1 <= count <= len(RECIPES):
        raise ValueError(f"there are 1 to {len(RECIPES)} recipes, not {count}")
    options = checked_options(options)
    limit = TimeLimit(options)
    others = replace(options, refinement=None, coordinates=None)
    recipes = [(policy, options), *((name, others) for name in RECIPES[1:count])]

    def solved(recipe: tuple[str | DampingPolicy, SolveOptions]) -> Solution:
        return solve(problem, recipe[0], limit.rest(recipe[1]))

    with ThreadPoolExecutor(process.threads()) as pool:
        return list(pool.map(solved, recipes))
