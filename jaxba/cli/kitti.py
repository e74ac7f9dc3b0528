"""`jaxba-kitti`: makes a problem from the images of a KITTI odometry sequence, and computes trajectory errors."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from jaxba.cli import common
from jaxba.cli.options import options
from jaxba.cli.overwriting import PROBLEM, check_apart, problem_files
from jaxba.io import check_output, write_problem
from jaxba.io.files import sidecar_path, strip_compression
from jaxba.io.formats import FORMATS, by_ending
from jaxba.io.frames import poses_of, read_sidecar, truth_of, write_sidecar
from jaxba.io.notes import note, note_center
from jaxba.io.poses import read_poses
from jaxba.kitti import evaluate
from jaxba.kitti.assemble import Assembled, sidecar_contents, windows
from jaxba.kitti.options import BuildOptions, Features
from jaxba.kitti.sequence import files_of, read_sequence
from jaxba.kitti.trajectory import path_length
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import ProblemError
from jaxba.runtime.atomic import write_text

EVALUATE = "evaluate"
"""First argument of the subcommand; a folder of this name can be given as ./evaluate."""

DEFAULTS = BuildOptions()
"""Defaults of the options of the same names."""


@options
class Arguments:
    """Options of `jaxba-kitti`."""

    sequence: Annotated[str, "SEQUENCE", tyro.conf.Positional]
    """Folder of a KITTI sequence: image_0/000000.png ... and calib.txt, or image_00/data of the raw data."""

    out: Annotated[str, "FILE"] = "kitti.txt.bz2"
    """Problem in BAL format, compressed by its ending (.bz2, .gz, .xz). NAME.frames.json beside it has the frame of
    each camera."""

    frames: Annotated[str, "A:B:STEP"] = ":"
    """Range of frame numbers, without the end, such as 0:200."""

    features: Features = DEFAULTS.features
    """sift, orb: match key-points. klt: track corners from frame to frame."""

    keypoints: int = DEFAULTS.keypoints
    """Key-points per frame at most."""

    reach: int = DEFAULTS.reach
    """Previous frames with which each frame is matched."""

    min_matches: int = DEFAULTS.min_matches
    """Verified matches between two frames at least."""

    keyframes: Annotated[str, "RULE"] = "auto"
    """auto: by parallax and the fraction of tracks left. all: every frame. N: every N-th frame."""

    start: Literal["vo", "poses", "noisy-poses"] = "vo"
    """vo: start from monocular visual odometry. poses: from --poses. noisy-poses: from --poses with accumulating
    errors."""

    poses: Annotated[str | None, "FILE"] = None
    """True poses, 12 numbers per line for every frame from 0, or 13, the first of them the frame. With --start vo only
    the error of the start is computed from them."""

    rotation_sigma: float = DEFAULTS.rotation_sigma
    """Error of noisy-poses: standard deviation per axis and key-frame, degrees."""

    translation_sigma: float = DEFAULTS.translation_sigma
    """The same per axis and key-frame, relative to the distance from the previous key-frame."""

    min_angle: float = DEFAULTS.min_angle
    """Smallest triangulation angle of a point, degrees."""

    max_error: float = DEFAULTS.max_error
    """Largest reprojection error of an observation before the noise of noisy-poses, pixels."""

    min_views: int = DEFAULTS.min_views
    """Key-frames that observe a point at least."""

    window: int | None = None
    """Write several problems of this many key-frames, named NAME-FIRST-LAST by their frames."""

    stride: int | None = None
    """Key-frames from the start of one window to the next. Default: half a window."""

    camera: int = 0
    """Number of the camera, from 0 (image_0 and P0) to 3."""

    calibration: Annotated[str | None, "FILE"] = None
    """Camera matrix: lines as in calib.txt, calib_cam_to_cam.txt or perspective.txt, or 3 x 3 numbers. Default: that of
    the sequence."""

    work: Annotated[str | None, "FOLDER"] = None
    """Intermediate results, with which an interrupted run continues. Default: NAME.work."""

    seed: int = DEFAULTS.seed
    """Seed of all random numbers."""


@options
class EvaluateArguments:
    """Options of `jaxba-kitti evaluate`."""

    problem: Annotated[str, "PROBLEM", tyro.conf.Positional]
    """Problem written by jaxba-kitti, with its NAME.frames.json beside it."""

    solutions: Annotated[tuple[str, ...], "[SOLUTION ...]", tyro.conf.Positional] = ()
    """Solutions of the problem by jaxba-solve, BAL files."""

    poses: Annotated[str | None, "FILE"] = None
    """True poses of the whole sequence, 12 numbers per line. Without them no errors are computed."""

    lengths: Annotated[tuple[float, ...], "METRES ..."] = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
    """Lengths of the segments for relative errors."""

    out: Annotated[str, "FOLDER"] = "runs/kitti"
    """Folder of top-view.png and .svg, evaluation.json and the aligned trajectories."""


def main() -> None:
    """Entry point of `jaxba-kitti`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 for success, 2 for bad input, 130 after Ctrl-C (a new run continues)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv[:1] == [EVALUATE]:
        text = "Computes trajectory errors and draws the scene from above."
        return common.run_command(EvaluateArguments, _evaluate, text, argv[1:], EVALUATE)
    text = "Makes a problem from KITTI images ('jaxba-kitti evaluate': compares solutions)."
    return common.run_command(Arguments, _build, text, argv)


def _check(args: Arguments) -> None:
    """Checks the options, and that OpenCV is installed."""
    common.check_positive(
        keypoints=args.keypoints, reach=args.reach, max_error=args.max_error, min_matches=args.min_matches
    )
    for name in ("max_error", "rotation_sigma", "translation_sigma"):
        value = getattr(args, name)
        common.require(math.isfinite(value), f"--{name.replace('_', '-')} must be finite, is {value:g}")
    common.require(args.min_views >= 2, f"--min-views must be at least 2, is {args.min_views}")
    common.require(0 <= args.min_angle < 180, f"--min-angle must lie between 0 and 180, is {args.min_angle:g}")
    common.require(0 <= args.seed < 2**31, f"--seed must lie between 0 and 2147483647, is {args.seed}")
    common.require(args.start == "vo" or args.poses is not None, f"--start {args.start} needs --poses")
    common.require(args.stride is None or args.window is not None, "--stride needs --window")
    common.check_writable("--out", args.out)
    check_output(args.out)
    is_bal = by_ending(args.out) in (None, FORMATS[0])
    common.require(is_bal, f"--out {args.out}: the problem is a BAL file, such as kitti00.txt.bz2")
    common.check_extra("jaxba.kitti.opencv")


def _build(args: Arguments) -> int:
    _check(args)
    from jaxba.kitti.build import build

    with common.notes_printed():
        sequence, poses = _inputs(args)
    _check_apart([args.out], sequence, args)
    options = BuildOptions(**{field.name: getattr(args, field.name) for field in fields(BuildOptions)})
    console = common.console()
    work = Path(args.work or Path(strip_compression(args.out)).with_suffix(".work"))
    try:
        with _progress(console) as report:
            built = build(sequence, options, work, poses, report)
        parts = _parts(built, args)
        _check_apart([path for _, path in parts], sequence, args)
        for part, path in parts:
            _write(part, path, sequence, args)
    except KeyboardInterrupt:
        console.print("interrupted; what is done is kept, run the same command again to continue")
        return common.INTERRUPTED
    console.print(_build_table([part for part, _ in parts], built, poses))
    for words, numbers in (
        ("left out, too few matches", built.dropped),
        ("placed relative to the key-frame beside, without enough known points", built.restarts),
    ):
        if numbers:
            console.print(f"note: {words}: frame{'s'[: len(numbers) > 1]} {', '.join(map(str, numbers))}")
    console.print(f"wrote {', '.join(path for _, path in parts)}")
    return 0


def _check_apart(problems: Sequence[str], sequence: Any, args: Arguments) -> None:
    """Refuses a problem, or the frames beside one, in the place of a file of the sequence."""
    written = {"--out": [*problems, *map(sidecar_path, problems)]}
    own = [*sequence.images, *files_of(args.sequence, sequence.folder)]
    read = {"the file of --poses": [args.poses], "the file of --calibration": [args.calibration]}
    check_apart(written, {"a file of the sequence": own, **read})


def _inputs(args: Arguments) -> tuple[Any, Any]:
    """The sequence, and its true poses as a function of the numbers of frames, or None."""
    from jaxba.kitti.images import image_size

    sequence = read_sequence(args.sequence, args.frames, args.camera, args.calibration)
    poses = None
    if args.poses is not None:
        table = read_poses(args.poses)
        if not table.one_a_line:
            whole, sequence = len(sequence), sequence.only(table.numbers)
            if len(sequence) < whole:
                note(args.poses, f"{whole - len(sequence)} of {whole} frames left out: they have no pose")
        poses = lambda frames: poses_of(table, frames, sequence.calibration)
        poses(sequence.numbers)  # raises errors before any work is done
    center = (sequence.calibration.cx, sequence.calibration.cy)
    note_center(args.calibration or sequence.folder, f"camera {args.camera}", center, image_size(sequence))
    return sequence, poses


def _parts(built: Any, args: Arguments) -> list[tuple[Assembled, str]]:
    """The problems to write, and their files."""
    if args.window is None:
        return [(built.whole, args.out)]
    stride = max(args.window // 2, 1) if args.stride is None else args.stride
    plain = strip_compression(args.out)
    stem, ending = Path(plain).with_suffix(""), Path(plain).suffix + args.out[len(plain) :]
    parts = windows(built.whole, args.window, stride, args.min_views)
    return [(part, f"{stem}-{part.frames[0]:06d}-{part.frames[-1]:06d}{ending}") for part in parts]


def _write(part: Assembled, path: str, sequence: Any, args: Arguments) -> None:
    """Writes the file of frames first, then the problem, so that there is never a problem without its frames."""
    from jaxba import __version__
    from jaxba.kitti.opencv import cv2

    times = None if sequence.times is None else dict(zip(sequence.numbers, sequence.times.tolist(), strict=True))
    metadata = sidecar_contents(
        part,
        sequence.calibration,
        times=times and [times[number] for number in part.frames],
        options=asdict(args),
        versions={"jaxba": __version__, "opencv": cv2.__version__},
    )
    write_sidecar(path, metadata)
    write_problem(part.problem, path)


def _build_table(parts: list[Assembled], built: Any, poses: Any) -> Any:
    title = f"{built.frames} frames, {len(built.whole.frames)} key-frames, {built.tracks} tracks"
    table = _table(title, "frames", "key-frames", "points", "observations", "mean error (px)", "ATE of the start (m)")
    for part in parts:
        problem = part.problem
        error = np.linalg.norm(geometry.residuals(problem), axis=1).mean()
        ate = "-"
        if poses is not None:
            try:
                found = evaluate.score(geometry.camera_poses(problem.cameras), poses(part.frames))
                ate = f"{found.absolute.rmse:.3f}"
            except ProblemError:  # a straight line, or two cameras
                ate = "undefined"
        numbers = (problem.num_cameras, problem.num_points, problem.num_observations, f"{error:.3f}", ate)
        table.add_row(f"{part.frames[0]} to {part.frames[-1]}", *map(str, numbers))
    return table


def _evaluate(args: EvaluateArguments) -> int:
    common.require(bool(args.lengths) and all(length > 0 for length in args.lengths), "--lengths must be positive")
    from jaxba.kitti import plots

    _check_results_apart(args)
    side = read_sidecar(args.problem)
    truth = None if args.poses is None else truth_of(side, args.poses)
    with common.notes_printed():
        results = evaluate.evaluate([args.problem, *args.solutions], side, truth, args.lengths)
    views = [plots.View(_caption(r), r.points, r.poses[:, :, 3]) for r in results]
    figure = plots.plot_top_view(views, None if truth is None else truth[:, :, 3])
    folder = Path(args.out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / "evaluation.json", json.dumps(evaluate.as_json(results, side), allow_nan=False) + "\n")
        for number, result in enumerate(results):
            evaluate.write_poses(folder / f"poses-{number}-{result.name}.txt", result.poses)
        if truth is not None:
            evaluate.write_poses(folder / "poses-truth.txt", truth)
        files = plots.save_figure(figure, folder / "top-view")
    except OSError as error:
        raise common.UsageError(f"--out {args.out}: {error.strerror or error}") from None
    console = common.console()
    console.print(_evaluate_table(results, truth))
    console.print(f"wrote {files[0]} and {len(results) + (truth is not None) + 2} files beside it")
    return 0


def _check_results_apart(args: EvaluateArguments) -> None:
    """Refuses results in the place of a file that is compared."""
    files, folder = [args.problem, *args.solutions], Path(args.out)
    names = [f"poses-{number}-{Path(strip_compression(path)).stem}.txt" for number, path in enumerate(files)]
    names += ["evaluation.json", "poses-truth.txt", "top-view.png", "top-view.svg"]
    read = {PROBLEM: [one for path in files for one in problem_files(path)], "the file of --poses": [args.poses]}
    check_apart({"--out": [folder / name for name in names]}, read)


def _caption(result: evaluate.Evaluated) -> str:
    ate = "" if result.scores is None else f", ATE {result.scores.absolute.rmse:.2f} m"
    return f"{result.name}{ate}"


def _evaluate_table(results: list[evaluate.Evaluated], truth: Any) -> Any:
    title = f"{len(results[0].poses)} key-frames"
    names: tuple[str, ...] = ()
    if truth is not None:
        title += f", {path_length(truth):.1f} m of path; after similarity alignment"
        names = ("ATE (m)", "largest (m)", "RPE (m)", "RPE (deg)", "segments (%)", "(deg/m)", "number")
    table = _table(title, "file", "rms (px)", *names)
    for r in results:
        row = [r.name, f"{r.rms:.4f}"]
        if r.scores is not None:
            s, segments = r.scores, r.scores.segments
            row += [f"{s.absolute.rmse:.3f}", f"{s.absolute.largest:.3f}"]
            row += [f"{s.relative.translation.rmse:.4f}", f"{s.relative.rotation.rmse:.4f}"]
            row += (
                ["-"] * 3
                if segments is None
                else [f"{segments.translation:.3f}", f"{segments.rotation:.5f}", str(segments.segments)]
            )
        table.add_row(*row)
    return table


def _table(title: str, first: str, *columns: str) -> Any:
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column(first, no_wrap=True)
    for name in columns:
        table.add_column(name, justify="right")
    return table


@contextmanager
def _progress(console: Any) -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar on a terminal, otherwise a line for every stage: a function of the stage, what is done and the
    total."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task, now = bar.add_task("starting", total=None), ""

        def report(stage: str, done: int, total: int) -> None:
            nonlocal now
            if stage != now:
                now = stage
                bar.reset(task, description=stage)
                if not console.is_terminal:
                    console.print(stage if total <= 1 else f"{stage} ({total})")
            bar.update(task, completed=done, total=total)

        yield report
