"""Table: trained on synthetic scenes, tested on real problems."""

from __future__ import annotations

from jaxba.bench.sources import Source
from jaxba.paper import agents, claims, places
from jaxba.paper.markdown import Section, disagreements, lines_table
from jaxba.paper.pieces import base, real
from jaxba.paper.pieces.base import Piece
from jaxba.paper.workshop import Workshop, named

WHY = (
    "our problems are other ones, partly small; the paper's agent and ours share the text's description and not the "
    "code, "
    "whose state, range of lambda and reward the text contradicts or leaves open."
)


def _sets(shop: Workshop) -> list[tuple[str, tuple[Source, ...], str, list[real.Named]]]:
    """Name, problems, reason for none, and rows of both data sets."""
    kitti = places.find(shop.config.real.kitti)
    count = shop.config.agents.trajectories

    def rows(outer: str, label: str, classic: float, its: tuple[float, float]) -> list[real.Named]:
        return [
            ("classic", named("classic"), classic, None),
            ("Ceres' rule", named("ceres"), None, None),
            ("ours: agent of this run", shop.agent(agents.OURS), its[0], None),
            ("ours: shipped policy, wide synthetic scenes", named("learned-driver"), its[0], None),
            (f"ours: trained on {count} scenes only", shop.agent(agents.FEW), its[0], None),
            (f"{label} + agent of this run", shop.agent(agents.OURS, outer), its[1], None),
        ]

    return [
        ("KITTI", kitti.all, kitti.reason, rows("stba", "STBA", 75.0, (17.0, 16.0))),
        (
            "BAL",
            places.bal(shop.config.real),
            places.why_no_bal(shop.config.real),
            rows("deeplm", "DeepLM", 20.0, (5.0, 5.0)),
        ),
    ]


def _work(shop: Workshop) -> None:
    for _, sources, _, methods in _sets(shop):
        shop.solve(sources, [method for _, method, _, _ in methods])


def _section(shop: Workshop) -> Section:
    body = [
        "The paper trains on 10 trajectories of 10 cameras and 10 points. Agents of this run train on scenes of that "
        "kind, "
        f"poses and points unknown as in the paper; one kind of agent on {shop.config.agents.trajectories} scenes in "
        "all. "
        "Real problems are then solved with BAL's nine unknowns a camera."
    ]
    found = []
    for name, sources, reason, methods in _sets(shop):
        lines = real.real_lines(shop, methods, sources)
        known = {line.row.method: line.row for line in lines if line.row.solves}
        wanted = {"KITTI": 17 / 75, "BAL": 5 / 20}[name]
        found.append(
            claims.ratio_claim(
                f"Synthetic training, {name}: share of classic's iterations",
                wanted,
                known.get(agents.OURS.name),
                known.get("classic"),
            )
        )
        if reason or not known:
            body.append(f"**{name}**: {reason or base.NOT_YET}")
            continue
        body += [
            f"**{name}**, {base.problems(len(sources))}:",
            lines_table(lines, known.get("classic"), known.get("ceres"), True),
        ]
    body.append(disagreements(found, WHY))
    return Section("Synthetic training, real problems", tuple(body), tuple(found))


PIECE = Piece("synthetic", "Table: trained on synthetic scenes, tested on real problems", _work, _section)
