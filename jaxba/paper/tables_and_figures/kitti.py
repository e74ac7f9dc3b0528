"""Table: KITTI."""

from __future__ import annotations

from jaxba.paper import claims, places
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base, real
from jaxba.paper.pieces.base import Piece
from jaxba.paper.workshop import Workshop, named

METHODS: tuple[tuple[str, str, float | None, float | None], ...] = (
    ("STBA", "stba+stba", 80.0, 287.4),
    ("STBA + ours", "stba+learned-driver", 16.0, 110.0),
    ("Ceres' rule", "ceres", None, None),
    ("Ceres' rule + embedded iterations", "ceres+embedded", None, None),
    ("classic", "classic", 75.0, 340.0),
    ("ours: shipped policy, lambda alone", "learned-driver", 14.0, 100.2),
    ("ours: shipped policy, embedded iterations", "learned", None, None),
)
"""Rows. Source: the paper, table "Average efficiency improvement - KITTI"."""

WHY = (
    "the shipped policy was trained on synthetic scenes, the paper's for this table on KITTI; front end, sequences "
    "and windows "
    "are other ones, which the paper does not describe; our STBA is written from its paper and authors' code, in JAX."
)


def _methods() -> list[real.Named]:
    return [(label, named(name), its, seconds) for label, name, its, seconds in METHODS]


def _work(shop: Workshop) -> None:
    shop.solve(places.find(shop.config.real.kitti).all, [method for _, method, _, _ in _methods()])


def _section(shop: Workshop) -> Section:
    place = places.find(shop.config.real.kitti)
    sources = place.all
    rows = {line.row.method: line.row for line in real.real_lines(shop, _methods(), sources)}
    known = {name: row if row.solves else None for name, row in rows.items()}
    ours, classic = known["learned-driver"], known["classic"]
    found = (
        claims.ratio_claim("KITTI: ours takes a fifth of classic's iterations", 14 / 75, ours, classic),
        claims.ratio_claim(
            "KITTI: ours takes a fifth of STBA's iterations", 0.2, known["stba+learned-driver"], known["stba+stba"]
        ),
        claims.time_claim("KITTI: ours takes a third of classic's time", 100.2 / 340.0, ours, classic),
        claims.share_claim("KITTI: classic succeeds everywhere", 1.0, rows["classic"].success),
        claims.share_claim("KITTI: ours succeeds everywhere", 1.0, rows["learned-driver"].success),
    )
    if place.reason or not any(row.solves for row in rows.values()):
        return Section("KITTI", (f"KITTI: {place.reason}." if place.reason else base.NOT_YET,), found)
    body = [
        f"{base.problems(len(sources))}: {', '.join(source.name for source in sources)}. `-firstN` is the part of N "
        "neighbouring "
        "cameras, begun with the camera that sees most.",
        *real.real_tables(shop, _methods(), sources),
        disagreements(found, WHY),
    ]
    if place.missing:
        body.insert(1, f"Named by the configuration and not here: {', '.join(f'`{name}`' for name in place.missing)}.")
    return Section("KITTI", tuple(body), found)


PIECE = Piece("kitti", "Table: average efficiency, KITTI", _work, _section)
