"""Wrong arguments of public functions are refused in one line that begins with their name."""

from __future__ import annotations

import numpy as np
import pytest
import support

import jaxba

WRONG = {
    "a tolerance": (
        lambda p: jaxba.SolveOptions(tolerances=jaxba.Tolerances(ftol="1e-6")),
        "ftol must be real numbers",
    ),
    "a limit of time": (
        lambda p: jaxba.SolveOptions(tolerances=jaxba.Tolerances(seconds="soon")),
        "seconds must be real numbers, not 'soon'",
    ),
    "within": (
        lambda p: jaxba.SolveOptions(within=[1, 2]),
        "within must be one number, not [1, 2]",
    ),
    "no within": (lambda p: jaxba.SolveOptions(within=None), "within must be"),
    "an array": (
        lambda p: jaxba.SolveOptions(max_iterations=np.zeros((2, 2))),
        "max_iterations must be a whole number",
    ),
    "a list for a word": (
        lambda p: jaxba.SolveOptions(dtype=["float64"]),
        "dtype must be one of float64, float32, mixed",
    ),
    "a callback": (lambda p: jaxba.solve(p, callback="print"), "callback must be a function"),
    "a number of views": (
        lambda p: jaxba.part(p, min_track="3"),
        "min_track must be a whole number, is '3'",
    ),
    "a seed": (
        lambda p: jaxba.perturb(p, "abc", 0.1),
        "seed must be a whole number that is not negative, not 'abc'",
    ),
    "a negative seed": (
        lambda p: jaxba.random_scene(jaxba.SceneConfig(cameras=4, points=30), -1),
        "seed must be",
    ),
    "a sigma": (
        lambda p: jaxba.perturb(p, 0, "0.1"),
        "rotation_sigma must be real numbers, not '0.1'",
    ),
    "a policy": (lambda p: jaxba.make_policy(3), "the name of a policy must be a text, not 3"),
    "a method": (
        lambda p: jaxba.make_method(None),
        "the name of a method must be a text, not None",
    ),
    "no problem to write": (
        lambda p: jaxba.write_bal(None, "new.txt"),
        "problem must be a BundleProblem",
    ),
    "no problem to search": (
        lambda p: jaxba.solve_and_retriangulate("a.txt"),
        "problem must be a BundleProblem",
    ),
    "no problem for inputs": (lambda p: jaxba.inputs_of([p]), "problem must be a BundleProblem"),
    "no several problems": (
        lambda p: jaxba.solve_many(7),
        "problems must be several, in a list or a stream, not 7",
    ),
    "recipes": (lambda p: jaxba.solve_recipes(p, "two"), "count must be a whole number, is 'two'"),
    "points of words": (
        lambda p: p.create(p.cameras, "xyz", p.observations, p.camera_index, p.point_index),
        "points must",
    ),
    "a coordinate system": (
        lambda p: jaxba.survey(p, {"crs": ["EPSG:32633"]}),
        "crs: a coordinate system is a text",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_argument_is_one_line_with_its_name(unchecked, what):
    call, said = WRONG[what]
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the message follows
        call(support.tiny())
    text = str(caught.value)
    assert said in text
    assert "\n" not in text
