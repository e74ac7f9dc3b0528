"""The formats of problems: endings, readers and writers, in one table that documents and errors
speak from."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePath

from jaxba.io.bal import check_bal_lenses, read_bal, write_bal
from jaxba.io.bundler import read_bundler, write_bundler
from jaxba.io.colmap import is_colmap, read_colmap
from jaxba.io.colmap.model import PARTS, RIG_PARTS
from jaxba.io.encoding import plain_text
from jaxba.io.files import StrPath, beginning, display_name, strip_compression
from jaxba.io.json_records import read_json
from jaxba.io.nerfstudio import check_transforms, write_transforms
from jaxba.io.opensfm import RECONSTRUCTION, TRACKS, from_document, recognises
from jaxba.io.ply import write_ply
from jaxba.problem.bundle_problem import BundleProblem, ProblemError

Reader = Callable[[StrPath], BundleProblem]
Writer = Callable[[BundleProblem, StrPath], None]


@dataclass(frozen=True)
class Format:
    """A format of single files."""

    name: str  # what messages call it
    # of its files, lower case, without compression; the first is the one to recommend
    endings: tuple[str, ...]
    read: Reader | None = None  # reader; None if it is only written
    write: Writer | None = None  # writer; None if it is only read
    check: Writer | None = None  # refuses, with ProblemError, lenses that cannot be written
    # first bytes after blanks, by which a file without a known ending is recognised
    begins: tuple[bytes, ...] = ()


def _read_json(path: StrPath) -> BundleProblem:
    """Reads OpenSfM's file; of another program it says what to give."""
    document = read_json(path)
    if recognises(document):
        return from_document(document, path)
    frames = document.value.get("frames") if isinstance(document.value, dict) else None
    if isinstance(frames, list) and any(
        isinstance(one, dict) and "transform_matrix" in one for one in frames
    ):
        document.fail(
            "is nerfstudio's transforms.json, which has poses but no points: give the COLMAP model "
            "it was made from"
        )
    document.fail(
        f"is JSON, but not OpenSfM's: have its program write a COLMAP model; {formats_read()}"
    )


TRANSFORMS = Format(
    "nerfstudio's cameras", (".json",), write=write_transforms, check=check_transforms
)

FORMATS = (
    Format("BAL", (".txt", ".bal"), read_bal, write_bal, check_bal_lenses),
    Format(
        "Bundler", (".out",), read_bundler, write_bundler, check_bal_lenses, (b"# Bundle file",)
    ),
    Format("OpenSfM", (".json",), _read_json, begins=(b"{", b"[")),
    Format("PLY", (".ply",), write=write_ply),
    TRANSFORMS,
)
"""Formats of files. The first is that of names whose ending says nothing. Folders are COLMAP
models, or OpenSfM's."""

OTHER_ENDINGS = (
    *(
        ".7z",
        ".abc",
        ".bin",
        ".csv",
        ".dae",
        ".db",
        ".fbx",
        ".g2o",
        ".glb",
        ".gltf",
        ".graph",
        ".h5",
        ".hdf5",
    ),
    *(
        ".html",
        ".ini",
        ".jpeg",
        ".jpg",
        ".kml",
        ".las",
        ".laz",
        ".log",
        ".mat",
        ".md",
        ".mvs",
        ".npy",
        ".npz",
        ".nvm",
    ),
    *(
        ".obj",
        ".pcd",
        ".pdf",
        ".pickle",
        ".pkl",
        ".png",
        ".psx",
        ".pt",
        ".py",
        ".rar",
        ".safetensors",
        ".sfm",
        ".sql",
    ),
    *(
        ".sqlite",
        ".stl",
        ".tar",
        ".tbz2",
        ".tgz",
        ".tif",
        ".toml",
        ".tsv",
        ".txz",
        ".usd",
        ".vtk",
        ".xml",
    ),
    *(".xyz", ".yaml", ".yml", ".z", ".zip", ".zst"),
)
"""Endings of what is neither read nor written, so that a name with one of them is a mistake."""

_SNIFFED = 1024  # bytes at the beginning of a file that tell its format

_ARCHIVE = "an archive: unpack it and give the problem in it"

_MAGIC = {
    **dict.fromkeys(
        (b"PK\x03\x04", b"7z\xbc\xaf\x27\x1c", b"Rar!", b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"),
        _ARCHIVE,
    ),
    b"SQLite format 3\0": "a COLMAP data base (SQLite), which holds no poses: give the folder that "
    "the mapper writes",
}
"""First bytes of files that are often given for a problem, and what they are."""

_COLMAP_COMMENTS = re.compile(rb"# (Camera|Image|3D point|Rig|Frame) list|# \w+ calib list")
"""First line of each text file of a COLMAP model."""

_UNPRINTABLE = re.compile(rb"[\0-\x08\x0e-\x1a\x1c-\x1f]")  # bytes that no text holds


def ending(path: StrPath) -> str:
    """The lower-case ending of a path without that of compression; empty if it has none."""
    return PurePath(strip_compression(path)).suffix.lower()


def by_ending(path: StrPath, *, written: bool = False) -> Format | None:
    """The format that a name's ending stands for; the one that is `written`, or else the first."""
    return next(
        (one for one in FORMATS if ending(path) in one.endings and (one.write or not written)), None
    )


def is_file_name(path: StrPath) -> bool:
    """Whether a name has an ending that says what a file is, or how it is compressed: it is no
    folder's."""
    known = by_ending(path) is not None or ending(path) in OTHER_ENDINGS
    return known or strip_compression(path) != str(path)


def formats_read() -> str:
    """The formats that are read, as part of a message."""
    shown = ", ".join(
        f"{one.name} ({', '.join(one.endings)})" for one in FORMATS if one.read is not None
    )
    return f"read are {shown}, and folders of COLMAP or OpenSfM"


def formats_written() -> str:
    """The endings that are written, as part of a message."""
    shown = ", ".join(
        f"{', '.join(one.endings)} ({one.name})" for one in FORMATS if one.write is not None
    )
    return f"written are {shown}, each also with .gz, .bz2 or .xz"


def read(path: StrPath) -> BundleProblem:
    """Reads a file in the format of its ending, or else of its first bytes; a folder as OpenSfM's
    or a COLMAP model. Raises ProblemError: it cannot be read; one line. Of a file of another
    program it says what that is."""
    if Path(path).is_dir():
        reconstruction = Path(path) / RECONSTRUCTION
        return (
            _read_json(reconstruction)
            if reconstruction.is_file() and not is_colmap(path)
            else read_colmap(path)
        )
    known = by_ending(path)
    if known is not None and known.read is None:
        raise ProblemError(
            f"cannot read {display_name(path)}: {known.name} is only written; {formats_read()}"
        )
    begin = _beginning(path)
    found = next(
        (one for one in FORMATS if one.begins and begin.lstrip().startswith(one.begins)), None
    )
    if found is not None and known in (None, FORMATS[0]):
        known = found
    elif begin and (what := recognised(path, begin)):
        raise ProblemError(
            f"{display_name(path)}: is {what}{'' if ': ' in what else f'; {formats_read()}'}"
        )
    try:
        return known.read(path) if known is not None and known.read is not None else read_bal(path)
    except ProblemError as error:
        if known is None and ending(path) in OTHER_ENDINGS:
            raise ProblemError(
                f"{error}; files with {ending(path)} are not read; {formats_read()}"
            ) from error
        # no number, as BAL begins
        if known in (None, FORMATS[0]) and re.match(rb"\s*[^\s\d+.-]", begin):
            raise ProblemError(f"{error}; {formats_read()}") from error
        raise


def recognised(path: StrPath, begin: bytes) -> str | None:
    """What an unread file is, by name and first bytes, as part of a message; None if it may be of a
    format here."""
    place = Path(path)
    beside = any(
        (place.parent / f"{part}{place.suffix}").is_file()
        for part in (*PARTS, *RIG_PARTS)
        if part != place.stem
    )
    if place.stem in (*PARTS, *RIG_PARTS) and (
        place.suffix == ".bin" or (place.suffix == ".txt" and beside)
    ):
        return (
            f"a file of a COLMAP model: give the folder that holds it, {display_name(place.parent)}"
        )
    if _COLMAP_COMMENTS.match(begin):
        return "a file of a COLMAP model: give the folder of the model"
    if begin[257:].startswith(b"ustar"):  # of a tar archive, whose compression is undone by then
        return _ARCHIVE
    known = next((what for magic, what in _MAGIC.items() if begin.startswith(magic)), None)
    return known or (
        "a binary file of no format that is known here" if _UNPRINTABLE.search(begin) else None
    )


def writer(path: StrPath) -> Writer:
    """What writes a file of a name. Raises ProblemError: a format that is not written; names those
    that are."""
    known = by_ending(path, written=True)
    write = (
        FORMATS[0].write
        if known is None and ending(path) not in OTHER_ENDINGS
        else known and known.write
    )
    if write is None:
        name = display_name(path)
        raise ProblemError(
            f"cannot write {name}: files with {ending(path)} are not written; {formats_written()}"
        )
    return write


def holds_problem(path: StrPath) -> bool:
    """Whether a path is a folder that holds a problem."""
    return is_colmap(path) or (Path(path) / RECONSTRUCTION).is_file()


def files_of(path: StrPath) -> list[StrPath]:
    """The files that a problem of this path is read from, or would be if they were there.

    A folder has those of a COLMAP model and of OpenSfM, whose tracks also lie beside a `.json`
    file."""
    folder = Path(path)
    if not folder.is_dir():
        beside = [folder.with_name(name) for name in TRACKS] if ending(path) == ".json" else []
        return [path, *beside]
    return [*model_files(path), *(folder / name for name in (RECONSTRUCTION, *TRACKS))]


def model_files(folder: StrPath) -> list[Path]:
    """The files that a COLMAP model in a folder may have."""
    return [
        Path(folder) / f"{part}{suffix}"
        for part in (*PARTS, *RIG_PARTS)
        for suffix in (".bin", ".txt")
    ]


def _beginning(path: StrPath) -> bytes:
    """First bytes of the text of a regular file; empty if they cannot be read."""
    try:
        return plain_text(beginning(path, _SNIFFED))
    except UnicodeError:
        return b""
