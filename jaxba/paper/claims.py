"""The paper's claims, and whether the numbers of a run bear them out. By rule, not by eye.

A claim is about a ratio (our method takes a fifth of classic's iterations), an order (five errors are better than one)
or a share (all solves succeed). The rules are stated in the report beside the claims.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from jaxba.bench.tables import number
from jaxba.paper.rows import Row

Verdict = Literal["reproduced", "partly", "not", "not run"]

AS_STRONG = 1.25
"""A ratio is reproduced if ours is at most this times the paper's ..."""

ANY_GAIN = 0.9
"""... and partly reproduced if ours is at most this: still a gain of a tenth."""

SHARE = 0.05
"""A share is reproduced within five points; partly within ..."""

ROUGH_SHARE = 0.15
"""... fifteen."""

CRITERION = (
    f"A **ratio** is *reproduced* if ours is at most {AS_STRONG:g} times the paper's, *partly* if at most {ANY_GAIN:g} "
    "(a gain of a tenth), else *not*. An **order** (A takes fewer iterations than B) is *reproduced* if A takes at "
    "most "
    f"{ANY_GAIN:g} of B's and their ranges over the seeds do not overlap, *partly* if A's mean is just lower, else "
    "*not*. "
    f"A **share** is *reproduced* within {100 * SHARE:.0f} points, *partly* within {100 * ROUGH_SHARE:.0f}. A claim "
    "about "
    "iterations or seconds is *not* reproduced where the method succeeds on fewer of the problems than the one it is "
    "compared with, by more than five points, whatever the numbers."
)


@dataclass(frozen=True)
class Claim:
    """One claim with its verdict."""

    text: str
    """The paper's claim, in words."""

    paper: str
    """Its number."""

    ours: str
    """Ours."""

    verdict: Verdict
    """By `CRITERION`."""


def ratio_claim(text: str, paper: float, ours: Row | None, base: Row | None) -> Claim:
    """That `ours` takes the share `paper` of the iterations of `base`."""
    if ours is None or base is None or not (math.isfinite(ours.iterations) and base.iterations > 0):
        return Claim(text, f"{paper:.2f}", "-", "not run")
    found = ours.iterations / base.iterations
    verdict: Verdict = "reproduced" if found <= AS_STRONG * paper else "partly" if found <= ANY_GAIN else "not"
    detail = f"{found:.2f} ({ours.iterations:.1f} / {base.iterations:.1f})"
    if ours.success < base.success - SHARE:
        verdict, detail = "not", f"{detail}, success {100 * ours.success:.0f} % against {100 * base.success:.0f} %"
    return Claim(text, f"{paper:.2f}", detail, verdict)


def time_claim(text: str, paper: float, ours: Row | None, base: Row | None) -> Claim:
    """That `ours` takes the share `paper` of the seconds of `base`; judged as `ratio_claim`."""
    if ours is None or base is None or not (ours.seconds > 0 and base.seconds > 0):
        return Claim(text, f"{paper:.2f}", "-", "not run")
    found = ours.seconds / base.seconds
    verdict: Verdict = "reproduced" if found <= AS_STRONG * paper else "partly" if found <= ANY_GAIN else "not"
    detail = f"{found:.2f} ({number(ours.seconds)} / {number(base.seconds)} s)"
    if ours.success < base.success - SHARE:
        verdict, detail = "not", f"{detail}, success {100 * ours.success:.0f} % against {100 * base.success:.0f} %"
    return Claim(text, f"{paper:.2f}", detail, verdict)


def order_claim(text: str, paper: str, better: Row | None, worse: Row | None) -> Claim:
    """That `better` takes fewer iterations than `worse`."""
    if better is None or worse is None or not math.isfinite(better.iterations + worse.iterations):
        return Claim(text, paper, "-", "not run")
    clear = better.iterations <= ANY_GAIN * worse.iterations
    clear &= better.high < worse.low or not (better.seeds or worse.seeds)
    verdict: Verdict = "not" if better.iterations >= worse.iterations else "reproduced" if clear else "partly"
    if better.success < worse.success - SHARE:
        verdict = "not"
    detail = f"{better.iterations:.1f} against {worse.iterations:.1f}"
    if min(better.success, worse.success) < 1:
        detail += f", success {100 * better.success:.0f} % and {100 * worse.success:.0f} %"
    return Claim(text, paper, detail, verdict)


def share_claim(text: str, paper: float, ours: float) -> Claim:
    """That a share is `paper`."""
    if math.isnan(ours):
        return Claim(text, f"{100 * paper:.0f} %", "-", "not run")
    gap = abs(paper - ours)
    verdict: Verdict = "reproduced" if gap <= SHARE else "partly" if gap <= ROUGH_SHARE else "not"
    return Claim(text, f"{100 * paper:.0f} %", f"{100 * ours:.0f} %", verdict)
