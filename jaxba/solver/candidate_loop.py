"""`try_step` run from Python: each candidate, and each camera round, is a run of a program of its own.

In one program the candidates of a step are turns of a loop (refinement/candidates.py). Here Python is that loop, so
that camera rounds are compiled only if a solve has some, beside the rest and to a level of their own. What is computed
is the same.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import Proposal, take_step
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Candidate, comparison
from jaxba.refinement.cameras import refine_cameras
from jaxba.refinement.candidates import Search, first_search, next_search
from jaxba.refinement.subproblems import Whole
from jaxba.runtime.compilation import Program, program
from jaxba.structure.layout import Layout


class Next(IntEnum):
    """What a search does next."""

    NOTHING = 0
    CANDIDATE = 1
    CAMERA_ROUND = 2


def try_candidate(
    layout: Layout,
    state: LMState,
    proposal: Proposal,
    options: StepOptions,
    min_gain: Float[Array, ""],
    search: Search,
    refined: Float[Array, "parameters cameras"],
) -> tuple[Search, Int[Array, ""]]:
    """One turn of the search for the candidate of a step, and what comes next. Arguments as for `next_search`."""
    against = comparison(Whole(layout), *state[:3], proposal.reference, proposal.step, options, min_gain)
    search = next_search(against, search, refined)
    following = jnp.where(search.active, jnp.where(search.refining, Next.CAMERA_ROUND, Next.CANDIDATE), Next.NOTHING)
    return search, following


def camera_round(layout: Layout, candidate: Candidate, options: StepOptions) -> Float[Array, "parameters cameras"]:
    """The cameras of a candidate, each re-optimised on its own."""
    return refine_cameras(layout, candidate.cameras, candidate.points, options)


def try_step_by_parts(
    call: Callable[..., Any],
    part: Callable[[Callable[..., Any]], Program],
    layout: Layout,
    state: LMState,
    damping: Any,
    proposal: Proposal,
    options: StepOptions,
    min_gain: Any,
) -> tuple[LMState, StepInfo]:
    """`try_step`, with the same arguments or their shapes and types, by programs that `call` runs or compiles.

    Camera rounds are not compiled before they are run.

    Args:
        call: runs or compiles a program.
        part: the program of a part of the step, at its present level.
    """
    search = first_search(state.cameras, state.points, state.cost, proposal.step)
    refined = state.cameras
    while True:
        arguments = (layout, state, proposal, options, min_gain, search, refined)
        search, following = call(part(try_candidate), *arguments)
        if not isinstance(following, Array) or int(following) == Next.NOTHING:
            break
        if int(following) == Next.CAMERA_ROUND:
            refined = call(part(camera_round), layout, search.candidate, options)
    return call(program(take_step, level="quick"), layout, state, damping, proposal, search.best)
