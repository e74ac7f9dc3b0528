"""Recipes: ways of solving that often end in different minima. Side by side, the lowest end wins.

Which ones, and in which order, is measured on windows of real problems (`python -m benchmarks.recipes`): each is the
one that adds most to those before it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

from jaxba.damping import DampingPolicy
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime import process
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.prepare import DEFAULT_POLICY
from jaxba.solver.solve import Solution, joined, solve


class Recipe(NamedTuple):
    """A way of solving."""

    policy: str
    lenses_first: bool = False  # whether it begins with a solve that holds all lenses

    def __str__(self) -> str:
        return f"{self.policy}{', lenses held first' * self.lenses_first}"


RECIPES = (
    Recipe(DEFAULT_POLICY),
    Recipe("ceres", lenses_first=True),
)
"""The first one is replaced by the policy that is asked for."""


def solve_recipes(
    problem: BundleProblem,
    count: int = 2,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
) -> list[Solution]:
    """Solves a problem by several recipes at a time: with the policy, and by those of `RECIPES` that follow. What they
    end with, in their order; `min(found, key=lambda one: one.final_cost)` is the best. Each core solves one; they take
    longer than the slowest alone, since each compiles programs of its own. Raises as `solve`; ValueError: there are not
    so many recipes."""
    if not 1 <= count <= len(RECIPES):
        raise ValueError(f"there are 1 to {len(RECIPES)} recipes, not {count}")
    options = checked_options(options)

    def by(recipe: Recipe) -> Solution:
        chosen = policy if recipe is RECIPES[0] else recipe.policy
        if not recipe.lenses_first:
            return solve(problem, chosen, options)
        first = solve(problem, chosen, replace(options, intrinsics="fixed"))
        return joined(first, solve(first.problem, chosen, options))

    with ThreadPoolExecutor(process.threads()) as pool:
        return list(pool.map(by, RECIPES[:count]))
