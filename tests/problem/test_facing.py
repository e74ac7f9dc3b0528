"""An image that is turned round is left out, and takes nothing with it: the others end where they
do without it."""

from __future__ import annotations

import numpy as np
import pytest
import support

import jaxba
from jaxba import (
    BundleProblem,
    Lenses,
    ProblemWarning,
    Solution,
    Termination,
    covariance,
    hold,
    read_bal,
    retriangulate,
    solve_and_retriangulate,
    write_bal,
)
from jaxba.cli.solve import run
from jaxba.cli.table import remarks
from jaxba.lm.records import StepInfo
from jaxba.problem import geometry
from jaxba.problem.camera_models import CAMERA_MODELS
from jaxba.problem.facing import facing_away, views_behind
from jaxba.problem.labels import Labels, part_names

BACK = np.diag([-1.0, 1.0, -1.0])
"""Half a turn about the y axis of a camera."""

OPTIONS = support.solve_options(compilation="auto")


def turned(problem: BundleProblem, *images: int) -> BundleProblem:
    """Images that look the other way from where they are."""
    cameras = np.array(problem.cameras)
    for image in images:
        turn = BACK @ geometry.rotation_matrices(cameras[image : image + 1, :3])
        cameras[image, :3], cameras[image, 3:6] = (
            geometry.angle_axis(turn)[0],
            BACK @ cameras[image, 3:6],
        )
    return problem.replace(cameras=cameras)


def unseen(problem: BundleProblem, image: int) -> BundleProblem:
    """The problem without the key-points of an image."""
    seen = np.asarray(problem.camera_index) != image
    parts = {
        name: getattr(problem, name)[seen]
        for name in ("observations", "camera_index", "point_index")
    }
    return problem.replace(**parts)


def unmoved(problem: BundleProblem) -> Solution:
    """A solve without an iteration."""
    nothing = StepInfo(*[np.zeros(0)] * len(StepInfo._fields))
    return Solution(
        problem, 0.0, 0.0, 0, 0, Termination.MAX_ITERATIONS, nothing, "explicit", 0.0, 0.0, 0.0
    )


@pytest.mark.parametrize("find", [jaxba.solve, solve_and_retriangulate])
def test_the_others_end_where_they_do_without_an_image_that_is_turned_round(find):
    problem = turned(support.tiny(), 2)
    with pytest.warns(ProblemWarning, match=r"left out 36 observations .* \(camera 2\)"):
        found = find(problem, "ceres", OPTIONS)
    wanted = find(unseen(problem, 2), "ceres", OPTIONS)
    assert (found.set_aside.tolist(), wanted.set_aside.tolist()) == ([2], [])
    np.testing.assert_allclose(found.final_cost, wanted.final_cost, rtol=1e-6)
    np.testing.assert_allclose(geometry.cost(unseen(found.problem, 2)), found.final_cost, rtol=1e-9)
    np.testing.assert_allclose(found.initial_cost, geometry.cost(unseen(problem, 2)), rtol=1e-9)
    assert (found.problem.cameras[2] == problem.cameras[2]).all()
    assert found.problem.observations is problem.observations


def test_covariances_are_those_without_it():
    once = np.flatnonzero(np.bincount(unseen(support.tiny(), 2).point_index) < 2)
    problem = hold(turned(support.tiny(), 2), poses=[0, 5], points=once)
    found = covariance(problem)
    wanted = covariance(unseen(problem, 2))
    np.testing.assert_allclose(found.poses, wanted.poses, rtol=1e-9)
    assert np.isnan(found.poses).all(axis=(1, 2)).tolist() == [image == 2 for image in range(6)]


@pytest.mark.parametrize("images", [(0, 1, 2), (0, 1, 2, 3, 4, 5)])
def test_nothing_is_left_out_where_half_of_the_images_or_more_face_away(images):
    problem = turned(support.tiny(), *images)
    assert views_behind(problem).sum() >= 100
    assert not len(facing_away(problem))
    assert "another convention?" in remarks(problem, unmoved(problem))[-1] or len(images) < 6
    np.testing.assert_array_equal(facing_away(turned(support.tiny(), *images[:2])), [0, 1])


def test_a_few_points_behind_an_image_are_no_reason_to_leave_it_out():
    assert views_behind(support.strayed(-1.0)).sum() >= 8
    assert not len(facing_away(support.strayed(-1.0)))


@pytest.mark.parametrize(
    ("model", "mirrored"), [("PINHOLE", True), ("FISHEYE", False), ("EQUIRECTANGULAR", False)]
)
def test_lenses_that_see_what_is_behind_them_never_face_away(model, mirrored):
    problem = turned(support.tiny(), 2)
    models = (CAMERA_MODELS[model],)
    numbers = np.tile([500.0, 500.0, 320.0, 240.0][: len(models[0])], (6, 1))
    lenses = Lenses(np.arange(6, dtype=np.int32), np.ones((6, len(models[0])), bool), models=models)
    problem = problem.replace(cameras=np.hstack([problem.cameras[:, :6], numbers]), lenses=lenses)
    assert facing_away(problem).tolist() == ([2] if mirrored else [])
    assert views_behind(problem).any() == mirrored


@support.needs_data
def test_all_views_of_a_start_of_bal_count():
    problem = read_bal(support.bal_file("problem-49-7776-pre"))
    assert views_behind(problem).sum() == 31
    assert not len(facing_away(problem))


def test_images_are_named_as_in_their_file():
    labels = Labels(tuple("abcdef"), np.arange(6), np.arange(6), np.arange(40))
    assert part_names(labels, "image", np.array([4])) == "image 4 (e)"
    assert part_names(labels, "image", np.arange(1, 4), 2) == "image 1 (b), image 2 (c) and 1 more"


def test_the_command_refuses_under_strict_and_says_else_what_was_left_out(tmp_path, capsys):
    path = tmp_path / "turned.txt"
    write_bal(turned(support.tiny(), 2), path)
    assert run([str(path), "--strict"]) == 2
    assert (
        "left out 36 observations of an image that faces away from them (camera 2)"
        in capsys.readouterr().err
    )
    assert run([str(path), "--max-iterations", "1"]) == 0
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert "(camera 2); its pose stays as it is" in notes[0]
    assert not any("behind" in note or "without observations" in note for note in notes[1:])


def test_a_search_for_points_looks_through_no_image_that_is_turned_round():
    problem = turned(support.strayed(3.0), 2)
    found = retriangulate(problem)
    wanted = retriangulate(unseen(problem, 2))
    assert found.moved == wanted.moved > 0
    np.testing.assert_allclose(found.cost_after, wanted.cost_after, rtol=1e-9)
