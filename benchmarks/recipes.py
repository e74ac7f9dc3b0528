"""Which recipes belong side by side: the ends of windows of real problems by each, and the order of
`RECIPES`.

    python -m benchmarks.recipes [--choose 0 1] [--judge 2 3]

`JAXBA_DATA` names the folder of real problems. Windows and disturbances are those of
`benchmarks.default_policy`. Its draws `--choose` put the candidates in order, and `--judge` says
what the first K are worth on windows that had no part in that. The first recipe is the default;
each further one leaves the fewest windows more than 1e-4 above the best end of all, and among
equals has the lowest mean of log10(end / best - 1 + 1e-6)."""

from __future__ import annotations

import argparse
import sys
import time
from typing import NamedTuple

import jax
import numpy as np

import jaxba
from benchmarks.default_policy import cases
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime import process
from jaxba.solver.recipes import RECIPES


class Recipe(NamedTuple):
    """A candidate."""

    policy: str
    lenses_first: bool = False  # whether it begins with a solve that holds all lenses

    def __str__(self) -> str:
        return f"{self.policy}{', lenses held first' * self.lenses_first}"


CANDIDATES = (
    *(
        Recipe(policy)
        for policy in ("guarded", "bold", "ceres", "ceres+embedded", "nielsen+embedded")
    ),
    *(Recipe(policy, lenses_first=True) for policy in ("guarded", "bold", "ceres")),
)
"""The first one is the default."""

ABOVE = 1e-4, 1e-3, 1e-2
"""Relative distances above the best end that are counted."""


def ends(problems: list[BundleProblem], recipe: Recipe) -> np.ndarray:
    """Final costs, infinite where a solve failed."""
    starts = problems
    if recipe.lenses_first:
        held = jaxba.solve_many(problems, recipe.policy, jaxba.SolveOptions(intrinsics="fixed"))
        starts = [
            one.replace(cameras=end.problem.cameras, points=end.problem.points)
            if isinstance(end, jaxba.Solution)
            else one
            for one, end in zip(problems, held, strict=True)
        ]
    found = jaxba.solve_many(starts, recipe.policy)
    return np.array(
        [one.final_cost if isinstance(one, jaxba.Solution) else np.inf for one in found]
    )


def table(draws: list[int]) -> np.ndarray:
    """Distances above the best end, of windows by recipes."""
    problems = [
        one.problem for draw in draws for one in cases(draw) if one.group.startswith("window")
    ]
    columns = []
    for recipe in CANDIDATES:
        began = time.perf_counter()
        columns.append(ends(problems, recipe))
        print(
            f"{len(problems)} windows, {recipe}: {time.perf_counter() - began:.0f} s",
            file=sys.stderr,
            flush=True,
        )
    every = np.stack(columns, axis=1)
    return every / every.min(axis=1, keepdims=True) - 1


def order(above: np.ndarray) -> list[int]:
    """Candidates, the best next to those before it."""
    chosen = [0]
    while len(chosen) < above.shape[1]:

        def worth(one: int) -> tuple[float, float]:
            left = above[:, [*chosen, one]].min(axis=1)
            return float(np.mean(left > ABOVE[0])), float(np.mean(np.log10(left + 1e-6)))

        chosen.append(min(set(range(above.shape[1])) - set(chosen), key=worth))
    return chosen


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--choose", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--judge", type=int, nargs="*", default=[2, 3])
    parser.add_argument("--out")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    seen = table(args.choose)
    judged = table(args.judge)
    if args.out:
        np.savez(args.out, seen=seen, judged=judged)
    chosen = order(seen)
    heading = " ".join(f"> {one:g}" for one in ABOVE)
    print(
        f"first K recipes: windows of the choice that end above the best by {heading} | judged "
        "windows | alone, judged"
    )
    print(f"now: {', '.join(RECIPES)}")
    for count, last in enumerate(chosen, 1):
        shares = [
            "  ".join(f"{np.mean(rows > one):4.0%}" for one in ABOVE)
            for rows in (
                seen[:, chosen[:count]].min(axis=1),
                judged[:, chosen[:count]].min(axis=1),
                judged[:, last],
            )
        ]
        print(f"{count:2d} + {CANDIDATES[last]!s:40s} {' | '.join(shares)}")


if __name__ == "__main__":
    main()
