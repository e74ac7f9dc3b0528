"""`jaxba-paper`: reproduces the tables and figures of the paper."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxba.cli import common
from jaxba.cli.options import options

FULL = "full"  # the preset that is run if none is named

REPORT = "paper.md"  # file of the report, unless `--report` names another


@options
class Arguments:
    """Options of `jaxba-paper`."""

    config: str = FULL
    """A preset (full; fast: fewer seeds and shorter trainings) or the path of a YAML file."""

    only: tuple[str, ...] = ()
    """Names of the tables and figures to compute; default: all. The report has the others from
    earlier results."""

    list: bool = False
    """List all tables and figures and exit."""

    out: str | None = None
    """Folder of results, agents and figures. Default: runs/paper, or runs/paper-NAME for the
    configuration NAME. A second run with the same folder computes only what is missing."""

    report: str | None = None
    """Markdown file of the report; an interactive page of the figures stands beside it, with the
    ending .html. Default: OUT/paper.md. The table of claims alone is OUT/claims.md."""


def main() -> None:
    """Entry point of `jaxba-paper`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 for a report, 2 for bad input, 130 after Ctrl-C (results are
    kept)."""
    return common.run_command(
        Arguments, _paper, "Reproduces the tables and figures of the paper.", argv
    )


def _paper(args: Arguments) -> int:
    from jaxba.cli.overwriting import check_apart
    from jaxba.paper import config as configs
    from jaxba.paper.report import CLAIMS
    from jaxba.paper.tables_and_figures import TABLES_AND_FIGURES
    from jaxba.settings.configurations import find

    console = common.console()
    if args.list:
        for entry in TABLES_AND_FIGURES.values():
            console.print(f"{entry.name:12} {entry.title}")
        return 0
    for name in args.only:
        if name not in TABLES_AND_FIGURES:
            raise common.UsageError(
                f"--only {name}: unknown; known: {', '.join(TABLES_AND_FIGURES)}"
            )
    config = configs.load(args.config)
    stem = Path(args.config).stem
    folder = Path(args.out or Path("runs") / ("paper" if stem == FULL else f"paper-{stem}"))
    report = Path(args.report or folder / REPORT)
    common.require(
        report.suffix != ".html", "--report is a Markdown file; the page of figures lies beside it"
    )
    check_apart(
        {"--report": [report, report.with_suffix(".html")], "--out": [folder / CLAIMS]},
        {"the file of --config": [find("paper", args.config)]},
    )
    _open(folder, config)
    common.check_writable("--report", str(report))
    common.prepare_process()
    return _work(args, config, folder, report, console)


def _open(folder: Path, config: Any) -> None:
    """Creates the folder and writes the configuration there, or checks that the folder has the same
    configuration. Raises InputError: the folder has another configuration, or cannot be written."""
    from jaxba import settings
    from jaxba.paper import config as configs
    from jaxba.runtime.atomic import write_text

    path = folder / configs.CONFIG
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            other = settings.differences(configs.load(str(path)), config)
            if other:
                raise common.UsageError(
                    f"{folder} holds a run with another {other[0]}; --out names another folder"
                )
        else:
            write_text(path, settings.to_yaml(config))
    except OSError as error:
        raise common.UsageError(f"--out {folder}: {error.strerror or error}") from None


def _work(args: Arguments, config: Any, folder: Path, report: Path, console: Any) -> int:
    import jax

    from jaxba.paper.report import write
    from jaxba.paper.runner import Runner
    from jaxba.paper.tables_and_figures import TABLES_AND_FIGURES
    from jaxba.runtime import process

    jax.config.update("jax_enable_x64", True)  # the game counts in float64, the networks in float32
    status = 0
    with process.single_blas_thread():
        runner = Runner(config, folder, lambda line: console.print(f"  {line}"))
        wanted = [
            entry
            for name, entry in TABLES_AND_FIGURES.items()
            if not args.only or name in args.only
        ]
        try:
            for number, entry in enumerate(wanted, start=1):
                console.print(f"{number} of {len(wanted)}: {entry.title}")
                started = time.perf_counter()
                before = runner.done
                entry.run(runner)
                spent = time.perf_counter() - started
                console.print(f"  {common.counted(runner.done - before, 'run')}, {spent:.1f} s")
        except KeyboardInterrupt:
            console.print(
                "interrupted; what is done is kept, run the same command again to continue"
            )
            status = common.INTERRUPTED
        # the command without paths of this machine
        files = write(runner, report, f"jaxba-paper --config {Path(args.config).name}")
    console.print(f"wrote {', '.join(str(file) for file in files)}")
    return status
