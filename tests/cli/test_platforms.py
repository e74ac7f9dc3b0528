"""Platforms that JAX does not have on this machine, and compiled programs that it cannot read."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

import jaxba

SOLVE = "import sys; from jaxba.cli.solve import run; sys.exit(run(sys.argv[1:]))"


@pytest.mark.parametrize("platform", ["cuda", "CPU"])
def test_a_platform_that_is_not_there_ends_a_command_with_one_line(tmp_path, platform):
    jaxba.write_bal(jaxba.random_scene(jaxba.scene_like("paper"), 0), tmp_path / "problem.txt")
    command = [sys.executable, "-c", SOLVE, str(tmp_path / "problem.txt")]
    env = {**os.environ, "JAX_PLATFORMS": platform, "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"error: JAX_PLATFORMS is {platform!r}")
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "files"), [(["--devices", "1"], "*-cache"), ([], "*.jaxba-program")]
)
def test_a_torn_program_of_the_cache_is_compiled_again_without_a_word_and_replaced(
    options, files, tmp_path
):
    """In JAX's cache, and in that of programs that are found without tracing."""
    jaxba.write_bal(jaxba.random_scene(jaxba.scene_like("paper"), 0), tmp_path / "problem.txt")
    command = [
        sys.executable,
        "-c",
        SOLVE,
        str(tmp_path / "problem.txt"),
        "--max-iterations",
        "2",
        *options,
    ]
    env = {**os.environ, "JAXBA_CACHE": str(tmp_path / "programs"), "JAX_COMPILATION_CACHE_DIR": ""}

    def run():
        return subprocess.run(
            command, env=env, capture_output=True, text=True, timeout=120, check=True
        )

    whole = run().stdout.splitlines()[-3:]
    largest = max((tmp_path / "programs").rglob(files), key=lambda path: path.stat().st_size)
    os.truncate(largest, 1000)
    again = run()
    assert "Warning" not in again.stderr
    assert len(again.stdout.splitlines()[-3:]) == len(whole)
    run()  # the one after the torn one was removed writes it
    assert largest.stat().st_size > 1000
