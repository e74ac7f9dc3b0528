"""`jaxba-view`, and `--record` and `--view` of `jaxba-solve`: problems and solves in the browser,
also running ones."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jaxba.cli import common
from jaxba.cli.options import options
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.solver.drivers import IterationRecord, Watch

if TYPE_CHECKING:
    from jaxba.viewer.page import Viewer

VIEWER = "jaxba.viewer.extra"  # module that needs viser
PAUSE_S = 0.3  # least time between two updates of the page


@options
class Arguments:
    """Options of `jaxba-view`."""

    files: Annotated[tuple[str, ...], "FILE ...", tyro.conf.Positional]
    """Problems in any format of jaxba-solve, and recordings of jaxba-solve --record, side by
    side."""

    images: Annotated[str | None, "FOLDER"] = None
    """Images, for files that name them (COLMAP, jaxba-kitti)."""

    html: Annotated[str | None, "FILE"] = None
    """Write one page that opens without a server and plays the iterations. Nothing is served."""

    host: Annotated[str, "ADDRESS"] = "127.0.0.1"
    """Address at which the page is served, without a password; 0.0.0.0 for every machine that
    reaches this one."""


def main() -> None:
    """Entry point of `jaxba-view`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0, or 2 for bad input."""
    return common.run_command(
        Arguments, _run, "Look at problems and recorded solves in the browser.", argv
    )


def _run(args: Arguments) -> int:
    common.require(bool(args.files), "name a problem or a recording")
    common.require(
        args.images is None or os.path.isdir(args.images), f"--images {args.images}: is no folder"
    )
    _check_host(args.host)
    common.check_writable("--html", args.html)
    _check_apart(args)
    common.check_extra(VIEWER)
    from jaxba.viewer import sources

    with common.notes_printed():
        shown = sources.open_all(args.files, args.images)
    if args.html:
        from jaxba.viewer.page_file import write_page

        write_page(shown, args.html)
        common.print_line(f"wrote {args.html} ({os.path.getsize(args.html) / 1e6:.1f} MB)")
        return 0
    from jaxba.viewer.page import Viewer

    viewer = Viewer(shown, args.host)
    announce(viewer)
    if missing := viewer.load_images():
        common.print_line(f"note: {common.counted(missing, 'image')} not found in {args.images}")
    wait(viewer)
    return 0


def _check_host(host: str) -> None:
    """Refuses what is no address of this machine."""
    try:
        family, kind, _, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as server:
            server.bind(place)
    except (OSError, UnicodeError) as error:
        raise common.UsageError(
            f"--host {host}: {getattr(error, 'strerror', None) or error}"
        ) from None


def _check_apart(args: Arguments) -> None:
    """Refuses a page in the place of a file that is shown."""
    if args.html is None:
        return
    from jaxba.cli.overwriting import PROBLEM, check_apart, problem_files
    from jaxba.datasets.bal.paths import resolve

    files = [file for name in args.files for file in problem_files(resolve(name))]
    images = (
        []
        if args.images is None
        else [one for one in Path(args.images).rglob("*") if one.suffix != ".html"]
    )
    check_apart({"--html": [args.html]}, {PROBLEM: files, "an image": images})


def announce(viewer: Viewer) -> None:
    """Prints where the page is, and opens it where there is a display."""
    common.print_line(f"open {viewer.url}")
    if (
        sys.platform in ("darwin", "win32")
        or os.environ.get("DISPLAY")
        or os.environ.get("WAYLAND_DISPLAY")
    ):
        webbrowser.open(viewer.url)


def wait(viewer: Viewer) -> None:
    """Serves the page until Ctrl-C."""
    common.print_line("Ctrl-C ends it")
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        viewer.close()


def watched(
    problem: BundleProblem, path: str | None, record: str | None, show: bool
) -> tuple[Watch | None, Callable[[], None]]:
    """Opens the page if `show`, for a problem that was read at `path`; `record` is the file of the
    recording, if one is wanted. Returns `watch` for `jaxba.solve`, and what writes the recording
    and serves the page after it."""
    if record is None and not show:
        return None, lambda: None
    from jaxba.viewer.recording import Recorder, write_recording

    recorder = Recorder(problem, path or "")
    drawn = 0.0
    viewer = None
    if show:
        from jaxba.viewer.page import Viewer
        from jaxba.viewer.sources import shown

        viewer = Viewer([shown(recorder.recording(), Path(path).name if path else "random scene")])
        announce(viewer)

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
            wait(viewer)

    return watch, end
