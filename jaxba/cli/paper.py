"""`jaxba-paper`: every table and figure of the seed paper."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxba.cli import common

FULL, FAST = "full", "fast"
"""Presets."""

TIMES = "times.json"
REPORT = "paper.md"


@dataclass(frozen=True)
class Arguments:
    """Options of `jaxba-paper`."""

    fast: bool = False
    """Fewer seeds and shorter trainings: the preset fast."""

    config: str | None = None
    """A preset (full, fast) or the path of a YAML file."""

    only: tuple[str, ...] = ()
    """Tables and figures to work on, by name; all if left out. The report shows the others as far as they are there."""

    list: bool = False
    """Names all tables and figures, and does nothing."""

    out: str | None = None
    """Folder of records, agents and pictures; runs/paper or runs/paper-NAME of the configuration if left out. A second
    run into the same folder does only what is missing."""

    report: str | None = None
    """The Markdown file; pictures go into a folder beside it that is called like it. OUT/paper.md if left out."""


def main() -> None:
    """Entry point of `jaxba-paper`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command; status 0 when the report is written, 2 for bad input, 130 after Ctrl-C (work is kept)."""
    return common.run_command(Arguments, _paper, "Every table and figure of the paper, from one command.", argv)


def _paper(args: Arguments) -> int:
    from rich.console import Console

    from jaxba.paper import config as configs
    from jaxba.paper.pieces import PIECES
    from jaxba.training.settings import SettingsError

    console = Console(soft_wrap=True, highlight=False)
    if args.list:
        for piece in PIECES.values():
            console.print(f"{piece.name:12} {piece.title}")
        return 0
    if args.fast and args.config:
        raise common.UsageError("--fast is --config fast; give one of them")
    for name in args.only:
        if name not in PIECES:
            raise common.UsageError(f"--only {name}: unknown; known: {', '.join(PIECES)}")
    name = args.config or (FAST if args.fast else FULL)
    try:
        config = configs.load(name)
    except SettingsError as error:
        raise common.UsageError(str(error)) from None
    stem = Path(name).stem
    folder = Path(args.out or Path("runs") / ("paper" if stem == FULL else f"paper-{stem}"))
    report = Path(args.report or folder / REPORT)
    _open(folder, config)
    common.check_writable("--report", str(report))
    common.prepare_process()
    return _work(args, config, folder, report, console)


def _open(folder: Path, config: Any) -> None:
    """Makes the folder, or finds the same run in it.

    Raises:
        UsageError: it holds a run with other settings, or cannot be written.
    """
    from jaxba.paper import config as configs
    from jaxba.runtime.atomic import write_text
    from jaxba.training import settings

    path = folder / configs.CONFIG
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            try:
                other = settings.differences(configs.load(str(path)), config)
            except settings.SettingsError as error:
                raise common.UsageError(str(error)) from None
            if other:
                raise common.UsageError(f"{folder} holds a run with another {other[0]}; --out names another folder")
        else:
            write_text(path, configs.to_yaml(config))
    except OSError as error:
        raise common.UsageError(f"--out {folder}: {error.strerror or error}") from None


def _work(args: Arguments, config: Any, folder: Path, report: Path, console: Any) -> int:
    import jax

    from jaxba.paper.pieces import PIECES
    from jaxba.paper.report import write
    from jaxba.paper.workshop import Workshop
    from jaxba.runtime import process

    jax.config.update("jax_enable_x64", True)  # the game counts in float64, the networks in float32
    status = 0
    with process.single_blas_thread():
        shop = Workshop(config, folder, lambda words: console.print(f"  {words}"))
        seconds = _read_times(folder)
        wanted = [piece for name, piece in PIECES.items() if not args.only or name in args.only]
        try:
            for number, piece in enumerate(wanted, start=1):
                console.print(f"{number} of {len(wanted)}: {piece.title}")
                started, cpu, before = time.perf_counter(), time.process_time(), shop.done
                try:
                    piece.work(shop)
                finally:
                    spent, cpu = time.perf_counter() - started, time.process_time() - cpu
                    if shop.done > before:
                        wall, busy = seconds.get(piece.name, (0.0, 0.0))
                        seconds[piece.name] = wall + spent, busy + cpu
                        _write_times(folder, seconds)
                console.print(f"  {shop.done - before} runs, {spent:.1f} s")
        except KeyboardInterrupt:
            console.print("interrupted; what is done is kept, run the same command again to continue")
            status = common.INTERRUPTED
        console.print("drawing")
        sections = [piece.section(shop) for piece in PIECES.values()]
        files = write(shop, sections, report, _command(args), {n: seconds[n] for n in PIECES if n in seconds})
    console.print(
        f"wrote {report} and {len(files) - 1} pictures; {sum(wall for wall, _ in seconds.values()):.0f} s of work in "
        f"{folder}"
    )
    return status


def _command(args: Arguments) -> str:
    """The command as a reader would repeat it; paths of the writer's machine are left out."""
    chosen = " --fast" if args.fast else f" --config {Path(args.config).name}" if args.config else ""
    return f"jaxba-paper{chosen}"


def _read_times(folder: Path) -> dict[str, tuple[float, float]]:
    """Seconds on the wall clock and of the processor by piece."""
    try:
        found = json.loads((folder / TIMES).read_text(encoding="utf-8"))
        return {str(name): (float(wall), float(cpu)) for name, (wall, cpu) in found.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _write_times(folder: Path, seconds: dict[str, tuple[float, float]]) -> None:
    from jaxba.runtime.atomic import write_text

    write_text(folder / TIMES, json.dumps(seconds, indent=1) + "\n")
