"""`jaxba-bench`: compares solvers on many problems."""

from __future__ import annotations

import functools
import glob
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

DEFAULT_SOLVERS = "guarded,bold,classic,ceres,ceres+refine3,ceres+embedded"
"""The default policy and the guard of agents, the paper's rule, and Ceres' rule with and without embedded
iterations."""

FILE_WIDTH = 180
"""Width of the tables in characters if the output is not a terminal."""

DETAILS_WIDTH = 120
"""On a narrower terminal the table of every problem is left out; the report has it."""

_VARIABLE = re.compile(r"\$\{?(\w+)\}?", re.ASCII)
"""A variable that `os.path.expandvars` expands."""


@options
class Arguments:
    """Options of `jaxba-bench`."""

    problems: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Files, downloaded BAL problems such as ladybug-49 (see jaxba-data), or random scenes such as scene:ladybug-49 or
    scene:tiny:7. Default: the problems of the suite, or eight random scenes."""

    suite: str | None = None
    """A suite (methods, real, rules, synthetic), or the path of a YAML file with any of: problems (names or paths, in
    which wildcards and $VARIABLES are expanded), solvers, tolerance, repeats, max_iterations."""

    solvers: Annotated[str | None, tyro.conf.arg(help_behavior_hint=f"(default: {DEFAULT_SOLVERS})")] = None
    """Comma-separated names of the form [method+]policy[+refineK|+embedded][@dtype], or, with the extra `ceres`,
    pyceres:dense|sparse|iterative[+policy[+refineK|+embedded]] and pyceres:dense-inner|sparse-inner. Default: the
    default policy, the other two that ship, the paper's rule, and Ceres' rule with and without embedded iterations."""

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
    """Folder of the results. A second run with the same folder does only what is missing."""


def main() -> None:
    """Entry point of `jaxba-bench`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 if all runs are done, 2 for bad input, 130 after Ctrl-C (results are kept)."""
    command = common.command_line("jaxba-bench", argv)
    bench = functools.partial(_bench, command=command)
    return common.run_command(Arguments, bench, "Compares solvers: tables, performance profiles, plots.", argv)


def _bench(args: Arguments, command: str) -> int:
    args = _with_suite(args)
    solvers = [name for name in (args.solvers or DEFAULT_SOLVERS).split(",") if name.strip()]
    tolerance = 1e-3 if args.tolerance is None else float(args.tolerance)
    repeats = 3 if args.repeats is None else args.repeats
    if not 0 < tolerance < 1:
        raise common.UsageError(f"--tolerance must lie between 0 and 1, is {tolerance:g}")
    max_iterations = 100 if args.max_iterations is None else args.max_iterations
    common.check_positive(repeats=repeats, max_iterations=max_iterations)
    if not solvers:
        raise common.UsageError("--solvers names no solver")
    from jaxba.bench import run
    from jaxba.bench.sources import default_sources, sources

    problems = sources(list(args.problems)) if args.problems else default_sources()
    jobs = run.plan(problems, solvers, repeats)
    _check_apart(args, jobs)
    settings = run.RunSettings(max_iterations=max_iterations, linear_solver=args.linear_solver)
    try:
        return _run_missing(Path(args.out), jobs, settings, tolerance, args.strict, command)
    except OSError as error:
        raise common.UsageError(f"--out {args.out}: {error.strerror or error}") from None


def _check_apart(args: Arguments, jobs: Any) -> None:
    """Refuses results in the place of a file that is read."""
    from jaxba.bench import run
    from jaxba.cli.overwriting import PROBLEM, check_apart, policy_file, problem_files

    names = (run.SETTINGS, run.RESULTS, "summary.json", "report.html", "profile.png")
    problems = [one for job in jobs for one in problem_files(job.source.location)]
    policies = [policy_file(job.solver.policy) for job in jobs]
    read = {PROBLEM: problems, "a policy": policies, "the file of --suite": [args.suite]}
    check_apart({"--out": [Path(args.out, name) for name in names]}, read)


def _run_missing(folder: Path, jobs: Any, settings: Any, tolerance: float, strict: bool, command: str) -> int:
    """Runs the jobs that the folder has no record of, and writes the report. Raises OSError if a file cannot be
    written."""
    from rich.console import Console

    from jaxba.bench import report, run
    from jaxba.bench.summary import summarize
    from jaxba.bench.tables import print_summary
    from jaxba.solver.record import Record

    done = run.open_folder(folder, settings, jobs)
    common.prepare_process()
    console = Console(markup=False, emoji=False)  # prints names without interpreting brackets and colons
    if not console.is_terminal:
        console = Console(width=FILE_WIDTH, markup=False, emoji=False)
    wanted = {(job.source.name, str(job.solver), job.repeat) for job in jobs}
    records: list[Record] = [r for r in done if (r.problem, r.solver, r.repeat) in wanted]
    if records:
        console.print(f"{len(records)} of {common.counted(len(jobs), 'run')} already in {folder}", highlight=False)
    status = 0

    def fail(error: Exception) -> None:
        nonlocal status
        status = common.BAD_INPUT
        common.print_error(str(error))

    try:
        with common.notes_printed(lambda note: console.print(note, highlight=False, soft_wrap=True)):
            for record in run.execute(jobs, done, folder, settings, fail, strict=strict):
                records.append(record)
                iterations = common.counted(record.iterations, "iteration")
                console.print(
                    f"{record.problem} {record.solver} #{record.repeat + 1}: {iterations}, "
                    f"cost {record.final_cost:.8g}, {record.total_s:.2f} s, {record.termination}",
                    highlight=False,
                    soft_wrap=True,
                )
    except KeyboardInterrupt:
        console.print("interrupted; what is done is kept, run the same command again to continue", highlight=False)
        status = common.INTERRUPTED
    if records:
        metadata = {"command": command, **report.run_metadata(records), **run.machine()}
        files = report.write_all(records, folder, tolerance, metadata=metadata)
        print_summary(summarize(records, tolerance), console, details=console.width >= DETAILS_WIDTH)
        console.print(f"wrote {len(files)} files; see {folder / 'report.html'}", highlight=False, soft_wrap=True)
    return status


@dataclass(frozen=True)
class Suite:
    """Content of a suite file; the command line replaces what it gives, by the options of the same names."""

    problems: tuple[str, ...] = ()
    """Names or paths, in which $VARIABLES and wildcards are expanded."""

    solvers: tuple[str, ...] | None = None
    """Names of solvers."""

    tolerance: float | None = None
    repeats: int | None = None
    max_iterations: int | None = None


def _with_suite(args: Arguments) -> Arguments:
    """The arguments, completed by those of the suite."""
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
    problems = args.problems or tuple(path for entry in suite.problems for path in _expand(args, entry))
    solvers = args.solvers or (None if suite.solvers is None else ",".join(suite.solvers))
    rest = {k: getattr(suite, k) for k in ("tolerance", "repeats", "max_iterations") if getattr(args, k) is None}
    return replace(args, problems=problems, solvers=solvers, **rest)


def _expand(args: Arguments, entry: str) -> list[str]:
    """The names or paths for an entry of a suite's problems, with variables and wildcards expanded."""
    for name in _VARIABLE.findall(entry):
        if not os.environ.get(name):
            raise common.UsageError(
                f"--suite {args.suite}: {entry}: the environment variable {name}, a folder of problems, is not set"
            )
    expanded = os.path.expandvars(entry)
    if not glob.has_magic(expanded):
        return [expanded]
    found = sorted(glob.glob(expanded))
    if not found:
        raise common.UsageError(f"--suite {args.suite}: {expanded}: no such file")
    return found
