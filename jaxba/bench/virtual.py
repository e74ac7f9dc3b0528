"""The virtual best rule: for each problem, the result of the hand-written damping rule that is best on it.

No single rule reaches it, since the best rule is not known beforehand. It bounds what can be gained by choosing lambda
with the same step. Source: "virtual best solver" of SATzilla (Xu et al. 2008).
"""

from __future__ import annotations

from collections.abc import Iterable

from jaxba.damping import is_learned
from jaxba.solver.methods import DEFAULT_METHOD
from jaxba.solver.names import SolverName, parse_solver
from jaxba.solver.options import SolveOptions

MIN_RULES = 3
"""Fewest rules of a virtual best. With the two baselines alone, one is nearly always the better, so that it would
repeat that row."""


def rules_of_one_step(solvers: Iterable[str]) -> dict[str, list[str]]:
    """Groups hand-written rules that use the same step and differ in lambda only.

    Args:
        solvers: names. Learned policies, other libraries, methods other than plain LM and unknown names are ignored.

    Returns:
        By the name of the virtual best, the rules of each group that has at least `MIN_RULES`.
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
        if len(group) >= MIN_RULES
    }


def _rule(name: str) -> SolverName | None:
    try:
        parsed = parse_solver(name)
    except ValueError:
        return None
    plain = not parsed.peer and parsed.method == DEFAULT_METHOD
    return parsed if plain and not is_learned(parsed.policy) else None
