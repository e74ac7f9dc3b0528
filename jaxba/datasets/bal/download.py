"""Downloads of BAL problems into the cache folder. Needs the extra `data`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxba.datasets.bal.catalog import Entry
from jaxba.io.files import open_input, reason
from jaxba.problem.bundle_problem import ProblemError

try:
    from jaxba.datasets.bal.transfer import DownloadError, Report, UnreachableError, download_rest
except ModuleNotFoundError:
    raise ImportError("this needs requests: pip install jaxba[data]") from None
try:
    import fcntl
except ModuleNotFoundError:  # not a POSIX system: there two processes must not download the same file
    fcntl = None

__all__ = ["BASE_URL", "DownloadError", "UnreachableError", "fetch", "partial_path"]

BASE_URL = "https://grail.cs.washington.edu/projects/bal/data"
"""The data set's own server."""


def fetch(
    entry: Entry, folder: Path, report: Report, base_url: str = BASE_URL, use_checksum: bool = True
) -> tuple[Path, bool]:
    """The path of a problem, downloaded if it is missing or has a wrong checksum.

    The file appears under its name complete and checked, or not at all. After a broken connection the part that was
    received stays beside it under a hidden name, and the next call resumes it. A file without a checksum must
    decompress, and its header must have the counts of its name.

    Args:
        entry: the problem.
        folder: of the whole data set; created if it is missing.
        report: called with the progress, see `download_rest`.
        base_url: folder of the families on a server.
        use_checksum: false to ignore known checksums, for a mirror that has compressed the files again.

    Returns:
        The path, and whether anything had to be downloaded.

    Raises:
        DownloadError: the download failed; one line.
    """
    url, target, partial = f"{base_url.rstrip('/')}/{entry.file}", folder / entry.file, partial_path(entry, folder)
    checksum = entry.sha256 if use_checksum else None
    try:
        if _is_there(target, checksum):
            return target, False
        target.parent.mkdir(parents=True, exist_ok=True)
        with _locked(partial):
            if _is_there(target, checksum):  # another process had the lock
                return target, False
            download_rest(url, partial, report)
            if checksum is None:
                _check(partial, entry)
            elif not _is_there(partial, checksum):
                partial.unlink()
                raise DownloadError(f"{url}: the file has a wrong checksum and was removed")
            os.replace(partial, target)
    except OSError as error:
        raise DownloadError(f"cannot write to {folder}: {reason(error)}") from error
    return target, True


def _is_there(path: Path, checksum: str | None) -> bool:
    """Whether there is a file, with this checksum if one is known."""
    if checksum is None or not path.is_file():
        return path.is_file()
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == checksum


def partial_path(entry: Entry, folder: Path) -> Path:
    """Path of an unfinished download. It is hidden, so that a pattern such as problem-* does not match it."""
    target = folder / entry.file
    return target.with_name(f".{target.name.removesuffix('.txt.bz2')}.part.bz2")


def _check(partial: Path, entry: Entry) -> None:
    """Removes and refuses a file that does not decompress, or whose header has other counts than its name."""
    head, why = b"", "its header does not fit its name"
    try:
        with open_input(partial) as blocks:
            for block in blocks:
                head = head or block[:100]
    except ProblemError as error:
        head, why = b"", reason(error.__cause__) if error.__cause__ else "it is no bz2 file"
    if head.split(b"\n", 1)[0].split()[:2] != [b"%d" % entry.cameras, b"%d" % entry.points]:
        partial.unlink()
        raise DownloadError(f"{entry.name}: what came is not the problem and was removed: {why}")


@contextmanager
def _locked(partial: Path) -> Iterator[None]:
    """Holds the lock of a partial file, so that one process at a time works on it."""
    if fcntl is None:
        yield
        return
    path = partial.with_suffix(".lock")
    while True:
        with open(path, "ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            try:
                ours = os.path.samestat(os.fstat(file.fileno()), path.stat())
            except FileNotFoundError:
                ours = False
            if not ours:
                continue  # the previous holder has removed it
            try:
                yield
            finally:
                path.unlink()
            return
