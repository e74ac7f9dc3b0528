"""No command writes over what it reads: every output is held against every input and the other
outputs, by identity."""

from __future__ import annotations

import os
import stat
from collections.abc import Hashable, Iterable, Mapping
from pathlib import Path

from jaxba.cli.common import UsageError
from jaxba.io.files import StrPath, display_name, sidecar_path, stream_number
from jaxba.io.formats import files_of

PROBLEM = "a file of the problem"  # what a message calls a file of a problem that is read


def check_apart(
    written: Mapping[str, Iterable[StrPath | None]], read: Mapping[str, Iterable[StrPath | None]]
) -> None:
    """Checks that no output is a file that is read, or another output, also by a link or another
    spelling. Outputs are given by the option that names them, None for no file; inputs by what they
    are for messages, such as `the file of --constraints`. Raises UsageError: one is; one line."""
    inputs = {_identity(path): what for what, paths in read.items() for path in paths if path}
    outputs: dict[Hashable, str] = {}
    for option, paths in written.items():
        new: dict[Hashable, str] = {}
        for path in paths:
            one = _identity(path) if path else None
            if one is None:
                continue
            if one in inputs:
                raise UsageError(
                    f"{option} {display_name(str(path))}: is {inputs[one]}, and would be replaced"
                )
            if one in outputs:
                raise UsageError(
                    f"{outputs[one]} and {option} name the same file, {display_name(str(path))}"
                )
            new[one] = option
        outputs |= new


def problem_files(path: str | None) -> list[StrPath]:
    """The files that a problem is read from, and the frames that `jaxba-kitti` has written beside
    one."""
    return [] if path is None else [*files_of(path), sidecar_path(path)]


def policy_file(policy: str) -> str | None:
    """The file of a policy's name, perhaps with its refinement; None if it names none."""
    from jaxba.damping.registry import file_of
    from jaxba.solver.names import split_refinement

    return file_of(split_refinement(policy)[0])


def _identity(path: StrPath) -> Hashable:
    """What all names of a file share; of another stream of this process its number, None for a
    device or a folder."""
    number = stream_number(path)
    try:
        found = os.stat(path) if number is None else os.fstat(number)
        return (found.st_dev, found.st_ino) if stat.S_ISREG(found.st_mode) else number
    except (OSError, ValueError):  # not there yet
        target = Path(os.path.realpath(path))
        try:
            folder = os.stat(target.parent)
        except OSError:
            return str(target)
        return folder.st_dev, folder.st_ino, target.name
