"""COLMAP models with damage: that of one view, point or image is left out with a note, all else
refused in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from colmap_model import FIRST_POINT, TextModel, head_with, noted, refusal, swap

from benchmarks.damage import damaged
from jaxba import (
    BundleProblem,
    ProblemError,
    ProblemWarning,
    read_colmap,
    read_problem,
    write_colmap,
)
from jaxba.cli.bench import run as run_bench
from jaxba.cli.solve import run
from jaxba.io import json_lines
from jaxba.solver.record import Record


def same(one: BundleProblem, other: BundleProblem) -> bool:
    names = ("cameras", "points", "observations", "camera_index", "point_index")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def without(problem: BundleProblem, views: list[int]) -> BundleProblem:
    kept = np.delete(np.arange(problem.num_observations), views)
    names = ("observations", "camera_index", "point_index")
    return problem.replace(**{name: getattr(problem, name)[kept] for name in names})


@pytest.fixture(scope="module")
def healthy(tmp_path_factory) -> BundleProblem:
    problem, notes = noted(TextModel().write(tmp_path_factory.mktemp("healthy")))
    assert notes == []
    return problem


def test_the_model_of_these_tests_is_read_as_the_scene_that_it_was_made_of(healthy):
    scene = TextModel().scene
    assert np.array_equal(healthy.points, scene.points)
    np.testing.assert_allclose(healthy.cameras, scene.cameras, rtol=1e-12, atol=1e-14)
    assert healthy.num_observations == scene.num_observations
    order = np.lexsort((scene.camera_index, scene.point_index))
    assert np.array_equal(healthy.camera_index, scene.camera_index[order])


def test_a_binary_model_is_read_as_the_text_of_the_same_numbers(tmp_path, healthy):
    problem, notes = noted(TextModel().write_binary(tmp_path / "m"))
    assert notes == []
    assert same(problem, healthy)


def test_a_binary_file_whose_count_looks_like_the_beginning_of_a_compressed_one_is_read(tmp_path):
    points = int.from_bytes(b"\x1f\x8b", "little")  # gzip's first bytes
    index = np.repeat([0, 1], points), np.tile(np.arange(points), 2)
    cameras = np.tile([0.0, 0, 0, 0, 0, -5, 700, 0, 0], (2, 1))
    problem = BundleProblem.create(
        cameras, np.zeros((points, 3)), np.zeros((2 * points, 2)), *index
    )
    write_colmap(problem, tmp_path)
    assert (tmp_path / "points3D.bin").read_bytes()[:2] == b"\x1f\x8b"
    assert read_problem(tmp_path).num_points == points


# What is left out or mended


def key_numbers_beyond(model: TextModel) -> None:
    for at in range(9, len(model.points[7]), 2):
        model.points[7][at] = str(1000 + int(model.points[7][at]))


def all_name_key_point_zero(model: TextModel) -> None:
    for point in model.points:
        point[9::2] = ["0"] * len(point[9::2])


def no_tracks(model: TextModel) -> None:
    model.points = [point[:8] for point in model.points]


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize(
    "damage", [key_numbers_beyond, all_name_key_point_zero, no_tracks], ids=lambda one: one.__name__
)
def test_key_points_are_believed_where_tracks_name_others(tmp_path, healthy, damage, binary):
    model = TextModel()
    damage(model)
    folder = (model.write_binary if binary else model.write)(tmp_path / "m")
    problem, (note,) = noted(folder)
    images = "images.bin" if binary else "images.txt"
    assert f"where {images} is believed (point {18 if damage is key_numbers_beyond else ''}" in note
    if damage is key_numbers_beyond:
        count = len(model.points[7][9::2])
        image = model.points[7][8]
        assert note.startswith(
            f"points3D.{'bin' if binary else 'txt'}: 1 point with another track than key-points say"
        )
        assert count > 1
        size = len(model.keys[int(image) - 1])
        beyond = (
            f"key-point {model.points[7][9]} of image {image} (view{int(image) - 1}.jpg), "
            f"which has {size})"
        )
        assert note.endswith(f"(point 18: {beyond}")
    assert same(problem, healthy)


def test_a_view_that_names_an_absent_image_is_left_out(tmp_path, healthy):
    model = TextModel()
    model.points[3] += ["99", "0", "4294967295", "4294967295", "-1", "-1"]
    problem, (note,) = noted(model.write(tmp_path / "m"))
    assert note == (
        "points3D.txt: 3 track elements left out, of an image that images.txt does not have (point "
        "14: key-point 0 of "
        "image 99)"
    )
    assert same(problem, healthy)


def test_a_view_that_is_said_twice_counts_once(tmp_path, healthy):
    model = TextModel()
    model.points[3] += model.points[3][8:10]
    problem, notes = noted(model.write(tmp_path / "m"))
    assert notes == []
    assert same(problem, healthy)


def test_key_points_say_which_views_there_are(tmp_path, healthy):
    model = TextModel()
    image = int(model.points[0][8])
    key = int(model.points[0][9])
    model.keys[image - 1][key][2] = "-1"  # the track of point 11 goes on to name it
    del model.points[1][-2:]  # its key-point goes on to name point 12
    problem, notes = noted(model.write(tmp_path / "m"))
    assert notes == [
        "points3D.txt: 2 points with another track than key-points say, where images.txt is "
        "believed (point 11: "
        f"key-point {key} of image {image} (view{image - 1}.jpg))",
    ]
    lost = np.flatnonzero((healthy.camera_index == image - 1) & (healthy.point_index == 0))[0]
    assert same(problem, without(healthy, [lost]))


def test_points_that_are_missing_are_those_of_no_view(tmp_path, healthy):
    model = TextModel()
    views = len(model.points.pop()[8:]) // 2
    problem, (note,) = noted(model.write(tmp_path / "m"))
    assert note.startswith(
        f"images.txt: {views} key-points left out, of a point that points3D.txt does not have "
        "(image "
    )
    assert problem.num_points == 39
    assert np.array_equal(problem.points, healthy.points[:39])


@pytest.mark.parametrize("word", ["nan", "-nan(ind)", "inf", "1e999", "-1.#IND"])
def test_what_is_no_number_leaves_out_its_point_or_key_point(tmp_path, healthy, word):
    model = TextModel()
    model.points[5][2] = word
    model.keys[2][0][1] = word
    point = int(model.keys[2][0][2]) - FIRST_POINT
    assert point != 5
    problem, notes = noted(model.write(tmp_path / "m"))
    assert notes == [
        "points3D.txt: 1 point left out, not finite (point 16)",
        "images.txt: 1 key-point left out, not finite (image 3 (view2.jpg): key-point 0)",
    ]
    assert np.array_equal(problem.points, np.delete(healthy.points, 5, axis=0))
    views = np.flatnonzero(
        (healthy.point_index == 5) | ((healthy.point_index == point) & (healthy.camera_index == 2))
    )
    assert np.array_equal(problem.observations, np.delete(healthy.observations, views, axis=0))


@pytest.mark.parametrize("layout", ["empty line", "no line", "no end of the last line"])
def test_an_image_without_key_points_is_left_out_and_written_again(tmp_path, healthy, layout):
    model = TextModel()
    blind = 5
    model.keys[blind] = []
    for point in model.points:
        track = [
            pair for pair in zip(point[8::2], point[9::2], strict=True) if pair[0] != str(blind + 1)
        ]
        point[8:] = [word for pair in track for word in pair]
    folder = model.write(tmp_path / "m")
    if layout != "empty line":
        lines = (folder / "images.txt").read_text().split("\n")
        del lines[2 + 2 * blind]
        text = "\n".join(lines)
        (folder / "images.txt").write_text(
            text.rstrip("\n") if layout == "no end of the last line" else text
        )
    problem, (note,) = noted(folder)
    assert (
        note == f"images.txt: 1 image left out, without observations (image {blind + 1} "
        f"(view{blind}.jpg))"
    )
    assert np.array_equal(problem.cameras, np.delete(healthy.cameras, blind, axis=0))
    with pytest.raises(ProblemError, match="1 image left out, without observations"):
        read_problem(folder, strict=True)
    write_colmap(problem, tmp_path / "out", like=folder)
    heads = (tmp_path / "out" / "images.txt").read_text().splitlines()[1::2]
    assert [head.split()[9] for head in heads] == [f"view{image}.jpg" for image in range(6)]
    assert [head.split()[0] for head in heads] == list("123456")


def test_writing_in_place_keeps_what_was_left_out(tmp_path):
    model = TextModel()
    model.heads[4] = model.heads[4].replace("view4", "flight A, plan  (2) 4")
    model.points[5][2] = "nan"
    model.points[3] += ["99", "0"]
    model.keys[2][0][1] = "nan"
    model.keys[0][1][2] = "-1"
    folder = model.write(tmp_path / "m")
    problem, notes = noted(folder)
    assert len(notes) == 4
    moved = problem.replace(points=problem.points + 1)
    write_colmap(moved, folder, like=folder)
    lines = {
        name: (folder / name).read_text().splitlines()[1:]
        for name in ("cameras.txt", "images.txt", "points3D.txt")
    }
    assert [line.split(None, 9)[9] for line in lines["images.txt"][::2]] == [
        head.split(None, 9)[9] for head in model.heads
    ]
    for line, keys in zip(lines["images.txt"][1::2], model.keys, strict=True):
        assert line.split() == [word for key in keys for word in key]
    for line, point in zip(lines["points3D.txt"], model.points, strict=True):
        words = line.split()
        assert (words[0], words[4:7], words[8:]) == (point[0], point[4:7], point[8:])
        by = 0 if point is model.points[5] else 1
        np.testing.assert_allclose(
            np.array(words[1:4], float), np.array(point[1:4], float) + by, rtol=1e-14
        )
    assert lines["points3D.txt"][5].split()[7] == "0.5"  # its error is as it was
    again, after = noted(folder)
    assert [note.partition("(")[0] for note in after] == [note.partition("(")[0] for note in notes]
    assert np.array_equal(again.points, moved.points)


NAMES = [
    "a b.jpg",
    "flight A, plan  (2) 1.jpg",
    '"it\'s".jpg',
    "\u00e9\u6771 \u00df.jpg",
    "# 5.jpg",
    "sub dir/6.JPG",
]


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_names_with_blanks_quotes_and_letters_of_any_alphabet_stay(tmp_path, healthy, binary):
    model = TextModel()
    model.heads = [head.replace(f"view{at}.jpg", NAMES[at]) for at, head in enumerate(model.heads)]
    folder = (model.write_binary if binary else model.write)(tmp_path / "m")
    assert same(noted(folder)[0], healthy)
    for out in (tmp_path / "out", folder):
        write_colmap(healthy, out, like=folder)
        data = (out / f"images.{'bin' if binary else 'txt'}").read_bytes()
        places = [data.index(name.encode() + (b"\0" if binary else b"\n")) for name in NAMES]
        assert places == sorted(places)


# Courtesies


def test_marks_line_ends_blanks_and_comments_do_not_matter(tmp_path, healthy):
    files = TextModel().files()
    layouts = {
        "windows": lambda lines: "\r\n".join([*lines, ""]).encode("utf-8-sig"),
        "16 bits": lambda lines: "\r\n".join([*lines, ""]).encode("utf-16"),
        "blanks": lambda lines: "".join(
            f"  {line.replace(' ', '  ')} \t\n" for line in lines
        ).encode(),
        "no end": lambda lines: "\n".join(lines).encode(),
        "comments": lambda lines: "".join(
            f"# {n}\n{line}\n# x y z\n" for n, line in enumerate(lines)
        ).encode(),
    }
    for layout, text in layouts.items():
        (tmp_path / layout).mkdir()
        for name, lines in files.items():
            (tmp_path / layout / name).write_bytes(text(lines))
        problem, notes = noted(tmp_path / layout)
        assert notes == []
        assert same(problem, healthy), layout


def test_whole_numbers_may_be_written_with_a_point(tmp_path, healthy):
    model = TextModel()
    model.cameras[1] = model.cameras[1].replace("1280 960", "1280.0 9.6e2")
    model.keys = [[[x, y, f"{point}.0"] for x, y, point in keys] for keys in model.keys]
    model.points = [[f"{point[0]}.0", *point[1:4], "1.0", *point[5:]] for point in model.points]
    assert same(noted(model.write(tmp_path / "m"))[0], healthy)


def test_ids_of_points_are_exact_up_to_the_largest(tmp_path, healthy):
    model = TextModel()

    def large(identity):
        return str(2**64 - 60 + int(identity))

    model.keys = [[[x, y, large(point)] for x, y, point in keys] for keys in model.keys]
    model.points = [[large(point[0]), *point[1:]] for point in model.points]
    problem, notes = noted(model.write(tmp_path / "m"))
    assert notes == []
    assert same(problem, healthy)
    write_colmap(problem, tmp_path / "out", like=tmp_path / "m")
    written = (tmp_path / "out" / "points3D.txt").read_text().splitlines()[1:]
    assert [line.split()[0] for line in written] == [point[0] for point in model.points]
    assert np.array_equal(noted(tmp_path / "out")[0].point_index, healthy.point_index)


# Rigs and frames


def framed(
    folder: Path, images: list[int], rigs: str = "7 1 CAMERA 7", data: str = "1 CAMERA 7 {}"
) -> Path:
    model = TextModel()
    model.write(folder)
    (folder / "rigs.txt").write_text(f"# rigs\n{rigs}\n")
    poses = {image: " ".join(model.heads[image - 1].split()[1:8]) for image in images}
    frames = [f"{100 + image} 7 {pose} " + data.format(image) for image, pose in poses.items()]
    (folder / "frames.txt").write_text("\n".join(["# frames", *frames, ""]))
    return folder


def test_poses_of_frames_count_and_images_without_one_stay_as_they_are(tmp_path, healthy):
    folder = framed(tmp_path / "m", [1, 2, 3, 4, 6])
    head_with(7, "123.0")(folder)
    problem, notes = noted(folder)
    assert notes == [
        "images.txt: 1 image left out, without a frame (image 5 (view4.jpg))",
        "images.txt: 1 image with another pose than in frames.txt, which counts (image 4 "
        "(view3.jpg))",
    ]
    assert np.array_equal(problem.cameras, np.delete(healthy.cameras, 4, axis=0))
    moved = problem.replace(cameras=problem.cameras + np.array([0, 0, 0, 1, 0, 0, 0, 0, 0]))
    write_colmap(moved, folder, like=folder)
    heads = (folder / "images.txt").read_text().splitlines()[1::2]
    assert heads[4] == TextModel().heads[4]
    again, notes = noted(folder)
    assert notes == ["images.txt: 1 image left out, without a frame (image 5 (view4.jpg))"]
    np.testing.assert_allclose(again.cameras, moved.cameras, rtol=1e-12, atol=1e-13)


def test_sensors_that_are_no_cameras_are_left_out_and_counted(tmp_path, healthy):
    problem, notes = noted(framed(tmp_path / "m", [1, 2, 3, 4, 5, 6], "7 2 CAMERA 7 IMU 3 0"))
    assert notes == ["rigs.txt: 1 sensor left out, no camera (sensor 3 of rig 7)"]
    assert np.array_equal(problem.cameras, healthy.cameras)


RIGS = {
    "absent rig": (("8 1 CAMERA 7", "1 CAMERA 7 {}"), "frames.txt: frame 101: rig 7 is not in "),
    "absent sensor": (
        ("7 1 IMU 7", "1 CAMERA 7 {}"),
        "frames.txt: frame 101: rig 7 has no sensor 7 of datum 1",
    ),
    "absent camera": (("7 1 CAMERA 8", "1 CAMERA 7 {}"), "rigs.txt: rig 7: camera 8 is not in "),
    "word of no sensor": (
        ("7 1 LIDAR 7", "1 CAMERA 7 {}"),
        "rigs.txt line 2: rig 7: 'LIDAR' is no type of sensors",
    ),
    "image in two frames": (
        ("7 1 CAMERA 7", "1 CAMERA 7 3"),
        "frames.txt: image 3 is in two frames",
    ),
    "count too large": (
        ("7 9 CAMERA 7", "1 CAMERA 7 {}"),
        "rigs.txt line 2: rig 7: '9' is outside 0..3",
    ),
    "left over": (("7 1 CAMERA 7 1", "1 CAMERA 7 {}"), "rigs.txt line 2: rig 7: '1' is left over"),
}


@pytest.mark.parametrize("damage", RIGS)
def test_references_of_rigs_and_frames_are_checked(tmp_path, damage):
    words, message = RIGS[damage]
    assert refusal(framed(tmp_path / "m", [1, 2, 3, 4, 5, 6], *words)).startswith(message)


def test_a_frame_without_a_finite_pose_is_refused_by_its_image(tmp_path):
    folder = framed(tmp_path / "m", [1, 2, 3, 4, 5, 6])
    lines = (folder / "frames.txt").read_text().split("\n")
    lines[4] = " ".join([*lines[4].split()[:2], "nan", *lines[4].split()[3:]])
    (folder / "frames.txt").write_text("\n".join(lines))
    assert refusal(folder).startswith(
        "frames.txt: frame 104 of image 4 (view3.jpg): qvec is not finite: nan "
    )


# Commands


def test_the_command_says_what_was_left_out_and_strict_refuses(tmp_path, capsys):
    model = TextModel()
    model.points[3] += ["99", "0"]
    folder = model.write(tmp_path / "m")
    note = (
        f"{folder}/points3D.txt: 1 track element left out, of an image that "
        f"{folder}/images.txt "
        "does not have"
    )
    assert run([str(folder), "--max-iterations", "1", "--output", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"note: {note} (")
    assert printed.out.count(note) == 1
    assert printed.err == ""
    assert run([str(folder), "--strict", "--output", str(tmp_path / "strict")]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"error: {note} (")
    assert (printed.err.count("\n"), printed.out) == (1, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m", "out"]


def test_a_principal_point_at_the_edge_is_mentioned_and_not_refused(tmp_path):
    folder = TextModel().write(tmp_path / "m")
    swap("cameras.txt", "640.0 480.0", "0.0 0.0")(folder)
    _, (note,) = noted(folder)
    assert (
        note
        == "cameras.txt: 1 principal point at the edge of the image (camera 7: pixel 0, 0 of 1280 "
        "x 960)"
    )
    with pytest.warns(ProblemWarning, match="principal point"):
        read_colmap(folder, strict=True)


@pytest.mark.slow
def test_a_benchmark_goes_on_after_models_that_cannot_be_read(tmp_path, capsys):
    bad, odd, good = (TextModel().write(tmp_path / name) for name in ("bad", "odd", "good"))
    head_with(1, "nan")(bad)
    (odd / "images.txt").write_text((odd / "images.txt").read_text() + "9 1 0 0 0 0 0 0 7 last.jpg")
    arguments = [
        *map(str, (bad, odd, good)),
        "--solvers",
        "ceres",
        "--repeats",
        "1",
        "--max-iterations",
        "2",
    ]
    assert run_bench([*arguments, "--out", str(tmp_path / "runs")]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(
        f"error: {bad}/images.txt: image 4 (view3.jpg): qvec is not finite: "
    )
    assert printed.err.count("\n") == 1
    assert (
        f"note: {odd}/images.txt: 1 image left out, without observations (image 9 (last.jpg))\n"
        in printed.out
    )
    assert [
        record.problem for record in json_lines.read(tmp_path / "runs" / "results.jsonl", Record)
    ] == [
        "odd",
        "good",
    ]
    (good / "._cameras.txt").write_text("of a Mac")  # the model is still the same
    assert run_bench([str(good), *arguments[3:], "--out", str(tmp_path / "runs")]) == 0
    assert run_bench([str(odd), "--strict", *arguments[3:], "--out", str(tmp_path / "strict")]) == 2
    error = (
        f"error: {odd}/images.txt: 1 image left out, without observations (image 9 (last.jpg))\n"
    )
    assert capsys.readouterr().err == error


# Any bytes


def read_or_refused(folder: Path) -> tuple[BundleProblem | None, str]:
    try:
        return noted(folder)[0], ""
    except ProblemError as error:
        return None, str(error)


@pytest.mark.parametrize("text", [True, False], ids=["text", "binary"])
def test_any_bytes_are_a_model_or_refused_in_one_line(tmp_path, text):
    model = TextModel()
    source = (model.write if text else model.write_binary)(tmp_path / "m")
    files = {path.name: path.read_bytes() for path in source.iterdir()}
    rng = np.random.default_rng(5)
    read = 0
    for case in range(150):
        for name, data in files.items():
            (source / name).write_bytes(damaged(data, rng) if rng.random() < 0.5 else data)
        problem, error = read_or_refused(source)
        if problem is None:
            assert error.isprintable(), case
            continue
        read += 1
        assert np.isfinite(problem.cameras).all()
        assert np.isfinite(problem.points).all()
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        write_colmap(problem, tmp_path / "out", like=source)
        assert noted(tmp_path / "out")[0].num_observations == problem.num_observations
    assert 10 < read < 140
