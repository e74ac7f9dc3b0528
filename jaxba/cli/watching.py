"""`--record` and `--view` of `jaxba-solve`: a solve that is recorded, or watched, while it runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jaxba.cli import common, view
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.solver.loop import Watch

if TYPE_CHECKING:
    from jaxba.viewer.live import Watcher
    from jaxba.viewer.panel import Viewer
    from jaxba.viewer.recording import Recorder


@dataclass(frozen=True)
class Watching:
    """A solve that is recorded or watched."""

    recorder: Recorder
    watch: Watch
    viewer: Viewer | None = None
    watcher: Watcher | None = None

    @classmethod
    def of(cls, problem: BundleProblem, path: str | None, record: bool, show: bool) -> Watching | None:
        """What the options ask for; None for nothing.

        Args:
            problem: the start.
            path: where it was read.
            record: whether it is recorded.
            show: whether a page shows it.
        """
        if not (record or show):
            return None
        from jaxba.viewer.recording import Recorder

        recorder = Recorder(problem, path or "")
        if not show:
            return cls(recorder, recorder)
        from jaxba.viewer.live import Watcher
        from jaxba.viewer.panel import Viewer
        from jaxba.viewer.sources import shown

        viewer = Viewer([shown(recorder.recording(), Path(path).name if path else "random scene")])
        view.announce(viewer)
        watcher = Watcher(viewer, recorder)
        return cls(recorder, watcher, viewer, watcher)

    def end(self, path: str | None) -> None:
        """Writes the recording, and serves the page until Ctrl-C."""
        if path is not None:
            from jaxba.viewer.recording import write_recording

            write_recording(self.recorder.recording(), path)
            common.print_line(f"wrote {path}")
        if self.viewer is not None and self.watcher is not None:
            self.watcher.draw()
            view.wait(self.viewer)
