"""`jaxba-view`: problems and recorded solves in the browser."""

from __future__ import annotations

import os
import socket
import sys
import threading
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jaxba.cli import common

if TYPE_CHECKING:
    from jaxba.viewer.panel import Viewer
    from jaxba.viewer.sources import Shown

LARGEST_EPISODE = 40
"""Most iterations of an episode: those of the training presets."""

NAMED = 5
"""Worst images that are printed."""


@dataclass(frozen=True)
class Arguments:
    """Options of `jaxba-view`."""

    files: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Problems in any format that jaxba-solve reads, and recordings of jaxba-solve --record; more than one stand side
    by side."""

    images: str | None = None
    """Folder of the images, for files that name them (COLMAP, jaxba-kitti)."""

    poses: str | None = None
    """KITTI's file of the true poses of the whole sequence. Default: that with which jaxba-kitti made the problem, if
    it is there."""

    policy: str | None = None
    """Instead of files: an episode of the game, played by a policy: a file of jaxba-train, or a name."""

    scene: int = 0
    """Number of the random scene of --policy."""

    html: str | None = None
    """Output file: one page that opens without a server and plays the iterations. Nothing is served."""

    port: int = 8080
    """First port that is tried."""

    host: str = "127.0.0.1"
    """Address of this machine at which the page is reached, without a password. Default: from this machine only;
    0.0.0.0: from every machine that reaches this one."""


def main() -> None:
    """Entry point of `jaxba-view`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0, or 2 for bad input."""
    return common.run_command(Arguments, _run, "Look at problems and recorded solves in the browser.", argv)


def _run(args: Arguments) -> int:
    if not args.files and args.policy is None:
        raise common.UsageError("name a problem or a recording, or a policy by --policy")
    if args.files and args.policy is not None:
        raise common.UsageError("--policy plays a random scene, not a file")
    if args.scene < 0:
        raise common.UsageError(f"--scene must not be negative, is {args.scene}")
    if not 0 < args.port < 65536:
        raise common.UsageError(f"--port must lie between 1 and 65535, is {args.port}")
    if args.images is not None and not os.path.isdir(args.images):
        raise common.UsageError(f"--images {args.images}: is no folder")
    _check_host(args.host)
    common.check_writable("--html", args.html)
    _check_apart(args)
    check_extra()
    from jaxba.viewer.sources import open_all

    with common.notes_printed():
        shown = open_all(args.files, args.images, args.poses) if args.policy is None else [_episode(args)]
    if args.html:
        from jaxba.viewer.page import write_page

        write_page(shown, args.html)
        common.print_line(f"wrote {args.html} ({os.path.getsize(args.html) / 1e6:.1f} MB)")
        return 0
    from jaxba.viewer.panel import Viewer, heading, worst_images

    viewer = Viewer(shown, args.port, args.host)
    for stage in viewer.stages:
        common.print_line(f"{heading(stage)}, {stage.numbers()}")
        for text, _ in worst_images(stage, NAMED):
            common.print_line(f"  worst: {text}")
    announce(viewer)
    missing = viewer.load_images()
    if missing:
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
        raise common.UsageError(f"--host {host}: {getattr(error, 'strerror', None) or error}") from None


def _check_apart(args: Arguments) -> None:
    """Refuses a page in the place of a file that is shown."""
    if args.html is None:
        return
    from jaxba.cli.overwriting import PROBLEM, check_apart, policy_file, problem_files
    from jaxba.datasets.bal.paths import resolve

    files = [file for name in args.files for file in problem_files(resolve(name))]
    images = [] if args.images is None else [one for one in Path(args.images).rglob("*") if one.suffix != ".html"]
    read = {PROBLEM: files, "the file of --poses": [args.poses], "an image": images}
    check_apart({"--html": [args.html]}, {**read, "the file of --policy": [policy_file(args.policy or "")]})


def _episode(args: Arguments) -> Shown:
    """An episode on a scene of the game's default class."""
    import jax

    import jaxba
    from jaxba.game.random_scenes import SceneClass
    from jaxba.game.scene_bank import draw
    from jaxba.viewer.recording import Recorder
    from jaxba.viewer.sources import shown

    assert args.policy is not None
    jax.config.update("jax_enable_x64", True)  # the game's type
    policy = jaxba.make_policy(args.policy)
    problem = draw(SceneClass(), jax.random.key(0), args.scene)
    recorder = Recorder(problem)
    jaxba.solve(problem, policy, jaxba.SolveOptions(max_iterations=LARGEST_EPISODE), watch=recorder)
    return shown(recorder.recording(), f"scene {args.scene}, {args.policy}")


def check_extra() -> None:
    """Raises a UsageError that names the package to install, if viser is missing."""
    try:
        import jaxba.viewer.extra  # noqa: F401
    except ImportError as error:
        raise common.UsageError(str(error)) from None


def announce(viewer: Viewer) -> None:
    """Prints where the page is, and opens it where there is a display."""
    common.print_line(f"open {viewer.url}")
    if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(viewer.url)


def wait(viewer: Viewer) -> None:
    """Serves the page until Ctrl-C."""
    common.print_line("Ctrl-C ends it")
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        viewer.close()
