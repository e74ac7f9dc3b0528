"""Table: trained on synthetic scenes, tested on real problems."""

from __future__ import annotations

from jaxba.bench.sources import Source
from jaxba.paper import agents, claims, real_problems
from jaxba.paper.markdown import Section, disagreements, lines_table
from jaxba.paper.runner import Runner, method_named
from jaxba.paper.tables_and_figures import common, real
from jaxba.paper.tables_and_figures.common import TableOrFigure

WHY = (
    "our problems are other ones, some of them small; our agent follows the paper's text and not its code, which "
    "differs from the text in state, range of lambda and reward."
)


def _sets(runner: Runner) -> list[tuple[str, tuple[Source, ...], str, list[real.LabelledMethod]]]:
    """For both data sets: name, problems, why there are none (or empty), and rows."""
    kitti = real_problems.find(runner.config.real.kitti)
    count = runner.config.agents.trajectories

    def rows(method: str, label: str, classic: float, its: tuple[float, float]) -> list[real.LabelledMethod]:
        return [
            ("classic", method_named("classic"), classic, None),
            ("Ceres' rule", method_named("ceres"), None, None),
            ("ours: agent of this run", runner.agent(agents.OURS), its[0], None),
            ("ours: shipped policy, wide synthetic scenes", method_named("learned-driver"), its[0], None),
            (f"ours: trained on {count} scenes only", runner.agent(agents.FEW), its[0], None),
            (f"{label} + agent of this run", runner.agent(agents.OURS, method), its[1], None),
        ]

    return [
        ("KITTI", kitti.all, kitti.reason, rows("stba", "STBA", 75.0, (17.0, 16.0))),
        (
            "BAL",
            real_problems.bal(runner.config.real),
            real_problems.reason_without_bal(runner.config.real),
            rows("deeplm", "DeepLM", 20.0, (5.0, 5.0)),
        ),
    ]


def _run(runner: Runner) -> None:
    for _, sources, _, methods in _sets(runner):
        runner.solve(sources, [method for _, method, _, _ in methods])


def _section(runner: Runner) -> Section:
    body = [
        "The paper trains on 10 trajectories of 10 cameras and 10 points. Agents of this run train on scenes of that "
        "kind, with unknown poses and points as in the paper; one kind of agent trains on "
        f"{runner.config.agents.trajectories} scenes in all. Real problems are then solved with the nine unknowns of a "
        "BAL camera."
    ]
    found = []
    for name, sources, reason, methods in _sets(runner):
        lines = real.real_lines(runner, methods, sources)
        known = {line.row.method: line.row for line in lines if line.row.solves}
        wanted = {"KITTI": 17 / 75, "BAL": 5 / 20}[name]
        found.append(
            claims.ratio_claim(
                f"Synthetic training, {name}: fraction of classic's iterations",
                wanted,
                known.get(agents.OURS.name),
                known.get("classic"),
            )
        )
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
