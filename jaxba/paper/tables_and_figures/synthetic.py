"""Table: trained on synthetic scenes, tested on real problems."""

from __future__ import annotations

from jaxba.bench.sources import Source
from jaxba.paper import agents, claims, real_problems
from jaxba.paper.markdown import Section, disagreements, lines_table
from jaxba.paper.runner import Runner, method_named
from jaxba.paper.tables_and_figures import common, real
from jaxba.paper.tables_and_figures.common import TableOrFigure

CLAIMS: dict[str, tuple[tuple[str, str, float], ...]] = {
    "KITTI": ((agents.OURS.name, "classic", 17 / 75), (f"stba+{agents.OURS.name}", "stba+stba", 16 / 80)),
    "BAL": ((agents.OURS.name, "classic", 5 / 20), (f"deeplm+{agents.OURS.name}", "deeplm+ceres", 5 / 15)),
}
"""For each set, method, what it is compared with, and the paper's ratio of their iterations. Source: the paper, tables
"Average efficiency improvement" and "Average acceleration using synthetic data for training"."""

WHY = (
    "our problems are other ones, some of them small; our agent follows the paper's text and not its code, which "
    "differs from the text in state, range of lambda and reward."
)


def _sets(runner: Runner) -> list[tuple[str, tuple[Source, ...], str, list[real.LabelledMethod]]]:
    """For both data sets: name, problems, why there are none (or empty), and rows."""
    kitti = real_problems.find(runner.config.real.kitti)
    count = runner.config.agents.trajectories

    def rows(paper: float, classic: float) -> list[real.LabelledMethod]:
        return [
            ("classic", method_named("classic"), classic, None),
            ("Ceres' rule", method_named("ceres"), None, None),
            ("ours: agent of this run", runner.agent(agents.OURS), paper, None),
            ("ours: shipped policy, wide synthetic scenes", method_named("learned-driver"), paper, None),
            (f"ours: trained on {count} scenes only", runner.agent(agents.FEW), paper, None),
        ]

    stba: list[real.LabelledMethod] = [
        ("STBA", method_named("stba+stba"), 80.0, None),
        ("STBA + agent of this run", runner.agent(agents.OURS, "stba"), 16.0, None),
    ]
    deeplm: list[real.LabelledMethod] = [
        ("DeepLM", method_named("deeplm+ceres"), 15.0, None),
        ("DeepLM + agent of this run", runner.agent(agents.OURS, "deeplm"), 5.0, None),
    ]
    bal, reason = real_problems.bal(runner.config.real), real_problems.reason_without_bal(runner.config.real)
    return [
        ("KITTI", kitti.all, kitti.reason, [*rows(17.0, 75.0), *stba]),
        ("BAL", bal, reason, [*rows(5.0, 20.0), *deeplm]),
    ]


def _run(runner: Runner) -> None:
    for _, sources, _, methods in _sets(runner):
        runner.solve(sources, [method for _, method, _, _ in methods])


def _section(runner: Runner) -> Section:
    body = [
        "The paper trains on 10 trajectories of 10 cameras and 10 points. Agents of this run train on scenes of that "
        "kind, with unknown poses and points as in the paper; one kind of agent trains on "
        f"{runner.config.agents.trajectories} scenes in all. Problems of BAL are then solved with the nine unknowns of "
        "its cameras, those of KITTI with known lenses."
    ]
    found = []
    for name, sources, reason, methods in _sets(runner):
        lines = real.real_lines(runner, methods, sources)
        known = {line.row.method: line.row for line in lines if line.row.solves}
        for method, base, wanted in CLAIMS[name]:
            text = f"Synthetic training, {name}: fraction of {base}'s iterations"
            found.append(claims.ratio_claim(text, wanted, known.get(method), known.get(base)))
        if reason or not known:
            body.append(f"**{name}**: {reason or common.NOT_YET}")
            continue
        body += [
            f"**{name}**, {common.problems(len(sources))}:",
            lines_table(lines, known.get("classic"), known.get("ceres"), True),
        ]
    body.append(disagreements(found, WHY))
    return Section("Synthetic training, real problems", tuple(body), tuple(found))


ENTRY = TableOrFigure("synthetic", "Table: trained on synthetic scenes, tested on real problems", _run, _section)
