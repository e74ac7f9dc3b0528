"""Random surveys with one gross error each: is it said, and by its name? And clean ones, of which
nothing should be.

    python -m benchmarks.survey_errors [--surveys 100] [--clean 100] [--kinds typo,click] [--seed 0]
    [--command 10]

Each survey is written as files (`benchmarks/survey_scenes.py`), read by `jaxba.survey` and solved
by `jaxba.solve`; every tenth goes through `jaxba-solve`. An error is found if there is an error, a
note or one of `Solution.notes`, and named if that has the name of the row which is wrong, or of a
whole table its key, or what its columns are. A table of other units or with its columns swapped may
be read as meant, too, so that cameras are where they are without it."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

import jaxba
from benchmarks.survey_scenes import (
    CHECKS,
    CONTROLS,
    SHAPES,
    Survey,
    depth_maps,
    draw,
    on_earth,
    write,
)
from jaxba.problem import geometry

Rng = np.random.Generator
Words = tuple[str, ...]

FEET = 3937 / 1200  # US survey feet in a metre

INFORMATION = (r"the scene is in ",)
"""Notes that say what was done, not that something is wrong."""

MARKS = ("control_point", "control point", "marks", "gcp")
LOG = ("position_prior", "positions of", "measured position")
DEPTHS = ("depth", r"\bmaps?\b")
AXES = ("mirrored", "axes", "swapped", "latitude", "longitude")
HEIGHTS = (*MARKS, *LOG, "height")
"""Patterns of what names a table."""


@dataclass(frozen=True)
class Outcome:
    """What was said of a survey."""

    notes: tuple[str, ...]
    # RMS distance of camera centres from the truth, metres; NaN where it was refused or not
    # georeferenced
    away: float
    limit: float  # what it may be without an error

    mended: bool = False  # whether the survey was read as meant

    @property
    def said(self) -> bool:
        return bool(self.notes) or self.mended

    def names(self, words: Words) -> bool:
        return any(re.search(word, note, re.IGNORECASE) for word in words for note in self.notes)


def half_marks(survey: Survey, rng: Rng) -> Words:
    survey.mark_pixels = survey.mark_pixels / rng.choice([2, 4])
    return MARKS


def typo(survey: Survey, rng: Rng) -> Words:
    mark = rng.integers(CONTROLS)
    axis = rng.integers(3)
    survey.marks[mark, axis] += rng.choice([-1, 1]) * rng.choice([1.0, 2.0, 5.0, 10.0, 20.0])
    return (rf"\b{survey.mark_names[mark]}\b",)


def click(survey: Survey, rng: Rng) -> Words:
    mark = rng.integers(CONTROLS)
    view = rng.integers(survey.mark_seen.shape[1])
    angle = rng.uniform(0, 2 * np.pi)
    survey.mark_pixels[mark, view] += rng.uniform(10, 60) * np.array([np.cos(angle), np.sin(angle)])
    return (rf"\b{survey.mark_names[mark]}\b",)


def swapped(survey: Survey, rng: Rng) -> Words:
    if len(survey.log) and (not len(survey.marks) or rng.random() < 0.5):
        survey.log = on_earth(survey, survey.centres, survey.crs)[:, [1, 0, 2]]
        survey.log_header = "image,x,y,z"
        return (*AXES, *LOG)
    survey.marks = survey.marks[:, [1, 0, 2]]
    return (*AXES, *MARKS)


def degrees(survey: Survey, rng: Rng) -> Words:
    if len(survey.log) and (not len(survey.marks) or rng.random() < 0.5):
        survey.log = on_earth(survey, survey.centres, "EPSG:4326")
        survey.log_header = "image,latitude,longitude,altitude"
        return (*AXES, *LOG)
    survey.marks = _converted(survey, survey.crs, "EPSG:4326")[:, [1, 0, 2]]
    survey.mark_system = "EPSG:4326"
    return (*AXES, *MARKS)


def heights(survey: Survey, rng: Rng) -> Words:
    shift = rng.choice([-1, 1]) * rng.uniform(20, 60)
    if not len(survey.marks):
        first = rng.integers(len(survey.log) - 4)
        count = rng.integers(3, 5)
        survey.log[first : first + count, 2] += shift
        return tuple(rf"\b{name}\b" for name in survey.names[first : first + count])
    if not len(survey.log) or rng.random() < 0.3:
        survey.marks[: rng.integers(1, 3), 2] += shift
    else:
        survey.marks[:, 2] += shift
    return HEIGHTS


def no_fix(survey: Survey, rng: Rng) -> Words:
    images = rng.choice(len(survey.names), rng.integers(1, 4), replace=False)
    survey.log[images] = 0.0
    return (*(rf"\b{survey.names[image]}\b" for image in images), "0, 0")


def disparity(survey: Survey, rng: Rng) -> Words:
    scale = rng.uniform(1, 100)
    shift = rng.choice([0.0, 0.2])
    survey.maps = depth_maps(survey, survey.size, lambda depth: scale / depth + shift, rng)
    return DEPTHS


def outside(survey: Survey, rng: Rng) -> Words:
    if survey.maps:
        change = rng.choice(["side", "cut", "square"])
        if change == "side":
            survey.maps = [np.rot90(depths).copy() for depths in survey.maps]
        elif change == "cut":
            survey.maps = [depths[:, : depths.shape[1] // 2].copy() for depths in survey.maps]
        else:
            side = int(rng.integers(200, 520))
            survey.maps = depth_maps(survey, (side, side), lambda depth: depth, rng)
        return DEPTHS
    if rng.random() < 0.5:
        survey.mark_pixels = survey.mark_pixels * 2
        return MARKS
    mark = rng.integers(CONTROLS)
    view = rng.integers(survey.mark_seen.shape[1])
    survey.mark_pixels[mark, view, 0] += survey.size[0]  # a digit too much
    return (rf"\b{survey.mark_names[mark]}\b",)


def units(survey: Survey, rng: Rng) -> Words:
    if len(survey.log):  # heights of one table in feet
        if rng.random() < 0.5:
            survey.log[:, 2] *= FEET
        else:
            survey.marks[:, 2] *= FEET
        return HEIGHTS
    kept = [0, 1, 2, *(range(CONTROLS, CONTROLS + CHECKS) if rng.random() < 0.5 else ())]
    survey.mark_names = [survey.mark_names[mark] for mark in kept]
    survey.checks = survey.mark_names[3:]
    survey.marks = survey.marks[kept]
    survey.mark_seen = survey.mark_seen[kept]
    survey.mark_pixels = survey.mark_pixels[kept]
    # mirrored along their normal, three points are in the same plane
    level = survey.shape != "facade"
    survey.marks = survey.marks[:, [1, 0, 2]] if level else survey.marks * [1, 1, -1]
    return (*AXES, *MARKS, "upside")


KINDS: dict[str, tuple[Callable[[Survey, Rng], Words], Words]] = {
    "half": (half_marks, ("block marks", "block log marks", "strip log marks", "facade marks")),
    "typo": (typo, ("block marks", "block log marks", "strip log marks", "facade marks")),
    "click": (click, ("block marks", "block log marks", "strip log marks", "facade marks")),
    "swapped": (swapped, ("block log", "block marks", "block log marks", "facade marks")),
    "degrees": (degrees, ("block log", "block marks", "block log marks")),
    "heights": (heights, ("block log", "block marks", "block log marks", "strip log marks")),
    "no-fix": (no_fix, ("block log", "block log marks", "room log depths")),
    "disparity": (disparity, ("room log depths",)),
    "outside": (
        outside,
        ("block marks", "strip log marks", "facade marks", "room log depths", "room log depths"),
    ),
    "units": (units, ("block log marks", "block marks", "facade marks")),
}
"""Gross errors: what makes one and says how it is named, and the shapes and contents of surveys
that have them."""


READ = ("degrees", "units")  # kinds of errors that a reader may mend


def _converted(survey: Survey, source: str, target: str) -> np.ndarray:
    import pyproj

    found = pyproj.Transformer.from_crs(
        pyproj.CRS(source).to_3d(), pyproj.CRS(target).to_3d(), always_xy=True
    ).transform(*survey.marks.T)
    return np.stack(found, axis=1)


def looked_at(survey: Survey, command: bool) -> Outcome:
    """Writes a survey and solves it, by the command or by the functions."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = write(survey, folder)
        if command:
            notes, centres = _by_command(folder, file)
        else:
            notes, centres = _by_functions(folder, file)
    away = np.nan
    if centres is not None:
        truth = survey.centres if survey.local else on_earth(survey, survey.centres, survey.crs)
        away = float(np.sqrt(np.mean(np.sum((centres - truth) ** 2, axis=1))))
    real = [note for note in notes if not any(re.search(word, note) for word in INFORMATION)]
    size = float(np.ptp(survey.centres))
    return Outcome(tuple(real), away, 0.002 * size + 3 * survey.log_stddev)


def _by_functions(folder: Path, file: Path) -> tuple[list[str], np.ndarray | None]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            survey = jaxba.survey(jaxba.read_colmap(folder / "model"), file, model=folder / "model")
            solution = jaxba.solve(survey.problem)
        except jaxba.ProblemError as error:
            return [f"error: {error}", *(str(one.message) for one in caught)], None
    notes = [str(one.message) for one in caught]
    notes += [str(note) for note in getattr(solution, "notes", ())]
    return notes, geometry.camera_centers(solution.problem.cameras)


def _by_command(folder: Path, file: Path) -> tuple[list[str], np.ndarray | None]:
    from jaxba.cli.solve import run

    said = io.StringIO()
    options = ["--constraints", str(file), "--output", str(folder / "out")]
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        status = run([str(folder / "model"), *options])
    notes = [
        line
        for line in said.getvalue().splitlines()
        if re.match(r"(jaxba-solve: )?(note|error|warning)", line)
    ]
    if status:
        return [*notes, f"error: {said.getvalue().strip().splitlines()[-1]}"], None
    return notes, geometry.camera_centers(jaxba.read_colmap(folder / "out").cameras)


def surveys_of(kinds: Sequence[str], count: int, seed: int) -> list[tuple[str, Survey, Words]]:
    """Surveys with an error of each kind in turn, with how it is named."""
    found = []
    for number in range(count):
        kind = kinds[number % len(kinds)]
        rng = np.random.default_rng([seed, number, len(kind)])
        damage, contents = KINDS[kind]
        shape, _, content = str(rng.choice(contents)).partition(" ")
        survey = draw(shape, content, 100_000 * seed + number)
        found.append((kind, survey, damage(survey, rng)))
    return found


def clean_surveys(count: int, seed: int) -> list[Survey]:
    """Surveys without an error, of every shape and content in turn."""
    every = [(shape, content) for shape, kind in SHAPES.items() for content in kind.contents]
    return [
        draw(*every[number % len(every)], 100_000 * seed + 50_000 + number)
        for number in range(count)
    ]


def table(
    kinds: Sequence[str], results: dict[str, list[tuple[Outcome, bool]]], clean: list[Outcome]
) -> str:
    """Lines of kinds, surveys, what was said and named, and where cameras are."""
    lines = [f"{'kind':10} surveys  said  named  cameras off, metres: median, largest"]
    for kind in kinds:
        found = results[kind]
        lines.append(
            f"{kind:10} {_line([one for one, _ in found], sum(named for _, named in found))}"
        )
    every = [pair for kind in kinds for pair in results[kind]]
    if every:
        lines.append(
            f"{'all':10} {_line([one for one, _ in every], sum(named for _, named in every))}"
        )
    if clean:
        lines.append(f"{'clean':10} {_line(clean, 0)}")
    return "\n".join(lines)


def _line(found: list[Outcome], named: int) -> str:
    away = [one.away for one in found if np.isfinite(one.away)]
    off = f"{np.median(away):.3g}, {np.max(away):.3g}" if away else "refused"
    said = sum(one.said for one in found)
    return f"{len(found):7} {said:5} {named:6}  {off}"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark. Exit status 1 if under 95 percent are named, or over 1 percent of clean
    ones have a note."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--surveys", type=int, default=100, help="with an error")
    parser.add_argument("--clean", type=int, default=100, help="without one")
    parser.add_argument("--kinds", default=",".join(KINDS), help="of errors, between commas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--command",
        type=int,
        default=10,
        help="every which survey goes through jaxba-solve; 0: none",
    )
    parser.add_argument("--verbose", action="store_true", help="print what is said of every survey")
    args = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    kinds = args.kinds.split(",")
    began = time.perf_counter()
    results: dict[str, list[tuple[Outcome, bool]]] = {kind: [] for kind in kinds}
    clean = []
    for number, (kind, survey, words) in enumerate(surveys_of(kinds, args.surveys, args.seed)):
        outcome = looked_at(
            survey, bool(args.command) and number % args.command == args.command - 1
        )
        outcome = replace(outcome, mended=kind in READ and outcome.away < outcome.limit)
        named = outcome.names(words) or outcome.mended
        results[kind].append((outcome, named))
        if args.verbose or not named:
            _print(f"{kind} {'named' if named else 'NOT NAMED'} in {survey.heading}", outcome)
    for number, survey in enumerate(clean_surveys(args.clean, args.seed)):
        outcome = looked_at(
            survey, bool(args.command) and number % args.command == args.command - 1
        )
        clean.append(outcome)
        if args.verbose or outcome.said:
            _print(f"clean {'NOTED' if outcome.said else 'quiet'}: {survey.heading}", outcome)
    print(table(kinds, results, clean))
    print(f"{time.perf_counter() - began:.0f} s")
    named = sum(named for found in results.values() for _, named in found)
    noted = sum(one.said for one in clean)
    return int(named < 0.95 * args.surveys or noted > 0.01 * args.clean)


def _print(heading: str, outcome: Outcome) -> None:
    print(f"{heading}: cameras {outcome.away:.3g} m off, may be {outcome.limit:.3g}")
    for note in outcome.notes:
        print(f"    {note}")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
