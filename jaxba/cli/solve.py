"""`jaxba-solve`: one problem in, an optimised one out."""

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
"""The one table of defaults."""

_STDOUT = 1
"""File descriptor of standard output."""

DEFAULT_SCENE = "random scene (30 cameras, 1500 points, seed 0)"
"""What is solved where no problem is named."""

FILE_ENDINGS = (".txt", ".bal", ".ply")
"""Endings by which the output of a COLMAP model is a file and no model, besides those of compression."""


@dataclass(frozen=True)
class Arguments:
    """Options of `jaxba-solve`."""

    problem: Annotated[str | None, tyro.conf.Positional] = None
    """BAL file or Bundler .out file, plain or .bz2, .gz, .xz; the folder of a COLMAP model (extra colmap); or the name
    of a downloaded problem of BAL, such as ladybug-49 (see jaxba-data). Without it a built-in scene is solved."""

    policy: str = DEFAULT_POLICY
    """Who chooses lambda: learned (the shipped policy that fits the step), a .safetensors file of jaxba-train, ceres,
    classic, gtsam, nielsen, stba, theseus, schedule, gauss-newton, constant:1e-4; most take a first lambda, as in
    classic:0.03."""

    method: str = DEFAULT_METHOD
    """How a step is made. lm: Levenberg-Marquardt. stba: random clusters of cameras, of at most 100 or, as stba:16, of
    another size. deeplm: conjugate gradients on all variables. ddlm: clusters optimised beside each other, ddlm:16.
    poba: a power series. See docs/methods.md."""

    refine_points: int | None = None
    """Embedded point iterations after each camera step, and no other embedded iterations. If left out: those that a
    learned policy was trained with, none for a rule."""

    linear_solver: LinearSolverChoice = DEFAULTS.linear_solver
    """explicit: form and factor the reduced camera system. sparse: form it, conjugate gradients. implicit: conjugate
    gradients without forming it. auto chooses by size."""

    preconditioner: Preconditioner = DEFAULTS.conjugate_gradients.preconditioner
    """Of conjugate gradients (sparse, implicit). two-level: block diagonal and the motion of clusters of cameras."""

    dtype: Dtype = DEFAULTS.dtype
    """Type of all arithmetic. mixed: float64, but the reduced camera system in float32."""

    pad: bool = DEFAULTS.pad
    """Round sizes up to a coarse grid, so that problems of similar size share one compiled program, also from one call
    of this command to the next; auto then means explicit. For many small problems: large ones and those for other
    solvers are left as they are, and the summary says so."""

    compilation: Compilation = DEFAULTS.compilation
    """quick: compiled in a third of the time, but iterations take two to six times as long. full: all optimisation.
    auto: quick, or in half of the time and nearly as fast, by the number of observations, and optimised after as many
    iterations as pay for it. On a GPU always full."""

    retriangulate: bool = False
    """After convergence look for every point at other depths, go on from the cheapest places, and so on in turns while
    that pays. Finds points that hang in the wrong place, and a lower cost, for more iterations."""

    max_iterations: int = DEFAULTS.max_iterations
    """Linear solves before giving up."""

    ftol: float = DEFAULTS.tolerances.ftol
    """Converged when an accepted step lowers the cost by less than this share."""

    xtol: float = DEFAULTS.tolerances.xtol
    """Converged when an accepted step is shorter than this share of the parameters."""

    gtol: float = DEFAULTS.tolerances.gtol
    """Converged when no gradient entry is larger."""

    scaling: Scaling = Coordinates().scaling
    """What lambda multiplies: the Hessian's diagonal, or the unit matrix (the paper's equation)."""

    rotation: Rotation = Coordinates().rotation
    """Coordinates of rotation steps: those of the file, as Ceres, or multiplication by exp(step)."""

    intrinsics: Intrinsics = DEFAULTS.intrinsics
    """free: focal length and distortion of every camera are optimised, as in BAL, or of every lens, as in COLMAP.
    fixed: they stay, as they should with calibrated cameras; the reduced camera system is then formed and factored."""

    loss: Literal["squared", "huber", "soft_l1", "cauchy", "tukey"] = "squared"
    """Robust loss of the squared residual."""

    loss_scale: float = 1.0
    """Residual in pixels where the loss bends."""

    output: str | None = None
    """Write the solution here: BAL format, compressed by its ending, or .ply for a viewer; /dev/stdout too. Of a COLMAP
    model: a COLMAP model, in a folder of this name, unless it ends in .txt, .bal, .ply, .bz2, .gz or .xz."""

    log: str | None = None
    """Write a JSON record of the solve here, compressed by its ending."""


def main() -> None:
    """Entry point of `jaxba-solve`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit status: 0 when a solution was found and written, 2 for bad input."""
    return common.run_command(Arguments, _run, "Bundle adjustment of one problem.", argv)


def _run(args: Arguments) -> int:
    from jaxba.io.files import stream_number

    if _STDOUT not in [stream_number(path or "") for path in (args.output, args.log)]:
        return _solve(args)
    with redirect_stdout(sys.stderr):  # nothing comes between the lines of the file
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
    from jaxba.bench.sources import embedded_sources
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
    place = None if args.problem is None else resolve(args.problem)
    if place and args.log and Path(place).resolve() == Path(args.log).resolve():
        raise common.UsageError(f"--log names the problem's file, {args.log}")
    problem = embedded_sources()[0].read() if place is None else read_problem(place)
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
    common.say(table.heading(args.problem or DEFAULT_SCENE, problem, args, options.step_options(policy)))
    steps: list[IterationRecord] = []
    with Interrupt("iteration", gentle=True) as interrupt:

        def show(record: IterationRecord) -> bool:
            if not steps:
                common.say(table.header(float(record.step.previous_cost)))
            common.say(table.row(record, steps[-1].time_s if steps else 0.0))
            steps.append(record)
            return interrupt.asked

        def tell(found: Retriangulation) -> None:
            common.say(table.retriangulated(found, args.ftol))

        search: dict[str, Any] = {"on_search": tell} if args.retriangulate else {}
        solution = (solve_and_retriangulate if args.retriangulate else solve)(
            problem,
            policy,
            options,
            callback=show,
            **search,
        )
    common.say(table.summary(problem, solution))
    if args.pad:
        common.say(table.padding(problem, solution))
    if args.output:
        try:
            if model is None:
                write_problem(solution.problem, args.output)
            else:
                write_colmap(solution.problem, model, like=str(args.problem))
        except OSError as error:
            raise common.UsageError(f"--output {args.output}: {error.strerror or error}") from None
        common.say(f"wrote {args.output}")
        if model is None and (lost := table.lost_in_bal(problem)):
            common.say(f"note: that file has no place for: {lost}")
    if args.log:
        record = record_of(solution, steps, name=args.problem or DEFAULT_SCENE, family="", solver=name)
        with open_output(args.log) as file:
            file.write(json.dumps(record_to_json(record), allow_nan=False).encode() + b"\n")
        common.say(f"wrote {args.log}")
    return 0


def _output_model(args: Arguments) -> str | None:
    """The folder where a COLMAP model is to be written: what has no ending of a file, where the problem is a model."""
    from jaxba.io.files import strip_compression

    if not args.output or not args.problem or not Path(args.problem).is_dir():
        return None
    bare = strip_compression(args.output)
    is_file = bare != args.output or Path(bare).suffix.lower() in FILE_ENDINGS
    return args.output if Path(args.output).is_dir() or not is_file else None
