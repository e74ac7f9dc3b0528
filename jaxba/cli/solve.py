"""`jaxba-solve`: bundle adjustment of one problem."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import tyro

from jaxba.cli import common, processes, table, view
from jaxba.cli.colmap_options import translated
from jaxba.cli.constraints import constrained
from jaxba.cli.interrupt import Interrupt
from jaxba.cli.output import check_outputs, check_storable, write_solution
from jaxba.cli.overwriting import policy_file
from jaxba.cli.streams import whole_input
from jaxba.cli.watching import Watching
from jaxba.damping import DampingPolicy
from jaxba.datasets.bal.paths import resolve
from jaxba.io import is_colmap, read_colmap, read_problem
from jaxba.io.files import open_output, stream_number
from jaxba.lm.termination import Tolerances
from jaxba.methods.registry import DEFAULT_METHOD
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.constraints import Gauge, hold
from jaxba.problem.facing import aside_text, facing_away
from jaxba.problem.losses import Loss
from jaxba.problem.options import (
    ConjugateGradients,
    Intrinsics,
    LinearSolverChoice,
    Preconditioner,
    Rotation,
    Scaling,
)
from jaxba.results.alternation import solve_and_retriangulate
from jaxba.results.covariance import covariance
from jaxba.runtime.compilation import Compilation
from jaxba.solver.loop import IterationRecord, Watch
from jaxba.solver.names import SolverName, parse_policy, split_refinement
from jaxba.solver.options import Dtype, SolveOptions
from jaxba.solver.prepare import DEFAULT_POLICY
from jaxba.solver.solve import Solution, solve

DEFAULTS = SolveOptions()
"""Defaults of the options, those of `jaxba.solve`."""

STREAM = "-"
"""Name of standard input for a problem, and of standard output for a file."""

_STDOUT = 1
"""File descriptor of standard output."""

DEFAULT_SCENE = "random scene (30 cameras, 1500 points, seed 0)"
"""Description of the scene that is solved if no problem is given."""

OPTION_OF_FIELD = {"points": "refine_points", "scale": "loss_scale"}
"""Fields of options whose command-line option has another name."""


@dataclass(frozen=True)
class Arguments:
    """Options of `jaxba-solve`."""

    problem: Annotated[str | None, tyro.conf.Positional] = None
    """BAL file, Bundler .out file, VisualSFM .nvm file, or a .json or .sfm file of OpenSfM, OpenMVG or AliceVision,
    plain or .bz2, .gz, .xz; the folder of a COLMAP model; the name of a downloaded BAL problem such as ladybug-49
    (see jaxba-data); or - for a file on standard input. Default: a random scene."""

    policy: str = DEFAULT_POLICY
    """Damping policy, which chooses lambda: guarded (1e-8 until a step fails), learned (the shipped network for the
    options of the step), bold (the smallest lambda that its guard allows), a .safetensors file of jaxba-train, or one
    of the rules ceres, classic, gtsam, nielsen, stba, theseus, schedule, gauss-newton, constant:1e-4. Most rules take
    the first lambda, as in classic:0.03. All may end with +embedded (all embedded iterations, as around learned) or
    +refineK (K point iterations after each camera step, as --refine-points K)."""

    method: str = DEFAULT_METHOD
    """Method that computes a step. lm: Levenberg-Marquardt. stba: random clusters of at most 100 cameras; stba:16: of
    at most 16. deeplm: conjugate gradients on all variables. ddlm, ddlm:16: clusters that are optimised in parallel.
    poba: a power series."""

    refine_points: int | None = None
    """Number of embedded point iterations after each camera step, without other embedded iterations. Default: the
    embedded iterations with which a learned policy was trained; none for a rule."""

    linear_solver: LinearSolverChoice = DEFAULTS.linear_solver
    """explicit: form and factor the reduced camera system. sparse: form it and use conjugate gradients. implicit:
    conjugate gradients without forming it. cg: the same, with twelve iterations. auto: choose among the first three by
    size."""

    preconditioner: Preconditioner = DEFAULTS.conjugate_gradients.preconditioner
    """Preconditioner of conjugate gradients (sparse, implicit, cg). two-level: block diagonal, and a coarse system of
    the motion of clusters of cameras."""

    dtype: Dtype = DEFAULTS.dtype
    """Floating point type. mixed: float64, but the reduced camera system in float32."""

    pad: Literal["auto", "yes", "no"] = "auto"
    """Pad sizes to a grid, so that problems of about the same size share one compiled program, also between calls of
    this command. auto: for at most 64 cameras and 60,000 observations, unless --compilation is full. Only for the
    explicit solver, which auto then means; large problems, those with lenses and those for other linear solvers are not
    padded."""

    compilation: Compilation = DEFAULTS.compilation
    """quick: compile in a third of the time, with iterations that take two to six times as long. full: compile with all
    optimisations. auto: quick for few observations, for more an intermediate mode with half of the compilation time and
    nearly full speed; compile again with all optimisations after as many iterations as repay it. On a GPU always
    full."""

    retriangulate: bool = False
    """After convergence, search for points at other depths with a lower cost, continue from them, and repeat this while
    it pays. Finds points in wrong local minima, and so a lower cost, for more iterations."""

    max_iterations: int = DEFAULTS.max_iterations
    """Limit of linear solves. 0: only compute the cost, and write the problem as it is."""

    ftol: float = DEFAULTS.tolerances.ftol
    """Converged when the relative decrease of the cost by an accepted step is below this."""

    xtol: float = DEFAULTS.tolerances.xtol
    """Converged when the norm of an accepted step, relative to that of the parameters, is below this."""

    gtol: float = DEFAULTS.tolerances.gtol
    """Converged when the largest gradient entry is below this."""

    scaling: Scaling | None = None
    """Matrix that lambda multiplies. diagonal: the diagonal of the Hessian. identity: the unit matrix, as in the
    paper's equation. Default: as a learned policy was trained; the diagonal for a rule."""

    rotation: Rotation | None = None
    """Coordinates of rotation steps. angle-axis: those of the file, as in Ceres. manifold: multiplication by
    exp(step). Default: as a learned policy was trained; those of the file for a rule."""

    intrinsics: Intrinsics = DEFAULTS.intrinsics
    """free: optimise focal length and distortion of every camera, as in BAL, or of every lens, as in COLMAP. fixed:
    keep them, for calibrated cameras; the linear solver must be explicit."""

    refine_principal_point: bool = False
    """Optimise principal points of a COLMAP model, too."""

    constant: tuple[str, ...] = ()
    """What stays as it is: poses, rotations, points, focal, distortion, principal-point, numbers of lenses such as k2;
    of rigs extrinsics, frames (their poses, not where cameras are in them) and frame-rotations."""

    gauge: Gauge | None = None
    """Fix position, orientation and scale. two-cameras: the pose of one camera, and a number of another's translation.
    three-points: three points. Default: free, or what --constraints says."""

    constraints: str | None = None
    """YAML file of constants and priors by the model's own names and ids, with the keys constant_poses,
    constant_rotations, constant_points, constant_cameras, constant_numbers, position_priors and gauge."""

    loss: Literal["squared", "huber", "soft_l1", "cauchy", "tukey"] = "squared"
    """Robust loss function of the squared residual."""

    loss_scale: float = DEFAULTS.loss.scale
    """Scale of the robust loss, pixels: residuals well below it count quadratically."""

    output: str | None = None
    """Output file in BAL format, compressed by its ending, .out for Bundler's format, or .ply for a viewer; - is
    standard output. A folder that is there, or a name that ends in /, becomes a COLMAP model. If the problem is one:
    every name does, unless it ends in .txt, .bal, .out, .ply, .bz2, .gz or .xz."""

    strict: bool = False
    """Refuse a problem of which a part would be left out, such as a view in a COLMAP model that names no key-point; and
    positions in --constraints of images that are not in the problem."""

    covariance: str | None = None
    """Output file (.npz) of covariances: poses, lenses, points, points_given_cameras. It needs a gauge, constants or
    priors that fix position, orientation and scale."""

    record: str | None = None
    """Output file (.npz) of the parameters after every step, for jaxba-view; of more than 20,000 points an even
    choice."""

    view: bool = False
    """Watch the solve in the browser while it runs (extra view)."""

    log: str | None = None
    """Output file of a JSON record of the solve, compressed by its ending; - is standard output."""

    device: Literal["auto", "cpu"] = "auto"
    """cpu: the CPU, also where JAX has a GPU."""

    devices: int | None = None
    """Devices of each process, among which points are divided. On a CPU virtual ones, which gain nothing. Default: one;
    with several processes all that there are."""

    coordinator: str | None = None
    """HOST:PORT of the first of several processes, which prints, reads and writes for all. Each is started with the
    same options but --process."""

    processes: int | None = None
    """Number of processes."""

    process: int | None = None
    """Number of this process, from 0."""

    distributed: bool = False
    """Find the last three under Slurm, Open MPI or Kubernetes."""


def main() -> None:
    """Entry point of `jaxba-solve`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 if a solution was found and written, 2 for bad input, 130 after a second
    Ctrl-C."""
    try:
        words = translated(sys.argv[1:] if argv is None else argv)
    except common.UsageError as error:
        return common.print_error(str(error))
    return common.run_command(Arguments, _run, "Bundle adjustment of one problem.", words)


def solver_name(args: Arguments) -> SolverName:
    """The name of the solver in records and tables.

    Raises:
        UsageError: the name of the policy states another number of point iterations than `--refine-points`.
    """
    name = replace(parse_policy(args.policy), dtype=args.dtype, method=args.method)
    if args.refine_points is None:
        return name
    _, stated_points, stated = split_refinement(args.policy)
    if stated and stated_points != args.refine_points:
        raise common.UsageError(f"--refine-points {args.refine_points} contradicts --policy {args.policy}")
    return replace(name, refine_points=args.refine_points)


def solve_options(args: Arguments) -> tuple[DampingPolicy, SolveOptions]:
    """The policy and the options for the arguments.

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
            pad={"auto": None, "yes": True, "no": False}[args.pad],
            compilation=args.compilation,
            devices=args.devices,
        )
        options.step_options(policy)  # raises an error for incompatible options
        return policy, options
    except ValueError as error:
        if type(error) is not ValueError:  # subclasses have messages that need no option name
            raise
        raise common.UsageError(_about_option(str(error))) from None


def _about_option(message: str) -> str:
    """A message that begins with the name of a field, with that name replaced by the command-line option."""
    field, _, rest = message.partition(" ")
    option = OPTION_OF_FIELD.get(field, field)
    return f"--{option.replace('_', '-')} {rest}" if hasattr(Arguments, option) else message


def _run(args: Arguments) -> int:
    streams = {name: "/dev/stdout" for name in ("output", "log") if getattr(args, name) == STREAM}
    args = replace(args, **streams)
    if args.device == "cpu":
        import jax

        jax.config.update("jax_platforms", "cpu")
    several = processes.start(args.coordinator, args.processes, args.process, args.distributed, args.devices)
    if not several:
        return _run_main(args)
    if (args.record is not None or args.view) and (args.processes is not None or args.distributed):
        raise common.UsageError("--record and --view are for one process")
    args = replace(args, compilation="full")
    from jaxba.runtime.distributed import MainFailedError, is_main

    if is_main():
        return _run_main(args)
    try:  # the others read, print and write nothing
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            return _solve(replace(args, output=None, log=None, covariance=None))
    except (MainFailedError, ProblemError, common.UsageError):  # which the first one reports
        return common.BAD_INPUT


def _run_main(args: Arguments) -> int:
    if _STDOUT not in [stream_number(path or "") for path in (args.output, args.log)]:
        return _solve(args)
    with redirect_stdout(sys.stderr):  # stdout has only the output file
        return _solve(args)


def _solve(args: Arguments) -> int:
    if args.problem == "":
        raise common.UsageError("the name of the problem is empty")
    policy, options = solve_options(args)
    path, problem = _in_all_processes(args) if _is_divided(args) else _checked(args)
    common.prepare_process(untraced=not _is_divided(args))
    name = DEFAULT_SCENE if args.problem is None else path if args.problem == STREAM else args.problem
    assert name is not None
    common.print_line(table.heading(name, problem, args, options.step_options(policy)))
    watching = Watching.of(problem, path, args.record is not None, args.view)
    solution, steps = _iterate(args, problem, policy, options, watching and watching.watch)
    common.print_line(table.summary(problem, solution, options.loss))
    if (args.pad == "yes" and not _is_divided(args)) or solution.capacity is not None:
        common.print_line(table.padding(problem, solution))
    if args.output:
        write_solution(args.output, solution.problem, path)
    if args.covariance:
        solved = solution.problem
        if args.intrinsics == "fixed":
            solved = hold(solved, lenses="all")
        _write_covariance(args.covariance, solved, options.loss)
    if args.log:
        from jaxba.bench.records import record_to_json
        from jaxba.bench.run import record_of

        record = record_of(solution, steps, name=name, family="", solver=solver_name(args))
        with open_output(args.log) as file:
            file.write(json.dumps(record_to_json(record), allow_nan=False).encode() + b"\n")
        common.print_line(f"wrote {args.log}")
    if watching:
        watching.end(args.record)
    return 0


def _is_divided(args: Arguments) -> bool:
    """Whether the solve may have several devices or processes."""
    return args.devices is not None or args.processes is not None or args.distributed


def _in_all_processes(args: Arguments) -> tuple[str | None, BundleProblem]:
    """What the first process checks and reads."""
    from jaxba.runtime.distributed import together

    return together(lambda: _checked(args))


def _checked(args: Arguments) -> tuple[str | None, BundleProblem]:
    """The path of the problem and the problem, after all checks of files."""
    path = _path(args.problem)
    if args.record is not None and not args.record.endswith(".npz"):
        raise common.UsageError(f"--record {args.record}: a recording ends in .npz")
    outputs = {"--log": args.log, "--covariance": args.covariance, "--record": args.record}
    read = {"the file of --constraints": args.constraints, "the file of --policy": policy_file(args.policy)}
    check_outputs(args.output, outputs, path, read)
    if args.view:
        view.check_extra()
    with common.notes_printed():
        problem = _default_scene() if path is None else _read(args, path)
        problem = constrained(problem, args.constant, args.gauge, args.constraints, strict=args.strict)
    if args.strict and len(away := facing_away(problem)):
        raise ProblemError(aside_text(problem, away))
    check_storable(args.output, problem, path)
    if args.covariance and problem.constants is None and problem.priors is None:
        raise common.UsageError("--covariance needs --gauge, constants or priors: position and scale are free")
    return path, problem


def _path(problem: str | None) -> str | None:
    """Where a problem is read; None for the built-in scene."""
    if problem != STREAM:
        return problem and resolve(problem)
    try:
        return whole_input()
    except OSError as error:
        raise common.UsageError(f"standard input: {error.strerror or error}") from None


def _read(args: Arguments, path: str) -> BundleProblem:
    if args.refine_principal_point:
        if not is_colmap(path):
            raise common.UsageError("--refine-principal-point is for COLMAP models")
        return read_colmap(path, strict=args.strict, refine_principal_point=True)
    return read_problem(path, strict=args.strict)


def _write_covariance(path: str, problem: BundleProblem, loss: Loss) -> None:
    with common.notes_printed():
        found = covariance(problem, loss=loss)
    with open_output(path) as file:
        arrays = ("poses", "lenses", "points", "points_given_cameras")
        np.savez_compressed(file, **{name: getattr(found, name) for name in arrays})
    common.print_line(f"wrote {path}")


def _default_scene() -> BundleProblem:
    from jaxba.bench.sources import default_sources

    return default_sources()[0].read()


def _iterate(
    args: Arguments, problem: BundleProblem, policy: DampingPolicy, options: SolveOptions, watch: Watch | None
) -> tuple[Solution, list[IterationRecord]]:
    """Solves, and prints every iteration. The first Ctrl-C stops after the current iteration."""
    steps: list[IterationRecord] = []
    alone = args.processes is None and not args.distributed  # processes must do the same
    with common.notes_printed(), Interrupt("iteration", graceful=alone) as interrupt:

        def show(record: IterationRecord) -> bool:
            if not steps:
                common.print_line(table.header(float(record.step.previous_cost)))
            common.print_line(table.row(record, steps[-1].time_s if steps else 0.0))
            steps.append(record)
            return interrupt.requested

        if not args.retriangulate:
            return solve(problem, policy, options, callback=show, watch=watch), steps
        show_search = lambda found: common.print_line(table.retriangulated(found, args.ftol))
        searching = {"on_search": show_search, "watch": watch}
        return solve_and_retriangulate(problem, policy, options, callback=show, **searching), steps
