"""A model without rejected observations: pycolmap reads it, and all that was not rejected is as it
was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import support

from jaxba import ProblemWarning, read_colmap, write_colmap
from jaxba.io.colmap.files import read_model, write_model

pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")
pytestmark = pytest.mark.extra


def test_rejected_observations_leave_tracks_and_key_points_and_points_of_one_view_go(tmp_path):
    write_colmap(support.tiny(), tmp_path / "old")
    problem = read_colmap(tmp_path / "old")
    rejected = np.random.default_rng(2).random(problem.num_observations) < 0.4
    write_colmap(problem, tmp_path / "new", like=tmp_path / "old", rejected=rejected)
    old, new = (pycolmap.Reconstruction(str(tmp_path / name)) for name in ("old", "new"))
    assert problem.labels is not None
    ids = np.array(problem.labels.points)
    kept = ~rejected
    views = np.bincount(problem.point_index[kept], minlength=problem.num_points)
    assert sorted(new.points3D) == ids[views > 1].tolist()
    assert 0 < len(new.points3D) < len(old.points3D)

    def pairs(image):
        return {(tuple(key.xy), key.point3D_id) for key in image.points2D if key.has_point3D()}

    def shift(number):
        return np.array(old.cameras[old.images[number].camera_id].params[1:3])

    for at, number in enumerate(problem.labels.images.tolist()):
        mine = np.flatnonzero(
            kept & (problem.camera_index == at) & (views > 1)[problem.point_index]
        )
        pixels = problem.observations[mine] * [1, -1] + shift(number)
        expected = sorted(zip(map(tuple, pixels), ids[problem.point_index[mine]], strict=True))
        assert [point for _, point in sorted(pairs(new.images[number]))] == [
            int(point) for _, point in expected
        ]
        np.testing.assert_allclose(
            [xy for xy, _ in sorted(pairs(new.images[number]))], [xy for xy, _ in expected]
        )
        assert len(new.images[number].points2D) == len(old.images[number].points2D)
    for number, point in new.points3D.items():
        assert point.track.length() == views[ids == number][0]
        for element in point.track.elements:
            assert new.images[element.image_id].points2D[element.point2D_idx].point3D_id == number
        errors = [
            np.linalg.norm(image.project_point(point.xyz) - image.points2D[element.point2D_idx].xy)
            for element in point.track.elements
            for image in [new.images[element.image_id]]
        ]
        np.testing.assert_allclose(point.error, np.mean(errors), rtol=1e-6)
    again = read_colmap(tmp_path / "new")
    assert again.num_observations == int((kept & (views > 1)[problem.point_index]).sum())


@pytest.mark.parametrize("key", [None, 0], ids=["no tracks", "tracks of the first key-points"])
def test_no_more_than_what_was_rejected_is_lost_where_tracks_are_wrong(tmp_path, key):
    write_colmap(support.tiny(), tmp_path / "old")
    model = read_model(tmp_path / "old")
    if key is None:
        model.points["length"] = 0
        model = replace(model, tracks=model.tracks[:0])
    else:
        model.tracks["key"] = key
    write_model(model, tmp_path / "old", ".bin")
    with pytest.warns(ProblemWarning, match="with another track than key-points say"):
        problem = read_colmap(tmp_path / "old")
    first = np.unique(problem.camera_index, return_index=True)[1]  # key-point of each image
    gone = np.isin(np.arange(problem.num_observations), first[:3])  # of six views of a point
    write_colmap(problem, tmp_path / "new", like=tmp_path / "old", rejected=gone)
    with pytest.warns(ProblemWarning, match="with another track than key-points say"):
        again = read_colmap(tmp_path / "new")
    assert again.num_points == problem.num_points
    assert np.array_equal(again.observations, problem.observations[~gone])


def test_what_does_not_fit_the_model_is_refused(tmp_path):
    write_colmap(support.tiny(), tmp_path / "old")
    problem = read_colmap(tmp_path / "old")
    with pytest.raises(ValueError, match="entries"):
        write_colmap(problem, tmp_path / "new", like=tmp_path / "old", rejected=np.zeros(3, bool))
    with pytest.raises(ValueError, match="subset"):
        write_colmap(problem, tmp_path / "new", rejected=np.zeros(problem.num_observations, bool))
