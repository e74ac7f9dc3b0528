"""The files of COLMAP models: which a folder has, reading them, and writing them whole or not at
all."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from jaxba.io.colmap import binary, text
from jaxba.io.colmap.model import PARTS, RIG_PARTS, Model, check_model, file_name
from jaxba.io.files import StrPath, display_name, reason
from jaxba.problem.bundle_problem import ProblemError

_FORMS: dict[str, Any] = {".bin": binary, ".txt": text}


def is_colmap(path: StrPath) -> bool:
    """Whether a path is a folder that holds a COLMAP model."""
    return any((Path(path) / f"cameras{suffix}").is_file() for suffix in _FORMS)


def read_model(folder: StrPath) -> Model:
    """Reads the files of a model, the binary ones where there are both, and checks its structure.
    Raises ProblemError: a file is missing, cannot be read or understood, or `check_model` refuses
    the model; one line that names the file."""
    if not is_colmap(folder):
        raise ProblemError(
            f"{display_name(folder)}: no directory with a COLMAP model (cameras.bin or cameras.txt)"
        )
    whole = [suffix for suffix in _FORMS if has_parts(folder, suffix)]
    suffix = (
        whole[0] if whole else next(s for s in _FORMS if (Path(folder) / f"cameras{s}").is_file())
    )
    here = [
        part for part in (*PARTS, *RIG_PARTS) if os.path.lexists(Path(folder) / (part + suffix))
    ]
    for part in PARTS if set(here).isdisjoint(RIG_PARTS) else (*PARTS, *RIG_PARTS):
        if part not in here:
            raise ProblemError(f"{file_name(os.fspath(folder), part + suffix)} is missing")
    try:
        content = {part: _read(folder, part, suffix) for part in here}
        cameras, images, points = (content[part] for part in PARTS)
        model = Model(
            os.fspath(folder), suffix, cameras, images, *points, *map(content.get, RIG_PARTS)
        )
        check_model(model)
    except MemoryError:
        raise ProblemError(f"cannot read {display_name(folder)}: not enough memory") from None
    return model


def has_parts(folder: StrPath, suffix: str) -> bool:
    """Whether a folder has all files of a model in a form; COLMAP reads the binary ones if it has
    them."""
    return all((Path(folder) / (part + suffix)).is_file() for part in PARTS)


def _read(folder: StrPath, part: str, suffix: str) -> Any:
    path = Path(folder) / (part + suffix)
    name = file_name(os.fspath(folder), path.name)
    if path.exists() and not path.is_file():  # reading a pipe could wait for ever
        raise ProblemError(f"{name} is no file")
    return _FORMS[suffix].read(part, path, name)


def write_model(model: Model, folder: StrPath, suffix: str) -> None:
    """Writes the files of a model with rigs and frames, `.bin` or `.txt` by the suffix, and both
    where the folder has the other ones, too, which some programs read first: all to a hidden
    folder, then each replaces the old one. It may not exist yet. Raises ProblemError: the folder
    cannot be written."""
    target = Path(folder)
    forms = [form for form in _FORMS if form == suffix or has_parts(folder, form)]
    # writable, and on the same file system
    beside = target if target.is_dir() else target.absolute().parent
    try:
        with tempfile.TemporaryDirectory(dir=beside, prefix=".jaxba-") as temporary:
            for name, content in (file for form in forms for file in _FORMS[form].encode(model)):
                with (Path(temporary) / name).open("wb") as stream:
                    stream.writelines(content)
            target.mkdir(exist_ok=True)
            for file in sorted(Path(temporary).iterdir()):
                place = os.path.realpath(target / file.name)
                if os.path.exists(place):
                    shutil.copymode(place, file)
                os.replace(file, place)
    except (OSError, ValueError, MemoryError) as error:  # ValueError: a name with NUL
        raise ProblemError(f"cannot write {display_name(folder)}: {reason(error)}") from error
