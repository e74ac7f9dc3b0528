"""Platforms that JAX does not have on this machine."""

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
