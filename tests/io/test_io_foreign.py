"""Files of OpenSfM, OpenMVG and AliceVision: the cost is that of each program's own projection."""

from __future__ import annotations

import gzip
import json
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest
from foreign_scene import Lens, Scene, write_alicevision, write_openmvg, write_opensfm

from jaxba.io import ProblemWarning, read_colmap, read_problem, write_colmap
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError

LENS_OF = [0, 0, 1, 1, 0]
PINHOLE = Lens(cx=800.0, cy=600.0)
RADIAL = Lens(cx=800.0, cy=600.0, radial=(-0.12, 0.03))
RADIAL3 = Lens(radial=(-0.12, 0.03, 0.01))
BROWN = Lens(fy=1230.0, radial=(-0.12, 0.03, 0.01), tangential=(0.003, -0.002))
FISHEYE = Lens(cx=800.0, cy=600.0, fx=900.0, fy=900.0, radial=(0.02, -0.01), fisheye=True)
FISHEYE4 = Lens(fx=900.0, fy=900.0, radial=(0.02, -0.01, 0.004, -0.002), fisheye=True)
ROUNDING = 1e-9


def scene_of(*lenses: Lens, noise: float = 0.5) -> Scene:
    return Scene([*lenses], LENS_OF if len(lenses) == 2 else [0] * 5, noise=noise)


def check(problem: BundleProblem, scene: Scene, tolerance: float) -> None:
    assert (problem.num_cameras, problem.num_points) == (5, 30)
    assert problem.num_observations == len(scene.seen)
    np.testing.assert_allclose(geometry.camera_centers(problem.cameras), scene.centers, atol=1e-9)
    np.testing.assert_allclose(problem.points, scene.points, rtol=1e-12)
    np.testing.assert_allclose(geometry.cost(problem), scene.cost, rtol=tolerance)
    assert (geometry.depths(problem) > 0).all()


def free(problem: BundleProblem) -> list[list[bool]]:
    return [] if problem.lenses is None else np.asarray(problem.lenses.free).tolist()


def optimised(problem: BundleProblem) -> list[list[str]]:
    """Names of the numbers of each lens that are optimised."""
    models = [problem.lenses.model_of(at).parameters for at in range(len(problem.lenses.free))]
    return [
        [name for name, one in zip(names, row, strict=False) if one]
        for names, row in zip(models, free(problem), strict=True)
    ]


@pytest.mark.parametrize("version", [0, 1, 2])
def test_opensfm_s_perspective_cameras_are_bal_s_but_shared(tmp_path, version):
    scene = scene_of(RADIAL, PINHOLE)
    write_opensfm(tmp_path, scene, ["perspective", "perspective"], version)
    for path in (tmp_path / "reconstruction.json", tmp_path):
        problem = read_problem(path)
        check(problem, scene, ROUNDING)
        assert free(problem) == [[True] * 3] * 2
        assert problem.whitening is None


@pytest.mark.parametrize(
    ("model", "lens", "moves"),
    [
        ("radial", Lens(fy=1230.0, radial=(-0.12, 0.03)), ["f", "k1", "k2"]),
        ("simple_radial", Lens(fy=1230.0, radial=(-0.12,)), ["f", "k1"]),
        ("brown", BROWN, []),
        ("fisheye", FISHEYE, []),
        ("fisheye_opencv", FISHEYE4, []),
    ],
)
def test_opensfm_s_other_cameras_keep_the_cost(tmp_path, model, lens, moves):
    for noise in (0.5, 0.0):
        scene = scene_of(lens, noise=noise)
        problem = read_problem(write_opensfm(tmp_path, scene, [model]))
        if noise:
            check(problem, scene, ROUNDING)
        else:
            assert geometry.cost(problem) < 1e-15
        assert optimised(problem) == [moves]


@pytest.mark.parametrize(
    ("models", "lenses", "moves"),
    [
        (["pinhole"], [Lens()], [["f"]]),
        (["pinhole_radial_k1"], [Lens(radial=(-0.1,))], [["f", "k1"]]),
        (["pinhole_radial_k3"], [Lens(radial=(-0.1, 0.02, 0.0))], [["f", "k1", "k2"]]),
        (["pinhole_radial_k3"], [RADIAL3], [[]]),
        (["pinhole_brown_t2"], [Lens(radial=BROWN.radial, tangential=BROWN.tangential)], [[]]),
        (["fisheye"], [FISHEYE4], [[]]),
        (["pinhole_radial_k3"] * 2, [RADIAL3, Lens(radial=(0.1, 0.0, 0.0))], [[], ["f", "k1", "k2"]]),
        (["fisheye", "pinhole"], [FISHEYE4, Lens()], [[], ["f"]]),
    ],
)
def test_openmvg_s_cameras_keep_the_cost(tmp_path, models, lenses, moves):
    scene = scene_of(*lenses)
    problem = read_problem(write_openmvg(tmp_path / "sfm_data.json", scene, models))
    check(problem, scene, ROUNDING)
    assert optimised(problem) == moves
    if [] in moves:  # lenses that BAL lacks are those of the file, so a COLMAP model has them, too
        write_colmap(problem, tmp_path / "model")
        np.testing.assert_allclose(geometry.cost(read_colmap(tmp_path / "model")), scene.cost, rtol=ROUNDING)


@pytest.mark.parametrize("version", [(1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 2, 3), (1, 2, 8)])
@pytest.mark.parametrize("fy", [1200.0, 1230.0])
def test_alicevision_s_versions_keep_the_cost(tmp_path, version, fy):
    scene = scene_of(Lens(fy=1200.0 if version < (1, 2, 0) else fy, radial=(-0.1,)))
    problem = read_problem(write_alicevision(tmp_path / "cameras.sfm", scene, ["radial1"], version))
    check(problem, scene, ROUNDING)
    assert free(problem) == [[True, True, False]]


@pytest.mark.parametrize(
    ("kind", "lens"), [("pinhole", Lens()), ("radial3", RADIAL3), ("brown", BROWN), ("fisheye4", FISHEYE4)]
)
def test_alicevision_s_models_keep_the_cost(tmp_path, kind, lens):
    scene = scene_of(lens)
    check(read_problem(write_alicevision(tmp_path / "sfm.json", scene, [kind], (1, 2, 1))), scene, ROUNDING)


def test_locked_intrinsics_stay(tmp_path):
    path = write_alicevision(tmp_path / "a.sfm", scene_of(Lens()), ["pinhole"], (1, 2, 1))
    path.write_text(path.read_text().replace('"locked": "0", "type"', '"locked": "true", "type"'))
    assert free(read_problem(path)) == [[False] * 3]


def test_views_that_are_not_reconstructed_are_left_out_and_counted(tmp_path):
    scene = scene_of(Lens())
    path = write_openmvg(tmp_path / "sfm_data.json", scene, ["pinhole"])
    contents = json.loads(path.read_text())
    contents["extrinsics"] = contents["extrinsics"][:4]
    contents["structure"][0]["value"]["observations"].append({"key": 99, "value": {"id_feat": 0, "x": [0.0, 0.0]}})
    path.write_text(json.dumps(contents))
    lost = 1 + sum(i == 4 for i, _ in scene.seen)
    with pytest.warns(ProblemWarning, match=f"{lost} of {len(scene.seen) + 1} observations left out: their views"):
        assert read_problem(path).num_cameras == 4


def test_each_of_two_observations_in_one_view_of_openmvg_counts(tmp_path):
    scene = scene_of(Lens())
    path = write_openmvg(tmp_path / "sfm_data.json", scene, ["pinhole"])
    contents = json.loads(path.read_text())
    seen = contents["structure"][0]["value"]["observations"]
    seen.append(seen[0] | {"value": {"id_feat": 0, "x": [1.0, 2.0]}})
    path.write_text(json.dumps(contents))
    assert read_problem(path).num_observations == len(scene.seen) + 1


def test_a_principal_point_at_the_edge_is_noted(tmp_path):
    path = write_openmvg(tmp_path / "sfm_data.json", scene_of(Lens(cx=0.0, cy=0.0)), ["pinhole"])
    with pytest.warns(ProblemWarning, match=r"intrinsic 0 lies at the edge of the image: \(0, 0\) of 1600 x 1200"):
        read_problem(path)


def test_only_the_first_reconstruction_is_read_and_that_is_said(tmp_path):
    path = write_opensfm(tmp_path, scene_of(PINHOLE), ["perspective"])
    path.write_text(json.dumps([*json.loads(path.read_text()), {"cameras": {}, "shots": {}, "points": {}}]))
    with pytest.warns(ProblemWarning, match="only the first of 2 reconstructions is read"):
        assert read_problem(path).num_cameras == 5


def changed_json(path, change):
    contents = json.loads(path.read_text())
    change(contents)
    path.write_text(json.dumps(contents))
    return path


def with_priors(contents):
    for row in contents["views"][:3]:
        row["value"]["ptr_wrapper"]["data"] |= {"use_pose_center_prior": True, "center": [0, 0, 0]}
    contents["views"][4]["value"]["ptr_wrapper"]["data"] |= {"use_pose_center_prior": False}
    contents["control_points"] = [{"key": 0, "value": {"X": [0, 0, 0], "observations": []}}] * 2


def with_locks(contents):
    contents["intrinsics"][0]["scaleLocked"] = "true"
    contents["constraints2d"] = [{"viewA": 0}] * 4
    for number, landmark in enumerate(contents["structure"]):
        for seen in landmark["observations"]:
            seen["scale"] = str(1.0 + number)


def with_positions(contents):
    shots = list(contents[0]["shots"].values())
    shots[0]["gps_position"], shots[1]["gps_position"], shots[2]["gps_position"] = [1, 2, 3], [0.0, 0.0, 0.0], None
    next(iter(contents[0]["cameras"].values()))["focal_prior"] = 0.8


def opensfm_with_more(folder):
    path = changed_json(write_opensfm(folder, scene_of(PINHOLE), ["perspective"]), with_positions)
    (folder / "gcp_list.txt").write_text("WGS84\n")
    tracks = folder / "tracks.csv"
    tracks.write_text(tracks.read_text().replace("0.004", "0.002", 1))
    return path


def openmvg_with_more(folder):
    return changed_json(write_openmvg(folder / "sfm_data.json", scene_of(PINHOLE), ["pinhole"]), with_priors)


def alicevision_with_more(folder):
    return changed_json(write_alicevision(folder / "a.sfm", scene_of(PINHOLE), ["pinhole"], (1, 2, 1)), with_locks)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (openmvg_with_more, "not used: priors of positions (3), control_points (2)"),
        (alicevision_with_more, "not used: constraints2d (4), scaleLocked (1), scales of key-points ({})"),
        (
            opensfm_with_more,
            "not used: measured positions (1), priors of cameras (1), gcp_list.txt beside it (1), scales of "
            "key-points ({})",
        ),
    ],
)
def test_what_a_file_holds_and_nothing_uses_is_one_note_and_refused_if_strict(write, message, tmp_path):
    path = write(tmp_path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read_problem(path)
    check(found, scene_of(PINHOLE), ROUNDING)
    wanted = f"{path}: {message.format(len(scene_of(PINHOLE).seen))}"
    assert [str(one.message) for one in caught] == [wanted]
    with pytest.raises(ProblemError, match=re.escape(wanted)):
        read_problem(path, strict=True)


def test_compressed_marked_and_windows_files_are_read_too(tmp_path):
    scene = scene_of(PINHOLE)
    path = write_opensfm(tmp_path, scene, ["perspective"])
    text, tracks = path.read_text(), (tmp_path / "tracks.csv").read_bytes()
    (tmp_path / "tracks.csv").unlink()
    (tmp_path / "tracks.csv.gz").write_bytes(gzip.compress(b"\xef\xbb\xbf" + tracks.replace(b"\n", b"\r\n")))
    path.write_bytes(text.encode("utf-16"))
    check(read_problem(path), scene, ROUNDING)


# What cannot be read


def refused(path) -> str:
    with pytest.raises(ProblemError) as caught:
        read_problem(path)
    message = str(caught.value)
    assert message.isprintable()
    return message


OPENSFM = {
    "no points": ('"points": {', '"pts": {', "has no points, only cameras and shots"),
    "unknown model": (
        '"perspective"',
        '"spherical"',
        "camera v2 maker 0 has projection_type 'spherical', which is not",
    ),
    "dangling camera": ('"camera": "v2 maker 0"', '"camera": "v2 x"', "shot a shot 0.jpg names camera v2 x, which is"),
    "text for a number": ('"focal": 0.75', '"focal": "wide"', "camera v2 maker 0: focal must be a number, is 'wide'"),
    "nan": ('"focal": 0.75', '"focal": NaN', "camera v2 maker 0: focal is not a finite number: nan"),
    "negative focal length": (
        '"focal": 0.75',
        '"focal": -0.75',
        "camera v2 maker 0 has focal length -1200, which must",
    ),
    "a key twice": ('"width": 1600', '"width": 1600, "width": 1601', "the key 'width' is there twice in one object"),
    "no width": ('"width": 1600', '"width": 0', "camera v2 maker 0 has no width and height"),
    "no rotation": ('"rotation"', '"turn"', "shot a shot 0.jpg has no rotation"),
    "short point": (
        '"coordinates": [',
        '"coordinates": [1,',
        "point 100: coordinates must be a list of 3 numbers, is a",
    ),
    "cut": ('"coordinates": [', "", "not JSON"),
    "rig": (
        '"cameras"',
        '"rig_instances": {"r": {"rig_camera_ids": {"a": "b", "c": "d"}}}, "cameras"',
        "rig instance r",
    ),
}


@pytest.mark.parametrize("case", OPENSFM)
def test_bad_reconstructions_are_refused_by_record_and_field(tmp_path, case):
    old, new, words = OPENSFM[case]
    path = write_opensfm(tmp_path, scene_of(PINHOLE), ["perspective"])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    message = refused(path)
    assert message.startswith(str(path))
    assert words in message


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("_v2", "_v9", "line 1: version '9' of tracks is not read"),
        ("\t100\t0\t", "\t100\t", "line 2: has 10 fields, separated by tabs, instead of 11"),
        ("\t100\t0\t", "\t100\t0\t-nan(ind)", "line 2: '-nan(ind)"),
        ("\t0.004", "\t0.004\t", "line 2: has 12 fields"),
        ("a shot", "no shot", ""),
    ],
)
def test_bad_tracks_are_refused_by_line_and_field(tmp_path, old, new, words):
    path = write_opensfm(tmp_path, scene_of(PINHOLE), ["perspective"])
    tracks = tmp_path / "tracks.csv"
    text = tracks.read_text()
    tracks.write_text(text.replace(old, new, -1 if old == "a shot" else 1))
    message = refused(path)
    assert message.startswith(str(tracks))
    assert (words or "no image of the reconstruction sees a point of it") in message


def test_a_reconstruction_without_tracks_is_refused(tmp_path):
    path = write_opensfm(tmp_path, scene_of(PINHOLE), ["perspective"])
    (tmp_path / "tracks.csv").unlink()
    assert "there is no tracks.csv beside it" in refused(path)


@pytest.mark.parametrize("part", ["views", "intrinsics", "extrinsics", "structure"])
def test_openmvg_s_files_without_a_part_are_refused_by_its_name(tmp_path, part):
    path = write_openmvg(tmp_path / "sfm_data.json", scene_of(Lens()), ["pinhole"])
    contents = json.loads(path.read_text())
    for change in ([], None):
        contents[part] = change
        path.write_text(json.dumps(contents))
        assert f"sfm_data.json: has no {part}, only " in refused(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"pinhole"', '"spherical"', "intrinsic 0 is of the model 'spherical', which is not read; read are pinhole,"),
        ('"polymorphic_name"', '"name"', "intrinsic 0 has polymorphic_id 2147483649, whose name was not given before"),
        ('"focal_length"', '"f"', "intrinsic 0 has no focal_length"),
        ('"id_pose": 11', '"id_pose": 10', "views 0 and 1 share pose 10, as in a rig; rigs are not read"),
        ('"rotation": [[', '"rotation": [[7', "pose 10 has a rotation that is none"),
        ('"X": [', '"X": [1, ', "landmark 1000: X must be a list of 3 numbers, is a list of 4"),
        ('"x": [', '"x": ["a", ', "x must be a list of 2 numbers"),
        ('{"key": 1000', '{"key": 1e400', "structure[0]: key is not a finite number: inf"),
        ('{"key": 1000', '{"key": [[]]', "structure[0]: key must be a number, is a list of 1"),
        ('"structure": [', '"structure": [[', "not JSON"),
    ],
)
def test_bad_files_of_openmvg_are_refused_by_record_and_field(tmp_path, old, new, words):
    path = write_openmvg(tmp_path / "sfm_data.json", scene_of(Lens()), ["pinhole"])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert words in refused(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"structure"', '"landmarks"', "has no structure, only views, intrinsics, poses: have AliceVision write"),
        ('"type": "pinhole"', '"type": "equidistant_r3"', "intrinsic 0 is of the model 'equidistant_r3', which is not"),
        ('"undistortionType": "none"', '"undistortionType": "3deanamorphic4"', "the model '3deanamorphic4', which"),
        ('"viewId": "0"', '"viewId": "0", "rigId": "1", "isPoseIndependant": "0"', "view 0 is of a rig of several"),
        ('"x": [', '"y": [', "landmark 0: observation in view 0 has no x: have AliceVision write observations with"),
        ('"sensorWidth": "24"', '"sensorWidth": "0"', "intrinsic 0 has a sensorWidth or pixelRatio that is not"),
        ('"poseId": "10", "pose"', '"poseId": "ten", "pose"', "poses[0]: poseId must be a number, is 'ten'"),
        ('"width": "1600"', '"width": "1.#QNAN"', "intrinsic 0: width is not a finite number: '1.#QNAN'"),
    ],
)
def test_bad_scenes_of_alicevision_are_refused_by_record_and_field(tmp_path, old, new, words):
    path = write_alicevision(tmp_path / "a.sfm", scene_of(Lens()), ["none"], (1, 2, 8))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert words in refused(path)


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        ("[" * 100_000, "is nested too deeply"),
        ("[]", "is JSON, but not of a program that is known here; read are BAL (.txt, .bal), Bundler (.out)"),
        ('{"a": 1}', "is JSON, but not of a program that is known here"),
        ("", "line 1: not JSON: Expecting value"),
        ('{"sfm_data_version": ' + "1" * 10_000 + "}", "holds a number of too many digits"),
        ("\udcff", "is no text"),
    ],
)
def test_other_json_is_refused(tmp_path, contents, words):
    path = tmp_path / "a.json"
    path.write_bytes(contents.encode(errors="surrogateescape"))
    assert words in refused(path)


def test_a_solve_of_a_bal_file_imports_none_of_these_readers():
    code = "import sys, jaxba; print([m for m in sys.modules if m.startswith('jaxba.io.foreign.')])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
