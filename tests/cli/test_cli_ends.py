"""Commands end quietly: closed pipes, full disks, Ctrl-C while they start."""

from __future__ import annotations

import errno
import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jaxba.cli import common
from jaxba.cli.solve import run
from jaxba.cli.streams import tolerant_streams
from jaxba.runtime.interrupt import Interrupt

COMMANDS = ("solve", "bench", "train", "data", "kitti", "paper")
START = "import sys; sys.argv[0] = 'jaxba-{0}'; {1}from jaxba.cli.{0} import main; main()"
linux = pytest.mark.skipif(
    sys.platform != "linux", reason="other systems have other pipes and no /dev/full"
)


def begin(command: str, *arguments: str, before: str = "", **streams) -> subprocess.Popen[str]:
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    return subprocess.Popen(
        [sys.executable, "-c", START.format(command, before), *arguments], text=True, **given
    )


@linux
@pytest.mark.parametrize("command", COMMANDS)
def test_help_into_a_pipe_that_nobody_reads_is_no_error(command):
    reader, writer = os.pipe()
    os.close(reader)
    child = begin(command, "--help", stdout=writer)
    os.close(writer)
    assert child.communicate(timeout=100)[1] == ""
    assert child.returncode == 0


@linux
@pytest.mark.parametrize("arguments", [("--help",), ("list",)])
def test_a_full_output_is_one_line(arguments):
    with open("/dev/full", "w") as full:
        child = begin("data", *arguments, stdout=full)
        assert (
            child.communicate(timeout=100)[1] == "error: standard output: No space left on device\n"
        )
    assert child.returncode == 2


@linux
def test_a_closed_terminal_hides_errors_and_keeps_the_status():
    reader, writer = os.pipe()
    os.close(reader)
    child = begin("solve", "--bogus", stderr=writer)
    os.close(writer)
    child.communicate(timeout=100)
    assert child.returncode == 2


@linux
def test_a_solve_whose_output_nobody_reads_writes_its_file(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    child = begin(
        "solve", "--max-iterations", "1", "--output", str(tmp_path / "out.txt"), stdout=writer
    )
    os.close(writer)
    assert child.communicate(timeout=200)[1] == ""
    assert child.returncode == 0
    assert (tmp_path / "out.txt").stat().st_size > 1000


@linux
@pytest.mark.parametrize("command", ["paper", "data", "kitti"])
def test_sigterm_is_handled_as_ctrl_c_with_its_own_status(command, monkeypatch, capsys):
    def main(_):
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:  # where commands say how to go on
            return common.INTERRUPTED

    monkeypatch.setattr(f"jaxba.cli.{command}._{'build' if command == 'kitti' else command}", main)
    words = {"paper": [], "data": ["list"], "kitti": ["folder"]}[command]
    assert importlib.import_module(f"jaxba.cli.{command}").run(words) == 143
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_signal_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interrupt() as outer, Interrupt("iteration", graceful=True) as interrupt:
            signal.raise_signal(signal.SIGINT)
            assert not interrupt.requested
            assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
            signal.raise_signal(signal.SIGTERM)
            assert interrupt.requested
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)
            assert outer.status == 143
    finally:
        signal.signal(signal.SIGINT, before)


@linux
def test_a_program_that_imports_jaxba_keeps_its_own_handler():
    code = (
        "import signal, jaxba; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == "True\n"


def test_an_interrupt_that_became_another_error_is_an_interrupt(monkeypatch, capsys):
    def library(_):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            for _ in range(1000):
                time.monotonic()
        except KeyboardInterrupt:
            raise RuntimeError("a callback failed") from None
        raise AssertionError("no signal came")

    monkeypatch.setattr("jaxba.cli.solve._run", library)
    assert run([]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_an_interrupt_lost_in_a_destructor_is_raised_again(capsys):
    class Lost:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            for _ in range(1000):
                time.monotonic()

    def drop() -> None:
        Lost()
        for _ in range(10**9):
            time.monotonic()

    with Interrupt() as interrupt:
        with pytest.raises(KeyboardInterrupt):
            drop()
        assert interrupt.status == 130
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EFBIG])
def test_a_disk_that_cannot_be_written_is_one_line(number, monkeypatch, capsys, tmp_path):
    path = str(tmp_path / "file")

    def full(_):
        raise OSError(number, os.strerror(number), path)

    monkeypatch.setattr("jaxba.cli.solve._run", full)
    assert run([]) == 2
    assert capsys.readouterr().err == f"error: {path}: {os.strerror(number)}\n"


def test_streams_are_those_of_before_afterwards():
    before = sys.stdout, sys.stderr
    with tolerant_streams():
        assert sys.stdout is not before[0]
        assert sys.stdout.encoding == before[0].encoding
    assert (sys.stdout, sys.stderr) == before


def test_one_is_singular():
    assert [common.counted(n, "iteration") for n in (0, 1, 2)] == [
        "0 iterations",
        "1 iteration",
        "2 iterations",
    ]


@linux
@pytest.mark.slow
def test_a_folder_below_a_file_is_refused_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    for command, *arguments in (
        ("solve", "--output", f"{tmp_path}/file/out.txt"),
        ("solve", "--log", f"{tmp_path}/file/out.json"),
        ("bench", "scene:tiny:1", "--solvers", "ceres", "--out", f"{tmp_path}/file/run"),
        ("train", "--config", "default", "--out", f"{tmp_path}/file/run"),
        ("paper", "--config", "fast", "--out", f"{tmp_path}/file/run"),
    ):
        child = begin(command, *arguments)
        printed, error = child.communicate(timeout=100)
        assert (printed, child.returncode) == ("", 2)
        assert error.startswith("error: ")
        assert error.count("\n") == 1
        assert str(Path(tmp_path.name, "file")) in error
