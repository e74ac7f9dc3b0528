"""Solver names of other libraries, and the error where the library is not installed; needs no library."""

from __future__ import annotations

import importlib
import sys

import pytest

from jaxba import peers
from jaxba.bench import run as bench_run
from jaxba.bench.sources import sources
from jaxba.cli.bench import run
from jaxba.damping import LearnedPolicy
from jaxba.problem.options import StepOptions
from jaxba.solver.names import PEERS, SolverName, parse_solver
from jaxba.typing import InputError


@pytest.mark.parametrize(
    ("text", "name", "shortest"),
    [
        ("pyceres:dense", SolverName("", peer="pyceres:dense"), None),
        ("pyceres:sparse", SolverName("", peer="pyceres:sparse"), None),
        (" pyceres:iterative ", SolverName("", peer="pyceres:iterative"), "pyceres:iterative"),
        ("pyceres:dense-inner", SolverName("", peer="pyceres:dense-inner"), None),
        ("pyceres:dense+learned", SolverName("learned", None, peer="pyceres:dense"), None),
        ("pyceres:dense+learned+refine0", SolverName("learned", peer="pyceres:dense"), None),
        ("pyceres:dense+learned+embedded", SolverName("learned", None, peer="pyceres:dense"), "pyceres:dense+learned"),
        ("pyceres:sparse+ceres+embedded", SolverName("ceres", None, peer="pyceres:sparse"), None),
        ("pyceres:dense+ceres+refine3", SolverName("ceres", 3, peer="pyceres:dense"), None),
        ("pyceres:dense+ceres+refine0", SolverName("ceres", peer="pyceres:dense"), "pyceres:dense+ceres"),
        ("pyceres:sparse+constant:1e+2", SolverName("constant:1e+2", peer="pyceres:sparse"), None),
        ("pyceres:iterative+classic:0.03", SolverName("classic:0.03", peer="pyceres:iterative"), None),
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
        ("pyceres:qr+ceres", "unknown mode 'qr'"),
        ("pyceres:dense@float32", "unknown mode 'dense@float32'"),
        ("pyceres:iterative-inner", "unknown mode 'iterative-inner'"),
        ("pyceres:sparse-inner+ceres", "inner iterations under its own rule alone"),
        ("pyceres:dense+", "is no solver"),
        ("pyceres:dense+cerse", "unknown damping policy 'cerse'"),
        ("pyceres:dense+ceres+refine", "unknown method 'ceres'"),
        ("pyceres:dense+stba+ceres", "the form is pyceres:dense+policy[+refineK|+embedded]"),
        ("pyceres:dense+ceres@float32", "the form is pyceres:dense+policy[+refineK|+embedded]"),
        ("pyceres:dense+pyceres:dense", "the form is pyceres:dense+policy"),
        ("pyceres:dense+pyceres:dense+ceres", "the form is pyceres:dense+policy"),
        ("lm+pyceres:dense", "unknown damping policy 'pyceres:dense'"),
    ],
)
def test_what_is_no_peer_is_one_clear_line(text, message):
    with pytest.raises(InputError) as caught:
        parse_solver(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["learned", "learned+refine0"])
def test_the_learned_policy_drives_a_peer_without_embedded_iterations(name):
    policy, options = parse_solver(f"pyceres:dense+{name}").build()
    assert isinstance(policy, LearnedPolicy)
    assert options.step_options(policy) == StepOptions()


def test_a_policy_brings_its_embedded_iterations_to_a_peer():
    policy, options = parse_solver("pyceres:dense+bold").build()
    ours, same = parse_solver("bold").build()
    assert (policy, options) == (ours, same)
    assert options.step_options(policy).refinement.points


def test_every_peer_says_what_brings_it():
    assert set(peers.NEEDS) == set(PEERS)


def test_without_its_library_a_peer_is_refused_before_anything_runs(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(peers, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"needs pyceres and pycolmap: pip install jaxba\[ceres\]"):
        bench_run.plan(sources(["scene:tiny"]), ["classic", "pyceres:dense+classic"], 1)
    assert run(["scene:tiny", "--solvers", "classic,pyceres:dense", "--out", str(tmp_path / "run")]) == 2
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
        importlib.import_module("jaxba.peers.driven")
    assert "\n" not in str(caught.value)
