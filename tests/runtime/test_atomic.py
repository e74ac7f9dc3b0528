"""A file is replaced whole or not at all, however its writer ends."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys

import pytest

from jaxba.runtime.atomic import TEMPORARY, atomic_write, write_text


def write_half(path, error):
    with atomic_write(path) as file:
        file.write(b"new, but not all of it")
        raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_midway_leaves_the_old_file_and_nothing_else(error, tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(error):
        write_half(path, error)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


KILLED = """
import os, signal, sys
from jaxba.runtime.atomic import atomic_write
with atomic_write(sys.argv[1]) as file:
    file.write(b"new, but not all of it")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills with a signal of POSIX")
@pytest.mark.parametrize("old", [b"old", None])
def test_a_writer_killed_midway_leaves_the_old_file_whole(old, tmp_path):
    path = tmp_path / "file"
    if old is not None:
        path.write_bytes(old)
    assert (
        subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False).returncode
        == -signal.SIGKILL
    )
    assert (path.read_bytes() if path.exists() else None) == old
    (left,) = set(tmp_path.iterdir()) - {path}
    assert left.match(TEMPORARY.format("*"))


def test_readers_see_the_old_file_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "file"
    write_text(path, "old")
    with atomic_write(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_links_and_permissions_stay(tmp_path):
    path = tmp_path / "file"
    link = tmp_path / "link"
    path.write_bytes(b"old")
    path.chmod(0o640)
    link.symlink_to(path)
    write_text(link, "new")
    assert link.is_symlink()
    assert path.read_text() == "new"
    assert stat.S_IMODE(os.stat(path).st_mode) == 0o640


def test_the_longest_name_that_a_folder_takes_may_be_written(tmp_path):
    path = tmp_path / ("n" * os.pathconf(tmp_path, "PC_NAME_MAX"))
    write_text(path, "new")
    assert path.read_text() == "new"
