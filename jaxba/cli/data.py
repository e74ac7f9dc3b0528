"""`jaxba-data`: downloads problems of the BAL data set, which other commands then find by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from jaxba.cli import common
from jaxba.cli.options import options


@options
class Download:
    """Downloads problems into the cache folder; continues interrupted downloads."""

    names: Annotated[tuple[str, ...], "NAME ...", tyro.conf.Positional]
    """Names such as ladybug-1197, or families such as trafalgar for all of their problems."""

    base_url: Annotated[str | None, "URL"] = None
    """Folder with the families. Default: that of the data set."""

    checksum: bool = True
    """Compare the checksum; else unpack the file and compare its header with its name, as without a
    known one."""


@options
class List:
    """Lists the problems, and whether they are in the cache folder."""

    names: Annotated[tuple[str, ...], "[NAME ...]", tyro.conf.Positional] = ()
    """Names or families. Default: all."""


@options
class PathOf:
    """Prints the path of a downloaded problem."""

    name: Annotated[str, "NAME", tyro.conf.Positional]
    """Name such as ladybug-1197."""


@options
class Arguments:
    """Options of `jaxba-data`."""

    command: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Download, tyro.conf.subcommand("download")]
        | Annotated[List, tyro.conf.subcommand("list")]
        | Annotated[PathOf, tyro.conf.subcommand("path")]
    ]


def main() -> None:
    """Entry point of `jaxba-data`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 for success, 2 for bad input or a failed download, 130 after
    Ctrl-C."""
    text = "Problems of BAL (Bundle Adjustment in the Large), in the folder JAXBA_BAL."
    return common.run_command(Arguments, _data, text, argv)


def _data(args: Arguments) -> int:
    if isinstance(args.command, Download):
        return _download(args.command)
    if isinstance(args.command, List):
        return _list(args.command)
    from jaxba.datasets.bal.paths import local_path

    print(local_path(args.command.name))
    return 0


def _list(args: List) -> int:
    from rich.table import Table

    from jaxba.datasets.bal.paths import ENTRIES, data_folder, downloaded_path, select

    table = Table(box=None, header_style="bold", pad_edge=False)  # 80 columns wide
    for title in ("name", "cameras", "points", "file", "sha256", "here"):
        table.add_column(
            title, no_wrap=True, justify="right" if title in ("cameras", "points") else "left"
        )
    for entry in select(args.names) if args.names else ENTRIES:
        file = entry.file.partition("/")[2]
        known = "known" if entry.sha256 else "no"
        here = "yes" if downloaded_path(entry) else "no"
        table.add_row(entry.name, str(entry.cameras), str(entry.points), file, known, here)
    console = common.console()
    console.print(table)
    console.print(f"folder: {data_folder()}", markup=False)
    return 0


def _download(args: Download) -> int:
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
        TransferSpeedColumn,
    )

    from jaxba.datasets.bal.paths import data_folder, select

    common.require(bool(args.names), "name a problem or a family; jaxba-data list shows them")
    entries = select(args.names)
    folder = data_folder()
    common.check_extra("jaxba.datasets.bal.download")
    from jaxba.datasets.bal import download

    console = common.console()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
    )
    status = 0
    with Progress(
        *columns,
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as progress:
        for entry in entries:
            task = progress.add_task(entry.name, total=None)

            def show(done: int, total: int | None, task: Any = task) -> None:
                progress.update(task, completed=done, total=total)

            try:
                path, new = download.fetch(
                    entry, folder, show, args.base_url or download.BASE_URL, args.checksum
                )
            except KeyboardInterrupt:
                console.print(
                    "interrupted; what was downloaded is kept, run the same command again to "
                    "continue"
                )
                return common.INTERRUPTED
            except download.DownloadError as error:
                progress.remove_task(task)
                status = common.print_error(str(error))
                if isinstance(error, download.UnreachableError):
                    break  # the others would fail too
                continue
            progress.remove_task(task)
            state = _state(new, args.checksum and bool(entry.sha256))
            console.print(f"{entry.name}: {state}: {path}", markup=False)
    return status


def _state(new: bool, checksum: bool) -> str:
    if not checksum:
        return (
            "downloaded, unpacks, header fits its name"
            if new
            else "was here (no checksum compared)"
        )
    return "downloaded, checksum agrees" if new else "was here, checksum agrees"
