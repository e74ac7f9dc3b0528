"""What marks cannot be is said before anything is solved: of other photos, apart, upside down, at
other heights."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable

import numpy as np
import pytest

import jaxba
from benchmarks.survey_scenes import Survey, draw, write
from jaxba import ProblemError, ProblemWarning

Change = Callable[[Survey], None]


@pytest.fixture
def said(tmp_path) -> Callable[..., list[str]]:
    """Notes on a survey after a change."""

    def read(survey: Survey, change: Change, **settings) -> list[str]:
        changed = copy.deepcopy(survey)
        change(changed)
        file = write(changed, tmp_path, bent=False)
        problem = jaxba.read_colmap(tmp_path / "model")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            jaxba.survey(problem, file, model=tmp_path / "model", **settings)
        texts = [str(one.message) for one in caught if issubclass(one.category, ProblemWarning)]
        return [text for text in texts if "the scene is in" not in text]

    return read


@pytest.fixture(scope="module")
def facade() -> Survey:
    return draw("facade", "marks", 3)


@pytest.fixture(scope="module")
def block() -> Survey:
    pytest.importorskip("pyproj")
    return draw("block", "log marks", 3)


def scaled(survey: Survey, size: float) -> None:
    survey.mark_pixels = survey.mark_pixels * size


def upside_down(survey: Survey) -> None:
    survey.mark_pixels = np.array(survey.size) - survey.mark_pixels


def y_up(survey: Survey) -> None:
    survey.mark_pixels[..., 1] = survey.size[1] - survey.mark_pixels[..., 1]


def test_marks_that_fit_get_no_note(said, facade):
    assert said(facade, lambda survey: None) == []


@pytest.mark.parametrize("size", [0.5, 0.27])
def test_marks_of_resized_photos_are_refused_with_both_sizes(said, facade, size):
    width, height = (round(size * side) for side in facade.size)
    with pytest.raises(
        ProblemError,
        match=rf"control_points: the pixels .* {size:.3g} times .* {width} x {height} inst",
    ):
        said(facade, lambda survey: scaled(survey, size))


@pytest.mark.parametrize(
    ("change", "what"), [(upside_down, "upside down"), (y_up, "whose y goes up")]
)
def test_marks_of_turned_photos_are_refused(said, facade, change, what):
    with pytest.raises(ProblemError, match=f"those of photos {what}"):
        said(facade, change)


def test_a_wrong_click_is_named_with_its_image(said, facade):
    def change(survey: Survey) -> None:
        survey.mark_pixels[3, 1] += [25.0, 10.0]

    (note,) = said(facade, change)
    assert "rays of the same point do not meet, by pixels (RMS): gcp4 (" in note
    assert f"those of gcp4 least in {facade.names[facade.mark_seen[3, 1]]}" in note


def test_pixels_outside_of_their_image_are_left_out(said, facade):
    def change(survey: Survey) -> None:
        survey.mark_pixels[2, 0] += [6000.0, 0.0]

    image = facade.names[facade.mark_seen[2, 0]]
    (note,) = said(facade, change)
    assert (
        f"pixels of gcp3 lie outside of {image} (6000 x 4000): photos of another size, or turned?"
        in note
    )


def test_pixels_outside_of_their_image_are_refused_where_all_must_fit(said, facade):
    def change(survey: Survey) -> None:
        survey.mark_pixels[2, 0] += [6000.0, 0.0]

    with pytest.raises(ProblemError, match="pixels of gcp3 lie outside"):
        said(facade, change, strict=True)


def test_three_points_with_heights_that_go_down_turn_the_scene_over(said, facade):
    def change(survey: Survey) -> None:
        survey.mark_names = survey.mark_names[:3]
        survey.checks = []
        survey.marks = survey.marks[:3] * [1, 1, -1]
        survey.mark_seen, survey.mark_pixels = survey.mark_seen[:3], survey.mark_pixels[:3]

    (note,) = said(facade, change)
    assert "the scene stands on its head" in note


@pytest.mark.parametrize("shift", [-47.0])
def test_two_kinds_of_heights_are_said_before_the_solve(said, block, shift):
    def change(survey: Survey) -> None:
        survey.marks[:, 2] += shift

    (note,) = said(block, change)
    assert "all alike" in note
    assert "heights above the ellipsoid and above the geoid" in note


def test_a_typo_in_a_control_point_is_named_before_the_solve(said, block):
    def change(survey: Survey) -> None:
        survey.marks[4, 0] += 40.0

    (note,) = said(block, change)
    assert "points are not where the scene has them: gcp5 is 40" in note


def test_pixels_most_of_which_lie_outside_are_refused(said, facade):
    with pytest.raises(
        ProblemError,
        match=r"lie outside of .* \(6000 x 4000\), and \d+ more: photos of another size",
    ):
        said(facade, lambda survey: scaled(survey, 3.0))


def test_a_wrong_click_is_refused_where_all_must_fit(said, facade):
    def change(survey: Survey) -> None:
        survey.mark_pixels[3, 1] += [25.0, 10.0]

    with pytest.raises(
        ProblemError, match=r"survey.yaml: control_points: rays of the same point do not meet"
    ):
        said(facade, change, strict=True)
