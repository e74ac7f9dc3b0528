"""Compiled programs that XLA distrusts are noticed once, and compiled for fewer instructions from then on."""

from __future__ import annotations

import os
import subprocess
import sys

import jax
import pytest
from jaxlib import xla_client

from jaxba.runtime import distrust
from jaxba.runtime.distrust import first_run, limit_instructions, reading

REFUSAL = b"E1 cpu_aot_loader.cc:195] Target machine feature +prefer-no-gather is not supported on the host machine. "
REFUSAL += b"Machine type used for XLA:CPU compilation doesn't match the machine type for execution. And so on.\n"


@pytest.fixture(autouse=True)
def no_flags(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_dump_max_hlo_modules=7")


def flags(folder):
    limit_instructions(folder)
    return os.environ["XLA_FLAGS"].split()[1:]


def test_a_refusal_is_said_once_and_limits_the_next_process(tmp_path, capfd):
    assert flags(tmp_path) == []
    for _ in range(2):
        with reading(tmp_path):
            os.write(2, REFUSAL + b"something else\n" + REFUSAL)
    heard = capfd.readouterr().err
    assert heard.count("something else") == 2
    assert heard.count("AVX2") == 1
    assert "prefer-no-gather" not in heard
    assert flags(tmp_path) == flags(tmp_path) == ["--xla_cpu_max_isa=AVX2"]


def test_the_choice_of_a_user_stays(tmp_path, monkeypatch):
    with reading(tmp_path):
        os.write(2, REFUSAL)
    monkeypatch.setenv("XLA_FLAGS", "- --xla_cpu_max_isa=SSE4_2")
    assert flags(tmp_path) == ["--xla_cpu_max_isa=SSE4_2"]


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="programs of CPUs")
@pytest.mark.parametrize("foreign", [False, True])
def test_xla_says_of_a_foreign_program_what_is_listened_for(foreign, tmp_path, capfd):
    executable = jax.jit(lambda x: x + 1).lower(1.0).compile().runtime_executable()
    code = executable.client.serialize_executable(executable)
    if foreign:
        if b"+64bit," not in code:
            pytest.skip("not a processor of this family")
        code = code.replace(b"+64bit,", b"+65bit,")
    with reading(tmp_path):
        executable.client.deserialize_executable(code, executable_devices=xla_client.DeviceList((jax.devices()[0],)))
    assert capfd.readouterr().err.count("AVX2") == foreign
    assert bool(flags(tmp_path)) == foreign


@pytest.mark.parametrize("dies", [False, True])
def test_a_process_that_dies_of_a_program_limits_the_next(dies, tmp_path, capfd):
    with subprocess.Popen([sys.executable, "-S", "-c", ""]) as dead, pytest.MonkeyPatch.context() as patch:
        dead.wait()
        patch.setattr(os, "getpid", lambda: dead.pid)
        with first_run(tmp_path):
            (file,) = tmp_path.iterdir()
    assert not file.exists()
    if dies:
        file.touch()
    with first_run(tmp_path):  # of a living process: says nothing
        assert bool(flags(tmp_path)) == dies
    assert capfd.readouterr().err.count("AVX2") == dies
    assert not list(tmp_path.glob(f"*{distrust.RUNNING}"))
