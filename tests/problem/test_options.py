"""Step options: constants that select a program, checked when they are made."""

from __future__ import annotations

import dataclasses

import pytest

from jaxba import Loss, StepOptions
from jaxba.problem.options import ConjugateGradients, Coordinates, Refinement


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"linear_solver": "dense"}, "linear_solver must be one of explicit"),
        ({"linear_solver": "auto"}, "linear_solver must be one of explicit"),
        ({"scaling": "none"}, "scaling must be one of diagonal, identity, not 'none'"),
        ({"rotation": "quaternion"}, "rotation must be one of angle-axis, manifold, not 'quaternion'"),
        ({"refine_points": -1}, "refine_points must be at least 0"),
        ({"camera_damping": 0.0}, "camera_damping must be positive and finite, is 0"),
        ({"camera_damping": float("nan")}, "camera_damping must be positive and finite, is nan"),
        ({"camera_damping": float("inf")}, "camera_damping must be positive and finite, is inf"),
        ({"camera_rounds": -1}, "camera_rounds must be at least 0"),
        ({"trials": 0}, "trials must be at least 1"),
        ({"intrinsics": "known"}, "intrinsics must be one of free, fixed, not 'known'"),
        ({"intrinsics": "fixed", "linear_solver": "implicit"}, "intrinsics 'fixed' need the explicit solver"),
        ({"cg_max_iterations": 0}, "cg_max_iterations must be at least 1"),
        ({"cg_forcing": float("nan")}, "cg_forcing must not be negative, is nan"),
        ({"cg_tolerance": -1.0}, "cg_tolerance must not be negative, is -1"),
        ({"refine_points": 2.5}, "refine_points must be a whole number, is 2.5"),
        ({"refine_points": 2**32}, "refine_points must be at most 2147483647"),
    ],
)
def test_an_option_that_makes_no_sense_is_one_clear_line(change, message, unchecked):
    with pytest.raises(ValueError, match=message) as caught:
        StepOptions(**change)
    assert "\n" not in str(caught.value)


def test_equal_options_are_one_key_and_different_ones_are_not():
    assert StepOptions() == StepOptions()
    assert hash(StepOptions(loss=Loss("huber", 2.0))) == hash(StepOptions(loss=Loss("huber", 2.0)))
    different = {
        StepOptions(),
        StepOptions(linear_solver="implicit"),
        StepOptions(coordinates=Coordinates(scaling="identity")),
        StepOptions(coordinates=Coordinates(rotation="manifold")),
        StepOptions(refinement=Refinement(points=1)),
        StepOptions(loss=Loss("huber")),
        StepOptions(conjugate_gradients=ConjugateGradients(forcing=0.5)),
        StepOptions(intrinsics="fixed"),
        StepOptions(coordinates=Coordinates(camera_damping=0.01)),
    }
    assert len(different) == 9


def test_options_cannot_change_under_a_compiled_program():
    with pytest.raises(dataclasses.FrozenInstanceError):
        StepOptions().scaling = "identity"  # type: ignore[misc]


def test_the_defaults_are_those_of_ceres():
    options = StepOptions()
    assert (options.coordinates.scaling, options.coordinates.rotation, options.refinement.points) == (
        "diagonal",
        "angle-axis",
        0,
    )
    assert (options.conjugate_gradients.forcing, options.conjugate_gradients.max_iterations, options.loss.name) == (
        0.1,
        500,
        "squared",
    )
