"""What `jaxba-solve` holds constant and knows besides the pixels, by options and by a YAML file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

from jaxba.cli.common import UsageError
from jaxba.cli.constraint_values import meant, parse_items, parse_mapping, parse_numbers
from jaxba.cli.measurements import MEASURED, with_measured
from jaxba.cli.survey import POSITIONS, with_control_points, with_positions
from jaxba.io.geodesy import Frame, projected
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.checks import shown
from jaxba.problem.gauge import Gauge, with_gauge
from jaxba.problem.hold import hold
from jaxba.problem.marks import Marks
from jaxba.problem.part import part
from jaxba.settings.configurations import SettingsError, read_file

PARTS = ("poses", "rotations", "points", "extrinsics", "frames", "frame-rotations")
"""What `--constant` names besides numbers of lenses."""

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


def constrained(
    problem: BundleProblem, constant: tuple[str, ...], gauge: Gauge | None, file: str | None, *, strict: bool = False
) -> BundleProblem:
    """`surveyed` of a problem without a file."""
    return surveyed(problem, constant, gauge, file, strict=strict)[0]


def surveyed(
    problem: BundleProblem,
    constant: tuple[str, ...],
    gauge: Gauge | None,
    file: str | None,
    *,
    strict: bool = False,
    path: str | None = None,
) -> tuple[BundleProblem, Marks | None]:
    """The problem with what the options and the file say, and the marks that it has got by that. `constant` is what
    `--constant` names, `gauge` what `--gauge` does, `file` a YAML file of constants and priors, and `path` that of the
    problem. `strict` refuses positions of images that are not in the problem, instead of leaving them out with a note.
    Raises UsageError: something is not in the problem; one line that names the option or the key. Raises ProblemError:
    as the functions of `jaxba` that do it."""
    settings = {} if file is None else _read(file)
    frame: Frame | None = None
    with _named(file, "crs"):
        if "crs" in settings:
            frame = projected(settings.pop("crs"))
    with _named(file, key := "position_priors"):
        if key in settings:  # the scene is aligned before anything is constant
            problem, frame = with_positions(problem, f"{file}: {key}", settings.pop(key), strict, frame)
    with _named(file, key := "control_points"):
        marks, value = None, settings.get(key)
        if isinstance(value, dict) and "file" in value:
            problem, marks = with_control_points(problem, f"{file}: {key}", settings.pop(key), strict, frame, path)
    try:
        problem = hold(problem, numbers=[one.replace("-", "_") for one in constant if one not in PARTS])
    except ValueError as error:
        raise UsageError(f"--constant: {error}; or {', '.join(PARTS)}") from None
    try:
        of_frames = {"frames": "poses", "frame-rotations": "rotations"}
        parts: dict[str, Any] = {of_frames[part]: "frames" for part in PARTS[4:] if part in constant}
        problem = hold(problem, **(parts | {part: "all" for part in PARTS[:4] if part in constant}))
    except ValueError as error:
        raise UsageError(f"--constant: {error}") from None
    in_file = settings.pop("gauge", "free")
    if in_file not in get_args(Gauge):
        raise UsageError(
            f"--constraints {file}: gauge: must be one of {', '.join(get_args(Gauge))}, not {shown(in_file)}"
        )
    for key, value in sorted(settings.items(), key=lambda item: item[0] != "part"):  # it says what is seen
        with _named(file, key):
            problem = _apply(problem, f"{file}: {key}", key, value, strict)
    return with_gauge(problem, gauge or in_file), marks


@contextmanager
def _named(file: str | None, key: str) -> Iterator[None]:
    """Errors of a key of the file begin with its name."""
    try:
        yield
    except ValueError as error:
        raise UsageError(f"--constraints {file}: {key}: {error}") from None


def _read(file: str) -> dict[str, Any]:
    try:
        settings = read_file(Path(file), file, as_text=True)
    except SettingsError as error:
        raise UsageError(f"--constraints {error}") from None
    unknown = [key for key in settings if key not in KEYS]
    if unknown:
        raise UsageError(f"--constraints {file}: unknown key {shown(unknown[0])}; there are {', '.join(KEYS)}")
    return settings


def _apply(problem: BundleProblem, where: str, key: str, value: Any, strict: bool) -> BundleProblem:
    if key in MEASURED:
        return with_measured(problem, where, key, value, strict)
    if key == "part":
        given = parse_mapping(value, (), tuple(OF_PART))
        chosen = {name: _wanted(problem, kind, given[name], name) for name, kind in OF_PART.items() if name in given}
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
        else meant(parse_items(value, what), labels.names if labels is not None and kind == "image" else ())
    )
    return items if labels is None or value == "all" else labels.positions(kind, items)
