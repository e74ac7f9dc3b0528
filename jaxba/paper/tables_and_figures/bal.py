"""Table: BAL."""

from __future__ import annotations

from jaxba.paper import claims, places
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base, real
from jaxba.paper.pieces.base import Piece
from jaxba.paper.workshop import Workshop, named

METHODS: tuple[tuple[str, str, float | None, float | None], ...] = (
    ("DeepLM's solver", "deeplm+ceres", 15.0, 40.75),
    ("DeepLM's solver + ours", "deeplm+learned-driver", 5.0, 20.3),
    ("Ceres' rule", "ceres", 20.0, 46.7),
    ("Ceres' rule + embedded iterations", "ceres+embedded", None, None),
    ("classic", "classic", 20.0, 110.0),
    ("ours: shipped policy, lambda alone", "learned-driver", 4.0, 62.04),
    ("ours: shipped policy, embedded iterations", "learned", None, None),
)
"""Rows. Source: the paper, table "Average efficiency improvement - BAL"; its "Ceres + ours" (4 iterations, 20.75 s) is
our lambda alone, since a policy takes the place of the rule and the step is the same."""

WHY = (
    "the shipped policy was trained on synthetic scenes, the paper's for this table on BAL; the problems are the few "
    "at hand, "
    "not all of BAL; Ceres is its rule in our step, not its C++ library."
)


def _methods() -> list[real.Named]:
    return [(label, named(name), its, seconds) for label, name, its, seconds in METHODS]


def _work(shop: Workshop) -> None:
    shop.solve(places.bal(shop.config.real), [method for _, method, _, _ in _methods()])


def _section(shop: Workshop) -> Section:
    reason = places.why_no_bal(shop.config.real)
    sources = places.bal(shop.config.real)
    rows = {line.row.method: line.row for line in real.real_lines(shop, _methods(), sources)}
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
        claims.share_claim("BAL: ours succeeds everywhere", 1.0, rows["learned-driver"].success),
    )
    if reason or not any(row.solves for row in rows.values()):
        return Section("BAL", (f"BAL: {reason}." if reason else base.NOT_YET,), found)
    body = [
        f"{base.problems(len(sources))}: {', '.join(source.name for source in sources)}. {missing(shop)}",
        "The paper's row Ceres + ours (4 iterations, 20.75 s) is our lambda alone: a policy takes the place of the "
        "rule.",
        *real.real_tables(shop, _methods(), sources),
        _headroom(rows),
        disagreements(found, WHY),
    ]
    return Section("BAL", tuple(body), found)


def missing(shop: Workshop) -> str:
    """Families of which no file is here, in a sentence."""
    absent = [found.family for found in places.families(shop.config.real) if found.reason]
    return f"No file is here of: {', '.join(absent)}." if absent else ""


def _headroom(rows) -> str:
    classic, ceres = rows["classic"], rows["ceres"]
    if not classic.solves or not ceres.solves:
        return ""
    part = ceres.iterations / classic.iterations
    if part > claims.ANY_GAIN:
        return f"Ceres' rule takes {part:.2f} of classic's iterations here."
    return (
        f"Ceres' rule, which learns nothing, takes {part:.2f} of classic's iterations here: so much of the distance "
        "to classic "
        "is that rule's first lambda (1e-4 instead of 1/4) and factors, and not learning."
    )


PIECE = Piece("bal", "Table: average efficiency, BAL", _work, _section)
