"""Problems from outside: what they refuse, when two are equal, and how they are shown."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import jax.numpy as jnp
import numpy as np
import pytest
from support import arrays, tiny

from jaxba import BundleProblem, Constants, Lenses, ProblemError, hold, inputs_of, make_policy
from jaxba.lm.records import StepInfo

NAMES = ("cameras", "points", "observations", "camera_index", "point_index")

WRONG = {
    "complex": lambda x: x.astype(complex),
    "text": lambda x: x.astype(str),
    "nothing": lambda x: None,
    "one number": lambda x: 5,
    "rows of other lengths": lambda x: [[1, 2], [3]],
    "masked": lambda x: np.ma.masked_array(x, mask=np.ones(x.shape)),
    "dates": lambda x: x.astype("M8[s]"),
    "objects": lambda x: np.array([object()] * len(x)),
    "another axis": lambda x: x[None],
    "an iterator": iter,
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", [*NAMES, "weight"])
def test_what_is_no_array_of_numbers_is_refused_in_one_line_that_names_it(name, wrong):
    given = dict(zip(NAMES, arrays(tiny()), strict=True), weight=np.ones(tiny().num_observations))
    if (name, wrong) == ("weight", "nothing"):
        return
    given[name] = WRONG[wrong](given[name])
    with pytest.raises(ProblemError) as caught:
        BundleProblem.create(**given)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "sequence" not in str(caught.value), "NumPy's words"


def test_problems_are_equal_where_all_their_arrays_are():
    problem = tiny()
    held = hold(problem, poses=[0], numbers=["k1"])
    moved = np.array(problem.points)
    moved[3, 1] += 1e-9
    assert problem == copy.deepcopy(problem) == pickle.loads(pickle.dumps(problem))
    assert problem == problem.replace(points=jnp.asarray(problem.points))
    assert held == hold(problem, poses=[0], numbers=["k1"])
    for other in (
        held,
        problem.replace(points=moved),
        problem.replace(points=problem.points[1:]),
        "problem",
        None,
    ):
        assert problem != other
    assert held != hold(problem, poses=[1], numbers=["k1"])
    with pytest.raises(TypeError, match="unhashable type: 'BundleProblem'"):
        hash(problem)


def test_nan_is_equal_to_nan():
    history = StepInfo(*[np.array([1.0, np.nan])] * len(StepInfo._fields))
    assert history == copy.deepcopy(history)
    assert history != history._replace(cost=np.array([2.0, np.nan]))


def shown() -> dict[str, object]:
    problem = hold(tiny(), poses=[0], numbers=["k1"])
    assert isinstance(problem.lenses, Lenses)
    assert isinstance(problem.constants, Constants)
    history = StepInfo(*[np.arange(9.0)] * len(StepInfo._fields))
    policy = make_policy("learned")
    return {
        "problem": problem,
        "inputs": inputs_of(problem),
        "history": history,
        "policy": policy,
    } | {field.name: getattr(problem, field.name) for field in dataclasses.fields(problem)[6:8]}


@pytest.mark.parametrize("name", shown())
def test_what_holds_arrays_is_shown_in_one_short_line(name):
    value = shown()[name]
    assert repr(value).startswith(type(value).__name__)
    assert "\n" not in repr(value)
    assert len(repr(value)) < 700


def test_a_problem_is_shown_by_its_counts():
    assert repr(tiny()) == "BundleProblem(6 cameras, 40 points, 200 observations)"
