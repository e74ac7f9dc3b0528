"""`--record` and `--view` of `jaxba-solve`: a solve that is recorded, or watched, while it runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from jaxba.cli import common, view
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.solver.drivers import IterationRecord, Watch

PAUSE_S = 0.3
"""Least time between two updates of the page."""


def watched(
    problem: BundleProblem, path: str | None, record: str | None, show: bool
) -> tuple[Watch | None, Callable[[], None]]:
    """Opens the page if `show`, for a problem that was read at `path`; `record` is the file of the recording, if one is
    wanted. Returns `watch` for `jaxba.solve`, and what is to be called after it: it writes the recording, and serves
    the page until Ctrl-C."""
    if record is None and not show:
        return None, lambda: None
    from jaxba.viewer.recording import Recorder, write_recording

    recorder, drawn, viewer = Recorder(problem, path or ""), 0.0, None
    if show:
        from jaxba.viewer.page import Viewer
        from jaxba.viewer.sources import shown

        viewer = Viewer([shown(recorder.recording(), Path(path).name if path else "random scene")])
        view.announce(viewer)

    def watch(step: IterationRecord, now: Callable[[], BundleProblem]) -> None:
        nonlocal drawn
        recorder(step, now)
        if viewer and time.perf_counter() - drawn >= PAUSE_S:
            viewer.grow(recorder.recording())
            drawn = time.perf_counter()

    def end() -> None:
        if record is not None:
            write_recording(recorder.recording(), record)
            common.print_line(f"wrote {record}")
        if viewer:
            viewer.grow(recorder.recording())
            view.wait(viewer)

    return watch, end
