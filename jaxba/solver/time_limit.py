"""The limit of time of a solve (`Tolerances.seconds`)."""

from __future__ import annotations

import math
import sys
import time
import warnings
from dataclasses import replace

from jaxba.lm.termination import Termination
from jaxba.problem.bundle_problem import ProblemWarning
from jaxba.runtime.distributed import together
from jaxba.solver.options import SolveOptions


def clock() -> float:
    """Seconds since a fixed moment."""
    return time.perf_counter()


class TimeLimit:
    """The limit of time of a solve that begins now."""

    def __init__(self, options: SolveOptions) -> None:
        self._end = clock() + (options.tolerances.seconds or math.inf)

    @property
    def exists(self) -> bool:
        """Whether there is one."""
        return self._end < math.inf

    def is_over(self) -> bool:
        """Whether the time is over. Of several processes the first one says so, since all must do
        the same."""
        return self.exists and together(lambda: clock() >= self._end)

    def rest(self, options: SolveOptions) -> SolveOptions:
        """The options of a solve that is a part of this one: with the time that is left."""
        if not self.exists:
            return options
        left = max(self._end - clock(), sys.float_info.min)
        return replace(options, tolerances=options.tolerances._replace(seconds=left))

    def warn_if_too_short(self, end: Termination, iterations: int) -> None:
        """Warns with a ProblemWarning if a solve ended like this because the time was over before
        its iterations."""
        if end == Termination.TIME_LIMIT and not iterations:
            text = (
                "the time limit was over before the first iteration, so that the result is the "
                "start"
            )
            warnings.warn(text, ProblemWarning, stacklevel=3)
