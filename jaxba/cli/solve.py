"""`jaxba-solve`: one problem in, an optimised one out."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import tyro

from jaxba.bench.records import record_to_json
from jaxba.bench.run import record_of
from jaxba.bench.sources import embedded_sources
from jaxba.cli import common, table
from jaxba.cli.interrupt import Interrupt
from jaxba.cli.output import check_outputs, write_solution
from jaxba.damping import DampingPolicy, is_learned
from jaxba.datasets.bal.paths import resolve
from jaxba.io import read_problem
from jaxba.io.files import open_output, stream_number
from jaxba.lm.termination import Tolerances
from jaxba.methods.registry import DEFAULT_METHOD
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.losses import Loss
from jaxba.problem.options import (
    ConjugateGradients,
    Intrinsics,
    LinearSolverChoice,
    Preconditioner,
    Rotation,
    Scaling,
)
from jaxba.runtime.compilation import Compilation
from jaxba.solver.alternation import solve_and_retriangulate
from jaxba.solver.callback_loop import IterationRecord
from jaxba.solver.names import SolverName
from jaxba.solver.options import Dtype, SolveOptions
from jaxba.solver.prepare import DEFAULT_POLICY
from jaxba.solver.solve import Solution, solve

DEFAULTS = SolveOptions()
"""Defaults of all options of a solve."""

_STDOUT = 1
"""File descriptor of standard output."""

DEFAULT_SCENE = "random scene (30 cameras, 1500 points, seed 0)"
"""What is solved where no problem is named."""

OPTION_OF_FIELD = {"points": "refine_points", "scale": "loss_scale"}
"""Options that are not called as the field that they fill."""


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

    scaling: Scaling | None = None
    """What lambda multiplies: the Hessian's diagonal, or the unit matrix (the paper's equation). If left out: as a
    learned policy was trained, the diagonal for a rule."""

    rotation: Rotation | None = None
    """Coordinates of rotation steps: those of the file, as Ceres, or multiplication by exp(step). If left out: as a
    learned policy was trained, those of the file for a rule."""

    intrinsics: Intrinsics = DEFAULTS.intrinsics
    """free: focal length and distortion of every camera are optimised, as in BAL, or of every lens, as in COLMAP.
    fixed: they stay, as they should with calibrated cameras; the reduced camera system is then formed and factored."""

    loss: Literal["squared", "huber", "soft_l1", "cauchy", "tukey"] = "squared"
    """Robust loss of the squared residual."""

    loss_scale: float = DEFAULTS.loss.scale
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


def solver_name(args: Arguments) -> SolverName:
    """The name of the solver in records and tables."""
    refine = 0 if args.refine_points is None and not is_learned(args.policy) else args.refine_points
    return SolverName(args.policy, refine, args.dtype, args.method)


def solve_options(args: Arguments) -> tuple[DampingPolicy, SolveOptions]:
    """The policy and the options that the arguments ask for.

    Raises:
        UsageError: a number out of range, or options that do not go together; the message names the option.
        UnknownPolicyError, PolicyFileError, UnknownMethodError: as `make_policy` and `make_method`.
    """
    if args.method != DEFAULT_METHOD and args.linear_solver != "auto":
        raise common.UsageError(f"--linear-solver is for --method {DEFAULT_METHOD}; {args.method} has its own")
    try:
        policy, options = solver_name(args).build()
        trained = options.step_options(policy).coordinates
        scaling, rotation = args.scaling or trained.scaling, args.rotation or trained.rotation
        options = replace(
            options,
            linear_solver=args.linear_solver,
            conjugate_gradients=ConjugateGradients(args.preconditioner),
            coordinates=replace(trained, scaling=scaling, rotation=rotation),
            intrinsics=args.intrinsics,
            loss=Loss(args.loss, args.loss_scale),
            tolerances=Tolerances(args.ftol, args.xtol, args.gtol),
            max_iterations=args.max_iterations,
            pad=args.pad,
            compilation=args.compilation,
        )
        options.step_options(policy)  # refuses what does not go together
        return policy, options
    except ValueError as error:
        if type(error) is not ValueError:  # a subclass has a message for a person
            raise
        raise common.UsageError(_about_option(str(error))) from None


def _about_option(message: str) -> str:
    """The message of an options class, which begins with the name of a field, about the option for that field."""
    field, _, rest = message.partition(" ")
    option = OPTION_OF_FIELD.get(field, field)
    return f"--{option.replace('_', '-')} {rest}" if hasattr(Arguments, option) else message


def _run(args: Arguments) -> int:
    if _STDOUT not in [stream_number(path or "") for path in (args.output, args.log)]:
        return _solve(args)
    with redirect_stdout(sys.stderr):  # nothing comes between the lines of the file
        return _solve(args)


def _solve(args: Arguments) -> int:
    if args.problem == "":
        raise common.UsageError("the name of the problem is empty")
    policy, options = solve_options(args)
    path = None if args.problem is None else resolve(args.problem)
    check_outputs(args.output, args.log, path)
    problem = embedded_sources()[0].read() if path is None else read_problem(path)
    common.prepare_process(untraced=True)
    name = args.problem or DEFAULT_SCENE
    common.say(table.heading(name, problem, args, options.step_options(policy)))
    solution, steps = _iterate(args, problem, policy, options)
    common.say(table.summary(problem, solution))
    if args.pad:
        common.say(table.padding(problem, solution))
    if args.output:
        write_solution(args.output, solution.problem, path)
    if args.log:
        record = record_of(solution, steps, name=name, family="", solver=solver_name(args))
        with open_output(args.log) as file:
            file.write(json.dumps(record_to_json(record), allow_nan=False).encode() + b"\n")
        common.say(f"wrote {args.log}")
    return 0


def _iterate(
    args: Arguments, problem: BundleProblem, policy: DampingPolicy, options: SolveOptions
) -> tuple[Solution, list[IterationRecord]]:
    """Solves, and prints every iteration; the first Ctrl-C stops after the present one."""
    steps: list[IterationRecord] = []
    with Interrupt("iteration", gentle=True) as interrupt:

        def show(record: IterationRecord) -> bool:
            if not steps:
                common.say(table.header(float(record.step.previous_cost)))
            common.say(table.row(record, steps[-1].time_s if steps else 0.0))
            steps.append(record)
            return interrupt.asked

        if not args.retriangulate:
            return solve(problem, policy, options, callback=show), steps
        show_search = lambda found: common.say(table.retriangulated(found, args.ftol))
        return solve_and_retriangulate(problem, policy, options, callback=show, on_search=show_search), steps
