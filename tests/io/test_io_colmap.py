"""COLMAP models: costs are COLMAP's, what is written is read back bit by bit, and what cannot be is
refused.

The truth is COLMAP itself: its projection, and its own bundle adjustment.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import IO

import numpy as np
import pytest
import support
from support import DATA, constrained, needs_data

from jaxba import (
    BundleProblem,
    ProblemError,
    Refinement,
    SolveOptions,
    covariance,
    hold,
    read_colmap,
    read_problem,
    solve,
    write_colmap,
)
from jaxba.bench.sources import sources
from jaxba.cli.bench import run as run_bench
from jaxba.cli.solve import run
from jaxba.io import json_lines
from jaxba.io.colmap.lenses import AS_BAL
from jaxba.problem import geometry
from jaxba.problem.camera_models import CAMERA_MODELS
from jaxba.solver.record import Record

pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")

pytestmark = pytest.mark.extra

SIZE = 1280, 960
LENSES = {
    "SIMPLE_PINHOLE": [700, 640, 480],
    "PINHOLE": [700, 721, 650, 470],
    "SIMPLE_RADIAL": [700, 640, 480, -0.03],
    "RADIAL": [700, 640, 480, -0.03, 0.002],
    "OPENCV": [700, 712, 640, 480, -0.03, 0.002, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [700, 700, 640, 480, 0.01, 0, 0, 0],
}
REAL = ("bulani7", "yding", "ranjith")


def model_of(kinds: list[str], seed: int = 0):
    """The cameras and points of a random scene behind lenses in turn, seen with half a pixel of
    noise.

    Ids have gaps and come in no order; one image is not registered, and one key-point of each
    belongs to no point."""
    scene = support.paper(seed)
    model = pycolmap.Reconstruction()
    for number, kind in enumerate(kinds):
        lens = pycolmap.Camera(
            camera_id=9 - 3 * number, model=kind, width=SIZE[0], height=SIZE[1], params=LENSES[kind]
        )
        model.add_camera_with_trivial_rig(lens)
    rng = np.random.default_rng(seed)
    matrices = geometry.rotation_matrices(scene.cameras[:, :3])
    flip = np.diag(geometry.COLMAP_FLIP)
    ids = [40 - 3 * camera for camera in range(scene.num_cameras)]
    for camera, identity in enumerate(ids):
        lens_id = 9 - 3 * (camera % len(kinds))
        rotation = flip @ matrices[camera]
        shift = flip @ scene.cameras[camera, 3:6]
        keys = model.camera(lens_id).img_from_cam(scene.points @ rotation.T + shift)
        keys = np.vstack([[[1.0, 2.0]], keys + rng.normal(scale=0.5, size=keys.shape)])
        image = pycolmap.Image(
            name=f"{identity}.png", keypoints=keys, camera_id=lens_id, image_id=identity
        )
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift)
        )
    absent = pycolmap.Image(name="absent.png", keypoints=np.zeros((3, 2)), camera_id=9, image_id=99)
    model.add_image_with_trivial_frame(absent)
    for point in range(scene.num_points):
        track = pycolmap.Track([pycolmap.TrackElement(i, 1 + point) for i in ids[point % 3 :]])
        model.add_point3D(scene.points[point] + rng.normal(scale=0.02, size=3), track)
    return model


def write(model, folder: Path, text: bool = False) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))
    return folder


def colmap_cost(folder: Path | str) -> float:
    """Half the squared errors of all observations, projected by COLMAP."""
    model = pycolmap.Reconstruction(str(folder))
    total = 0.0
    for point in model.points3D.values():
        for view in point.track.elements:
            image = model.image(view.image_id)
            error = image.project_point(point.xyz) - image.point2D(view.point2D_idx).xy
            total += 0.5 * float(error @ error)
    return total


def adjusted_by_colmap(folder: Path | str, target: Path, lenses: bool, **free: bool) -> float:
    """Cost after COLMAP's own bundle adjustment, squared loss, principal points constant."""
    model = pycolmap.Reconstruction(str(folder))
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False,
        refine_focal_length=lenses,
        refine_extra_params=lenses,
        refine_principal_point=False,
        **free,
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    options.ceres.solver_options.max_num_iterations = 300
    options.ceres.solver_options.function_tolerance = 1e-12
    config = pycolmap.BundleAdjustmentConfig()
    for identity in model.reg_image_ids():
        config.add_image(identity)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    return colmap_cost(write(model, target))


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("kinds", [*([kind] for kind in LENSES), list(LENSES)[:4]], ids="+".join)
def test_the_cost_is_that_of_colmap(tmp_path, kinds, text):
    folder = write(model_of(kinds), tmp_path / "model", text)
    problem = read_problem(folder)
    assert (problem.num_cameras, problem.num_points, problem.num_observations) == (
        10,
        10,
        10 * 10 - 9,
    )
    np.testing.assert_allclose(geometry.cost(problem), colmap_cost(folder), rtol=1e-9)


def test_images_of_one_camera_share_a_lens_whose_model_says_what_is_free(tmp_path):
    problem = read_colmap(write(model_of(list(AS_BAL)), tmp_path / "bal"))
    assert problem.lenses is not None
    # ids of images fall as those of lenses do: image 13 is the last one made
    assert problem.lenses.index.tolist() == [2, 0, 1, 2, 0, 1, 2, 0, 1, 2]
    by_id = [[1, 1, 1], [1, 1, 0], [1, 0, 0]]  # ids 3, 6, 9: RADIAL first
    assert problem.lenses.free.astype(int).tolist() == by_id
    mixed = read_colmap(write(model_of(["PINHOLE", "OPENCV"]), tmp_path / "mixed"))
    assert mixed.lenses is not None
    assert [model.name for model in mixed.lenses.models] == ["OPENCV", "PINHOLE"]
    assert mixed.lenses.free.astype(int).tolist() == [
        [1, 1, 0, 0, 1, 1, 1, 1],
        [1, 1, 0, 0, 0, 0, 0, 0],
    ]


@pytest.mark.parametrize("kind", sorted(set(CAMERA_MODELS) - {"BAL"}))
def test_pixels_of_every_camera_model_are_colmaps(kind):
    rng = np.random.default_rng(0)
    model = CAMERA_MODELS[kind]
    start = {
        "omega": 0.8,
        "alpha": 0.6,
        "beta": 1.1,
        "width": 640.0,
        "height": 320.0,
        "cx": 320.0,
        "cy": 240.0,
    }
    focals = dict.fromkeys(("f", "fx", "fy"), 500.0)
    lens = [{**start, **focals}.get(name, 0.0) * rng.uniform(0.9, 1.1) for name in model.parameters]
    lens = [number or rng.uniform(-0.02, 0.02) for number in lens]
    points = rng.normal(size=(200, 3)) * [0.4, 0.4, 0.2] + [0, 0, 1.2]
    points[0, :2] = 0  # on the axis
    truth = np.array(
        pycolmap.Camera(model=kind, width=640, height=480, params=lens).img_from_cam(points)
    )
    numbers = [np.float64(number) for number in lens]
    np.testing.assert_allclose(
        np.stack(model.project(numbers, *points.T), axis=1), truth, rtol=1e-12, atol=1e-10
    )


@pytest.mark.parametrize(
    "kinds",
    [
        ["RADIAL"],
        ["SIMPLE_PINHOLE", "RADIAL"],
        ["OPENCV"],
        ["PINHOLE", "OPENCV_FISHEYE", "SIMPLE_RADIAL"],
    ],
    ids="+".join,
)
def test_a_solve_ends_where_colmaps_own_bundle_adjustment_does(tmp_path, kinds):
    folder = write(model_of(kinds), tmp_path / "model")
    solution = solve(read_problem(folder), "bold")
    assert solution.converged
    write_colmap(solution.problem, tmp_path / "out", like=folder)
    truth = adjusted_by_colmap(folder, tmp_path / "truth", lenses=True)
    np.testing.assert_allclose(solution.final_cost, truth, rtol=1e-5)
    np.testing.assert_allclose(colmap_cost(tmp_path / "out"), solution.final_cost, rtol=1e-9)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_what_is_written_is_read_back_and_the_rest_is_as_it_was(tmp_path, text):
    folder = write(model_of(["PINHOLE", "RADIAL", "OPENCV"]), tmp_path / "model", text)
    problem = read_problem(folder)
    rng = np.random.default_rng(1)
    cameras = problem.cameras + 1e-3 * rng.normal(size=problem.cameras.shape)
    first = np.array(
        [np.flatnonzero(problem.lenses.index == lens)[0] for lens in problem.lenses.index]
    )
    held = ~problem.lenses.free[problem.lenses.index]
    cameras[:, 6:] = np.where(held, problem.cameras[:, 6:], cameras[first, 6:])
    changed = problem.replace(cameras=cameras, points=problem.points + 0.1)
    write_colmap(changed, tmp_path / "out", like=folder)
    assert (tmp_path / "out" / ("cameras.txt" if text else "cameras.bin")).is_file()
    back = read_problem(tmp_path / "out")
    np.testing.assert_allclose(back.cameras, changed.cameras, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(back.points, changed.points, rtol=1e-15)
    np.testing.assert_allclose(back.observations, problem.observations, rtol=1e-12)
    assert (back.camera_index == problem.camera_index).all()
    assert (back.point_index == problem.point_index).all()
    before, after = (pycolmap.Reconstruction(str(place)) for place in (folder, tmp_path / "out"))
    assert {i: image.name for i, image in before.images.items()} == {
        i: image.name for i, image in after.images.items()
    }
    assert after.num_reg_images() == 10
    assert set(after.point3D_ids()) == set(before.point3D_ids())


def test_a_model_may_be_written_in_its_own_folder(tmp_path):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    (folder / "notes.txt").write_text("mine")
    assert run([str(folder), "--output", str(folder)]) == 0
    assert sorted(path.name for path in folder.iterdir()) == [
        *("cameras.bin", "frames.bin", "images.bin", "notes.txt", "points3D.bin", "rigs.bin")
    ]
    assert geometry.cost(read_problem(folder)) < 0.99 * geometry.cost(
        read_problem(write(model_of(["RADIAL"]), tmp_path / "again"))
    )


def test_the_command_solves_a_model_and_writes_one_or_a_file(tmp_path, capsys):
    folder = write(model_of(["SIMPLE_RADIAL"]), tmp_path / "model")
    assert run([str(folder), "--output", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "10 cameras, 10 points, 91 observations, 1 lens (f, k1)" in printed.out
    assert f"wrote {tmp_path / 'out'}" in printed.out
    solved = read_problem(tmp_path / "out")
    assert geometry.cost(solved) < geometry.cost(read_problem(folder))
    assert run([str(folder), "--intrinsics", "fixed", "--output", str(tmp_path / "out.txt")]) == 0
    assert "1 lens (constant)" in capsys.readouterr().out
    flat = read_problem(tmp_path / "out.txt")
    assert (flat.cameras[:, 6] == 700).all()


def test_the_heading_counts_lenses_by_what_is_free(tmp_path, capsys):
    folder = write(
        model_of(["RADIAL", "OPENCV", "SIMPLE_PINHOLE", "SIMPLE_PINHOLE"]), tmp_path / "model"
    )
    assert run([str(folder), "--max-iterations", "1"]) == 0
    assert (
        "2 SIMPLE_PINHOLE (f), 1 OPENCV (fx, fy, k1, k2, p1, p2), 1 RADIAL (f, k1, k2)"
        in capsys.readouterr().out
    )


def test_a_name_with_a_dot_is_a_folder_and_a_file_says_what_it_lacks(tmp_path, capsys):
    folder = write(model_of(["PINHOLE"]), tmp_path / "model")
    assert (
        run([str(folder), "--max-iterations", "2", "--output", str(tmp_path / "refined.v2")]) == 0
    )
    assert (tmp_path / "refined.v2" / "cameras.bin").is_file()
    assert "cannot store" not in capsys.readouterr().out
    assert (
        run([str(folder), "--max-iterations", "2", "--output", str(tmp_path / "flat.txt.gz")]) == 2
    )
    assert capsys.readouterr().err.endswith("it would hold BAL's lenses only, not PINHOLE\n")


def test_robust_losses_and_the_search_for_points_work_with_shared_lenses(tmp_path, capsys):
    folder = write(model_of(["PINHOLE", "RADIAL"]), tmp_path / "model")
    out = tmp_path / "out"
    assert run([str(folder), "--loss", "huber", "--retriangulate", "--output", str(out)]) == 0
    assert "search for points at other depths" in capsys.readouterr().out
    assert colmap_cost(out) < colmap_cost(folder)


def test_fixed_lenses_stay_bit_by_bit_in_float32(tmp_path):
    folder = write(model_of(["PINHOLE", "RADIAL"]), tmp_path / "model")
    for arguments in (["--intrinsics", "fixed"], []):
        assert (
            run([str(folder), "--dtype", "float32", *arguments, "--output", str(tmp_path / "out")])
            == 0
        )
        before, after = (
            pycolmap.Reconstruction(str(place)) for place in (folder, tmp_path / "out")
        )
        for identity in (6, 9):
            same = before.camera(identity).params == after.camera(identity).params
            assert same.all() if arguments else same.tolist()[-2:] == [identity == 9, identity == 9]


def test_a_benchmark_takes_models_and_skips_what_a_solver_refuses(tmp_path, capsys):
    folder = write(model_of(["RADIAL"]), tmp_path / "garden" / "sparse" / "0")
    (source,) = sources([str(folder)])
    assert source.name == "garden-sparse-0"
    out = tmp_path / "runs"
    solvers = "stba+ceres,ceres,pyceres:dense"
    assert run_bench([str(folder), "--solvers", solvers, "--repeats", "1", "--out", str(out)]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2
    assert errors[0].startswith("error: garden-sparse-0, stba+ceres: shared lenses need plain LM")
    assert errors[1].startswith(
        "error: garden-sparse-0, pyceres:dense: Ceres as a peer takes no covariances"
    )
    assert [record.solver for record in json_lines.read(out / "results.jsonl", Record)] == ["ceres"]
    assert (out / "report.html").is_file()


def test_point_errors_in_the_written_model_are_those_of_the_solution(tmp_path):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    write_colmap(solve(read_problem(folder), "bold").problem, tmp_path / "out", like=folder)
    model = pycolmap.Reconstruction(str(tmp_path / "out"))
    point = model.point3D(1)
    errors = []
    for view in point.track.elements:
        image = model.image(view.image_id)
        errors.append(
            np.linalg.norm(image.project_point(point.xyz) - image.point2D(view.point2D_idx).xy)
        )
    np.testing.assert_allclose(point.error, np.mean(errors), rtol=1e-9)


# What is refused, in one line that names the folder


def refusal(folder: Path) -> str:
    with pytest.raises(ProblemError) as caught:
        read_problem(folder)
    message = str(caught.value)
    assert str(folder) in message
    assert message.isprintable()
    return message


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_file_that_is_cut_short_is_refused(tmp_path, file):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    content = (folder / file).read_bytes()
    (folder / file).write_bytes(content[: len(content) // 2])
    assert f"{folder / file} is cut short" in refusal(folder)


def test_a_missing_file_is_refused(tmp_path):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    (folder / "images.bin").unlink()
    assert refusal(folder) == f"{folder / 'images.bin'} is missing"


def test_impossible_lenses_are_refused(tmp_path):
    model = model_of(["RADIAL"])
    model.camera(9).params = [-1.0, 0, 0, 0, 0]
    assert "camera 9 has impossible parameters" in refusal(write(model, tmp_path / "model"))


def test_a_model_without_points_is_refused(tmp_path):
    model = model_of(["RADIAL"])
    for identity in list(model.point3D_ids()):
        model.delete_point3D(identity)
    assert "no image sees a point" in refusal(write(model, tmp_path / "model"))


def test_a_problem_of_another_model_is_not_written(tmp_path):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    problem = read_problem(folder)
    fewer = problem.replace(points=problem.points[1:])
    for other in (support.tiny(), fewer):
        with pytest.raises(ProblemError, match="the problem is not one of"):
            write_colmap(other, tmp_path / "out", like=folder)
    apart = solve(problem.replace(lenses=None), "ceres", SolveOptions(max_iterations=2)).problem
    with pytest.raises(ProblemError, match="images of camera 9 have different intrinsics"):
        write_colmap(apart, tmp_path / "out", like=folder)
    assert not (tmp_path / "out").exists()


def test_a_model_that_a_full_disk_cuts_short_replaces_nothing(tmp_path, monkeypatch):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    problem = read_problem(folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    as_ever = Path.open

    def full(path: Path, mode: str, **more: object) -> IO:
        if path.name == "rigs.bin" and mode == "wb":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return as_ever(path, mode, **more)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(ProblemError, match=f"^cannot write {folder}: No space left on device$"):
        write_colmap(problem.replace(points=problem.points + 1), folder, like=folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_links_and_permissions_of_files_stay(tmp_path):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    (folder / "points3D.bin").rename(tmp_path / "elsewhere")
    (folder / "points3D.bin").symlink_to(tmp_path / "elsewhere")
    (folder / "images.bin").chmod(0o640)
    problem = read_problem(folder)
    write_colmap(problem.replace(points=problem.points + 1), folder, like=folder)
    assert (folder / "points3D.bin").is_symlink()
    assert (folder / "images.bin").stat().st_mode & 0o777 == 0o640
    assert np.array_equal(read_problem(folder).points, problem.points + 1)


@pytest.mark.parametrize("change", [(2, 6, 0.0), (2, 6, np.inf), (3, 4, np.nan), (1, 0, np.nan)])
def test_what_could_not_be_read_is_not_written(tmp_path, change):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    problem = read_problem(folder)
    cameras = problem.cameras.copy()
    row, column, value = change
    cameras[slice(None) if column == 6 else row, column] = value
    why = r"cannot write .* (impossible parameters: |the pose of image .* is not finite)"
    with pytest.raises(ProblemError, match=why):
        write_colmap(problem.replace(cameras=cameras), tmp_path / "out", like=folder)
    assert not (tmp_path / "out").exists()


def test_a_text_model_beside_a_binary_one_is_written_as_that(tmp_path):
    text = write(model_of(["RADIAL"]), tmp_path / "text", text=True)
    binary = write(model_of(["RADIAL"]), tmp_path / "b")
    problem = read_problem(text)
    moved = problem.replace(points=problem.points + 1)
    write_colmap(moved, binary, like=text)
    np.testing.assert_allclose(read_problem(binary).points, moved.points, rtol=1e-15)


def test_both_forms_of_a_folder_are_written_and_none_is_left_old(tmp_path):
    """nerfstudio reads the text files first, COLMAP the binary ones."""
    folder = write(model_of(["RADIAL"]), tmp_path / "m")
    write(model_of(["RADIAL"]), tmp_path / "m", text=True)
    problem = read_problem(folder)
    moved = problem.replace(points=problem.points + 1)
    write_colmap(moved, folder, like=folder)
    for file in folder.glob("*.bin"):
        file.rename(tmp_path / file.name)
    np.testing.assert_allclose(read_problem(folder).points, moved.points, rtol=1e-15)


def rigs_of(cameras: int):
    """Two rigs of cameras that see 60 points in five frames each, with noise."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    noise = pycolmap.SyntheticNoiseOptions()
    options.num_rigs = 2
    options.num_cameras_per_rig = cameras
    options.num_frames_per_rig = 5
    options.num_points3D = 60
    options.num_points2D_without_point3D = 0
    model = pycolmap.synthesize_dataset(options)
    noise.point2D_stddev = 0.5
    noise.point3D_stddev = 0.02
    noise.rig_from_world_rotation_stddev = 0.3
    pycolmap.synthesize_noise(noise, model)
    return model


@pytest.mark.parametrize("linear_solver", ["explicit", "implicit"])
@pytest.mark.parametrize("places", ["constant", "free"])
def test_rigs_end_where_colmap_has_them_and_are_written_as_rigs(tmp_path, linear_solver, places):
    folder = write(rigs_of(3), tmp_path / "model")
    problem = read_problem(folder)
    assert problem.rigs.free.sum() == 20  # two of three cameras in ten frames
    problem = hold(problem, extrinsics="all" if places == "constant" else ())
    np.testing.assert_allclose(geometry.cost(problem), colmap_cost(folder), rtol=1e-9)
    solution = solve(
        problem, "ceres", SolveOptions(linear_solver=linear_solver, max_iterations=100)
    )
    truth = adjusted_by_colmap(
        folder, tmp_path / "truth", lenses=True, refine_sensor_from_rig=places == "free"
    )
    np.testing.assert_allclose(solution.final_cost, truth, rtol=1e-5)
    write_colmap(solution.problem, tmp_path / "out", like=folder)
    np.testing.assert_allclose(colmap_cost(tmp_path / "out"), solution.final_cost, rtol=1e-9)
    np.testing.assert_allclose(
        geometry.cost(read_problem(tmp_path / "out")), solution.final_cost, rtol=1e-9
    )


@pytest.mark.parametrize(
    ("held", "option"),
    [
        ("frames", {"refine_rig_from_world": False}),
        ("frame-rotations", {"constant_rig_from_world_rotation": True}),
    ],
)
def test_frames_that_are_constant_let_places_in_rigs_move_as_in_colmap(tmp_path, held, option):
    folder = write(rigs_of(3), tmp_path / "model")
    problem = constrained(read_problem(folder), (held,), None, None)
    solution = solve(problem, "ceres", SolveOptions(max_iterations=100))
    truth = adjusted_by_colmap(folder, tmp_path / "truth", lenses=True, **option)
    np.testing.assert_allclose(solution.final_cost, truth, rtol=1e-5)


def test_a_rig_that_does_not_say_where_a_camera_is_is_refused(tmp_path):
    folder = write(rigs_of(2), tmp_path / "model", text=True)
    lines = (folder / "rigs.txt").read_text().splitlines()
    at = next(n for n, line in enumerate(lines) if not line.startswith("#"))
    words = lines[at].split()  # id, 2, CAMERA, reference, CAMERA, other, 1 and seven numbers
    lines[at] = " ".join([*words[:6], "0"])
    (folder / "rigs.txt").write_text("\n".join(lines) + "\n")
    assert f"it is not known where camera {words[5]} is in it" in refusal(folder)


def test_a_lens_without_a_focal_length_has_colmaps_cost_and_is_constant(tmp_path):
    model = model_of(["RADIAL"])
    lens = pycolmap.Camera(
        camera_id=80, model="EQUIRECTANGULAR", width=SIZE[0], height=SIZE[1], params=list(SIZE)
    )
    model.add_camera_with_trivial_rig(lens)
    seen = np.array([point.xyz for _, point in sorted(model.points3D.items())])
    keys = np.array(lens.img_from_cam(seen)) + 1.0
    image = pycolmap.Image(name="sphere.png", keypoints=keys, camera_id=80, image_id=80)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for at, identity in enumerate(sorted(model.point3D_ids())):
        model.add_observation(identity, pycolmap.TrackElement(80, at))
    folder = write(model, tmp_path / "model")
    problem = read_problem(folder)
    np.testing.assert_allclose(geometry.cost(problem), colmap_cost(folder), rtol=1e-9)
    solution = solve(problem, "ceres")
    assert solution.final_cost < solution.initial_cost
    assert (solution.problem.cameras[-1, 6:8] == SIZE).all()


@pytest.mark.parametrize("name", ["file", "file.v2"])
def test_an_output_folder_that_is_a_file_is_refused_before_any_work(tmp_path, capsys, name):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    (tmp_path / name).write_text("mine")
    assert run([str(folder), "--output", str(tmp_path / name)]) == 2
    printed = capsys.readouterr()
    assert printed.err == f"error: --output {tmp_path / name}: is a file, not a folder\n"
    assert printed.out == ""


def test_an_output_folder_that_cannot_be_made_is_refused_before_any_work(tmp_path, capsys):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    assert run([str(folder), "--output", str(tmp_path / "none" / "out")]) == 2
    printed = capsys.readouterr()
    assert (
        printed.err
        == f"error: --output {tmp_path}/none/out: folder {tmp_path}/none does not exist\n"
    )
    assert printed.out == ""


def test_no_lens_needs_pycolmap(tmp_path):
    folder = write(model_of(["RADIAL", "OPENCV"]), tmp_path / "model")
    program = "import sys; sys.modules['pycolmap'] = None; from jaxba.cli.solve import main; main()"
    command = [
        sys.executable,
        "-c",
        program,
        str(folder),
        "--max-iterations",
        "1",
        "--output",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert pycolmap.Reconstruction(str(tmp_path / "out")).num_points3D() == 10


# Real models


@needs_data
@pytest.mark.parametrize("name", REAL)
def test_real_models_have_colmaps_cost(name):
    problem = read_problem(f"{DATA}/colmap/{name}")
    np.testing.assert_allclose(
        geometry.cost(problem), colmap_cost(f"{DATA}/colmap/{name}"), rtol=1e-9
    )


@pytest.mark.slow
@needs_data
@pytest.mark.parametrize("name", REAL)
def test_real_models_end_no_higher_than_after_colmaps_own_bundle_adjustment(tmp_path, name):
    folder = f"{DATA}/colmap/{name}"
    solution = solve(read_problem(folder), "bold")
    assert solution.converged
    write_colmap(solution.problem, tmp_path / "out", like=folder)
    truth = adjusted_by_colmap(folder, tmp_path / "truth", lenses=name != "ranjith")
    assert colmap_cost(tmp_path / "out") <= (1 + 1e-5) * truth


def test_a_start_far_from_the_end_is_solved_with_a_shared_lens(tmp_path):
    folder = write(model_of(["RADIAL"]), tmp_path / "model")
    problem = read_problem(folder)
    rng = np.random.default_rng(2)
    far: BundleProblem = problem.replace(
        points=problem.points + rng.normal(scale=0.3, size=problem.points.shape)
    )
    near = solve(problem, "bold").final_cost
    options = SolveOptions(refinement=Refinement(points=3))
    np.testing.assert_allclose(solve(far, "ceres", options).final_cost, near, rtol=1e-4)


def test_covariances_are_colmaps(tmp_path):
    folder = write(rigs_of(1), tmp_path / "model")
    problem = solve(read_problem(folder), "ceres", SolveOptions(max_iterations=100)).problem
    write_colmap(problem, tmp_path / "solved", like=folder)
    points = [0, 20, 40]
    found = covariance(hold(problem, points=points))
    model = pycolmap.Reconstruction(str(tmp_path / "solved"))
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    config = pycolmap.BundleAdjustmentConfig()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    for identity in model.reg_image_ids():
        config.add_image(identity)
    for point in points:
        config.add_constant_point(int(problem.labels.points[point]))
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    settings = pycolmap.BACovarianceOptions()
    settings.params = pycolmap.BACovarianceOptionsParams.ALL
    truth = pycolmap.estimate_ba_covariance(settings, model, adjuster)
    # COLMAP's tangents of rotations are half angles, and its axes are turned
    axes = np.kron(np.diag([0.5, 1.0]), np.diag(geometry.COLMAP_FLIP))
    for camera in (0, 3):
        theirs = truth.get_cam_cov_from_world(int(problem.labels.images[camera]))
        ours = axes @ found.poses[camera] @ axes.T
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-7 * np.abs(theirs).max())
    for point in (1, 33):
        theirs = truth.get_point_cov(int(problem.labels.points[point]))  # of given cameras
        np.testing.assert_allclose(found.points_given_cameras[point], theirs, rtol=1e-6)
