"""Downloads against a server of this process: what is asked of it, what is kept, and what is
refused."""

from __future__ import annotations

import bz2
import contextlib
import hashlib
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import support

pytest.importorskip("requests", reason="the extra `data` is not installed")

from jaxba import read_bal
from jaxba.cli.data import run
from jaxba.datasets.bal import download
from jaxba.datasets.bal.download import DownloadError, UnreachableError, fetch, partial_path
from jaxba.datasets.bal.paths import Entry, select


def packed(cameras: int, points: int, seed: int = 0) -> bytes:
    """A compressed file with the header of such a problem, some hundred kB of digits, and nothing
    to solve."""
    digits = np.random.default_rng(seed).integers(0, 10**9, size=60_000)
    return bz2.compress(
        f"{cameras} {points} {len(digits)}\n".encode() + "\n".join(map(str, digits)).encode()
    )


BODY = packed(7, 30)
ENTRY = Entry("ladybug", 7, 30, hashlib.sha256(BODY).hexdigest())
UNSIGNED = Entry("ladybug", 7, 30, None)


class Server(ThreadingHTTPServer):
    """Files by path; counts what it is asked for and the bytes that it sends."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files: dict[str, bytes] = {f"/{ENTRY.file}": BODY}
        self.ranges = True
        self.break_after: int | None = None  # bytes of an answer after which the connection is cut
        self.asked: list[tuple[str, str | None]] = []  # path and Range header
        self.sent = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class _Handler(BaseHTTPRequestHandler):
    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        server = self.server
        span = self.headers.get("Range")
        server.asked.append((self.path, span))
        body = server.files.get(self.path)
        if body is None:
            self.send_error(404)
            return
        start = int(span.removeprefix("bytes=").rstrip("-")) if span and server.ranges else 0
        if start and start >= len(body):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(body)}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
        self.send_header("Content-Length", str(len(body) - start))
        self.end_headers()
        part = body[start:][: server.break_after]
        server.sent += len(part)  # before the last byte is on its way, after which a test may ask
        self.wfile.write(part)
        self.close_connection = True

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The cache folder, empty, for this test alone; proxies of the machine are left out."""
    monkeypatch.setenv("JAXBA_BAL", str(tmp_path / "bal"))
    for variable in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(variable, "127.0.0.1,bal.invalid")
    return tmp_path / "bal"


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def get(server: Server, folder: Path, entry: Entry = ENTRY, **options) -> tuple[Path, bool]:
    return fetch(entry, folder, lambda *_: None, server.url, **options)


def break_off(server: Server, folder: Path, after: int, entry: Entry = ENTRY) -> None:
    """A download whose connection is cut after so many bytes; the server then works again."""
    server.break_after = after
    with pytest.raises(DownloadError, match="the connection broke after"):
        get(server, folder, entry)
    server.break_after = None
    server.sent = 0
    server.asked = []


def check_one_line(error: str, message: str) -> None:
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error


# What works


def test_what_another_process_received_while_this_one_waited_is_used(server, folder, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def wait(file, _):
        with open(file.name, "ab") as other:
            other.write(BODY[:1000])

    monkeypatch.setattr(fcntl, "flock", wait)
    path, _ = get(server, folder)
    assert path.read_bytes() == BODY
    assert server.sent == len(BODY) - 1000


@pytest.mark.parametrize("entry", [ENTRY, UNSIGNED])
def test_a_download_is_the_servers_file_byte_by_byte_and_nothing_else_is_left(
    server, folder, entry
):
    path, new = get(server, folder, entry)
    assert new
    assert path == folder / "ladybug" / "problem-7-30-pre.txt.bz2"
    assert path.read_bytes() == BODY
    assert files(folder) == [ENTRY.file]
    made = folder / "made"
    made.touch()
    assert path.stat().st_mode == made.stat().st_mode  # readable for whom the user lets read


@pytest.mark.parametrize("entry", [ENTRY, UNSIGNED])
def test_a_second_run_uses_the_cache_without_any_request(server, folder, entry):
    path, _ = get(server, folder, entry)
    server.asked.clear()
    assert get(server, folder, entry) == (path, False)
    assert server.asked == []


def test_a_second_run_beside_the_first_waits_for_it_and_asks_for_nothing(
    server, folder, monkeypatch
):
    """The first one holds its file until the second one has come to the lock."""
    fcntl = pytest.importorskip("fcntl")
    waits = threading.Event()
    results = []
    lock = fcntl.flock

    def flock(*arguments) -> None:
        if threading.current_thread() is second:
            waits.set()
        lock(*arguments)

    def first(done: int, total: int | None) -> None:
        if done == 0:
            second.start()
            assert waits.wait(10)

    monkeypatch.setattr(download.fcntl, "flock", flock)
    second = threading.Thread(target=lambda: results.append(get(server, folder)))
    path, new = fetch(ENTRY, folder, first, server.url)
    second.join()
    assert new
    assert results == [(path, False)]
    assert len(server.asked) == 1
    assert files(folder) == [ENTRY.file]


def test_progress_ends_at_the_size_of_the_file_and_counts_what_was_there(
    server, folder, monkeypatch
):
    monkeypatch.setattr(download, "BLOCK_BYTES", 1 << 14)
    break_off(server, folder, after=100_000)
    seen: list = []
    fetch(ENTRY, folder, lambda *state: seen.append(state), server.url)
    assert seen[0] == (100_000, len(BODY))
    assert seen[-1] == (len(BODY), len(BODY))
    assert seen == sorted(seen)


# Going on


@pytest.mark.parametrize("entry", [ENTRY, UNSIGNED])
def test_a_download_that_broke_off_leaves_no_final_file_and_goes_on_with_the_rest_alone(
    server, folder, entry
):
    break_off(server, folder, 100_000, entry)
    assert files(folder) == [str(partial_path(ENTRY, folder).relative_to(folder))]
    assert not list(folder.rglob("problem-*"))
    path, _ = get(server, folder, entry)
    assert path.read_bytes() == BODY
    assert server.asked == [(f"/{ENTRY.file}", "bytes=100000-")]
    assert server.sent == len(BODY) - 100_000
    assert files(folder) == [ENTRY.file]


def test_it_may_break_off_again_and_again(server, folder):
    for _ in range(3):
        break_off(server, folder, after=50_000)
    get(server, folder)
    assert server.sent == len(BODY) - 150_000


def test_a_server_that_cannot_continue_sends_the_whole_file_again(server, folder):
    break_off(server, folder, after=100_000)
    server.ranges = False
    path, _ = get(server, folder)
    assert path.read_bytes() == BODY
    assert server.sent == len(BODY)


@pytest.mark.parametrize("more", [b"", b"more"])
def test_a_leftover_that_is_not_shorter_than_the_file_is_replaced(server, folder, more):
    partial = partial_path(ENTRY, folder)
    partial.parent.mkdir(parents=True)
    partial.write_bytes(BODY + more)
    path, _ = get(server, folder)
    assert path.read_bytes() == BODY


def test_a_leftover_of_another_file_is_refused_and_the_next_run_gets_the_right_one(server, folder):
    partial = partial_path(ENTRY, folder)
    partial.parent.mkdir(parents=True)
    partial.write_bytes(packed(7, 30, seed=1)[:100_000])
    with pytest.raises(DownloadError, match="wrong checksum"):
        get(server, folder)
    assert files(folder) == []
    assert get(server, folder)[0].read_bytes() == BODY


# What is refused


@pytest.mark.parametrize(
    "body", [packed(7, 30, seed=1), BODY[:-1000], b"<html>log in first</html>", b""]
)
def test_a_file_with_another_checksum_is_refused_and_removed(server, folder, body):
    server.files[f"/{ENTRY.file}"] = body
    with pytest.raises(
        DownloadError, match=r"problem-7-30-pre\.txt\.bz2: the file has a wrong checksum"
    ):
        get(server, folder)
    assert files(folder) == []


def test_a_stored_file_that_has_changed_is_downloaded_again(server, folder):
    path, _ = get(server, folder)
    path.write_bytes(BODY[:-1])
    assert get(server, folder) == (path, True)
    assert path.read_bytes() == BODY


@pytest.mark.parametrize(
    ("body", "why"),
    [
        (packed(8, 30), "header does not fit"),
        (packed(7, 31), "header does not fit"),
        (bz2.compress(b""), "header does not fit"),
        (b"", "header does not fit"),
        (BODY[:-1000], "cut short"),
        (BODY[:100_000] + b"\0" + BODY[100_001:], "[Ii]nvalid data"),
        (b"<html>log in first</html>", "no bz2 file"),
    ],
)
def test_without_a_checksum_damage_and_a_foreign_header_are_found_and_removed(
    server, folder, body, why
):
    server.files[f"/{ENTRY.file}"] = body
    with pytest.raises(
        DownloadError, match=rf"^ladybug-7: what came is not the problem and was removed: .*{why}"
    ):
        get(server, folder, UNSIGNED)
    assert files(folder) == []


def test_a_mirror_that_compressed_anew_is_accepted_only_on_demand(server, folder):
    body = bz2.compress(bz2.decompress(BODY), compresslevel=1)
    server.files[f"/{ENTRY.file}"] = body
    with pytest.raises(DownloadError, match="wrong checksum"):
        get(server, folder)
    assert get(server, folder, use_checksum=False)[0].read_bytes() == body


def test_a_missing_file_is_told_with_the_servers_words_and_leaves_nothing(server, folder):
    server.files.clear()
    with pytest.raises(
        DownloadError, match=r"problem-7-30-pre\.txt\.bz2: the server answers 404 Not Found"
    ):
        get(server, folder)
    assert files(folder) == []


def test_a_folder_that_cannot_be_made_is_one_line(server, tmp_path):
    (tmp_path / "bal").write_text("a file is in the way")
    with pytest.raises(DownloadError, match=r"cannot write to .*bal: "):
        get(server, tmp_path / "bal")
    assert server.asked == []


def _closed_port() -> int:
    with contextlib.closing(socket.socket()) as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def test_a_silent_server_is_given_up(folder, monkeypatch):
    monkeypatch.setattr(download, "TIMEOUT_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(
            UnreachableError, match=r"cannot reach 127.0.0.1:\d+: no answer in 0.2 s"
        ):
            fetch(ENTRY, folder, lambda *_: None, url)
    assert files(folder) == []


# The command


def test_without_a_network_the_command_says_so_once_and_leaves_nothing(folder, capsys):
    assert (
        run(
            [
                "download",
                "trafalgar",
                "ladybug-49",
                "--base-url",
                f"http://127.0.0.1:{_closed_port()}",
            ]
        )
        == 2
    )
    check_one_line(capsys.readouterr().err, "Connection refused; is there a network?")
    assert files(folder) == []


def test_a_name_that_cannot_be_resolved_is_one_line(folder, capsys, monkeypatch):
    def fail(*_, **__):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", fail)
    assert run(["download", "ladybug-49", "--base-url", "http://bal.invalid"]) == 2
    check_one_line(
        capsys.readouterr().err,
        "cannot reach bal.invalid: Name or service not known; is there a network?",
    )
    assert files(folder) == []


@pytest.mark.parametrize("url", ["bal", "ftp://127.0.0.1", "http://"])
def test_an_address_that_is_none_is_one_line(folder, capsys, url):
    assert run(["download", "ladybug-49", "--base-url", url]) == 2
    check_one_line(capsys.readouterr().err, "not the address of a web server")


def test_one_bad_file_does_not_keep_the_others_from_coming(server, folder, capsys):
    body = packed(1723, 156502)
    server.files["/" + select(["ladybug-1723"])[0].file] = body
    assert run(["download", "ladybug-49", "ladybug-1723", "--base-url", server.url + "/"]) == 2
    done = capsys.readouterr()
    check_one_line(done.err, "404 Not Found")
    assert "ladybug-1723: downloaded, unpacks, header fits its name: " in done.out
    assert files(folder) == [select(["ladybug-1723"])[0].file]


def test_ctrl_c_keeps_what_has_come_and_the_same_command_goes_on(
    server, folder, capsys, monkeypatch
):
    (name,) = select(["ladybug-1723"])
    server.files["/" + name.file] = packed(1723, 156502)
    monkeypatch.setattr(download, "BLOCK_BYTES", 1 << 14)
    original = download.download_rest

    def interrupted(url, partial, report):
        def stop(done, total):
            if done > 100_000:
                raise KeyboardInterrupt

        original(url, partial, stop)

    monkeypatch.setattr(download, "download_rest", interrupted)
    assert run(["download", "ladybug-1723", "--base-url", server.url]) == 130
    assert "run the same command again" in capsys.readouterr().out
    kept = partial_path(name, folder).stat().st_size
    assert kept > 100_000
    monkeypatch.setattr(download, "download_rest", original)
    assert run(["download", "ladybug-1723", "--base-url", server.url]) == 0
    assert server.asked[-1] == (f"/{name.file}", f"bytes={kept}-")


@support.needs_data
@pytest.mark.parametrize(
    ("name", "file"),
    [("ladybug-49", "problem-49-7776-pre"), ("trafalgar-21", "problem-21-11315-pre")],
)
def test_the_real_files_have_the_stated_checksums_and_are_the_problems_of_their_names(
    server, folder, name, file
):
    server.files["/" + select([name])[0].file] = support.bal_file(file).read_bytes()
    assert run(["download", name, "--base-url", server.url]) == 0
    problem = read_bal(folder / select([name])[0].file)
    assert (problem.num_cameras, problem.num_points) == (
        select([name])[0].cameras,
        select([name])[0].points,
    )
