"""Resumable downloads over HTTP: what was received is kept, and only the rest is requested (RFC 9110, section 14)."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import requests
from urllib3.exceptions import HTTPError

from jaxba.io.files import display_name, reason
from jaxba.typing import InputError

TIMEOUT_S = 30.0
"""Time without any data from the server after which a download fails."""

BLOCK_BYTES = 1 << 16
"""Bytes between two reports of progress; a broken connection loses fewer than that."""

Report = Callable[[int, int | None], object]
"""Called with the bytes received so far, and the size of the whole file or None if the server does not report it."""


class DownloadError(InputError):
    """A download that failed. The message is one line for the user."""


class UnreachableError(DownloadError):
    """The server cannot be reached: no other file of it can be downloaded either."""


def download_rest(url: str, partial: Path, report: Report) -> None:
    """Downloads the missing rest of a partial file, or all of it if the server does not resume.

    Args:
        url: http or https.
        partial: the file so far; may be missing. After a failure it keeps what was received.
        report: called after every block.

    Raises:
        UnreachableError: no response.
        DownloadError: the server has no such file, the connection broke, or the file cannot be written.
    """
    have = partial.stat().st_size if partial.exists() else 0
    with requests.Session() as session, ExitStack() as stack:
        response = stack.enter_context(_request(session, url, have))
        start, total = _range(response)
        if have and not (response.status_code == requests.codes.partial_content and start == have):
            if response.status_code == requests.codes.requested_range_not_satisfiable and total == have:
                return  # nothing is missing
            have = 0
            if response.status_code != requests.codes.ok:
                response = stack.enter_context(_request(session, url, 0))
        _append(response, partial, have, report)


def _request(session: requests.Session, url: str, have: int) -> requests.Response:
    headers = {"Accept-Encoding": "identity"}  # lengths are those of the file
    if have:
        headers["Range"] = f"bytes={have}-"
    try:
        return session.get(url, headers=headers, stream=True, timeout=TIMEOUT_S)
    except (requests.exceptions.InvalidURL, requests.exceptions.InvalidSchema, requests.exceptions.MissingSchema):
        raise UnreachableError(f"{url}: not the address of a web server") from None
    except requests.RequestException as error:
        message = f"cannot reach {urlsplit(url).netloc}: {_cause(error)}; is there a network?"
        raise UnreachableError(message) from error


def _range(response: requests.Response) -> tuple[int | None, int | None]:
    """The first byte of the part that a response holds, and the size of the whole file, if it says so."""
    found = re.match(r"bytes (?:(\d+)-\d+|\*)/(\d+)?", response.headers.get("Content-Range", ""))
    start, total = found.groups() if found else (None, None)
    return int(start) if start else None, int(total) if total else None


def _append(response: requests.Response, partial: Path, have: int, report: Report) -> None:
    if response.status_code not in (requests.codes.ok, requests.codes.partial_content):
        raise DownloadError(f"{response.url}: the server answers {response.status_code} {response.reason}")
    length = response.headers.get("Content-Length", "")
    total = have + int(length) if length.isdecimal() else _range(response)[1]
    broken: Exception | None = None
    try:
        with open(partial, "r+b" if have else "wb") as file:
            file.seek(have)
            report(have, total)
            for block in response.raw.stream(BLOCK_BYTES, decode_content=False):
                file.write(block)
                have += len(block)
                report(have, total)
    except HTTPError as error:
        broken = error
    except OSError as error:
        raise DownloadError(f"cannot write {display_name(partial)}: {reason(error)}") from error
    if broken or (total is not None and have < total):
        message = f"{response.url}: the connection broke after {have:,} bytes; the same command goes on from there"
        raise DownloadError(message) from broken


def _cause(error: BaseException) -> str:
    """The system's reason for a failed connection, without what libraries wrap around it."""
    if isinstance(error, requests.Timeout):
        return f"no answer in {TIMEOUT_S:g} s"
    if isinstance(error, requests.exceptions.SSLError):
        return "its certificate is not accepted"
    inner: BaseException | None = error
    while inner is not None:
        if isinstance(inner, OSError) and inner.strerror:
            return inner.strerror
        inner = inner.__cause__ or inner.__context__
    return "the connection failed"
