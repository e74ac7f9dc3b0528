"""Files of OpenSfM: the cost is that of its own projection."""

from __future__ import annotations

import gzip
import json
import re
import warnings

import numpy as np
import pytest
from foreign_scene import Lens, Scene, write_opensfm

from jaxba.io import ProblemWarning, read_colmap, read_problem, write_colmap
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError

LENS_OF = [0, 0, 1, 1, 0]
PINHOLE = Lens(cx=800.0, cy=600.0)
RADIAL = Lens(cx=800.0, cy=600.0, radial=(-0.12, 0.03))
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
        (["brown"], [BROWN], [[]]),
        (["fisheye_opencv"], [FISHEYE4], [[]]),
        (
            ["brown", "radial"],
            [BROWN, Lens(fy=1230.0, radial=(0.1, 0.0))],
            [[], ["fx", "fy", "k1", "k2"]],
        ),
        (["fisheye_opencv", "simple_radial"], [FISHEYE4, Lens(radial=(-0.1,))], [[], ["f", "k1"]]),
    ],
)
def test_lenses_that_bal_lacks_keep_their_numbers_so_a_colmap_model_has_them_too(
    tmp_path, models, lenses, moves
):
    scene = scene_of(*lenses)
    problem = read_problem(write_opensfm(tmp_path, scene, models))
    check(problem, scene, ROUNDING)
    assert optimised(problem) == moves
    write_colmap(problem, tmp_path / "model")
    np.testing.assert_allclose(
        geometry.cost(read_colmap(tmp_path / "model")), scene.cost, rtol=ROUNDING
    )


def test_images_that_see_no_point_are_left_out_and_counted(tmp_path):
    scene = scene_of(PINHOLE)
    path = write_opensfm(tmp_path, scene, ["perspective"])
    tracks = tmp_path / "tracks.csv"
    lines = tracks.read_text().splitlines(keepends=True)
    tracks.write_text("".join(line for line in lines if not line.startswith("a shot 1.jpg")))
    with pytest.warns(ProblemWarning, match="1 of 5 images left out: they see no point"):
        problem = read_problem(path)
    assert problem.num_observations == sum(image != 1 for image, _ in scene.seen)
    np.testing.assert_allclose(
        geometry.camera_centers(problem.cameras), np.delete(scene.centers, 1, 0), atol=1e-9
    )


def test_a_principal_point_at_the_edge_is_noted(tmp_path):
    path = write_opensfm(tmp_path, scene_of(Lens(cx=0.0, cy=0.0)), ["simple_radial"])
    with pytest.warns(
        ProblemWarning, match=r"maker 0 lies at the edge of the image: \(0, 0\) of 1600 x 1200"
    ):
        read_problem(path)


def test_only_the_first_reconstruction_is_read_and_that_is_said(tmp_path):
    path = write_opensfm(tmp_path, scene_of(PINHOLE), ["perspective"])
    path.write_text(
        json.dumps([*json.loads(path.read_text()), {"cameras": {}, "shots": {}, "points": {}}])
    )
    with pytest.warns(ProblemWarning, match="only the first of 2 reconstructions is read"):
        assert read_problem(path).num_cameras == 5


def changed_json(path, change):
    contents = json.loads(path.read_text())
    change(contents)
    path.write_text(json.dumps(contents))
    return path


def with_positions(contents):
    shots = list(contents[0]["shots"].values())
    shots[0]["gps_position"], shots[1]["gps_position"], shots[2]["gps_position"] = (
        [1, 2, 3],
        [0.0, 0.0, 0.0],
        None,
    )
    next(iter(contents[0]["cameras"].values()))["focal_prior"] = 0.8


def opensfm_with_more(folder):
    path = changed_json(write_opensfm(folder, scene_of(PINHOLE), ["perspective"]), with_positions)
    (folder / "gcp_list.txt").write_text("WGS84\n")
    tracks = folder / "tracks.csv"
    tracks.write_text(tracks.read_text().replace("0.004", "0.002", 1))
    return path


def test_what_a_file_holds_and_nothing_uses_is_one_note_and_refused_if_strict(tmp_path):
    path = opensfm_with_more(tmp_path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read_problem(path)
    scene = scene_of(PINHOLE)
    check(found, scene, ROUNDING)
    wanted = (
        f"{path}: not used: measured positions (1), priors of cameras (1), gcp_list.txt beside it "
        "(1), scales of "
        f"key-points ({len(scene.seen)})"
    )
    assert [str(one.message) for one in caught] == [wanted]
    with pytest.raises(ProblemError, match=re.escape(wanted)):
        read_problem(path, strict=True)


def test_compressed_marked_and_windows_files_are_read_too(tmp_path):
    scene = scene_of(PINHOLE)
    path = write_opensfm(tmp_path, scene, ["perspective"])
    text = path.read_text()
    tracks = (tmp_path / "tracks.csv").read_bytes()
    (tmp_path / "tracks.csv").unlink()
    (tmp_path / "tracks.csv.gz").write_bytes(
        gzip.compress(b"\xef\xbb\xbf" + tracks.replace(b"\n", b"\r\n"))
    )
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
    "dangling camera": (
        '"camera": "v2 maker 0"',
        '"camera": "v2 x"',
        "shot a shot 0.jpg names camera v2 x, which is",
    ),
    "text for a number": (
        '"focal": 0.75',
        '"focal": "wide"',
        "camera v2 maker 0: focal must be a number, is 'wide'",
    ),
    "nan": (
        '"focal": 0.75',
        '"focal": NaN',
        "camera v2 maker 0: focal is not a finite number: nan",
    ),
    "negative focal length": (
        '"focal": 0.75',
        '"focal": -0.75',
        "camera v2 maker 0 has focal length -1200, which must",
    ),
    "a key twice": (
        '"width": 1600',
        '"width": 1600, "width": 1601',
        "the key 'width' is there twice in one object",
    ),
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


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        ("[" * 100_000, "is nested too deeply"),
        (
            "[]",
            "is JSON, but not OpenSfM's: have its program write a COLMAP model; read are BAL "
            "(.txt, .bal)",
        ),
        ('{"a": 1}', "is JSON, but not OpenSfM's"),
        ("", "line 1: not JSON: Expecting value"),
        ('{"shots": ' + "1" * 10_000 + "}", "holds a number of too many digits"),
        ("\udcff", "is no text"),
    ],
)
def test_other_json_is_refused(tmp_path, contents, words):
    path = tmp_path / "a.json"
    path.write_bytes(contents.encode(errors="surrogateescape"))
    assert words in refused(path)
