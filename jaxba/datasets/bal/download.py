"""Downloads of BAL problems into the cache folder, resumed where they broke off. Needs the extra
`data`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO
from urllib.parse import urlsplit

from jaxba.datasets.bal.paths import Entry
from jaxba.io.files import read_bytes, reason
from jaxba.problem.bundle_problem import ProblemError
from jaxba.typing import InputError

try:
    import requests
    from urllib3.exceptions import HTTPError
except ModuleNotFoundError:
    raise ImportError("this needs requests: pip install jaxba[data]") from None
try:
    import fcntl
# not a POSIX system: there two processes must not download the same file
except ModuleNotFoundError:
    fcntl = None

BASE_URL = "https://grail.cs.washington.edu/projects/bal/data"  # the data set's own server
TIMEOUT_S = 30.0  # time without any data from the server after which a download fails
# bytes between two reports of progress; a broken connection loses fewer than that
BLOCK_BYTES = 1 << 16

Report = Callable[[int, int | None], object]
"""Called with the bytes received so far, and the size of the whole file or None if the server does
not report it."""


class DownloadError(InputError):
    """A download that failed. The message is one line for the user."""


class UnreachableError(DownloadError):
    """The server cannot be reached: no other file of it can be downloaded either."""


def fetch(
    entry: Entry, folder: Path, report: Report, base_url: str = BASE_URL, use_checksum: bool = True
) -> tuple[Path, bool]:
    """The path of a problem in the folder of the data set, and whether it had to be downloaded
    since it was missing or had a wrong checksum (that is ignored without `use_checksum`, for a
    mirror that has compressed the files again).

    The file appears under its name complete and checked, or not at all. After a broken connection
    the part that was received stays beside it under a hidden name, and the next call resumes it. A
    file without a checksum must decompress, and its header must have the counts of its name. Raises
    DownloadError: the download failed; one line."""
    url = f"{base_url.rstrip('/')}/{entry.file}"
    target = folder / entry.file
    partial = partial_path(entry, folder)
    checksum = entry.sha256 if use_checksum else None
    try:
        if _is_there(target, checksum):
            return target, False
        target.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "ab") as file:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX)
                file.seek(0, os.SEEK_END)  # another process may have written while this one waited
            if _is_there(target, checksum):  # another process had the lock
                return target, False
            try:
                download_rest(url, file, report)
            except BaseException:
                if not file.tell():
                    partial.unlink()
                raise
            file.flush()
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
    """Path of an unfinished download. It is hidden, so that a pattern such as problem-* does not
    match it."""
    target = folder / entry.file
    return target.with_name(f".{target.name.removesuffix('.txt.bz2')}.part.bz2")


def _check(partial: Path, entry: Entry) -> None:
    """Removes and refuses a file that does not decompress, or whose header has other counts than
    its name."""
    why = "its header does not fit its name"
    try:
        header = read_bytes(partial)[:100].split(b"\n", 1)[0].split()
    except ProblemError as error:
        header = []
        why = reason(error.__cause__) if error.__cause__ else "it is no bz2 file"
    if header[:2] != [b"%d" % entry.cameras, b"%d" % entry.points]:
        partial.unlink()
        raise DownloadError(f"{entry.name}: what came is not the problem and was removed: {why}")


def download_rest(url: str, file: BinaryIO, report: Report) -> None:
    """Downloads the missing rest of a file that is open to append, or all of it if the server does
    not resume. After a failure the file keeps what was received. `report` is called after every
    block. Raises UnreachableError: no response. Raises DownloadError: the server has no such file,
    or the connection broke."""
    have = file.tell()
    with requests.Session() as session:
        response = _request(session, url, have)
        if have and response.status_code in (
            requests.codes.ok,
            requests.codes.requested_range_not_satisfiable,
        ):
            have = file.truncate(0)
            if response.status_code != requests.codes.ok:
                response = _request(session, url, have)
        with response:
            if not response.ok:
                raise DownloadError(
                    f"{response.url}: the server answers {response.status_code} {response.reason}"
                )
            length = response.headers.get("Content-Length", "")
            total = have + int(length) if length.isdecimal() else None
            broken: Exception | None = None
            try:
                report(have, total)
                for block in response.raw.stream(BLOCK_BYTES, decode_content=False):
                    have += file.write(block)
                    report(have, total)
            except HTTPError as error:
                broken = error
    if broken or (total is not None and have < total):
        message = (
            f"{url}: the connection broke after {have:,} bytes; the same command goes on from there"
        )
        raise DownloadError(message) from broken


def _request(session: requests.Session, url: str, have: int) -> requests.Response:
    headers = {"Accept-Encoding": "identity"}  # lengths are those of the file
    if have:
        headers["Range"] = f"bytes={have}-"
    try:
        return session.get(url, headers=headers, stream=True, timeout=TIMEOUT_S)
    except (
        requests.exceptions.InvalidURL,
        requests.exceptions.InvalidSchema,
        requests.exceptions.MissingSchema,
    ):
        raise UnreachableError(f"{url}: not the address of a web server") from None
    except requests.RequestException as error:
        message = f"cannot reach {urlsplit(url).netloc}: {_cause(error)}; is there a network?"
        raise UnreachableError(message) from error


def _cause(error: BaseException | None) -> str:
    """The system's reason for a failed connection, without what libraries wrap around it."""
    if isinstance(error, requests.Timeout):
        return f"no answer in {TIMEOUT_S:g} s"
    if isinstance(error, requests.exceptions.SSLError):
        return "its certificate is not accepted"
    while error is not None and not (isinstance(error, OSError) and error.strerror):
        error = error.__cause__ or error.__context__
    return "the connection failed" if error is None else reason(error)
