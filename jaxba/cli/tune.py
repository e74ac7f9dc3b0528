"""`jaxba-tune`: settings of the step that suit one's own problems."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from jaxba.cli import common
from jaxba.cli.options import options

MOST_SECONDS = 300.0
"""Longest race."""


@options
class Arguments:
    """Options of `jaxba-tune`."""

    problems: Annotated[tuple[str, ...], "FILE ...", tyro.conf.Positional] = ()
    """Files or COLMAP models like those that are to be solved, or downloaded BAL problems such as ladybug-49."""

    out: Annotated[str, "FILE"] = "settings.yaml"
    """What jaxba-solve --settings reads."""

    seconds: float = 120.0
    """After which no further solve begins; at most 300."""

    within: float = 1e-3
    """A solve has failed that ends further above the best known cost of its window, relatively."""

    windows: int = 32
    """Windows to race on, and as many held out."""

    seed: int = 0
    """Of the choice of windows."""


def main() -> None:
    """Entry point of `jaxba-tune`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 if the settings were written, 2 for bad input, 130 after Ctrl-C."""
    command = common.command_line("jaxba-tune", argv)
    tune = functools.partial(_tune, command=command)
    return common.run_command(Arguments, tune, "Finds settings of the step for your own problems.", argv)


def _tune(args: Arguments, command: str) -> int:
    from jaxba.bench import tuning
    from jaxba.bench.tables import Table, to_rich
    from jaxba.cli.overwriting import PROBLEM, check_apart, problem_files
    from jaxba.datasets.bal.paths import resolve
    from jaxba.runtime.atomic import write_text

    common.require(bool(args.problems), "name the files of some problems")
    common.check_positive(seconds=args.seconds, within=args.within)
    common.require(args.seconds <= MOST_SECONDS, f"--seconds must be at most {MOST_SECONDS:g}, is {args.seconds:g}")
    common.require(args.windows >= tuning.ROUND, f"--windows must be at least {tuning.ROUND}, is {args.windows}")
    common.require(args.seed >= 0, f"--seed must not be negative, is {args.seed}")
    paths = [resolve(name) for name in args.problems]
    common.check_writable("--out", args.out)
    check_apart({"--out": [args.out]}, {PROBLEM: [file for path in paths for file in problem_files(path)]})
    common.prepare_process(untraced=True)
    with common.notes_printed():
        windows = tuning.windows_of(paths, args.windows, args.seed)
    found = tuning.tune(windows, args.seconds, args.within, report=common.print_line)
    if found.rows:
        cells = [(str(one), str(count), "{:.3f} [{:.3f}, {:.3f}]".format(*ratio)) for one, count, ratio in found.rows]
        header = ("settings", "failures", "price over the default's [95%]")
        title = f"Last round of the race, on {found.windows[0]} windows"
        common.console().print(to_rich(Table(title, header, cells, "Price: predicted time of the file.")))
    line = verdict(found)
    common.print_line(line)
    if not found.in_time:
        common.print_line(f"note: --seconds {args.seconds:g} ended the race early; on another day it may end elsewhere")
    lines = [f"# {command}", f"# {line}", *(f"{name}: {value}" for name, value in found.chosen.settings.items())]
    try:
        write_text(args.out, "".join(f"{one}\n" for one in lines))
    except OSError as error:
        raise common.UsageError(f"--out {args.out}: {error.strerror or error}") from None
    common.print_line(f"wrote {args.out}")
    return 0


def verdict(found: Any) -> str:
    """What was found, in one line."""
    price = "{:.2f} [{:.2f}, {:.2f}] of its price on {}".format(
        *found.held_out, common.counted(found.windows[1], "held-out window")
    )
    if found.held_out[2] < 1:
        return f"better than the default: {found.chosen}, {price}"
    why = "no other won the race" if found.rows else "there was no time for a round"
    if found.winner != found.chosen:
        late = f"there was no time to hold {found.winner} against it"
        why = f"the best other, {found.winner}, has {price}" if found.held_out[2] >= 1 else late
    return f"nothing is better than the default: {why}"
