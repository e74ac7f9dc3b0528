"""Table: average efficiency on BAL."""

from __future__ import annotations

from jaxba.paper import claims, real_problems
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.runner import Runner, method_named
from jaxba.paper.tables_and_figures import common, real
from jaxba.paper.tables_and_figures.common import TableOrFigure

METHODS: tuple[tuple[str, str, float | None, float | None], ...] = (
    ("DeepLM's solver", "deeplm+ceres", 15.0, 40.75),
    ("DeepLM's solver + ours", "deeplm+learned-driver", 5.0, 20.3),
    ("Ceres' rule", "ceres", 20.0, 46.7),
    ("Ceres' rule + embedded iterations", "ceres+embedded", None, None),
    ("classic", "classic", 20.0, 110.0),
    ("ours: shipped policy, lambda alone", "learned-driver", 4.0, 62.04),
    ("ours: shipped policy, embedded iterations", "learned", None, None),
)
"""Label, solver, and the paper's iterations and seconds of each row. Source: the paper, table "Average efficiency
improvement - BAL". Its row "Ceres + ours" (4 iterations, 20.75 s) is our row "lambda alone": the policy replaces Ceres'
rule, and the step is the same."""

WHY = (
    "the shipped policy was trained on synthetic scenes, the paper's for this table on BAL; the problems are those on "
    "this machine, not all of BAL; Ceres means its rule with our step, not its C++ library."
)


def _methods() -> list[real.LabelledMethod]:
    return [(label, method_named(name), its, seconds) for label, name, its, seconds in METHODS]


def _run(runner: Runner) -> None:
    runner.solve(real_problems.bal(runner.config.real), [method for _, method, _, _ in _methods()])


def _section(runner: Runner) -> Section:
    reason = real_problems.reason_without_bal(runner.config.real)
    sources = real_problems.bal(runner.config.real)
    rows = {line.row.method: line.row for line in real.real_lines(runner, _methods(), sources)}
    known = {name: row if row.solves else None for name, row in rows.items()}
    classic, ceres = known["classic"], known["ceres"]
    found = (
        claims.ratio_claim("BAL: ours takes a fifth of classic's iterations", 0.2, known["learned-driver"], classic),
        claims.ratio_claim("BAL: ours takes a fifth of Ceres' iterations", 0.2, known["learned-driver"], ceres),
        claims.ratio_claim(
            "BAL: ours takes a third of DeepLM's iterations",
            1 / 3,
            known["deeplm+learned-driver"],
            known["deeplm+ceres"],
        ),
        claims.time_claim("BAL: ours takes half of classic's time", 62.04 / 110.0, known["learned-driver"], classic),
        claims.fraction_claim("BAL: ours succeeds everywhere", 1.0, rows["learned-driver"].success),
    )
    if reason or not any(row.solves for row in rows.values()):
        return Section("BAL", (f"BAL: {reason}." if reason else common.NOT_YET,), found)
    body = [
        f"{common.problems(len(sources))}: {', '.join(source.name for source in sources)}. {missing(runner)}",
        "The paper's row Ceres + ours (4 iterations, 20.75 s) is our row lambda alone: the policy replaces the rule.",
        *real.real_tables(runner, _methods(), sources),
        _ceres_comparison(rows),
        disagreements(found, WHY),
    ]
    return Section("BAL", tuple(body), found)


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
