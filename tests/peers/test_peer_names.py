"""Solver names of other libraries, and the error where the library is not installed; needs no
library."""

from __future__ import annotations

import importlib
import sys

import pytest

from jaxba import peers
from jaxba.bench import run as bench_run
from jaxba.bench.sources import sources
from jaxba.cli.bench import run
from jaxba.solver.names import PEERS, SolverName, parse_solver
from jaxba.typing import InputError


@pytest.mark.parametrize(
    ("text", "name", "shortest"),
    [
        ("pyceres:dense", SolverName("", peer="pyceres:dense"), None),
        ("pyceres:sparse", SolverName("", peer="pyceres:sparse"), None),
        (" pyceres:iterative ", SolverName("", peer="pyceres:iterative"), "pyceres:iterative"),
        ("pyceres:dense-inner", SolverName("", peer="pyceres:dense-inner"), None),
    ],
)
def test_solver_names_of_other_libraries_are_parsed_and_printed(text, name, shortest):
    assert parse_solver(text) == name
    assert str(name) == (shortest or text)
    assert parse_solver(str(name)) == name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pyceres", "known: dense, sparse, iterative"),
        ("pyceres:", "known: dense, sparse, iterative"),
        ("pyceres:qr", "unknown mode 'qr'"),
        ("pyceres:dense+ceres", "unknown mode 'dense+ceres'"),
        ("pyceres:dense@float32", "unknown mode 'dense@float32'"),
        ("pyceres:iterative-inner", "unknown mode 'iterative-inner'"),
        ("lm+pyceres:dense", "unknown damping policy 'pyceres:dense'"),
    ],
)
def test_what_is_no_peer_is_one_clear_line(text, message):
    with pytest.raises(InputError) as caught:
        parse_solver(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_peer_says_what_brings_it():
    assert set(peers.NEEDS) == set(PEERS)


def test_without_its_library_a_peer_is_refused_before_anything_runs(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(peers, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"needs pyceres and pycolmap: pip install jaxba\[ceres\]"):
        bench_run.plan(sources(["scene:tiny"]), ["classic", "pyceres:dense"], 1)
    assert (
        run(["scene:tiny", "--solvers", "classic,pyceres:dense", "--out", str(tmp_path / "run")])
        == 2
    )
    error = capsys.readouterr().err
    assert error.startswith("error: 'pyceres:dense' needs pyceres")
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()
    bench_run.plan(sources(["scene:tiny"]), ["classic", "ceres"], 1)


def test_without_its_library_the_module_says_what_to_install(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("jaxba.peers.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pyceres", None)
    with pytest.raises(ImportError, match=r"pip install jaxba\[ceres\]") as caught:
        importlib.import_module("jaxba.peers.ceres")
    assert "\n" not in str(caught.value)
