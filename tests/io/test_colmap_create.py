"""COLMAP models of problems that did not come from one."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import support
from scipy.spatial.transform import Rotation

from jaxba import (
    BundleProblem,
    Lenses,
    ProblemError,
    read_problem,
    write_bal,
    write_colmap,
    write_problem,
)
from jaxba.cli.solve import run
from jaxba.problem import geometry


def same_problem(one: BundleProblem, other: BundleProblem) -> None:
    """Compares two problems up to the order of observations."""
    np.testing.assert_allclose(one.cameras, other.cameras, rtol=1e-12, atol=1e-13)
    assert np.array_equal(one.points, other.points)
    views = [
        sorted(
            zip(
                p.camera_index.tolist(),
                p.point_index.tolist(),
                *p.observations.T.tolist(),
                strict=True,
            )
        )
        for p in (one, other)
    ]
    np.testing.assert_allclose(views[0], views[1], rtol=1e-12, atol=1e-10)


def test_a_problem_is_read_back_from_its_model(tmp_path):
    problem = support.tiny()
    write_problem(problem, f"{tmp_path}/new/")
    back = read_problem(tmp_path / "new")
    same_problem(back, problem)
    assert back.lenses is None
    np.testing.assert_allclose(geometry.cost(back), geometry.cost(problem), rtol=1e-11)


def test_cameras_say_what_a_lens_has_and_which_images_share_it(tmp_path):
    problem = support.tiny()
    cameras = problem.cameras.copy()
    lens = np.array([2, 0, 2, 1, 1, 3])
    cameras[:, 6:] = np.array([[500.0, 0.1, 0.01], [600, 0.2, 0], [700, 0, 0], [800, 0, 0.03]])[
        lens
    ]
    free = np.array(
        [[True, True, True], [True, True, False], [True, False, False], [False, False, False]]
    )
    shared = problem.replace(cameras=cameras, lenses=Lenses(lens, free))
    write_problem(shared, f"{tmp_path}/new/")
    data = (tmp_path / "new" / "cameras.bin").read_bytes()
    kinds = {0: ("SIMPLE_PINHOLE", 3), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5)}
    at = 8
    found = []
    for _ in range(4):
        _, kind, width, height = struct.unpack_from("<IiQQ", data, at)
        name, count = kinds[kind]
        f, x, y, *distortion = struct.unpack_from(f"<{count}d", data, at + 24)
        at += 24 + 8 * count
        assert (x, y) == (width / 2, height / 2)
        found.append((name, f, *distortion))
    assert found == [
        ("RADIAL", 500, 0.1, 0.01),
        ("SIMPLE_RADIAL", 600, 0.2),
        ("SIMPLE_PINHOLE", 700),
        ("RADIAL", 800, 0, 0.03),
    ]
    back = read_problem(tmp_path / "new")
    same_problem(back, shared)
    assert back.lenses is not None
    assert np.array_equal(back.lenses.index, lens)
    assert back.lenses.free.tolist()[:3] == free.tolist()[:3]


def test_the_principal_point_is_the_centre_of_the_smallest_even_image_with_all_pixels(tmp_path):
    problem = support.tiny()
    write_problem(problem, f"{tmp_path}/new/")
    data = (tmp_path / "new" / "cameras.bin").read_bytes()
    for camera in range(6):
        *_, width, height = struct.unpack_from("<IiQQ", data, 8 + 64 * camera)
        seen = np.abs(problem.observations[problem.camera_index == camera]).max(axis=0)
        assert [width, height] == (2 * np.ceil(seen)).tolist()


@pytest.mark.extra
def test_colmap_reads_the_model_with_the_same_cost_and_our_names(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")
    problem = support.tiny()
    write_colmap(problem, tmp_path / "new")
    model = pycolmap.Reconstruction(str(tmp_path / "new"))
    assert (model.num_reg_images(), model.num_points3D(), model.compute_num_observations()) == (
        6,
        40,
        200,
    )
    assert sorted(image.name for image in model.images.values()) == [
        f"image{number:04d}.jpg" for number in range(1, 7)
    ]
    total = 0.0
    for point in model.points3D.values():
        errors = [
            model.image(view.image_id).project_point(point.xyz)
            - model.image(view.image_id).point2D(view.point2D_idx).xy
            for view in point.track.elements
        ]
        total += 0.5 * np.square(errors).sum()
        np.testing.assert_allclose(point.error, np.mean(np.linalg.norm(errors, axis=1)), rtol=1e-8)
    np.testing.assert_allclose(total, geometry.cost(problem), rtol=1e-11)
    for identity, image in model.images.items():
        assert model.frame(image.frame_id).rig_id == identity
        inside = np.array([key.xy for key in image.points2D])
        assert inside.min() >= 0
        assert (inside <= [image.camera.width, image.camera.height]).all()


def test_cameras_and_points_that_nothing_sees_are_written_too(tmp_path):
    problem = support.tiny()
    kept = (problem.camera_index != 3) & (problem.point_index != 7)
    names = ("observations", "camera_index", "point_index")
    fewer = problem.replace(**{name: getattr(problem, name)[kept] for name in names})
    write_problem(fewer, f"{tmp_path}/new/")
    with pytest.warns() as caught:
        back = read_problem(tmp_path / "new")
    assert [str(one.message).partition(": ")[2] for one in caught] == [
        "1 image left out, without observations (image 4 (image0004.jpg))",
        "1 point left out, seen by no image (point 8)",
    ]
    assert (back.num_cameras, back.num_points) == (5, 39)


REFUSED = {
    "focal length": (
        {"cameras": (2, 6, 0.0)},
        "f of camera 2 is 0, and COLMAP's focal lengths are positive",
    ),
    "far pixel": (
        {"observations": (5, 0, 1e12)},
        r"a pixel is 1e\+12 from the centre of its image",
    ),
    "no number": ({"points": (4, 1, np.nan)}, r"points\[4\] is not finite"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_a_model_cannot_hold_is_refused_and_nothing_written(tmp_path, what):
    change, message = REFUSED[what]
    (name, (row, column, value)) = next(iter(change.items()))
    array = getattr(support.tiny(), name).copy()
    array[row, column] = value
    with pytest.raises(ProblemError, match=message):
        write_problem(support.tiny().replace(**{name: array}), f"{tmp_path}/new/")
    assert list(tmp_path.iterdir()) == []


def test_only_an_empty_folder_or_one_of_a_model_is_written(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes").write_text("mine")
    with pytest.raises(
        ProblemError, match="mine: the directory holds other files, and no COLMAP model"
    ):
        write_problem(support.tiny(), tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes"]
    for _ in range(2):
        (tmp_path / "empty").mkdir(exist_ok=True)
        # systems leave such files in any folder
        for hidden in (".DS_Store", "._cameras.bin", "._images.txt"):
            (tmp_path / "empty" / hidden).write_text("hidden")
        write_problem(support.tiny(), tmp_path / "empty")
        same_problem(read_problem(tmp_path / "empty"), support.tiny())


def test_the_command_writes_the_solution_of_a_bal_file_into_a_folder(tmp_path, capsys):
    file: Path = tmp_path / "tiny.txt"
    write_bal(support.tiny(), file)
    assert run([str(file), "--output", str(tmp_path / "new") + "/"]) == 0
    printed = capsys.readouterr()
    assert (
        printed.out.count(
            "note: names and sizes of images, and so principal points, are made up in that model\n"
        )
        == 1
    )
    assert f"wrote {tmp_path}/new/\n" in printed.out
    assert printed.err == ""
    assert geometry.cost(read_problem(tmp_path / "new")) < 0.99 * geometry.cost(support.tiny())


def rolled(problem: BundleProblem, cameras: list[int]) -> BundleProblem:
    """The problem with some cameras rolled by 180 degrees, and their focal lengths negative: the
    same pixels."""
    numbers = np.array(problem.cameras)
    turn = Rotation.from_euler("z", 180, degrees=True)
    numbers[cameras, :3] = (turn * Rotation.from_rotvec(numbers[cameras, :3])).as_rotvec()
    numbers[cameras, 3:6] = turn.apply(numbers[cameras, 3:6])
    numbers[cameras, 6] *= -1
    return problem.replace(cameras=numbers)


@pytest.mark.parametrize("target", ["new/", "transforms.json"])
def test_cameras_of_a_negative_focal_length_are_written_as_rolled_ones(tmp_path, target):
    problem = support.tiny()
    write_problem(rolled(problem, [1, 4]), f"{tmp_path}/{target}")
    write_problem(problem, f"{tmp_path}/same{target}")
    if target == "new/":
        same_problem(read_problem(tmp_path / "new"), problem)
    else:
        found, same = (
            json.loads((tmp_path / name).read_text()) for name in (target, f"same{target}")
        )
        for one, other in zip(found["frames"], same["frames"], strict=True):
            assert one["fl_x"] == other["fl_x"] > 0
            np.testing.assert_allclose(
                one["transform_matrix"], other["transform_matrix"], atol=1e-13
            )


def test_a_model_whose_focal_length_became_negative_is_written_into_itself(tmp_path):
    problem = support.tiny()
    write_problem(problem, f"{tmp_path}/old/")
    old = read_problem(tmp_path / "old")
    write_colmap(rolled(old, [2]), tmp_path / "new", like=tmp_path / "old")
    same_problem(read_problem(tmp_path / "new"), old)


def test_a_solve_of_cameras_with_negative_focal_lengths_writes_its_model(tmp_path, capsys):
    write_bal(rolled(support.tiny(), [0, 3]), tmp_path / "rolled.txt")
    assert (
        run(
            [
                str(tmp_path / "rolled.txt"),
                "--max-iterations",
                "1",
                "--output",
                f"{tmp_path}/model/",
            ]
        )
        == 0
    )
    assert "wrote" in capsys.readouterr().out
    assert (read_problem(tmp_path / "model").cameras[:, 6] > 0).all()


def test_a_pixel_that_no_model_holds_is_refused_before_the_solve(tmp_path, capsys):
    problem = support.tiny()
    pixels = np.array(problem.observations)
    pixels[5, 0] = 1e12
    write_bal(problem.replace(observations=pixels), tmp_path / "far.txt")
    assert run([str(tmp_path / "far.txt"), "--output", f"{tmp_path}/model/"]) == 2
    printed = capsys.readouterr()
    assert "is 1e+12 from the centre of its image" in printed.err
    assert "iteration" not in printed.out
