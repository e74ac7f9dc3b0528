"""The configuration of an agent: what it accepts, and the step that it asks for."""

from __future__ import annotations

from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxba import ConjugateGradients, StepOptions
from jaxba.damping.agent_config import AgentConfig
from jaxba.problem.options import Coordinates, Refinement
from jaxba.settings import read

numbers = st.fixed_dictionaries(
    dict(
        observation=st.sampled_from(["scale-free", "paper", "duration"]),
        history=st.integers(1, 20),
        low=st.floats(-15, -3),
        high=st.floats(-2, 10),
        guard=st.sampled_from(["off", "hand-over"]),
        patience=st.integers(1, 9),
        max_rejections=st.integers(1, 99),
        escalate=st.floats(0, 3),
        refinement=st.builds(
            Refinement,
            st.integers(0, 5),
            st.sampled_from(["step", "rays"]),
            *(st.integers(1, 6), st.integers(0, 4), st.integers(0, 4)),
        ),
        lens_step=st.sampled_from(["file", "pixels"]),
    )
)


@given(numbers)
def test_a_configuration_comes_back_from_its_numbers(numbers):
    config = AgentConfig(
        **numbers
    )  # here: beartype draws the item of a list that it looks at, which a strategy must not
    assert read(AgentConfig, asdict(config)) == config
    made = config.step_options(StepOptions(conjugate_gradients=ConjugateGradients(forcing=0.2)))
    assert made.conjugate_gradients.forcing == 0.2
    assert made.refinement == config.refinement
    assert made.coordinates == Coordinates(lens_step=config.lens_step)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"histroy": 3}, "histroy"),
        ({"history": 3.0}, "history"),
        ({"history": True}, "history"),
        ({"history": "3"}, "history"),
        ({"low": "-3"}, "low"),
        ({"low": None}, "low"),
        ({"guard": 1}, "guard"),
        ({"guard": "none"}, "guard"),
        ({"observation": "everything"}, "observation"),
        ({"history": 0}, "history"),
        ({"history": 21}, "history"),
        ({"low": 3.0}, "lambda"),
        ({"low": -16.0}, "lambda"),
        ({"low": float("nan")}, "low"),
        ({"high": float("inf")}, "high"),
        ({"patience": 0}, "patience"),
        ({"max_rejections": 0}, "max_rejections"),
        ({"descent": 0.0}, "descent"),
        ({"descent": float("nan")}, "descent"),
        ({"first_low": 3.0}, "first_low"),
        ({"first_low": float("nan")}, "first_low"),
        ({"min_gain": 1.0}, "min_gain"),
        ({"min_gain": float("nan")}, "min_gain"),
        ({"escalate": -0.1}, "escalate"),
        ({"escalate": float("nan")}, "escalate"),
        ({"escalate": float("inf")}, "escalate"),
        ({"refinement": {"points": -1}}, "points"),
        ({"refinement": {"trials": 0}}, "trials"),
        ({"refinement": 3}, "refinement"),
        ({"lens_step": "zoom"}, "lens_step"),
        ({"refinement": {"starts": True}}, "starts"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_impossible_configurations_are_refused_in_one_line(change, word):
    with pytest.raises(ValueError, match=word) as caught:
        read(AgentConfig, {**asdict(AgentConfig()), **change})
    assert "\n" not in str(caught.value)
