"""Methods by name: each is found where its class is, and other packages can add one."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import get_args

import pytest

from jaxba import METHODS, Refinement, SolveOptions, StepOptions, make_method, make_policy
from jaxba.methods.deeplm import GlobalConjugateGradients
from jaxba.problem.options import ConjugateGradients
from jaxba.solver import methods
from jaxba.training.config import MethodName
from jaxba.typing import InputError


@pytest.mark.parametrize("name", METHODS)
def test_a_method_is_called_as_it_is_looked_up(name):
    assert METHODS[name].name == name
    assert make_method(name) == METHODS[name]


def test_a_training_knows_all_methods_of_the_package():
    assert set(get_args(MethodName)) == set(methods.SHIPPED)


def test_a_package_adds_a_method_by_an_entry_point(monkeypatch):
    added = EntryPoint("mine", "jaxba.methods.deeplm:GlobalConjugateGradients", methods.GROUP)
    monkeypatch.setattr(
        methods, "entry_points", lambda group: [added] if group == methods.GROUP else []
    )
    monkeypatch.setattr(methods, "METHODS", type(METHODS)())
    assert make_method("mine") == GlobalConjugateGradients()
    with pytest.raises(InputError, match="known: lm, stba, deeplm, mine"):
        make_method("yours")


def test_a_method_without_a_name_is_an_option_of_a_solve():
    method = GlobalConjugateGradients(ConjugateGradients(max_iterations=3))
    step = SolveOptions(method=method).step_options(make_policy("ceres"))
    assert step == StepOptions(method=method, refinement=Refinement())
