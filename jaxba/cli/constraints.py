"""What `jaxba-solve` holds constant and knows besides the pixels, by options and by a YAML file."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from jaxba.cli.common import UsageError
from jaxba.constraints.file import ConstraintError, Survey, constrained
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.gauge import Gauge, with_gauge
from jaxba.problem.hold import hold

PARTS = ("poses", "rotations", "points", "extrinsics", "frames", "frame-rotations")
"""What `--constant` names besides numbers of lenses."""


def surveyed(
    problem: BundleProblem,
    constant: tuple[str, ...],
    gauge: Gauge | None,
    file: str | None,
    *,
    strict: bool = False,
    path: str | None = None,
) -> Survey:
    """The problem with what the options and the file say. `constant` is what `--constant` names,
    `gauge` what `--gauge` does, `file` that of `--constraints`, and `path` that of the problem.
    `strict` is as for `jaxba.survey`. Raises UsageError: something is not in the problem; one line
    that names the option or the key. Raises ProblemError: as the functions of `jaxba` that do
    it."""

    def held(one):
        return _held(one, constant)

    try:
        found, in_file = constrained(problem, file or {}, model=path, strict=strict, held=held)
    except ConstraintError as error:
        raise UsageError(f"--constraints {error}") from None
    return replace(found, problem=with_gauge(found.problem, gauge or in_file))


def _held(problem: BundleProblem, constant: tuple[str, ...]) -> BundleProblem:
    try:
        problem = hold(
            problem, numbers=[one.replace("-", "_") for one in constant if one not in PARTS]
        )
    except ValueError as error:
        raise UsageError(f"--constant: {error}; or {', '.join(PARTS)}") from None
    try:
        of_frames = {"frames": "poses", "frame-rotations": "rotations"}
        parts: dict[str, Any] = {
            of_frames[part]: "frames" for part in PARTS[4:] if part in constant
        }
        return hold(problem, **(parts | {part: "all" for part in PARTS[:4] if part in constant}))
    except ValueError as error:
        raise UsageError(f"--constant: {error}") from None
