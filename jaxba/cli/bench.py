"""`jaxba-bench`: compares solvers on many problems."""

from __future__ import annotations

import functools
import glob
import itertools
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxba.cli import common
from jaxba.cli.options import options
from jaxba.problem.options import LinearSolverChoice

DEFAULT_SOLVERS = "ceres,ceres+refine3,guarded,classic"
"""Ceres' rule, without and with embedded point iterations, the default policy, and the paper's
rule."""

WIDTH = 100  # width of the table in characters
_VARIABLE = re.compile(r"\$\{?(\w+)\}?", re.ASCII)  # A variable that `os.path.expandvars` expands


@options
class Arguments:
    """Options of `jaxba-bench`."""

    problems: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Files, downloaded BAL problems such as ladybug-49 (see jaxba-data), or random scenes such as
    scene:ladybug-49 or scene:tiny:7. Default: the problems of the suite, or six random scenes,
    padded to one shape."""

    suite: str | None = None
    """A suite (methods, real, rules, synthetic), or the path of a YAML file with any of: problems
    (names or paths, in which wildcards and $VARIABLES are expanded), solvers, tolerance, repeats,
    max_iterations."""

    solvers: Annotated[
        str | None, tyro.conf.arg(help_behavior_hint=f"(default: {DEFAULT_SOLVERS})")
    ] = None
    """Comma-separated names of the form [method+]policy[+refineK|+embedded][@dtype], where a policy
    may be a class of your own, mine.py:Tenfold; or, with the extra `ceres`,
    pyceres:dense|sparse|iterative|dense-inner|sparse-inner. Default: Ceres' rule without and with
    embedded iterations, the default policy, and the paper's rule."""

    tolerance: float | None = None
    """tau of the performance profile: cost <= f* + tau (f0 - f*). Default: 1e-3."""

    repeats: int | None = None
    """Runs of each solver on each problem; times are medians. Default: 3."""

    max_iterations: int | None = None
    """Limit of linear solves. The tables count more than 100 as a failure. Default: 100."""

    linear_solver: LinearSolverChoice = "auto"
    """Linear solver of the method lm; other methods have their own."""

    strict: bool = False
    """Fail instead of skipping invalid parts of the input."""

    out: str = "runs/bench"
    """Folder of the results. A second run with the same folder does only what is missing; one with
    other settings needs another folder."""


def main() -> None:
    """Entry point of `jaxba-bench`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 if all runs are done, 2 for bad input, 130 after Ctrl-C
    (results are kept)."""
    command = common.command_line("jaxba-bench", argv)
    bench = functools.partial(_bench, command=command)
    return common.run_command(
        Arguments, bench, "Compares solvers: tables, performance profiles, plots.", argv
    )


def _bench(args: Arguments, command: str) -> int:
    args = _with_suite(args)
    solvers = [name for name in (args.solvers or DEFAULT_SOLVERS).split(",") if name.strip()]
    tolerance = 1e-3 if args.tolerance is None else float(args.tolerance)
    repeats = 3 if args.repeats is None else args.repeats
    common.require(0 < tolerance < 1, f"--tolerance must lie between 0 and 1, is {tolerance:g}")
    max_iterations = 100 if args.max_iterations is None else args.max_iterations
    common.check_positive(repeats=repeats, max_iterations=max_iterations)
    common.require(bool(solvers), "--solvers names no solver")
    from jaxba.bench import run
    from jaxba.bench.sources import SCENE_PREFIX, sources
    from jaxba.scenes import DEFAULT_SCENES

    problems = sources([*args.problems] or [f"{SCENE_PREFIX}{name}" for name in DEFAULT_SCENES])
    jobs = run.plan(problems, solvers, repeats)
    settings = run.RunSettings(max_iterations, args.linear_solver, pad=not args.problems)
    try:
        folder = Path(args.out)
        _check_apart(folder, args, jobs)
        done = run.open_folder(folder, settings, jobs, command)
        return _run_missing(folder, done, jobs, settings, tolerance, args.strict, command)
    except OSError as error:
        raise common.UsageError(f"--out {args.out}: {error.strerror or error}") from None


def _check_apart(folder: Path, args: Arguments, jobs: Any) -> None:
    """Refuses results in the place of a file that is read."""
    from jaxba.bench import report, run
    from jaxba.cli.overwriting import PROBLEM, check_apart, policy_file, problem_files

    names = (run.SETTINGS, run.RESULTS, report.FILE)
    problems = [one for job in jobs for one in problem_files(job.source.location)]
    policies = [policy_file(job.solver.policy) for job in jobs]
    read = {PROBLEM: problems, "a policy": policies, "the file of --suite": [args.suite]}
    check_apart({"--out": [folder / name for name in names]}, read)


def _run_missing(
    folder: Path, done: Any, jobs: Any, settings: Any, tolerance: float, strict: bool, command: str
) -> int:
    """Runs the jobs that the folder has no record of, and writes the report. Raises OSError: it
    cannot."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from jaxba.bench import report, run
    from jaxba.bench.summary import summarize
    from jaxba.bench.tables import print_summary
    from jaxba.solver.record import Record

    common.prepare_process()
    # prints names without interpreting brackets and colons
    console = Console(markup=False, emoji=False, highlight=False)
    console.width = min(console.width, WIDTH) if console.is_terminal else WIDTH
    wanted = {(job.source.name, str(job.solver), job.repeat) for job in jobs}
    records: list[Record] = [r for r in done if (r.problem, r.solver, r.repeat) in wanted]
    if records:
        console.print(
            f"{len(records)} of {common.counted(len(jobs), 'run')} already in {folder}",
            soft_wrap=True,
        )
    status = 0

    def fail(error: Exception) -> None:
        nonlocal status
        status = common.BAD_INPUT
        common.print_error(str(error))

    say = functools.partial(console.print, soft_wrap=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    try:
        with common.notes_printed(say), bar:
            task = bar.add_task("reading and compiling", total=len(jobs), completed=len(records))
            runs = run.execute(jobs, done, folder, settings, fail, strict=strict)
            for problem, group in itertools.groupby(runs, lambda record: record.problem):
                first = len(records)
                for record in group:
                    records.append(record)
                    bar.update(task, advance=1, description=f"{problem} {record.solver}")
                say(_line(problem, records[first:]))
    except KeyboardInterrupt:
        say("interrupted; what is done is kept, run the same command again to continue")
        status = common.INTERRUPTED
    if records:
        metadata = {"command": command, **report.run_metadata(records), **run.machine()}
        report.write_report(records, folder, tolerance, metadata=metadata)
        print_summary(summarize(records, tolerance), console)
        say(f"every problem and run: {folder / report.FILE}")
    return status


def _line(problem: str, records: Any) -> str:
    seconds = sum(one.setup_s + one.compile_s + one.total_s for one in records)
    compiled = sum(one.compile_s for one in records)
    cost = min(one.final_cost for one in records)
    runs = common.counted(len(records), "run")
    return (
        f"{problem}: {runs} in {seconds:.1f} s ({compiled:.1f} s of compilation), least cost "
        f"{cost:.8g}"
    )


@dataclass(frozen=True)
class Suite:
    """Content of a suite file; the command line replaces what it gives, by the options of the same
    names."""

    problems: tuple[str, ...] = ()  # names or paths, in which $VARIABLES and wildcards are expanded
    solvers: tuple[str, ...] | None = None  # names of solvers
    tolerance: float | None = None
    repeats: int | None = None
    max_iterations: int | None = None


def _with_suite(args: Arguments) -> Arguments:
    if args.suite is None:
        return args
    from jaxba import settings
    from jaxba.settings import configurations

    try:
        data = configurations.read("bench", args.suite)
    except configurations.SettingsError as error:
        raise common.UsageError(f"--suite: {error}") from None
    if not data:
        known = ", ".join(settings.field_types(Suite))
        raise common.UsageError(f"--suite {args.suite}: is empty; known: {known}")
    try:
        suite = settings.read(Suite, data)
    except configurations.SettingsError as error:
        raise common.UsageError(f"--suite {args.suite}: {error}") from None
    problems = args.problems or tuple(
        path for entry in suite.problems for path in _expand(args, entry)
    )
    solvers = args.solvers or (None if suite.solvers is None else ",".join(suite.solvers))
    rest = {
        k: getattr(suite, k)
        for k in ("tolerance", "repeats", "max_iterations")
        if getattr(args, k) is None
    }
    return replace(args, problems=problems, solvers=solvers, **rest)


def _expand(args: Arguments, entry: str) -> list[str]:
    """The names or paths for an entry of a suite's problems, with variables and wildcards
    expanded."""
    for name in _VARIABLE.findall(entry):
        unset = f"{entry}: the environment variable {name}, a folder of problems, is not set"
        common.require(bool(os.environ.get(name)), f"--suite {args.suite}: {unset}")
    expanded = os.path.expandvars(entry)
    if not glob.has_magic(expanded):
        return [expanded]
    found = sorted(glob.glob(expanded))
    common.require(bool(found), f"--suite {args.suite}: {expanded}: no such file")
    return found
