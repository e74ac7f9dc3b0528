"""Solver names: what is written can be read, and what cannot be read is said in one line."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxba import POLICIES
from jaxba.solver.names import DTYPES, SolverName, parse_solver
from jaxba.typing import InputError

names = st.builds(
    SolverName,
    method=st.sampled_from(["lm", "stba", "stba:12", "deeplm"]),
    policy=st.one_of(
        st.sampled_from(sorted(POLICIES)),
        st.floats(1e-300, 1e300).map(lambda x: f"constant:{x!r}"),
        st.floats(1e-20, 1e30).map(lambda x: f"ceres:{x:g}"),
        st.floats(1e-9, 1e9).map(lambda x: f"classic:{x:e}"),
    ),
    refine_points=st.integers(0, 99),
    dtype=st.sampled_from(DTYPES),
)


@given(names)
def test_a_name_reads_back_as_itself(name):
    assert parse_solver(str(name)) == name
    assert name.method != "lm" or parse_solver(f"  lm+{name} ") == name
    assert str(parse_solver(str(name))) == str(name)


@pytest.mark.parametrize(
    ("text", "name", "shortest"),
    [
        ("ceres", SolverName("ceres"), "ceres"),
        ("lm+ceres", SolverName("ceres"), "ceres"),
        ("ceres+refine3", SolverName("ceres", 3), "ceres+refine3"),
        ("ceres+refine0", SolverName("ceres", 0), "ceres"),
        ("lm+classic:0.03+refine12@float32", SolverName("classic:0.03", 12, "float32"), None),
        ("ceres@float64", SolverName("ceres"), "ceres"),
        ("constant:1e-4", SolverName("constant:1e-4"), None),
        ("constant:1e+2", SolverName("constant:1e+2"), None),
        ("lm+constant:1.5E+2+refine1", SolverName("constant:1.5E+2", 1), "constant:1.5E+2+refine1"),
        ("gauss-newton", SolverName("gauss-newton"), "gauss-newton"),
        ("stba+classic", SolverName("classic", method="stba"), None),
        ("stba:16+ceres+refine2@float32", SolverName("ceres", 2, "float32", "stba:16"), None),
        ("deeplm+learned", SolverName("learned", None, method="deeplm"), None),
        ("stba+learned+refine0", SolverName("learned", 0, method="stba"), None),
        ("bold", SolverName("bold", None), None),
        ("bold+embedded", SolverName("bold", None), "bold"),
        ("stba+bold+refine0@float32", SolverName("bold", 0, "float32", "stba"), None),
        ("deeplm+constant:1e-4", SolverName("constant:1e-4", method="deeplm"), None),
    ],
)
def test_names_of_the_contract(text, name, shortest):
    assert parse_solver(text) == name
    assert str(name) == (shortest or text.removeprefix("lm+"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'' is no solver"),
        ("   ", "is no solver"),
        ("+ceres", "unknown method ''"),
        ("ceres+", "is no solver"),
        ("ceres+refine", "unknown method 'ceres'"),
        ("ceres+refine-1", "unknown method 'ceres'"),
        ("ceres+refine3+refine4", "unknown method 'ceres'"),
        ("refine3", "unknown damping policy 'refine3'"),
        ("+refine3", "is no solver"),
        ("gn+ceres", "unknown method 'gn'"),
        ("lm:3+ceres", "lm has no clusters"),
        ("stba:0+ceres", "must be a positive number, not '0'"),
        ("stba:few+ceres", "must be a positive number, not 'few'"),
        ("lm+lm+ceres", "is no solver"),
        ("ceres@", "unknown type ''"),
        ("ceres@float16", "unknown type 'float16'"),
        ("ceres@float32@float64", "unknown type 'float32@float64'"),
        ("@float32", "is no solver"),
        ("cerse", "unknown damping policy 'cerse'"),
        ("constant:zero", "lambda must be a positive number, not 'zero'"),
        ("schedule:1", "has no first lambda to set"),
        ("ce\nres", "unknown damping policy"),
    ],
)
def test_what_is_no_name_is_one_clear_line(text, message):
    with pytest.raises(InputError) as caught:
        parse_solver(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
