"""Table: average efficiency on KITTI."""

from __future__ import annotations

from jaxba.paper import claims, real_problems
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.runner import ELSEWHERE, Runner, method_named
from jaxba.paper.tables_and_figures import common, real
from jaxba.paper.tables_and_figures.common import TableOrFigure

RULES: tuple[tuple[str, str, float | None, float | None], ...] = (
    ("STBA", "stba+stba", 80.0, 287.4),
    ("classic", "classic", 75.0, 340.0),
    ("Ceres' rule", "ceres", None, None),
    ("shipped policy, lambda alone", "learned-driver", None, None),
)
"""Label, solver, and the paper's iterations and seconds of the rows without an agent of the run. Source: the paper,
table "Average efficiency improvement - KITTI"."""

WHY = (
    "front end, sequences and windows differ, since the paper does not describe them; both files at hand are of "
    "sequence 00, from different front ends; our STBA is written in JAX from its paper and its authors' code."
)


def _methods(runner: Runner) -> list[real.LabelledMethod]:
    return [
        *((label, method_named(name), its, seconds) for label, name, its, seconds in RULES),
        ("STBA + ours: agent trained on KITTI", runner.agent_trained_elsewhere("stba"), 16.0, 110.0),
        ("ours: agent trained on KITTI", runner.agent_trained_elsewhere(), 14.0, 100.2),
    ]


def _run(runner: Runner) -> None:
    sources = real_problems.find(runner.config.real.kitti).all
    runner.solve(sources, [method for _, method, _, _ in _methods(runner)])


def _section(runner: Runner) -> Section:
    problems = real_problems.find(runner.config.real.kitti)
    sources = problems.all
    methods = _methods(runner)
    rows = {line.row.method: line.row for line in real.real_lines(runner, methods, sources)}
    known = {name: row if row.solves else None for name, row in rows.items()}
    ours, classic = known[ELSEWHERE], known["classic"]
    found = (
        claims.ratio_claim("KITTI: ours takes a fifth of classic's iterations", 14 / 75, ours, classic),
        claims.ratio_claim(
            "KITTI: ours takes a fifth of STBA's iterations", 0.2, known[f"stba+{ELSEWHERE}"], known["stba+stba"]
        ),
        claims.time_claim("KITTI: ours takes a third of classic's time", 100.2 / 340.0, ours, classic),
        claims.fraction_claim("KITTI: classic succeeds everywhere", 1.0, rows["classic"].success),
        claims.fraction_claim("KITTI: ours succeeds everywhere", 1.0, rows[ELSEWHERE].success),
    )
    if problems.reason or not any(row.solves for row in rows.values()):
        return Section("KITTI", (f"KITTI: {problems.reason}." if problems.reason else common.NOT_YET,), found)
    body = [
        f"{common.problems(len(sources))}: {', '.join(source.name for source in sources)}. `-firstN` is the "
        "sub-problem of N neighbouring cameras, starting with the camera that observes most points. As in the paper, "
        "poses and points are unknown and the lens is known.",
        real.trained_elsewhere(runner, sources),
        *real.real_tables(runner, methods, sources),
        disagreements(found, WHY),
    ]
    if problems.missing:
        names = ", ".join(f"`{name}`" for name in problems.missing)
        body.insert(1, f"In the configuration, but not on this machine: {names}.")
    return Section("KITTI", tuple(body), found)


ENTRY = TableOrFigure("kitti", "Table: average efficiency, KITTI", _run, _section)
