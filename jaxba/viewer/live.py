"""A solve that is watched while it runs."""

from __future__ import annotations

import time
from collections.abc import Callable

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.solver.loop import IterationRecord
from jaxba.viewer.panel import Viewer
from jaxba.viewer.recording import Recorder

PAUSE_S = 0.3
"""Least time between two updates of the page."""


class Watcher:
    """`watch` of `jaxba.solve` that draws what a recorder recorded."""

    def __init__(self, viewer: Viewer, recorder: Recorder) -> None:
        self._viewer, self._recorder, self._drawn = viewer, recorder, 0.0

    def __call__(self, record: IterationRecord, now: Callable[[], BundleProblem]) -> None:
        """Records an iteration, and draws it if the last update was long enough ago."""
        self._recorder(record, now)
        if time.perf_counter() - self._drawn >= PAUSE_S:
            self.draw()

    def draw(self) -> None:
        """Draws what was recorded so far."""
        self._viewer.grow(self._recorder.recording())
        self._drawn = time.perf_counter()
