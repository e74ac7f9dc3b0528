"""Table: average efficiency on KITTI."""

from __future__ import annotations

from jaxba.paper import claims, real_problems
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.runner import Runner, method_named
from jaxba.paper.tables_and_figures import common, real
from jaxba.paper.tables_and_figures.common import TableOrFigure

METHODS: tuple[tuple[str, str, float | None, float | None], ...] = (
    ("STBA", "stba+stba", 80.0, 287.4),
    ("STBA + ours", "stba+learned-driver", 16.0, 110.0),
    ("Ceres' rule", "ceres", None, None),
    ("Ceres' rule + embedded iterations", "ceres+embedded", None, None),
    ("classic", "classic", 75.0, 340.0),
    ("ours: shipped policy, lambda alone", "learned-driver", 14.0, 100.2),
    ("ours: shipped policy, embedded iterations", "learned", None, None),
)
"""Label, solver, and the paper's iterations and seconds of each row. Source: the paper, table "Average efficiency
improvement - KITTI"."""

WHY = (
    "the shipped policy was trained on synthetic scenes, the paper's for this table on KITTI; front end, sequences "
    "and windows differ, since the paper does not describe them; our STBA is written in JAX from its paper and its "
    "authors' code."
)


def _methods() -> list[real.LabelledMethod]:
    return [(label, method_named(name), its, seconds) for label, name, its, seconds in METHODS]


def _run(runner: Runner) -> None:
    runner.solve(real_problems.find(runner.config.real.kitti).all, [method for _, method, _, _ in _methods()])


def _section(runner: Runner) -> Section:
    problems = real_problems.find(runner.config.real.kitti)
    sources = problems.all
    rows = {line.row.method: line.row for line in real.real_lines(runner, _methods(), sources)}
    known = {name: row if row.solves else None for name, row in rows.items()}
    ours, classic = known["learned-driver"], known["classic"]
    found = (
        claims.ratio_claim("KITTI: ours takes a fifth of classic's iterations", 14 / 75, ours, classic),
        claims.ratio_claim(
            "KITTI: ours takes a fifth of STBA's iterations", 0.2, known["stba+learned-driver"], known["stba+stba"]
        ),
        claims.time_claim("KITTI: ours takes a third of classic's time", 100.2 / 340.0, ours, classic),
        claims.fraction_claim("KITTI: classic succeeds everywhere", 1.0, rows["classic"].success),
        claims.fraction_claim("KITTI: ours succeeds everywhere", 1.0, rows["learned-driver"].success),
    )
    if problems.reason or not any(row.solves for row in rows.values()):
        return Section("KITTI", (f"KITTI: {problems.reason}." if problems.reason else common.NOT_YET,), found)
    body = [
        f"{common.problems(len(sources))}: {', '.join(source.name for source in sources)}. `-firstN` is the "
        "sub-problem of N neighbouring cameras, starting with the camera that observes most points.",
        *real.real_tables(runner, _methods(), sources),
        disagreements(found, WHY),
    ]
    if problems.missing:
        names = ", ".join(f"`{name}`" for name in problems.missing)
        body.insert(1, f"In the configuration, but not on this machine: {names}.")
    return Section("KITTI", tuple(body), found)


ENTRY = TableOrFigure("kitti", "Table: average efficiency, KITTI", _run, _section)
