"""`--record` and `--view` of `jaxba-solve`: a solve that is recorded, or watched, while it runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxba.cli import common, view
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.solver.loop import IterationRecord, Watch

PAUSE_S = 0.3
"""Least time between two updates of the page."""


class Watching:
    """A solve that is recorded or watched; nothing is done without either."""

    watch: Watch | None = None
    """For `jaxba.solve`."""

    def __init__(self, problem: BundleProblem, path: str | None, record: str | None, show: bool) -> None:
        """Opens the page.

        Args:
            problem: the start.
            path: where it was read.
            record: file of the recording.
            show: whether a page shows the solve.
        """
        self._record, self._viewer, self._drawn = record, None, 0.0
        if record is None and not show:
            return
        from jaxba.viewer.recording import Recorder

        self.watch = self._recorder = Recorder(problem, path or "")
        if not show:
            return
        from jaxba.viewer.panel import Viewer
        from jaxba.viewer.sources import shown

        self._viewer = Viewer([shown(self._recorder.recording(), Path(path).name if path else "random scene")])
        view.announce(self._viewer)
        self.watch = self._record_and_draw

    def _record_and_draw(self, record: IterationRecord, now: Callable[[], BundleProblem]) -> None:
        """Records an iteration, and draws it if the last update was long enough ago."""
        self._recorder(record, now)
        if time.perf_counter() - self._drawn >= PAUSE_S:
            self._draw(self._viewer)

    def _draw(self, viewer: Any) -> None:
        viewer.grow(self._recorder.recording())
        self._drawn = time.perf_counter()

    def end(self) -> None:
        """Writes the recording, and serves the page until Ctrl-C."""
        if self._record is not None:
            from jaxba.viewer.recording import write_recording

            write_recording(self._recorder.recording(), self._record)
            common.print_line(f"wrote {self._record}")
        if self._viewer is not None:
            self._draw(self._viewer)
            view.wait(self._viewer)
