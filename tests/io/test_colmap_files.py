"""Files of COLMAP models: what is read is what COLMAP reads, and what is written COLMAP reads with
the same numbers."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
from support import DATA, needs_data

from jaxba import read_colmap, write_colmap
from jaxba.io.colmap import binary, text
from jaxba.io.colmap.files import read_model
from jaxba.io.colmap.model import MODELS, NO_POINT, SENSORS, Camera, Model
from jaxba.problem.camera_models import CAMERA_MODELS

pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")

pytestmark = pytest.mark.extra

REAL = ("bulani7", "crane8", "mc949", "ranjith", "yding")
KINDS = [kind for kind in MODELS if kind != "EQUIRECTANGULAR"]
FILES = ("cameras", "images", "points3D", "rigs", "frames")


def synthetic(kind: str = "SIMPLE_RADIAL", **options):
    """A reconstruction that COLMAP makes up; ids of points have a gap, and one key-point in five is
    of none."""
    settings = pycolmap.SyntheticDatasetOptions()
    for name, value in {
        "num_rigs": 2,
        "num_cameras_per_rig": 1,
        "num_frames_per_rig": 4,
        "num_points3D": 40,
        "num_points2D_without_point3D": 10,
        **options,
    }.items():
        setattr(settings, name, value)
    default = pycolmap.Camera.create_from_model_name(1, kind, 1000.0, 1024, 768)
    settings.camera_model_id = default.model
    settings.camera_params = default.params.tolist()
    model = pycolmap.synthesize_dataset(settings)
    model.delete_point3D(sorted(model.point3D_ids())[3])
    return model


def write(model, folder: Path, layout: str) -> Path:
    folder.mkdir(parents=True)
    (model.write_text if "text" in layout else model.write_binary)(str(folder))
    if "old" in layout:
        for file in itertools.chain(folder.glob("rigs.*"), folder.glob("frames.*")):
            file.unlink()
    return folder


def same_numbers(model: Model, truth) -> None:
    """Compares a model that was read with what COLMAP has read, number by number."""
    assert sorted(model.cameras) == sorted(truth.cameras)
    for identity, camera in model.cameras.items():
        other = truth.camera(identity)
        assert (camera.model, camera.width, camera.height) == (
            other.model.name,
            other.width,
            other.height,
        )
        assert list(camera.params) == other.params.tolist()
    assert sorted(model.images) == sorted(truth.images)
    for identity, image in model.images.items():
        other = truth.image(identity)
        pose = other.cam_from_world()
        assert (image.name.decode(), image.camera) == (other.name, other.camera_id)
        assert list(image.pose[:4]) == pose.rotation.quat[[3, 0, 1, 2]].tolist()
        assert list(image.pose[4:]) == pose.translation.tolist()
        keys = other.points2D
        assert image.keys["xy"].tolist() == [key.xy.tolist() for key in keys]
        assert image.keys["point"].tolist() == [
            key.point3D_id if key.has_point3D() else NO_POINT for key in keys
        ]
    ends = np.cumsum(model.points["length"].astype(int))
    assert sorted(model.points["id"].tolist()) == sorted(truth.point3D_ids())
    for head, track in zip(model.points, np.split(model.tracks, ends[:-1]), strict=True):
        other = truth.point3D(int(head["id"]))
        assert head["xyz"].tolist() == other.xyz.tolist()
        assert head["rgb"].tolist() == other.color.tolist()
        assert head["error"] == other.error
        assert track.tolist() == [
            (view.image_id, view.point2D_idx) for view in other.track.elements
        ]
    if model.rigs is not None and model.frames is not None:
        assert sorted(model.rigs) == sorted(truth.rigs)
        assert sorted(model.frames) == sorted(truth.frames)
        for identity, frame in model.frames.items():
            other = truth.frame(identity)
            assert frame.rig == other.rig_id
            assert list(frame.pose[4:]) == other.rig_from_world.translation.tolist()
            assert sorted(image for _, image in frame.images) == sorted(
                one.id for one in other.image_ids
            )


@pytest.mark.parametrize("layout", ["binary", "text", "old binary", "old text"])
@pytest.mark.parametrize("options", [{}, {"num_cameras_per_rig": 3}], ids=["cameras", "rigs"])
def test_every_number_is_the_one_that_colmap_reads(tmp_path, layout, options):
    folder = write(synthetic(**options), tmp_path / "m", layout)
    same_numbers(read_model(folder), pycolmap.Reconstruction(str(folder)))


@pytest.mark.parametrize("kind", MODELS)
def test_camera_models_are_colmaps(kind):
    camera = pycolmap.Camera.create_from_model_name(1, kind, 1000.0, 1024, 768)
    model = CAMERA_MODELS[kind]
    assert (int(camera.model), len(camera.params)) == (MODELS.index(kind), len(model))
    assert tuple(camera.focal_length_idxs()) == model.focal
    if model.focal:
        params = camera.params * np.arange(1, len(model) + 1)
        camera.params = params
        ours = Camera(1, kind, 1024, 768, tuple(params.tolist()))
        assert ours.principal_point == (camera.principal_point_x, camera.principal_point_y)


def test_all_camera_models_and_sensors_of_colmap_are_known():
    assert set(MODELS) == set(pycolmap.CameraModelId.__members__) - {"INVALID"}
    assert {name: int(kind) for name, kind in pycolmap.SensorType.__members__.items()} == {
        **SENSORS,
        "INVALID": -1,
    }


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_read_from_binary_files_gives_their_bytes(tmp_path, kind):
    folder = write(synthetic(kind, num_cameras_per_rig=3), tmp_path / "m", "binary")
    written = dict(binary.encode(read_model(folder)))
    assert sorted(written) == sorted(f"{part}.bin" for part in FILES)
    for name, content in written.items():
        assert b"".join(content) == (folder / name).read_bytes(), name


@pytest.mark.parametrize("form", [binary, text])
@pytest.mark.parametrize("layout", ["binary", "text"])
def test_what_is_written_colmap_reads_with_the_same_numbers(tmp_path, layout, form):
    model = read_model(write(synthetic(num_cameras_per_rig=2), tmp_path / "m", layout))
    (tmp_path / "out").mkdir()
    for name, content in form.encode(model):
        (tmp_path / "out" / name).write_bytes(b"".join(content))
    same_numbers(model, pycolmap.Reconstruction(str(tmp_path / "out")))


@pytest.mark.parametrize("layout", ["binary", "text", "old binary", "old text"])
def test_a_solution_is_written_with_a_rig_of_each_camera_and_a_frame_of_each_image(
    tmp_path, layout
):
    folder = write(synthetic(), tmp_path / "m", layout)
    problem = read_colmap(folder)
    moved = problem.replace(points=problem.points + 1.0)
    write_colmap(moved, tmp_path / "out", like=folder)
    before, after = (pycolmap.Reconstruction(str(place)) for place in (folder, tmp_path / "out"))
    assert sorted(path.stem for path in (tmp_path / "out").iterdir()) == sorted(FILES)
    assert sorted(after.rigs) == sorted(before.rigs)
    assert {i: image.frame_id for i, image in after.images.items()} == {
        i: image.frame_id for i, image in before.images.items()
    }
    for identity in before.point3D_ids():
        assert after.point3D(identity).xyz.tolist() == (before.point3D(identity).xyz + 1.0).tolist()
    after.update_point_3d_errors()
    stored = read_model(tmp_path / "out").points
    truth = [after.point3D(int(identity)).error for identity in stored["id"]]
    np.testing.assert_allclose(stored["error"], truth, rtol=1e-9)


@pytest.mark.parametrize("kind", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FOV"])
def test_errors_of_points_are_colmaps_whatever_the_lens(tmp_path, kind):
    folder = write(synthetic(kind), tmp_path / "m", "binary")
    problem = read_colmap(folder)
    rng = np.random.default_rng(0)
    moved = problem.replace(points=problem.points + 0.01 * rng.normal(size=problem.points.shape))
    write_colmap(moved, tmp_path / "out", like=folder)
    truth = pycolmap.Reconstruction(str(tmp_path / "out"))
    truth.update_point_3d_errors()
    stored = read_model(tmp_path / "out").points
    assert stored["error"].min() > 1e-3
    np.testing.assert_allclose(
        stored["error"], [truth.point3D(int(i)).error for i in stored["id"]], rtol=1e-7
    )


@needs_data
@pytest.mark.parametrize("name", REAL)
def test_real_models_are_read_as_colmap_reads_them_and_written_bit_by_bit(tmp_path, name):
    folder = Path(f"{DATA}/colmap/{name}")
    model = read_model(folder)
    same_numbers(model, pycolmap.Reconstruction(str(folder)))
    shutil.copytree(folder, tmp_path / "m")
    write_colmap(read_colmap(folder), tmp_path / "m", like=folder)
    again = read_model(tmp_path / "m")
    assert [image.keys.tobytes() for image in again.images.values()] == [
        image.keys.tobytes() for image in model.images.values()
    ]
    assert again.tracks.tobytes() == model.tracks.tobytes()
    assert again.cameras == model.cameras
