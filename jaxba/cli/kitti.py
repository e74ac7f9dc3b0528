"""`jaxba-kitti`: makes a problem from the images of a KITTI odometry sequence, and computes
trajectory errors."""

from __future__ import annotations

import functools
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from jaxba.cli import common
from jaxba.cli.options import options
from jaxba.cli.overwriting import PROBLEM, check_apart, problem_files
from jaxba.io import check_output, write_problem
from jaxba.io.files import sidecar_path, strip_compression
from jaxba.io.formats import FORMATS, by_ending
from jaxba.io.frames import poses_of, read_poses, read_sidecar, write_sidecar
from jaxba.io.notes import note_center
from jaxba.kitti import evaluate
from jaxba.kitti.evaluate import path_length
from jaxba.kitti.options import Build
from jaxba.kitti.sequence import calibration_files, read_sequence
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.runtime.atomic import write_text

# first argument of the subcommand; a folder of this name can be given as ./evaluate
EVALUATE = "evaluate"

options(Build)


@options
class Files:
    """What is read and written."""

    sequence: Annotated[str, "SEQUENCE", tyro.conf.Positional]
    """Folder of a KITTI sequence: image_0/000000.png ... and calib.txt."""

    out: Annotated[str, "FILE"] = "kitti.txt.bz2"
    """Problem in BAL format, compressed by its ending (.bz2, .gz, .xz); NAME.frames.json beside it
    has the frames."""

    frames: Annotated[str, "A:B:STEP"] = ":"
    """Range of frame numbers, without the end, such as 0:200."""

    poses: Annotated[str | None, "FILE"] = None
    """True poses, 12 numbers per line for every frame from 0. With --start vo only the error of the
    start is computed from them."""

    camera: int = 0
    """Number of the camera, from 0 (image_0 and P0) to 3."""

    calibration: Annotated[str | None, "FILE"] = None
    """Camera matrix: lines as in calib.txt, or 3 x 3 numbers. Default: that of the sequence."""


@options
class Arguments(Build, Files):
    """Options of `jaxba-kitti`."""


@options
class EvaluateArguments:
    """Options of `jaxba-kitti evaluate`."""

    problem: Annotated[str, "PROBLEM", tyro.conf.Positional]
    """Problem written by jaxba-kitti, with its NAME.frames.json beside it."""

    solutions: Annotated[tuple[str, ...], "[SOLUTION ...]", tyro.conf.Positional] = ()
    """Solutions of the problem by jaxba-solve, BAL files."""

    poses: Annotated[str | None, "FILE"] = None
    """True poses of the whole sequence, 12 numbers per line. Without them no errors are
    computed."""

    out: Annotated[str, "FOLDER"] = "runs/kitti"
    """Folder of evaluation.json and the aligned trajectories."""


def main() -> None:
    """Entry point of `jaxba-kitti`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 for success, 2 for bad input, 130 after Ctrl-C."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv[:1] == [EVALUATE]:
        text = "Computes trajectory errors."
        return common.run_command(EvaluateArguments, _evaluate, text, argv[1:], EVALUATE)
    text = "Makes a problem from KITTI images ('jaxba-kitti evaluate': compares solutions)."
    return common.run_command(Arguments, _build, text, argv)


def _check(args: Arguments) -> None:
    common.check_positive(
        keypoints=args.keypoints,
        reach=args.reach,
        max_error=args.max_error,
        min_matches=args.min_matches,
    )
    common.require(
        math.isfinite(args.max_error), f"--max-error must be finite, is {args.max_error:g}"
    )
    common.require(args.min_views >= 2, f"--min-views must be at least 2, is {args.min_views}")
    common.require(
        0 <= args.min_angle < 180, f"--min-angle must lie between 0 and 180, is {args.min_angle:g}"
    )
    common.require(args.start == "vo" or args.poses is not None, "--start poses needs --poses")
    common.check_writable("--out", args.out)
    check_output(args.out)
    is_bal = by_ending(args.out) in (None, FORMATS[0])
    common.require(is_bal, f"--out {args.out}: the problem is a BAL file, such as kitti00.txt.bz2")
    common.check_extra("jaxba.kitti.opencv")


def _build(args: Arguments) -> int:
    _check(args)
    from jaxba.kitti.frontend import build

    console = common.console()
    with common.notes_printed():
        sequence, poses = _inputs(args)
        _check_apart(sequence, args)
        problem, frames, tracks = build(sequence, args, poses, console.print)
    _write(problem, frames, sequence, args)
    title = f"{len(sequence)} frames, {len(frames)} key-frames, {tracks} tracks"
    console.print(_build_table(title, problem, frames, poses))
    console.print(f"wrote {args.out}")
    return 0


def _check_apart(sequence: Any, args: Arguments) -> None:
    """Refuses a problem, or the frames beside it, in the place of a file of the sequence."""
    written = {"--out": [args.out, sidecar_path(args.out)]}
    folder = Path(args.sequence)
    own = [*sequence.images, *calibration_files(folder), folder / "times.txt"]
    read = {"the file of --poses": [args.poses], "the file of --calibration": [args.calibration]}
    check_apart(written, {"a file of the sequence": own, **read})


def _inputs(args: Arguments) -> tuple[Any, Any]:
    """The sequence, and its true poses as a function of the numbers of frames, or None."""
    from jaxba.kitti.images import image_size

    sequence = read_sequence(args.sequence, args.frames, args.camera, args.calibration)
    poses = None
    if args.poses is not None:
        table = read_poses(args.poses)
        poses = functools.partial(poses_of, table, calibration=sequence.calibration)
        poses(sequence.numbers)  # raises errors before any work is done
    center = (sequence.calibration.cx, sequence.calibration.cy)
    note_center(
        args.calibration or sequence.folder, f"camera {args.camera}", center, image_size(sequence)
    )
    return sequence, poses


def _write(problem: BundleProblem, frames: tuple[int, ...], sequence: Any, args: Arguments) -> None:
    """Writes the file of frames first, then the problem, so that there is never a problem without
    its frames."""
    from jaxba import __version__
    from jaxba.kitti.opencv import cv2

    metadata = {
        "format": 1,
        "frames": frames,
        "calibration": asdict(sequence.calibration),
        "options": asdict(args),
        "versions": {"jaxba": __version__, "opencv": cv2.__version__},
    }
    write_sidecar(args.out, metadata)
    write_problem(problem, args.out)


def _build_table(title: str, problem: BundleProblem, frames: tuple[int, ...], poses: Any) -> Any:
    table = _table(
        title,
        "frames",
        "key-frames",
        "points",
        "observations",
        "mean error (px)",
        "ATE of the start (m)",
    )
    error = np.linalg.norm(geometry.residuals(problem), axis=1).mean()
    ate = "-"
    if poses is not None:
        try:
            scores = evaluate.score(geometry.camera_poses(problem.cameras), poses(frames))
            ate = f"{scores['ate_m']['rmse']:.3f}"
        except ProblemError:  # a straight line, or two cameras
            ate = "undefined"
    numbers = (
        problem.num_cameras,
        problem.num_points,
        problem.num_observations,
        f"{error:.3f}",
        ate,
    )
    table.add_row(f"{frames[0]} to {frames[-1]}", *map(str, numbers))
    return table


def _evaluate(args: EvaluateArguments) -> int:
    files = [args.problem, *args.solutions]
    folder = Path(args.out)
    names = [
        f"poses-{number}-{Path(strip_compression(path)).stem}.txt"
        for number, path in enumerate(files)
    ]
    names += ["evaluation.json", "poses-truth.txt"]
    read = {
        PROBLEM: [one for path in files for one in problem_files(path)],
        "the file of --poses": [args.poses],
    }
    check_apart({"--out": [folder / name for name in names]}, read)
    side = read_sidecar(args.problem)
    truth = (
        None
        if args.poses is None
        else poses_of(read_poses(args.poses), side.frames, side.calibration)
    )
    with common.notes_printed():
        results = evaluate.evaluate(files, side, truth)
    rows = [numbers for numbers, _ in results]
    contents = json.dumps({"frames": side.frames, "results": rows}, allow_nan=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / "evaluation.json", contents + "\n")
        for at, (numbers, poses) in enumerate(results):
            evaluate.write_poses(folder / f"poses-{at}-{numbers['name']}.txt", poses)
        if truth is not None:
            evaluate.write_poses(folder / "poses-truth.txt", truth)
    except OSError as error:
        raise common.UsageError(f"--out {args.out}: {error.strerror or error}") from None
    console = common.console()
    console.print(_evaluate_table(rows, truth))
    files_beside = common.counted(len(results) + (truth is not None), "file")
    console.print(f"wrote {folder / 'evaluation.json'} and {files_beside} beside it")
    return 0


def _evaluate_table(results: list[dict[str, Any]], truth: Any) -> Any:
    title = f"{results[0]['cameras']} key-frames"
    names: tuple[str, ...] = ()
    if truth is not None:
        title += f", {path_length(truth):.1f} m of path; after similarity alignment"
        names = (
            "ATE (m)",
            "largest (m)",
            "RPE (m)",
            "RPE (deg)",
            "segments (%)",
            "(deg/m)",
            "number",
        )
    table = _table(title, "file", "rms (px)", *names)
    for found in results:
        row = [found["name"], f"{found['rms_px']:.4f}"]
        if truth is not None:
            row += [f"{found['ate_m'][name]:.3f}" for name in ("rmse", "largest")]
            row += [
                f"{found[name]['rmse']:.4f}" for name in ("rpe_translation_m", "rpe_rotation_deg")
            ]
            if (segments := found["segments"]) is None:
                row += ["-"] * 3
            else:
                row += [
                    f"{segments['translation']:.3f}",
                    f"{segments['rotation']:.5f}",
                    str(segments["segments"]),
                ]
        table.add_row(*row)
    return table


def _table(title: str, first: str, *columns: str) -> Any:
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column(first, no_wrap=True)
    for name in columns:
        table.add_column(name, justify="right")
    return table
