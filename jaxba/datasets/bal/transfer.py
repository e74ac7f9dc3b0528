"""A file over HTTP that can be continued: what has come stays, only the rest is asked for (RFC 9110, section 14)."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import requests
from urllib3.exceptions import HTTPError

from jaxba.io.files import display_name, reason

TIMEOUT_S = 30.0
"""Silence of the server, at the start or on the way, after which a download is given up."""

BLOCK_BYTES = 1 << 16
"""Bytes from one report of progress to the next; less than that is lost where a connection breaks."""

Report = Callable[[int, int | None], object]
"""Called with the bytes at hand and the bytes of the whole file, or None where the server does not tell."""


class DownloadError(ValueError):
    """A download that failed. The message is one line for a person."""


class UnreachableError(DownloadError):
    """The server cannot be reached: other files of it will not come either."""


def download_rest(url: str, partial: Path, report: Report) -> None:
    """Brings a partial file to its full length. Where the server does not continue files, it starts anew.

    Args:
        url: http or https.
        partial: what has come so far; may be missing. It keeps what has come if this fails.
        report: told after every block.

    Raises:
        UnreachableError: no answer.
        DownloadError: the server has no such file, the connection broke, or the file cannot be written.
    """
    have = partial.stat().st_size if partial.exists() else 0
    with requests.Session() as session, ExitStack() as stack:
        answer = stack.enter_context(_ask(session, url, have))
        if have and not _continues(answer, have):
            if answer.status_code == requests.codes.requested_range_not_satisfiable and _range_total(answer) == have:
                return  # nothing is missing
            have = 0
            if answer.status_code != requests.codes.ok:
                answer = stack.enter_context(_ask(session, url, 0))
        _store(answer, partial, have, report)


def _ask(session: requests.Session, url: str, have: int) -> requests.Response:
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


def _continues(answer: requests.Response, have: int) -> bool:
    """Whether the answer is the part from byte `have` on."""
    span = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range", ""))
    return answer.status_code == requests.codes.partial_content and span is not None and int(span[1]) == have


def _range_total(answer: requests.Response) -> int | None:
    total = answer.headers.get("Content-Range", "").rpartition("/")[2]
    return int(total) if total.isdecimal() else None


def _store(answer: requests.Response, partial: Path, have: int, report: Report) -> None:
    if answer.status_code not in (requests.codes.ok, requests.codes.partial_content):
        raise DownloadError(f"{answer.url}: the server answers {answer.status_code} {answer.reason}")
    length = answer.headers.get("Content-Length", "")
    total = have + int(length) if length.isdecimal() else _range_total(answer)
    broken: Exception | None = None
    try:
        with open(partial, "r+b" if have else "wb") as file:
            file.seek(have)
            report(have, total)
            for block in answer.raw.stream(BLOCK_BYTES, decode_content=False):
                file.write(block)
                have += len(block)
                report(have, total)
    except HTTPError as error:
        broken = error
    except OSError as error:
        raise DownloadError(f"cannot write {display_name(partial)}: {reason(error)}") from error
    if broken or (total is not None and have < total):
        message = f"{answer.url}: the connection broke after {have:,} bytes; the same command goes on from there"
        raise DownloadError(message) from broken


def _cause(error: BaseException) -> str:
    """What the system said of a failed connection, in a few words, below all that libraries wrap around it."""
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
