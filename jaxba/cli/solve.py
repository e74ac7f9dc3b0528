"""`jaxba-solve`: bundle adjustment of one problem."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from jaxba.cli import common
from jaxba.cli.interrupt import Interrupt
from jaxba.methods.registry import DEFAULT_METHOD
from jaxba.problem.options import (
    ConjugateGradients,
    Coordinates,
    Intrinsics,
    LinearSolverChoice,
    Preconditioner,
    Rotation,
    Scaling,
)
from jaxba.runtime.compilation import Compilation
from jaxba.solver.options import Dtype, SolveOptions
from jaxba.solver.prepare import DEFAULT_POLICY

DEFAULTS = SolveOptions()
"""Defaults of the options, those of `jaxba.solve`."""

_STDOUT = 1
"""File descriptor of standard output."""

DEFAULT_SCENE = "random scene (30 cameras, 1500 points, seed 0)"
"""Description of the scene that is solved if no problem is given."""

FILE_ENDINGS = (".txt", ".bal", ".ply")
"""If the output has one of these endings, or one of compression, a COLMAP model is written as a single file."""


@dataclass(frozen=True)
class Arguments:
    """Options of `jaxba-solve`."""

    problem: Annotated[str | None, tyro.conf.Positional] = None
    """BAL file or Bundler .out file, plain or .bz2, .gz, .xz; the folder of a COLMAP model (extra colmap); or the name
    of a downloaded BAL problem such as ladybug-49 (see jaxba-data). Default: a random scene."""

    policy: str = DEFAULT_POLICY
    """Damping policy, which chooses lambda: learned (the shipped policy for the options of the step), a .safetensors
    file of jaxba-train, or one of the rules ceres, classic, gtsam, nielsen, stba, theseus, schedule, gauss-newton,
    constant:1e-4. Most rules take the first lambda, as in classic:0.03."""

    method: str = DEFAULT_METHOD
    """Method that computes a step. lm: Levenberg-Marquardt. stba: random clusters of at most 100 cameras; stba:16: of
    at most 16. deeplm: conjugate gradients on all variables. ddlm, ddlm:16: clusters that are optimised in parallel.
    poba: a power series."""

    refine_points: int | None = None
    """Number of embedded point iterations after each camera step, without other embedded iterations. Default: the
    embedded iterations with which a learned policy was trained; none for a rule."""

    linear_solver: LinearSolverChoice = DEFAULTS.linear_solver
    """explicit: form and factor the reduced camera system. sparse: form it and use conjugate gradients. implicit:
    conjugate gradients without forming it. auto: choose by size."""

    preconditioner: Preconditioner = DEFAULTS.conjugate_gradients.preconditioner
    """Preconditioner of conjugate gradients (sparse, implicit). two-level: block diagonal, and a coarse system of the
    motion of clusters of cameras."""

    dtype: Dtype = DEFAULTS.dtype
    """Floating point type. mixed: float64, but the reduced camera system in float32."""

    pad: bool = DEFAULTS.pad
    """Pad sizes to a coarse grid, so that problems of similar size share one compiled program, also between calls of
    this command. auto then means explicit. This is for many small problems; large problems, and those for other linear
    solvers, are not padded."""

    compilation: Compilation = DEFAULTS.compilation
    """quick: compile in a third of the time, with iterations that take two to six times as long. full: compile with all
    optimisations. auto: quick for few observations, for more an intermediate mode with half of the compilation time and
    nearly full speed; compile again with all optimisations after as many iterations as repay it. On a GPU always
    full."""

    retriangulate: bool = False
    """After convergence, search for points at other depths with a lower cost, continue from them, and repeat this while
    it pays. Finds points in wrong local minima, and so a lower cost, for more iterations."""

    max_iterations: int = DEFAULTS.max_iterations
    """Limit of linear solves."""

    ftol: float = DEFAULTS.tolerances.ftol
    """Converged when the relative decrease of the cost by an accepted step is below this."""

    xtol: float = DEFAULTS.tolerances.xtol
    """Converged when the norm of an accepted step, relative to that of the parameters, is below this."""

    gtol: float = DEFAULTS.tolerances.gtol
    """Converged when the largest gradient entry is below this."""

    scaling: Scaling = Coordinates().scaling
    """Matrix that lambda multiplies. diagonal: the diagonal of the Hessian. identity: the unit matrix, as in the
    paper's equation."""

    rotation: Rotation = Coordinates().rotation
    """Coordinates of rotation steps. angle-axis: those of the file, as in Ceres. manifold: multiplication by
    exp(step)."""

    intrinsics: Intrinsics = DEFAULTS.intrinsics
    """free: optimise focal length and distortion of every camera, as in BAL, or of every lens, as in COLMAP. fixed:
    keep them, for calibrated cameras; the linear solver must be explicit."""

    loss: Literal["squared", "huber", "soft_l1", "cauchy", "tukey"] = "squared"
    """Robust loss function of the squared residual."""

    loss_scale: float = 1.0
    """Scale of the robust loss, pixels: residuals well below it count quadratically."""

    output: str | None = None
    """Output file in BAL format, compressed by its ending, or .ply for a viewer; also /dev/stdout. If the problem is a
    COLMAP model: output folder of a COLMAP model, unless the name ends in .txt, .bal, .ply, .bz2, .gz or .xz."""

    log: str | None = None
    """Output file of a JSON record of the solve, compressed by its ending."""


def main() -> None:
    """Entry point of `jaxba-solve`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 if a solution was found and written, 2 for bad input, 130 after a second
    Ctrl-C."""
    return common.run_command(Arguments, _run, "Bundle adjustment of one problem.", argv)


def _run(args: Arguments) -> int:
    from jaxba.io.files import stream_number

    if _STDOUT not in [stream_number(path or "") for path in (args.output, args.log)]:
        return _solve(args)
    with redirect_stdout(sys.stderr):  # stdout has only the output file
        return _solve(args)


def _solve(args: Arguments) -> int:
    if args.problem == "":
        raise common.UsageError("the name of the problem is empty")
    common.check_positive(
        max_iterations=args.max_iterations, ftol=args.ftol, xtol=args.xtol, gtol=args.gtol, loss_scale=args.loss_scale
    )
    if args.refine_points is not None and args.refine_points < 0:
        raise common.UsageError(f"--refine-points must not be negative, is {args.refine_points}")
    if args.refine_points:
        common.check_positive(refine_points=args.refine_points)
    if args.method != DEFAULT_METHOD and args.linear_solver != "auto":
        raise common.UsageError(f"--linear-solver is for --method lm; {args.method} has its own")
    if args.intrinsics == "fixed" and (args.method != DEFAULT_METHOD or args.linear_solver not in ("auto", "explicit")):
        raise common.UsageError("--intrinsics fixed needs --method lm and the explicit linear solver")
    from jaxba.io import check_output
    from jaxba.problem.losses import Loss

    try:
        loss = Loss(args.loss, args.loss_scale)
    except ValueError as error:
        raise common.UsageError(f"--loss-scale: {error}") from None
    model = _output_model(args)
    if model is None:
        common.check_writable("--output", args.output)
        check_output(args.output or "")
    else:
        common.check_folder("--output", model)
    common.check_writable("--log", args.log)
    if args.output and args.log and Path(args.output).resolve() == Path(args.log).resolve():
        raise common.UsageError(f"--output and --log name the same file, {args.output}")
    from jaxba.bench.records import record_to_json
    from jaxba.bench.run import record_of
    from jaxba.bench.sources import default_sources
    from jaxba.cli import table
    from jaxba.damping import is_learned
    from jaxba.datasets.bal.paths import resolve
    from jaxba.io import read_problem, write_colmap, write_problem
    from jaxba.io.files import open_output
    from jaxba.lm.termination import Tolerances
    from jaxba.solver.alternation import solve_and_retriangulate
    from jaxba.solver.callback_loop import IterationRecord
    from jaxba.solver.names import SolverName
    from jaxba.solver.retriangulate import Retriangulation
    from jaxba.solver.solve import solve

    refine = None if args.refine_points is None and is_learned(args.policy) else args.refine_points or 0
    name = SolverName(args.policy, refine, args.dtype, args.method)
    policy, options = name.build()
    path = None if args.problem is None else resolve(args.problem)
    if path and args.log and Path(path).resolve() == Path(args.log).resolve():
        raise common.UsageError(f"--log names the problem's file, {args.log}")
    problem = default_sources()[0].read() if path is None else read_problem(path)
    common.prepare_process(untraced=True)
    coordinates = options.step_options(policy).coordinates
    options = replace(
        options,
        linear_solver=args.linear_solver,
        conjugate_gradients=ConjugateGradients(args.preconditioner),
        coordinates=replace(coordinates, scaling=args.scaling, rotation=args.rotation),
        intrinsics=args.intrinsics,
        loss=loss,
        tolerances=Tolerances(args.ftol, args.xtol, args.gtol),
        max_iterations=args.max_iterations,
        pad=args.pad,
        compilation=args.compilation,
    )
    common.print_line(table.heading(args.problem or DEFAULT_SCENE, problem, args, options.step_options(policy)))
    steps: list[IterationRecord] = []
    with Interrupt("iteration", graceful=True) as interrupt:

        def show(record: IterationRecord) -> bool:
            if not steps:
                common.print_line(table.header(float(record.step.previous_cost)))
            common.print_line(table.row(record, steps[-1].time_s if steps else 0.0))
            steps.append(record)
            return interrupt.requested

        def report_search(found: Retriangulation) -> None:
            common.print_line(table.retriangulated(found, args.ftol))

        search: dict[str, Any] = {"on_search": report_search} if args.retriangulate else {}
        solution = (solve_and_retriangulate if args.retriangulate else solve)(
            problem,
            policy,
            options,
            callback=show,
            **search,
        )
    common.print_line(table.summary(problem, solution))
    if args.pad:
        common.print_line(table.padding(problem, solution))
    if args.output:
        try:
            if model is None:
                write_problem(solution.problem, args.output)
            else:
                write_colmap(solution.problem, model, like=str(args.problem))
        except OSError as error:
            raise common.UsageError(f"--output {args.output}: {error.strerror or error}") from None
        common.print_line(f"wrote {args.output}")
        if model is None and (lost := table.lost_in_bal(problem)):
            common.print_line(f"note: that file cannot store: {lost}")
    if args.log:
        record = record_of(solution, steps, name=args.problem or DEFAULT_SCENE, family="", solver=name)
        with open_output(args.log) as file:
            file.write(json.dumps(record_to_json(record), allow_nan=False).encode() + b"\n")
        common.print_line(f"wrote {args.log}")
    return 0


def _output_model(args: Arguments) -> str | None:
    """The folder to which a COLMAP model is written; None if the problem is not a model, or the output is a file."""
    from jaxba.io.files import strip_compression

    if not args.output or not args.problem or not Path(args.problem).is_dir():
        return None
    bare = strip_compression(args.output)
    is_file = bare != args.output or Path(bare).suffix.lower() in FILE_ENDINGS
    return args.output if Path(args.output).is_dir() or not is_file else None
