"""Tests by fixed rules whether the results of a run reproduce the paper's claims.

A claim is about a ratio (our method takes a fifth of classic's iterations), an order (five errors are better than one)
or a fraction (all solves succeed). The report states the rules (`CRITERION`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from jaxba.bench.tables import number
from jaxba.paper.rows import Row

Status = Literal["reproduced", "partly", "not", "not run"]

RATIO_TOLERANCE = 1.25
"""A ratio is reproduced if ours is at most this times the paper's."""

PARTLY_RATIO = 0.9
"""A ratio is partly reproduced if ours is at most this, a gain of at least a tenth."""

FRACTION_TOLERANCE = 0.05
"""A fraction is reproduced if ours differs from the paper's by at most this. Also the largest deficit in success of a
method whose iterations or seconds are compared."""

PARTLY_FRACTION_TOLERANCE = 0.15
"""A fraction is partly reproduced if ours differs from the paper's by at most this."""

CRITERION = (
    f"A **ratio** is *reproduced* if ours is at most {RATIO_TOLERANCE:g} times the paper's, *partly* if it is at most "
    f"{PARTLY_RATIO:g} (a gain of a tenth), else *not*. An **order** (A takes fewer iterations than B) is *reproduced* "
    f"if A takes at most {PARTLY_RATIO:g} of B's iterations and their ranges over the training runs do not overlap, "
    "*partly* if only A's mean is lower, else *not*. "
    f"A **fraction** is *reproduced* within {100 * FRACTION_TOLERANCE:.0f} percentage points, *partly* within "
    f"{100 * PARTLY_FRACTION_TOLERANCE:.0f}. A claim about iterations or seconds is *not* reproduced, whatever the "
    "numbers, if the fraction of problems on which the method succeeds is lower than that of the other method by more "
    "than five percentage points."
)


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and whether it is reproduced."""

    text: str
    """The claim in words."""

    paper: str
    """The paper's number."""

    ours: str
    """Our number."""

    status: Status
    """Whether it is reproduced, by `CRITERION`."""


def ratio_claim(text: str, paper: float, ours: Row | None, base: Row | None) -> Claim:
    """The claim that `ours` takes the fraction `paper` of the iterations of `base`."""
    if ours is None or base is None or not (math.isfinite(ours.iterations) and base.iterations > 0):
        return Claim(text, f"{paper:.2f}", "-", "not run")
    found = ours.iterations / base.iterations
    status: Status = "reproduced" if found <= RATIO_TOLERANCE * paper else "partly" if found <= PARTLY_RATIO else "not"
    detail = f"{found:.2f} ({ours.iterations:.1f} / {base.iterations:.1f})"
    if ours.success < base.success - FRACTION_TOLERANCE:
        status, detail = "not", f"{detail}, success {100 * ours.success:.0f} % against {100 * base.success:.0f} %"
    return Claim(text, f"{paper:.2f}", detail, status)


def time_claim(text: str, paper: float, ours: Row | None, base: Row | None) -> Claim:
    """The claim that `ours` takes the fraction `paper` of the seconds of `base`, by the rule of `ratio_claim`."""
    if ours is None or base is None or not (ours.seconds > 0 and base.seconds > 0):
        return Claim(text, f"{paper:.2f}", "-", "not run")
    found = ours.seconds / base.seconds
    status: Status = "reproduced" if found <= RATIO_TOLERANCE * paper else "partly" if found <= PARTLY_RATIO else "not"
    detail = f"{found:.2f} ({number(ours.seconds)} / {number(base.seconds)} s)"
    if ours.success < base.success - FRACTION_TOLERANCE:
        status, detail = "not", f"{detail}, success {100 * ours.success:.0f} % against {100 * base.success:.0f} %"
    return Claim(text, f"{paper:.2f}", detail, status)


def order_claim(text: str, paper: str, better: Row | None, worse: Row | None) -> Claim:
    """The claim that `better` takes fewer iterations than `worse`."""
    if better is None or worse is None or not math.isfinite(better.iterations + worse.iterations):
        return Claim(text, paper, "-", "not run")
    clear = better.iterations <= PARTLY_RATIO * worse.iterations
    clear &= better.high < worse.low or not (better.seeds or worse.seeds)
    status: Status = "not" if better.iterations >= worse.iterations else "reproduced" if clear else "partly"
    if better.success < worse.success - FRACTION_TOLERANCE:
        status = "not"
    detail = f"{better.iterations:.1f} against {worse.iterations:.1f}"
    if min(better.success, worse.success) < 1:
        detail += f", success {100 * better.success:.0f} % and {100 * worse.success:.0f} %"
    return Claim(text, paper, detail, status)


def fraction_claim(text: str, paper: float, ours: float) -> Claim:
    """The claim that a fraction is `paper`."""
    if math.isnan(ours):
        return Claim(text, f"{100 * paper:.0f} %", "-", "not run")
    gap = abs(paper - ours)
    status: Status = (
        "reproduced" if gap <= FRACTION_TOLERANCE else "partly" if gap <= PARTLY_FRACTION_TOLERANCE else "not"
    )
    return Claim(text, f"{100 * paper:.0f} %", f"{100 * ours:.0f} %", status)
