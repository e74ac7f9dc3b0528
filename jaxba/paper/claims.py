"""Tests by fixed rules whether the results of a run reproduce the paper's claims.

A claim is about a ratio (our method takes a fifth of classic's iterations), an order (five errors
are better than one) or a fraction (all solves succeed). The report states the rules (`criterion` in
texts.md)."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple

from jaxba.bench.tables import number
from jaxba.paper.results import Row

Status = Literal["reproduced", "partly", "not", "not run"]

RATIO_TOLERANCE = 1.25  # a ratio is reproduced if ours is the paper's up to this factor, either way
# a ratio is partly reproduced if ours is at most this, a gain of at least a tenth, of another size
PARTLY_RATIO = 0.9
# up to which fractions are alike; a larger deficit in success makes a gain none
FRACTION_TOLERANCE = 0.05
# a fraction is partly reproduced if ours differs from the paper's by at most this
PARTLY_FRACTION_TOLERANCE = 0.15


class Claim(NamedTuple):
    """A claim of the paper and whether it is reproduced."""

    text: str  # in words
    paper: str  # the paper's number
    ours: str
    status: Status
    near: str = "-"  # as `ours`, in iterations to f*(1+1e-3)


class Statement(NamedTuple):
    """A claim before it is tested: the rule, the claim in words, the paper's number, and the
    methods."""

    test: Callable[..., Claim]  # a function of this module such as `ratio_claim`
    text: str  # in words; `{}` stands for the set of problems
    paper: Any  # the paper's number, as the test takes it
    ours: str  # method that the claim is about
    base: str = ""  # method that it is compared with; none for `success_claim`


def judge(
    statements: Iterable[Statement], row: Callable[[str], Row | None], where: str = ""
) -> tuple[Claim, ...]:
    """Tests claims on the problems called `where`; `row` gives a method's row by name, None if it
    was not run."""
    return tuple(
        one.test(
            one.text.format(where), one.paper, *(row(name) for name in (one.ours, one.base) if name)
        )
        for one in statements
    )


def is_less_successful(one: Row, other: Row) -> bool:
    """Whether a method succeeds so much less often than another one that fewer iterations or
    seconds are no gain."""
    return one.success < other.success - FRACTION_TOLERANCE


def _comparable(name: str, one: Row | None, other: Row | None) -> bool:
    """Whether two means are positive numbers, over the same number of problems, and of no collapsed
    agents."""
    if one is None or other is None:
        return False
    means = getattr(one, name), getattr(other, name)
    learned = not (one.collapsed or other.collapsed)
    return (
        learned
        and all(math.isfinite(mean) and mean > 0 for mean in means)
        and one.solves == other.solves
    )


def ratio_claim(
    text: str, paper: float, ours: Row | None, base: Row | None, of: str = "iterations"
) -> Claim:
    """The claim that `ours` takes the fraction `paper` of the iterations of `base`, or of its
    seconds."""
    if ours is None or base is None or not _comparable(of, ours, base):
        return Claim(text, f"{paper:.2f}", "-", "not run")
    one = getattr(ours, of)
    other = getattr(base, of)
    found = one / other
    near_enough = paper / RATIO_TOLERANCE <= found <= RATIO_TOLERANCE * paper
    status: Status = "reproduced" if near_enough else "partly" if found <= PARTLY_RATIO else "not"
    parts = (
        f"{one:.1f} / {other:.1f}" if of == "iterations" else f"{number(one)} / {number(other)} s"
    )
    detail = f"{found:.2f} ({parts})"
    if is_less_successful(ours, base):
        status = "not"
        detail = f"{detail}, success {100 * ours.success:.0f} % against {100 * base.success:.0f} %"
    near = (
        f"{ours.near / base.near:.2f} ({ours.near:.1f} / {base.near:.1f})"
        if of == "iterations"
        else "-"
    )
    return Claim(text, f"{paper:.2f}", detail, status, near)


time_claim = functools.partial(ratio_claim, of="seconds")


def longer_claim(text: str, paper: str, ours: Row | None, base: Row | None) -> Claim:
    """The claim that `ours` takes more seconds than `base`."""
    if ours is None or base is None or not _comparable("seconds", ours, base):
        return Claim(text, paper, "-", "not run")
    longer = 1e3 * (ours.seconds - base.seconds)
    detail = f"{longer:+.1f} ms ({number(1e3 * ours.seconds)} / {number(1e3 * base.seconds)} ms)"
    return Claim(text, paper, detail, "reproduced" if longer > 0 else "not")


def order_claim(text: str, paper: str, better: Row | None, worse: Row | None) -> Claim:
    """The claim that `better` takes fewer iterations than `worse`."""
    if better is None or worse is None or not _comparable("iterations", better, worse):
        return Claim(text, paper, "-", "not run")
    clear = better.iterations <= PARTLY_RATIO * worse.iterations
    clear &= better.high < worse.low or not (better.seeds or worse.seeds)
    status: Status = (
        "not" if better.iterations >= worse.iterations else "reproduced" if clear else "partly"
    )
    if is_less_successful(better, worse):
        status = "not"
    detail = f"{better.iterations:.1f} against {worse.iterations:.1f}"
    if min(better.success, worse.success) < 1:
        detail += f", success {100 * better.success:.0f} % and {100 * worse.success:.0f} %"
    return Claim(text, paper, detail, status, f"{better.near:.1f} against {worse.near:.1f}")


def success_claim(text: str, paper: float, ours: Row | None) -> Claim:
    """The claim that a method succeeds on the fraction `paper` of the problems."""
    if ours is None or math.isnan(ours.success) or ours.collapsed:
        return Claim(text, f"{100 * paper:.0f} %", "-", "not run")
    gap = abs(paper - ours.success)
    status: Status = (
        "reproduced"
        if gap <= FRACTION_TOLERANCE
        else "partly"
        if gap <= PARTLY_FRACTION_TOLERANCE
        else "not"
    )
    return Claim(text, f"{100 * paper:.0f} %", f"{100 * ours.success:.0f} %", status)


def error_claim(text: str, paper: float, excess: Sequence[float]) -> Claim:
    """The claim that an error is larger by less than `paper` on every problem; `excess` is how much
    ours is."""
    if not excess:
        return Claim(text, f"< {paper:g}", "-", "not run")
    within = sum(x < paper for x in excess)
    status: Status = (
        "reproduced" if within == len(excess) else "partly" if 2 * within >= len(excess) else "not"
    )
    return Claim(
        text,
        f"< {paper:g}",
        f"on {within} of {len(excess)} problems, at most {max(excess):+.2g}",
        status,
    )
