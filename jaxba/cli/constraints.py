"""What `jaxba-solve` holds constant and knows besides the pixels, by options and by a YAML file."""

from __future__ import annotations

import re
from collections.abc import Container
from pathlib import Path
from typing import Any, get_args

import numpy as np

from jaxba.cli.common import UsageError
from jaxba.io.configurations import SettingsError, read_file
from jaxba.io.text import number
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.constraints import Gauge, hold, with_gauge
from jaxba.problem.labels import part_name
from jaxba.problem.losses import Loss
from jaxba.problem.measured import with_position_priors

PARTS = ("poses", "rotations", "points", "extrinsics", "frames", "frame-rotations")
"""What `--constant` names besides numbers of lenses."""

KEYS = {
    "constant_poses": "names or ids of images",
    "constant_rotations": "names or ids of images",
    "constant_points": "ids of points",
    "constant_cameras": "ids of cameras, which images share",
    "constant_extrinsics": "ids of cameras, whose places in their rigs do not move",
    "constant_numbers": "focal, principal_point, distortion or names such as k2",
    "position_priors": "positions: {name or id: [x, y, z]}, stddev, loss and loss_scale",
    "gauge": "free, two-cameras or three-points",
}
"""Keys of the file, and what they hold."""


def constrained(
    problem: BundleProblem, constant: tuple[str, ...], gauge: Gauge | None, file: str | None
) -> BundleProblem:
    """The problem with what the options and the file say.

    Raises:
        UsageError: something is not in the problem; one line that names the option or the key.
        ProblemError: as the functions of `jaxba` that do it.
    """
    settings = {} if file is None else _read(file)
    first = [key for key in settings if key == "position_priors"]  # the scene is aligned before anything is constant
    for key in first:
        problem = _applied(problem, file, key, settings.pop(key))
    try:
        numbers = [one.replace("-", "_") for one in constant if one not in PARTS]
        parts: dict[str, Any] = {part: "all" for part in PARTS[:4] if part in constant}
        for part, held in (("frames", "poses"), ("frame-rotations", "rotations")):
            if part in constant:
                parts.setdefault(held, _with_known_places(problem))
        problem = hold(problem, numbers=numbers, **parts)
    except ValueError as error:
        raise UsageError(f"--constant: {error}") from None
    in_file = settings.pop("gauge", "free")
    if in_file not in get_args(Gauge):
        raise UsageError(f"--constraints {file}: gauge: must be one of {', '.join(get_args(Gauge))}, not {in_file!r}")
    for key, value in settings.items():
        problem = _applied(problem, file, key, value)
    return with_gauge(problem, gauge or in_file)


def _with_known_places(problem: BundleProblem) -> np.ndarray:
    """One camera or more of every frame, whose pose is the frame's: its place in the rig is constant.

    Raises:
        ValueError: a frame has none.
    """
    rigs = problem.rigs
    if rigs is None or rigs.free is None:
        return np.ones(problem.num_cameras, bool)
    known = ~np.asarray(rigs.free)
    lost = np.setdiff1d(rigs.frame, np.asarray(rigs.frame)[known])
    if len(lost):
        first = int(np.flatnonzero(np.asarray(rigs.frame) == lost[0])[0])
        name = part_name(problem.labels, "image", first)
        raise ValueError(f"the frame of {name} has no image of a camera with a constant place in its rig")
    return known


def _applied(problem: BundleProblem, file: str | None, key: str, value: Any) -> BundleProblem:
    try:
        return _apply(problem, key, value)
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise UsageError(f"--constraints {file}: {key}: {what}") from None


def _read(file: str) -> dict[str, Any]:
    try:
        settings = read_file(Path(file), file, as_text=True)
    except SettingsError as error:
        raise UsageError(f"--constraints {error}") from None
    unknown = [key for key in settings if key not in KEYS]
    if unknown:
        raise UsageError(f"--constraints {file}: unknown key {unknown[0]!r}; there are {', '.join(KEYS)}")
    return settings


def _named(wanted: Any, names: Container[str] = ()) -> Any:
    """What a list of the file means: of each text a name if there is such a one, else an id or a position.

    Only the plain form of a number is one: `000010` and `0x10` are not, in contrast to YAML's rules. The word `all`
    alone is all; another word alone is a list of it.
    """
    if isinstance(wanted, str):
        return wanted if wanted == "all" else _named([wanted] if wanted else [], names)
    plain = lambda one: isinstance(one, str) and one not in names and re.fullmatch(r"0|[1-9]\d*", one, re.ASCII)
    return [int(one) if plain(one) else one for one in wanted]


def _numbers(value: Any) -> Any:
    """Numbers for the texts of a value. Raises ValueError."""
    return number(value) if isinstance(value, str) else [_numbers(one) for one in value]


def _apply(problem: BundleProblem, key: str, value: Any) -> BundleProblem:
    labels = problem.labels

    def images(wanted: Any) -> Any:
        found = _named(wanted, () if labels is None else frozenset(labels.names))
        return found if labels is None or found == "all" else labels.images_at(found)

    def ids(wanted: Any, at: str) -> Any:
        found = _named(wanted)
        return found if labels is None or found == "all" else getattr(labels, at)(found)

    if key == "constant_poses":
        return hold(problem, poses=images(value))
    if key == "constant_rotations":
        return hold(problem, rotations=images(value))
    if key == "constant_points":
        return hold(problem, points=ids(value, "points_at"))
    if key == "constant_cameras":
        return hold(problem, lenses=ids(value, "lenses_at"))
    if key == "constant_extrinsics":
        return hold(problem, extrinsics=ids(value, "lenses_at"))
    if key == "constant_numbers":
        return hold(problem, numbers=value)
    if key == "position_priors":
        unknown = [one for one in value if one not in ("positions", "stddev", "loss", "loss_scale")]
        if unknown:
            raise ValueError(f"unknown key {unknown[0]!r}; there are positions, stddev, loss and loss_scale")
        positions = value["positions"]
        spread = np.broadcast_to(np.asarray(_numbers(value.get("stddev", "1")), np.float64), 3)
        loss = Loss(value.get("loss", "squared"), _numbers(value.get("loss_scale", "1")))
        at = np.asarray(images(list(positions))).tolist()
        measured = [_numbers(one) for one in positions.values()]
        return with_position_priors(problem, measured, np.diag(spread**2), images=at, loss=loss)
    raise ValueError("unknown key")
