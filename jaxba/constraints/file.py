"""What is constant and known besides the pixels, by a YAML file or a mapping: `survey`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from jaxba.constraints.control_points import with_control_points
from jaxba.constraints.measurements import MEASURED, with_measured
from jaxba.constraints.report import Report, report
from jaxba.constraints.surveys import POSITIONS, with_positions
from jaxba.constraints.values import meant, parse_items, parse_mapping, parse_numbers
from jaxba.io.files import StrPath
from jaxba.io.geodesy import Frame, projected
from jaxba.io.notes import report as note
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.checks import shown
from jaxba.problem.gauge import Gauge, with_gauge
from jaxba.problem.hold import hold
from jaxba.problem.marks import Marks
from jaxba.problem.part import part
from jaxba.settings.configurations import SettingsError, read_file
from jaxba.solver.solve import Solution
from jaxba.typing import ArrayRecord

KEYS = {
    "constant_poses": "names or ids of images",
    "constant_rotations": "names or ids of images",
    "constant_points": "ids of points",
    "constant_cameras": "ids of cameras, which images share",
    "constant_extrinsics": "ids of cameras, whose places in their rigs do not move",
    "constant_numbers": "focal, principal_point, distortion or names such as k2",
    "crs": "projected coordinate system that the scene gets",
    "position_priors": POSITIONS,
    **MEASURED,
    "part": "images, points, ignored and min_track of jaxba.part",
    "gauge": "free, two-cameras or three-points",
}
"""Keys of the file, and what they hold."""

OF_PART = {"images": "image", "points": "point", "ignored": "point", "min_track": None}
"""Keys of `part`, and of what kind the items of their lists are; None for a number."""


Constraints = StrPath | Mapping[str, Any]
"""A YAML file, or a mapping with its keys."""


class ConstraintError(ProblemError):
    """Constraints that cannot be used. The message is one line that begins with their file and
    key."""


@dataclass(frozen=True, eq=False, repr=False)
class Survey(ArrayRecord):
    """A problem with what was measured and what is constant."""

    problem: BundleProblem
    """What is to be solved. The marks of a file of control points are its last points."""

    marks: Marks | None = None
    """These marks."""

    def report(self, solution: Solution) -> Report:
        """What a solve of the problem made of control points, check points and distances, and what
        does not fit."""
        problem = solution.problem
        gone = solution.rejected
        return report(
            problem if gone is None else problem.subset(~gone), self.marks, solution.notes
        )

    def without_marks(self, solution: Solution) -> Solution:
        """A solution of the problem as of one without marks, such as is written."""
        if self.marks is None:
            return solution
        own = np.asarray(solution.problem.point_index) < solution.problem.num_points - len(
            self.marks.names
        )
        rejected = None if solution.rejected is None else solution.rejected[own]
        return replace(solution, problem=self.marks.without(solution.problem), rejected=rejected)


def survey(
    problem: BundleProblem,
    constraints: Constraints,
    *,
    model: StrPath | None = None,
    strict: bool = False,
) -> Survey:
    """The problem with what a survey and other constraints say of it, as `jaxba-solve
    --constraints` has them.

    Args:
        problem: any problem; of a COLMAP model, images have names, and all parts have ids.
        constraints: a YAML file, or a mapping with its keys (how-to "Surveys" and "Constants and
            priors"). Files that it names lie beside it, those of a mapping in the current folder.
        model: the COLMAP model that the problem was read from, which a file of control points
            needs.
        strict: refuse what is not in the problem, instead of leaving it out with a
            `ProblemWarning`.

    Raises ProblemError: something is not in the problem, or not what its key takes; one line with
        file and key."""
    found, gauge = constrained(problem, constraints, model=model, strict=strict)
    return replace(found, problem=with_gauge(found.problem, gauge))


def constrained(
    problem: BundleProblem,
    constraints: Constraints,
    *,
    model: StrPath | None,
    strict: bool,
    held: Callable[[BundleProblem], BundleProblem] = lambda problem: problem,
) -> tuple[Survey, Gauge]:
    """`survey` without a gauge, and the gauge. `held` says what else is constant in the problem,
    once it is aligned."""
    given = isinstance(constraints, Mapping)
    file = "constraints" if given else str(constraints)
    try:
        settings = _as_text(constraints) if given else read_file(Path(file), file, as_text=True)
    except SettingsError as error:
        raise ConstraintError(str(error)) from None
    if unknown := [key for key in settings if key not in KEYS]:
        raise ConstraintError(
            f"{file}: unknown key {shown(unknown[0])}; there are {', '.join(KEYS)}"
        )
    frame: Frame | None = None
    with _named(file, "crs"):
        if "crs" in settings:
            frame = projected(settings.pop("crs"))
    with _named(file, key := "position_priors"):
        if key in settings:  # the scene is aligned before anything is constant
            problem, frame = with_positions(
                problem, f"{file}: {key}", settings.pop(key), strict, frame
            )
    with _named(file, key := "control_points"):
        marks = None
        value = settings.get(key)
        if isinstance(value, dict) and "file" in value:
            problem, marks = with_control_points(
                problem, f"{file}: {key}", settings.pop(key), strict, frame, model
            )
    if frame is not None and frame.crs and marks is None and not problem.residuals:
        note(
            [
                f"{file}: crs: nothing moves the scene there: it needs position_priors or a file "
                "of control_points"
            ]
        )
    problem = held(problem)
    with _named(file, "gauge"):
        gauge = settings.pop("gauge", "free")
        if gauge not in get_args(Gauge):
            raise ValueError(f"must be one of {', '.join(get_args(Gauge))}, not {shown(gauge)}")
    # it says what is seen
    for key, value in sorted(settings.items(), key=lambda item: item[0] != "part"):
        with _named(file, key):
            problem = _apply(problem, f"{file}: {key}", key, value, strict, model)
    return Survey(problem, marks), gauge


@contextmanager
def _named(file: str, key: str) -> Iterator[None]:
    """Errors of a key of the file begin with its name."""
    try:
        yield
    except ValueError as error:
        raise ConstraintError(f"{file}: {key}: {error}") from None


def _as_text(value: Any) -> Any:
    """A value as a file would have it, whose scalars are text."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Mapping):
        return {str(key): _as_text(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_text(item) for item in value]
    return "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _apply(
    problem: BundleProblem, where: str, key: str, value: Any, strict: bool, model: StrPath | None
) -> BundleProblem:
    if key in MEASURED:
        return with_measured(problem, where, key, value, strict, model)
    if key == "part":
        given = parse_mapping(value, (), tuple(OF_PART))
        chosen = {
            name: _wanted(problem, kind, given[name], name)
            for name, kind in OF_PART.items()
            if name in given
        }
        return part(problem, **chosen)
    if key == "constant_numbers":
        return hold(problem, numbers=parse_items(value, KEYS[key]))
    held = {"constant_cameras": "lenses"}.get(key, key.removeprefix("constant_"))
    kind = {"poses": "image", "rotations": "image", "points": "point"}.get(held, "lens")
    frames = kind == "image" and value == "frames"
    return hold(problem, **{held: value if frames else _wanted(problem, kind, value, KEYS[key])})


def _wanted(problem: BundleProblem, kind: Any, value: Any, what: str) -> Any:
    """What of a kind a key means, as functions of problems take it."""
    if kind is None:
        return int(parse_numbers(what, value, "a whole number", ()))
    labels = problem.labels
    items = (
        value
        if value == "all"
        else meant(
            parse_items(value, what), labels.names if labels is not None and kind == "image" else ()
        )
    )
    return items if labels is None or value == "all" else labels.positions(kind, items)
