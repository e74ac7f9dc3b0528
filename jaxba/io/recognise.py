"""What a file is that no reader could read, and what to give instead: by its first bytes, or else by its name."""

from __future__ import annotations

import re
from pathlib import Path

from jaxba.io.colmap.model import PARTS, RIG_PARTS
from jaxba.io.files import StrPath, display_name

_ARCHIVE = "an archive: unpack it and give the problem in it"
_IMAGE = "an image: give the problem that was made from the images"
_DATABASE = "a COLMAP data base (SQLite), which holds no poses: give the folder of the model that the mapper writes"
_PAGE = "an HTML page: perhaps a link was saved in the place of the file behind it"
_POSES = "a file of poses, as KITTI has them, without points: give the problem, and these to jaxba-kitti by --poses"
_ARRAYS = "a file of NumPy arrays, perhaps a recording of a solve, which jaxba-view shows: give the problem"
_LFS = "a pointer of Git LFS, not the file that it stands for: fetch that with git lfs pull"

MAGIC = {
    b"SQLite format 3\0": _DATABASE,
    **dict.fromkeys((b"7z\xbc\xaf\x27\x1c", b"Rar!", b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"), _ARCHIVE),
    **dict.fromkeys((b"\x89PNG", b"\xff\xd8\xff", b"GIF8", b"II*\0", b"MM\0*", b"RIFF", b"P5\n", b"P6\n"), _IMAGE),
    b"ply\n": "a point cloud, which has no observations of its points",
    b"version https://git-lfs": _LFS,
}
"""First bytes of files of other programs, and what they are."""

_COLMAP_COMMENTS = re.compile(rb"# (Camera|Image|3D point|Rig|Frame) list|# \w+ calib list")
"""First line of each text file of a COLMAP model."""

_TAR_AT = 257
"""Where the word `ustar` stands in a tar archive, whose compression is undone by then. Source: POSIX, pax format."""

_POSE_WIDTHS = (12, 13)
"""Numbers on every line of a file of poses: 3 x 4 matrices, perhaps behind the number of the frame."""

_UNPRINTABLE = re.compile(rb"[\0-\x08\x0e-\x1a\x1c-\x1f]")
"""Bytes that no text holds."""


def recognised(path: StrPath, begin: bytes) -> str | None:
    """What a file is, as part of a message; None if that is not known, or it may be a damaged text of a format here.

    Args:
        path: of the file.
        begin: its first bytes, decompressed.
    """
    model = _of_model(Path(path), begin)
    if model is not None:
        return f"a file of a COLMAP model: give {model}"
    if begin.startswith(b"PK\x03\x04"):
        return _ARRAYS if str(path).lower().endswith(".npz") else _ARCHIVE
    known = next((what for magic, what in MAGIC.items() if begin.startswith(magic)), None)
    if known is not None:
        return known
    if begin[_TAR_AT:].startswith(b"ustar"):
        return _ARCHIVE
    if re.match(rb"\s*(?:<!doctype html|<html)", begin, re.IGNORECASE):
        return _PAGE
    if begin[8:10] == b'{"' and str(path).endswith(".safetensors"):
        return "a policy file: give the problem, and the policy by --policy"
    if _are_poses(begin):
        return _POSES
    return "a binary file of no format that is known here" if _UNPRINTABLE.search(begin) else None


def nerfstudio(value: object) -> bool:
    """Whether the contents of a JSON file are those of `transforms.json`."""
    frames = value.get("frames") if isinstance(value, dict) else None
    return isinstance(frames, list) and any(isinstance(one, dict) and "transform_matrix" in one for one in frames)


def _of_model(path: Path, begin: bytes) -> str | None:
    """The folder to give for a file of a COLMAP model, for a message."""
    parts = (*PARTS, *RIG_PARTS)
    beside = any((path.parent / f"{part}{path.suffix}").is_file() for part in parts if part != path.stem)
    named = path.suffix in (".txt", ".bin") and path.stem in parts and (beside or path.suffix == ".bin")
    if named:
        return f"the folder that holds it, {display_name(path.parent)}"
    return "the folder of the model" if _COLMAP_COMMENTS.match(begin) else None


def _are_poses(begin: bytes) -> bool:
    """Whether all whole lines are of as many numbers as poses have. No problem in a format here begins so."""
    lines = [line.split() for line in begin.splitlines() if line.strip()]
    whole = lines[:-1] if len(lines) > 1 and not begin.endswith(b"\n") else lines
    try:
        numbers = [[float(word) for word in line] for line in whole]
    except ValueError:
        return False
    return bool(whole) and {len(line) for line in numbers} <= set(_POSE_WIDTHS)
