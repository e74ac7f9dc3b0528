"""The virtual best: on every problem the hand-written rule that does best there, which nobody knows beforehand.

A yardstick that no single rule reaches (SATzilla's "virtual best solver", Xu et al. 2008): what is left to win by
choosing lambda, with one and the same step.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from jaxba.bench.profile import NEVER, Reach
from jaxba.damping import is_learned
from jaxba.methods.registry import DEFAULT_METHOD
from jaxba.solver.names import SolverName, parse_solver
from jaxba.solver.options import SolveOptions

FEWEST = 3
"""Rules that make a virtual best: of the two yardsticks, which most tables have, one is nearly always the better."""


def rules_of_one_step(solvers: Iterable[str]) -> dict[str, list[str]]:
    """Hand-written rules that differ in lambda alone, under the name of their virtual best.

    Args:
        solvers: names; learned policies, peers, other methods than plain LM and unknown names are left out.

    Returns:
        `FEWEST` rules or more each.
    """
    groups: dict[SolveOptions, dict[str, str]] = {}
    for name in solvers:
        rule = _rule(name)
        if rule is not None:
            ending = str(rule).removeprefix(rule.policy)
            groups.setdefault(rule.build()[1], {})[name] = ending
    # `bold` has the embedded iterations without the ending that the other rules of its group have
    return {
        f"best of {len(group)} rules{max(group.values(), key=len)}": list(group)
        for group in groups.values()
        if len(group) >= FEWEST
    }


def best_reach(reaches: Sequence[Reach]) -> Reach:
    """The fewest iterations and the least time, each of whoever has it."""
    counts, times = [r.iterations for r in reaches], [r.seconds for r in reaches]
    return Reach(min(counts), min(times)) if reaches else NEVER


def _rule(name: str) -> SolverName | None:
    try:
        parsed = parse_solver(name)
    except ValueError:
        return None
    plain = not parsed.peer and parsed.method == DEFAULT_METHOD
    return parsed if plain and not is_learned(parsed.policy) else None
