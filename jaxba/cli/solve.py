"""`jaxba-solve`: bundle adjustment of a problem, or of several."""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from jaxba.cli import common, processes, table, view
from jaxba.cli.colmap_options import translated
from jaxba.cli.constraints import surveyed
from jaxba.cli.options import options
from jaxba.cli.output import check_outputs, check_storable, fitting, write_solution
from jaxba.cli.overwriting import policy_file
from jaxba.cli.short_help import short_help
from jaxba.cli.streams import whole_input
from jaxba.constraints.file import Survey
from jaxba.constraints.report import report
from jaxba.damping import DampingPolicy
from jaxba.datasets.bal.paths import resolve
from jaxba.io import is_colmap, read_colmap, read_problem
from jaxba.io.files import open_output, stream_number
from jaxba.lm.termination import Tolerances
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.facing import aside_text, facing_away
from jaxba.problem.gauge import Gauge
from jaxba.problem.hold import hold
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
from jaxba.runtime.interrupt import Interrupt
from jaxba.scenes import DEFAULT_SCENES, random_scene
from jaxba.solver.drivers import IterationRecord, Watch
from jaxba.solver.methods import DEFAULT_METHOD
from jaxba.solver.names import Repairs, SolverName, adjusted, parse_policy, split_refinement
from jaxba.solver.options import Dtype, SolveOptions
from jaxba.solver.prepare import DEFAULT_POLICY
from jaxba.solver.solve import Solution, solve
from jaxba.typing import InputError

DEFAULTS = SolveOptions()
"""Defaults of the options, those of `jaxba.solve`."""

STREAM = "-"
"""Name of standard input for a problem, and of standard output for a file."""

_STDOUT = 1
"""File descriptor of standard output."""

DEFAULT_SCENE = next(iter(DEFAULT_SCENES))
"""Name of the scene that is solved if no problem is given."""

AXES = (
    "rotation (radians, left perturbation), then translation; in the camera's frame y is up, "
    "and it looks along -z"
)
"""What the rows of `poses` in a file of covariances are."""

OPTION_OF_FIELD = {"points": "refine_points", "scale": "loss_scale"}
"""Fields of options whose command-line option has another name."""


@options
class Problem:
    """What is solved."""

    problem: Annotated[str | None, "[PROBLEM]", tyro.conf.Positional] = None
    """BAL, Bundler or OpenSfM file, also .bz2, .gz, .xz; folder of a COLMAP model; a downloaded BAL
    problem (see jaxba-data); - for standard input. Default: a scene."""

    more: Annotated[tuple[str, ...], "[PROBLEM ...]", tyro.conf.Positional] = ()
    """Further problems; a folder stands for those in it."""

    intrinsics: Intrinsics = DEFAULTS.intrinsics
    """fixed: keep focal lengths and distortion."""

    refine_principal_point: bool = False
    """Optimise principal points of a COLMAP model, too."""

    constant: Annotated[tuple[str, ...], "PART ..."] = ()
    """Parts that stay as they are: poses, rotations, points, focal, distortion, principal-point, or
    numbers of lenses such as k2; of rigs extrinsics, frames (their poses) and frame-rotations."""

    gauge: Gauge | None = None
    """Fix position, orientation and scale. Default: as in --constraints."""

    constraints: Annotated[str | None, "FILE"] = None
    """YAML file of constants, priors and gauge by the model's own names and ids."""

    loss: Literal["squared", "huber", "soft_l1", "cauchy", "tukey"] = "squared"
    """Robust loss function."""

    loss_scale: float = DEFAULTS.loss.scale
    """Width of its quadratic part, pixels."""

    strict: bool = False
    """Fail instead of skipping invalid parts of the input. Exit status 3 if what was measured does
    not fit; the solution is written."""


@options
class Step:
    """How a step is computed."""

    policy: Annotated[str, "NAME"] = DEFAULT_POLICY
    """Damping policy, which chooses lambda: guarded (1e-6, then 1e-8 until a step fails), bold (the
    smallest lambda that the guard of agents allows), learned (the shipped network, without embedded
    iterations), a .safetensors file of jaxba-train, or a rule: ceres, classic, gtsam, nielsen,
    stba, theseus, schedule, gauss-newton, constant:1e-4. Most rules take the first lambda, as in
    classic:0.03. A suffix +embedded adds all embedded iterations, +refineK is --refine-points K."""

    method: Annotated[str, "NAME"] = DEFAULT_METHOD
    """lm: Levenberg-Marquardt. stba, stba:16: random clusters of at most 100 or 16 cameras. deeplm:
    conjugate gradients on all variables."""

    recipes: int | None = None
    """Solve by so many policies side by side, this one and the next of a list; the lowest end
    wins."""

    refine_points: int | None = None
    """Point iterations after each camera step. Default: those that the policy brings (guarded,
    bold, learned); none for a rule."""

    repairs: Repairs | None = None
    """Of a bad step. none; trials: up to three shorter steps; all: camera rounds and pattern moves,
    too. Default: those of the policy, but none with --refine-points."""

    min_gain: float | None = None
    """Gain ratio that a step must exceed. Default: that of the policy."""

    linear_solver: LinearSolverChoice = DEFAULTS.linear_solver
    """explicit: factor the reduced camera system. sparse: form it for conjugate gradients.
    implicit: do not form it. cg: twelve iterations of that. auto: by size."""

    preconditioner: Preconditioner = DEFAULTS.conjugate_gradients.preconditioner
    """Of conjugate gradients. two-level: with a coarse system of the motion of clusters."""

    scaling: Scaling | None = None
    """Matrix that lambda multiplies. Default: that of a learned policy; diagonal for a rule."""

    rotation: Rotation | None = None
    """angle-axis: steps of the file's numbers, as in Ceres. manifold: multiplication by exp(step).
    Default: that of a learned policy; angle-axis for a rule."""

    dtype: Dtype = DEFAULTS.dtype
    """mixed: float64, but the reduced camera system in float32."""

    pad: Literal["auto", "yes", "no"] = "auto"
    """Pad sizes, so that similar problems share a compiled program. auto: up to 64 cameras and
    60,000 observations, not if fully compiled."""

    compilation: Compilation = DEFAULTS.compilation
    """quick: compile in a third of the time, and iterate two to six times as long. full: the
    contrary. auto: full once that pays; on a GPU always."""

    prepare: bool = False
    """Only compile, for the given problems or usual ones."""


@options
class Stop:
    """When the solve ends."""

    max_iterations: int = DEFAULTS.max_iterations
    """Limit of linear solves. 0: compute the cost, and write the problem as it is."""

    ftol: float = DEFAULTS.tolerances.ftol
    """Stop when an accepted step lowers the cost by less, relatively."""

    xtol: float = DEFAULTS.tolerances.xtol
    """Stop when an accepted step is shorter, relative to the parameters."""

    gtol: float = DEFAULTS.tolerances.gtol
    """Stop at this largest gradient entry."""

    within: float = DEFAULTS.within
    """Stop when the cost is estimated to be nearer to its end, relatively: 1e-3 where 0.1% does not
    matter."""

    seconds: float | None = None
    """Limit of time, compilation included."""

    retriangulate: bool = False
    """After convergence, move points to depths with a lower cost and go on."""

    reject: bool = False
    """Find wrong matches; solve and write without them."""


@options
class Output:
    """What is written and shown."""

    output: Annotated[str | None, "FILE", "-o"] = None
    """Solution in BAL format, compressed by its ending; .out: Bundler's; .ply: for a viewer; .json:
    cameras for nerfstudio; -: standard output. An existing folder or NAME/ becomes a COLMAP model;
    so does any name if the problem is one, but for these endings, .txt, .bal, .bz2, .gz and .xz. Of
    several problems: a folder."""

    checkpoint: Annotated[str | None, "FILE"] = None
    """Solve that goes on if killed; written every minute."""

    resume: bool = False
    """Go on with several problems where it ended."""

    survey: Annotated[str | None, "FILE"] = None
    """CSV of control points, check points and distances."""

    covariance: Annotated[str | None, "FILE"] = None
    """Covariances (.npz): poses, lenses, points, points_given_cameras. Needs a gauge or priors."""

    record: Annotated[str | None, "FILE"] = None
    """Parameters after every step (.npz), for jaxba-view."""

    view: bool = False
    """Watch the solve in the browser (extra view)."""

    log: Annotated[str | None, "FILE"] = None
    """JSON record of the solve, compressed by its ending; -: standard output."""


@options
class Devices(processes.Devices):
    """Where the solve runs."""

    device: Literal["auto", "cpu"] = "auto"
    """cpu: even where JAX has a GPU."""


@options
class Arguments(Problem, Step, Stop, Output, Devices):
    """Options of `jaxba-solve`."""


EVERYDAY = (
    "output",
    "constant",
    "gauge",
    "constraints",
    "loss",
    "loss_scale",
    "reject",
    "strict",
    "policy",
    "max_iterations",
    "seconds",
    "view",
)
"""Options that `--help` shows; `--help-all` shows all."""

EXAMPLES = (
    ("jaxba-solve sparse/0 -o refined/", "Refine a COLMAP model, and write another one."),
    ("jaxba-solve problem.txt.bz2 --view", "Solve a BAL problem, and watch it in the browser."),
    ("jaxba-solve sparse/0 -o out/ --constraints site.yaml", "With GPS, control points, or gauge."),
)
"""Command lines that `--help` shows, with what they do."""


def main() -> None:
    """Entry point of `jaxba-solve`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 if a solution was found and written, 2 for bad input, 3 with
    `--strict` if what was measured does not fit the solution, 130 after a second Ctrl-C."""
    try:
        words = translated(sys.argv[1:] if argv is None else argv)
    except common.UsageError as error:
        return common.print_error(str(error))
    text = "Bundle adjustment of a problem, or of several."
    page = short_help(Arguments, "jaxba-solve", text, EVERYDAY, EXAMPLES)
    return common.run_command(Arguments, _run, text, words, short_page=page)


def solver_name(args: Arguments) -> SolverName:
    """The name of the solver in records and tables. Raises UsageError: the name of the policy
    states another number of point iterations than `--refine-points`."""
    name = replace(parse_policy(args.policy), dtype=args.dtype, method=args.method)
    if args.refine_points is None:
        return name
    _, stated_points, stated = split_refinement(args.policy)
    if stated and stated_points != args.refine_points:
        raise common.UsageError(
            f"--refine-points {args.refine_points} contradicts --policy {args.policy}"
        )
    return replace(name, refine_points=args.refine_points)


def solve_options(args: Arguments) -> tuple[DampingPolicy, SolveOptions]:
    """The policy and the options for the arguments. Raises UsageError: a number out of range, or
    options that do not go together; the message names the option. Raises InputError: as
    `make_policy` and `make_method`."""
    try:
        policy, options = adjusted(*solver_name(args).build(), args.repairs, args.min_gain)
        trained = options.step_options(policy).coordinates
        scaling = args.scaling or trained.scaling
        rotation = args.rotation or trained.rotation
        options = replace(
            options,
            linear_solver=args.linear_solver,
            conjugate_gradients=ConjugateGradients(args.preconditioner),
            coordinates=replace(trained, scaling=scaling, rotation=rotation),
            intrinsics=args.intrinsics,
            loss=Loss(args.loss, args.loss_scale),
            tolerances=Tolerances(args.ftol, args.xtol, args.gtol, seconds=args.seconds),
            within=args.within,
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
    """A message that begins with the name of a field, with that name replaced by the command-line
    option."""
    field, _, rest = message.partition(" ")
    option = OPTION_OF_FIELD.get(field, field)
    return f"--{option.replace('_', '-')} {rest}" if hasattr(Arguments, option) else message


def _run(args: Arguments) -> int:
    streams = {name: "/dev/stdout" for name in ("output", "log") if getattr(args, name) == STREAM}
    args = replace(args, **streams)
    if args.device == "cpu":
        import jax

        jax.config.update("jax_platforms", "cpu")
    several = processes.start(args)
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
            return _solve(replace(args, output=None, log=None, covariance=None, survey=None))
    except (MainFailedError, InputError):  # which the first one reports
        return common.BAD_INPUT


def _run_main(args: Arguments) -> int:
    taken = _STDOUT in [stream_number(path or "") for path in (args.output, args.log)]
    with redirect_stdout(sys.stderr) if taken else nullcontext():  # stdout has only the output file
        return _solve(args)


def _solve(args: Arguments) -> int:
    common.require(args.problem != "", "the name of the problem is empty")
    policy, options = solve_options(args)
    common.require(
        not (args.reject and args.retriangulate), "--reject and --retriangulate exclude each other"
    )
    _check_recipes(args)
    _check_checkpoint(args)
    problems = [name for name in (args.problem, *args.more) if name]
    if args.prepare:
        return _prepare(args, problems, policy, options)
    if (
        args.more
        or args.resume
        or (args.problem and os.path.isdir(args.problem) and not is_colmap(args.problem))
    ):
        from jaxba.cli import several

        if paths := several.inputs(problems):
            return several.solve_all(
                args, paths, functools.partial(_one_of_several, args), policy, options
            )
    common.require(not args.resume, "--resume is for several problems")
    from jaxba.runtime.distributed import together

    path, survey = together(lambda: _checked(args))
    problem = survey.problem
    common.prepare_process(untraced=not _is_divided(args))
    name = (
        f"random scene {DEFAULT_SCENE}"
        if args.problem is None
        else path
        if args.problem == STREAM
        else args.problem
    )
    assert name is not None
    common.print_line(table.heading(name, problem, args, options.step_options(policy)))
    watch, end = view.watched(problem, path, args.record, args.view)
    run = _iterate if args.recipes is None else _by_recipes
    solution, steps = run(args, problem, policy, options, watch)
    common.print_line(table.summary(problem, solution, options.loss))
    if solution.capacity is not None:
        common.print_line(f"padded to {solution.capacity}")
    found = survey.report(solution)
    if found.rows:
        common.print_line(found.table())
    if args.survey:
        found.write(args.survey)
        common.print_line(f"wrote {args.survey}")
    own = survey.without_marks(solution)
    if args.output:
        write_solution(args.output, own, path)
    if args.covariance:
        solved = fitting(solution)
        solved = hold(solved, lenses="all") if args.intrinsics == "fixed" else solved
        _write_covariance(args.covariance, solved, options.loss, fitting(own).num_points)
    if args.log:
        from jaxba.io import json_lines
        from jaxba.solver.record import record_of

        record = record_of(solution, steps, name=name, family="", solver=solver_name(args))
        with open_output(args.log) as file:
            file.write(json.dumps(json_lines.plain(record), allow_nan=False).encode() + b"\n")
        common.print_line(f"wrote {args.log}")
    end()
    return common.misfit_status(args.strict, len(solution.notes))


def _prepare(
    args: Arguments, names: list[str], policy: DampingPolicy, options: SolveOptions
) -> int:
    """Compiles programs for some problems, or for usual ones. Raises UsageError: none are kept."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from jaxba.solver.prepared_programs import prepare_programs

    problems = [_one_of_several(args, name) for name in names] or None
    common.prepare_process(untraced=True)
    columns = (
        TextColumn("compiling programs"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=common.console()) as bar:
        task = bar.add_task("", total=None)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        try:
            kinds = prepare_programs(problems, policy, options, progress=show)
        except InputError:
            raise
        except ValueError as error:
            raise common.UsageError(f"--prepare: {error}") from None
    common.print_line(f"programs for {common.counted(kinds, 'kind')} of problems are on disk")
    return 0


def _is_divided(args: Arguments) -> bool:
    """Whether the solve may have several devices or processes."""
    return args.devices is not None or args.processes is not None or args.distributed


def _checked(args: Arguments) -> tuple[str | None, Survey]:
    """The path of the problem, and the problem with what the options say of it, after all checks of
    files; the first process does this for all."""
    path = _path(args.problem)
    named = args.record is None or args.record.endswith(".npz")
    common.require(named, f"--record {args.record}: a recording ends in .npz")
    outputs = {"--log": args.log, "--covariance": args.covariance, "--record": args.record}
    outputs |= {"--survey": args.survey, "--checkpoint": args.checkpoint}
    read = {
        "the file of --constraints": args.constraints,
        "the file of --policy": policy_file(args.policy),
    }
    check_outputs(args.output, outputs, path, read)
    if args.view:
        common.check_extra(view.VIEWER)
    with common.notes_printed():
        survey = _constrained(args, path)
    problem = survey.problem
    known = not args.survey or bool(report(problem, survey.marks).rows)
    common.require(known, "--survey needs control points or distances in the file of --constraints")
    if args.strict and len(away := facing_away(problem)):
        raise ProblemError(aside_text(problem, away))
    check_storable(args.output, problem, path)
    if args.covariance and problem.constants is None and not problem.residuals:
        raise common.UsageError(
            "--covariance needs --gauge, constants or priors: position and scale are free"
        )
    return path, survey


def _constrained(args: Arguments, path: str | None) -> Survey:
    """A problem with what is constant or measured; without a path the built-in scene."""
    problem = random_scene(DEFAULT_SCENES[DEFAULT_SCENE], 0) if path is None else _read(args, path)
    found = surveyed(
        problem, args.constant, args.gauge, args.constraints, strict=args.strict, path=path
    )
    whole = (
        np.sum(np.asarray(found.problem.point_index) < problem.num_points)
        == problem.num_observations
    )
    common.require(
        bool(whole) or not args.reject, "--reject is for all observations, not for a part"
    )
    return found


def _one_of_several(args: Arguments, path: str) -> BundleProblem:
    survey = _constrained(args, path)
    common.require(survey.marks is None, "a file of control points is for one problem")
    return survey.problem


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
        common.require(is_colmap(path), "--refine-principal-point is for COLMAP models")
        return read_colmap(path, strict=args.strict, refine_principal_point=True)
    return read_problem(path, strict=args.strict)


def _write_covariance(path: str, problem: BundleProblem, loss: Loss, points: int) -> None:
    """Writes covariances, of so many points; the others are marks."""
    from jaxba.results.covariance import covariance

    with common.notes_printed():
        found = covariance(problem, loss=loss)
    names = ("poses", "lenses", "points", "points_given_cameras")
    arrays: dict[str, Any] = {name: getattr(found, name) for name in names} | {
        "axes": np.array(AXES)
    }
    if (labels := problem.labels) is not None:
        ids = {"image_names": np.array(labels.names), "image_ids": labels.images}
        arrays |= ids | {"camera_ids": labels.lenses, "point_ids": labels.points}
    arrays |= {name: value[:points] for name, value in arrays.items() if name.startswith("point")}
    with open_output(path) as file:
        np.savez_compressed(file, **arrays)
    common.print_line(f"wrote {path}")


def _check_checkpoint(args: Arguments) -> None:
    """Raises UsageError: a checkpoint of more than one solve."""
    names = ("recipes", "retriangulate", "reject", "resume", "processes", "distributed")
    several = [f"--{name}" for name in names if getattr(args, name)] + ["several problems"] * bool(
        args.more
    )
    common.require(
        not (args.checkpoint and several),
        f"--checkpoint is for one solve, not for {', '.join(several)}",
    )


def _check_recipes(args: Arguments) -> None:
    """Raises UsageError: a wrong number of recipes, or an option that is for one policy."""
    if args.recipes is None:
        return
    from jaxba.solver.recipes import RECIPES

    common.require(2 <= args.recipes <= len(RECIPES), f"--recipes must be 2 to {len(RECIPES)}")
    others = {
        f"--{name}": getattr(args, name)
        for name in ("record", "view", "log", "retriangulate", "reject")
    }
    given = [
        name
        for name, value in {**others, "--devices and --processes": _is_divided(args)}.items()
        if value
    ]
    common.require(not given, f"{', '.join(given)}: for one policy, not for --recipes")


def _by_recipes(
    args: Arguments,
    problem: BundleProblem,
    policy: DampingPolicy,
    options: SolveOptions,
    watch: Watch | None,
) -> tuple[Solution, list[IterationRecord]]:
    """Solves by several policies, and prints the end of each; the lowest one is the solution."""
    from jaxba.solver.recipes import RECIPES, solve_recipes

    with common.notes_printed():
        found = solve_recipes(problem, args.recipes or 1, policy, options)
    for name, one in zip((args.policy, *RECIPES[1:]), found, strict=False):
        common.print_line(
            f"{name}: cost {one.final_cost:.6e} after {common.counted(one.iterations, 'iteration')}"
        )
    return min(found, key=lambda one: one.final_cost), []


def _iterate(
    args: Arguments,
    problem: BundleProblem,
    policy: DampingPolicy,
    options: SolveOptions,
    watch: Watch | None,
) -> tuple[Solution, list[IterationRecord]]:
    """Solves, and prints every iteration. The first Ctrl-C stops after the current iteration."""
    steps: list[IterationRecord] = []
    alone = args.processes is None and not args.distributed  # processes must do the same
    with common.notes_printed(), Interrupt("iteration", graceful=alone) as interrupt:

        def show(record: IterationRecord) -> bool:
            steps.append(record)
            return interrupt.requested

        hooks = {"callback": show, "watch": watch, "verbose": True}
        if args.reject:
            from jaxba.results.graduated import solve_graduated

            return solve_graduated(problem, policy, options, **hooks), steps
        if not args.retriangulate:
            return solve(problem, policy, options, checkpoint=args.checkpoint, **hooks), steps
        from jaxba.results.alternation import solve_and_retriangulate

        def show_search(found):
            return common.print_line(table.retriangulated(found, args.ftol))

        return solve_and_retriangulate(
            problem, policy, options, on_search=show_search, **hooks
        ), steps
