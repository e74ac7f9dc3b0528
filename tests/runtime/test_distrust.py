"""Compiled programs that XLA distrusts are noticed once, and compiled for fewer instructions from
then on."""

from __future__ import annotations

import os

import jax
import pytest
from jax.experimental.serialize_executable import serialize

from jaxba.runtime import distrust
from jaxba.runtime.distrust import are_distrusted, programs_folder


@pytest.fixture(autouse=True)
def no_flags(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_dump_max_hlo_modules=7")


def flags(folder):
    programs_folder(folder)
    return os.environ["XLA_FLAGS"].split()[1:]


@pytest.mark.parametrize("distrusted", [False, True])
def test_a_refusal_is_said_once_and_limits_the_next_process(
    distrusted, tmp_path, capfd, monkeypatch
):
    monkeypatch.setattr(distrust, "are_distrusted", lambda _: distrusted)
    for _ in range(2):
        monkeypatch.setenv("XLA_FLAGS", "--xla_dump_max_hlo_modules=7")
        assert flags(tmp_path) == ["--xla_cpu_max_isa=AVX2"] * distrusted
    assert capfd.readouterr().err.count("AVX2") == distrusted


def test_the_choice_of_a_user_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(distrust, "are_distrusted", lambda _: True)
    monkeypatch.setenv("XLA_FLAGS", "- --xla_cpu_max_isa=SSE4_2")
    assert flags(tmp_path) == ["--xla_cpu_max_isa=SSE4_2"]


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="programs of CPUs")
@pytest.mark.parametrize("foreign", [False, True])
def test_xla_says_of_a_foreign_program_what_is_listened_for(foreign, capfd):
    code, *trees = serialize(jax.jit(lambda x: x + 1).lower(1.0).compile())
    if foreign:
        if b"+64bit," not in code:
            pytest.skip("not a processor of this family")
        code = code.replace(b"+64bit,", b"+65bit,")
    assert are_distrusted((code, *trees)) == foreign
    assert COMPLAINT not in capfd.readouterr().err


COMPLAINT = distrust.COMPLAINT.decode()


def test_another_processor_has_another_folder(tmp_path, monkeypatch):
    here = programs_folder(tmp_path)
    assert programs_folder(tmp_path) == here
    # a system that tells no instructions
    monkeypatch.setattr(distrust.Path, "is_file", lambda _: False)
    monkeypatch.setattr(distrust.platform, "node", lambda: "another")
    assert programs_folder(tmp_path) not in (here, tmp_path)
