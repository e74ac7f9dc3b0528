"""Step options: constants that select a program, checked when they are made."""

from __future__ import annotations

import dataclasses

import pytest

from jaxba import ConjugateGradients, Coordinates, Loss, Refinement, StepOptions


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (StepOptions, {"linear_solver": "dense"}, "linear_solver must be one of explicit"),
        (StepOptions, {"linear_solver": "auto"}, "linear_solver must be one of explicit"),
        (
            StepOptions,
            {"intrinsics": "known"},
            "intrinsics must be one of free, fixed, not 'known'",
        ),
        (Coordinates, {"scaling": "none"}, "scaling must be one of diagonal, identity, not 'none'"),
        (
            Coordinates,
            {"rotation": "quaternion"},
            "rotation must be one of angle-axis, manifold, not 'quaternion'",
        ),
        (Coordinates, {"lens_step": "zoom"}, "lens_step must be one of file, pixels, not 'zoom'"),
        (Refinement, {"points": -1}, "points must be at least 0"),
        (Refinement, {"points": 2.5}, "points must be a whole number, is 2.5"),
        (Refinement, {"points": 2**32}, "points must be at most 2147483647"),
        (Refinement, {"starts": "anywhere"}, "starts must be one of step, rays, not 'anywhere'"),
        (Refinement, {"camera_rounds": -1}, "camera_rounds must be at least 0"),
        (Refinement, {"trials": 0}, "trials must be at least 1"),
        (ConjugateGradients, {"preconditioner": "none"}, "preconditioner must be one of two-level"),
        (ConjugateGradients, {"max_iterations": 0}, "max_iterations must be at least 1"),
        (ConjugateGradients, {"forcing": float("nan")}, "forcing must not be negative, is nan"),
        (ConjugateGradients, {"tolerance": -1.0}, "tolerance must not be negative, is -1"),
    ],
)
def test_an_option_that_makes_no_sense_is_one_clear_line(kind, change, message, unchecked):
    with pytest.raises(ValueError, match=message) as caught:
        kind(**change)
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
    }
    assert len(different) == 8


def test_options_cannot_change_under_a_compiled_program():
    with pytest.raises(dataclasses.FrozenInstanceError):
        StepOptions().intrinsics = "fixed"  # type: ignore[misc]


def test_the_defaults_are_those_of_ceres():
    assert Coordinates() == Coordinates(scaling="diagonal", rotation="angle-axis", lens_step="file")
    rule = ConjugateGradients()
    assert (rule.forcing, rule.tolerance, rule.max_iterations) == (0.1, 0.0, 500)
    assert StepOptions().loss == Loss("squared")


def test_the_default_is_a_plain_step():
    assert Refinement() == Refinement(points=0, trials=1, camera_rounds=0, pattern_moves=0)
