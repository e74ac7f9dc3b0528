"""Table: average efficiency on BAL."""

from __future__ import annotations

from collections.abc import Sequence

from jaxba.bench.sources import Source
from jaxba.paper import claims, real_problems
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.runner import ELSEWHERE, Runner, method_named
from jaxba.paper.tables_and_figures import common, real
from jaxba.paper.tables_and_figures.common import TableOrFigure

CERES_ITSELF, CERES_WITH_OURS = "pyceres:sparse", "pyceres:sparse+learned+refine0"
"""Ceres under its own rule, and with our lambda; both need the extra `ceres`."""

RULES: tuple[tuple[str, str, float | None, float | None], ...] = (
    ("DeepLM's solver", "deeplm+ceres", 15.0, 40.75),
    ("Ceres, C++", CERES_ITSELF, 20.0, 46.7),
    ("Ceres, C++, + shipped policy", CERES_WITH_OURS, 4.0, 20.75),
    ("classic", "classic", 20.0, 110.0),
    ("Ceres' rule", "ceres", None, None),
    ("shipped policy, lambda alone", "learned-driver", None, None),
)
"""Label, solver, and the paper's iterations and seconds of the rows without an agent of the run. Source: the paper,
table "Average efficiency improvement - BAL"."""

MSE_DIFFERENCE = 0.003
"""Largest difference of the mean squared errors of DeepLM's solver with and without ours. Source: the paper, after that
table."""

WHY = "the problems are those on this machine and parts of them, not all of BAL."


def _methods(runner: Runner) -> list[real.LabelledMethod]:
    return [
        *((label, method_named(name), its, seconds) for label, name, its, seconds in RULES),
        ("DeepLM's solver + ours: agent trained on BAL", runner.agent_trained_elsewhere("deeplm"), 5.0, 20.3),
        ("ours: agent trained on BAL", runner.agent_trained_elsewhere(), 4.0, 62.04),
    ]


def _run(runner: Runner) -> None:
    runner.solve(real_problems.bal(runner.config.real), [method for _, method, _, _ in _methods(runner)])


def _section(runner: Runner) -> Section:
    reason = real_problems.reason_without_bal(runner.config.real)
    sources = real_problems.bal(runner.config.real)
    methods = _methods(runner)
    rows = {line.row.method: line.row for line in real.real_lines(runner, methods, sources)}
    known = {name: row if row.solves else None for name, row in rows.items()}
    ours, classic = known[ELSEWHERE], known["classic"]
    with_deeplm, deeplm = known[f"deeplm+{ELSEWHERE}"], known["deeplm+ceres"]
    excess = _mse_excess(runner, sources)
    found = (
        claims.ratio_claim("BAL: ours takes a fifth of classic's iterations", 0.2, ours, classic),
        claims.ratio_claim(
            "BAL: Ceres + ours takes a fifth of Ceres' iterations", 0.2, known[CERES_WITH_OURS], known[CERES_ITSELF]
        ),
        claims.ratio_claim("BAL: DeepLM + ours takes a third of DeepLM's iterations", 1 / 3, with_deeplm, deeplm),
        claims.time_claim("BAL: ours takes half of classic's time", 62.04 / 110.0, ours, classic),
        claims.time_claim(
            "BAL: Ceres + ours takes half of Ceres' time", 20.75 / 46.7, known[CERES_WITH_OURS], known[CERES_ITSELF]
        ),
        claims.fraction_claim("BAL: ours succeeds everywhere", 1.0, rows[ELSEWHERE].success),
        claims.error_claim("BAL: ours does not change DeepLM's mean squared error", MSE_DIFFERENCE, excess),
    )
    if reason or not any(row.solves for row in rows.values()):
        return Section("BAL", (f"BAL: {reason}." if reason else common.NOT_YET,), found)
    body = [
        f"{common.problems(len(sources))}: {', '.join(source.name for source in sources)}. {missing(runner)}",
        real.trained_elsewhere(runner, sources),
        *real.real_tables(runner, methods, sources),
        _ceres_comparison(rows),
        "The mean squared error is that of an observation in pixels squared, twice the final cost over their number.",
        disagreements(found, WHY),
    ]
    return Section("BAL", tuple(body), found)


def _mse_excess(runner: Runner, sources: Sequence[Source]) -> list[float]:
    """By how much the mean squared error of DeepLM's solver is larger with the agent, for each problem, the mean over
    the training runs."""
    method, base = runner.agent_trained_elsewhere("deeplm"), method_named("deeplm+ceres")
    found = []
    for source in sources:
        before = runner.records_on([source], [base])
        after = [r for seed in method.numbers for r in runner.records_on([source], [method], seed)]
        if before and after:
            mean = sum(r.final_cost for r in after) / len(after)
            found.append(2 * (mean - before[0].final_cost) / before[0].observations)
    return found


def missing(runner: Runner) -> str:
    """A sentence that lists the families without files on this machine; empty if there are none."""
    absent = [found.family for found in real_problems.families(runner.config.real) if found.reason]
    return f"No file on this machine of: {', '.join(absent)}." if absent else ""


def _ceres_comparison(rows) -> str:
    classic, ceres = rows["classic"], rows["ceres"]
    if not classic.solves or not ceres.solves:
        return ""
    ratio = ceres.iterations / classic.iterations
    if ratio > claims.PARTLY_RATIO:
        return f"Ceres' rule takes {ratio:.2f} of classic's iterations here."
    return (
        f"Ceres' rule, without any learning, takes {ratio:.2f} of classic's iterations here. This part of the gain "
        "over classic comes from that rule's first lambda (1e-4 instead of 1/4) and factors, and not from learning."
    )


ENTRY = TableOrFigure("bal", "Table: average efficiency, BAL", _run, _section)
