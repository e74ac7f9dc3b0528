"""COLMAP's own names of options, and a file of constants and priors, on the command line."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import support
from support import constrained

from jaxba import BundleProblem, ProblemWarning, hold, read_problem, with_gauge, write_colmap
from jaxba.cli.colmap_options import translated
from jaxba.cli.common import UsageError
from jaxba.cli.solve import run

POSITIONS = "position_priors: {positions: {1: [0, 0, 0], 2: [1, 0, 0], 3: [0, 1, 0], 4: [0, 0, 1]}"


@pytest.fixture
def model(tmp_path):
    write_colmap(support.tiny(), tmp_path / "m")
    return tmp_path / "m"


def test_colmaps_options_are_those_of_the_command():
    words = "--input_path in --output_path=out --BundleAdjustment.refine_focal_length 0 "
    words += (
        "--BundleAdjustment.refine_extra_params=false --BundleAdjustment.refine_principal_point 0 "
    )
    words += "--BundleAdjustmentCeres.max_num_iterations 7 "
    words += "--BundleAdjustmentCeres.loss_function_type CAUCHY --dtype mixed"
    wanted = (
        "in --output out --max-iterations 7 --loss cauchy --dtype mixed --constant focal distortion"
    )
    assert translated(words.split()) == wanted.split()


def test_constants_of_both_ways_are_gathered():
    words = "s --constant poses k1 --BundleAdjustment.refine_focal_length 0 --dtype mixed"
    assert translated(words.split()) == [
        "s",
        "--dtype",
        "mixed",
        "--constant",
        "poses",
        "k1",
        "focal",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "gauge: two_cameras",
            "gauge: must be one of free, two-cameras, three-points, not 'two_cameras'",
        ),
        ("gauge: [free]", "gauge: must be one of"),
        ("position_priors: {stddev: 0.1}", "position_priors: 'positions' is missing"),
        ("position_priors: {std: 0.1, positions: {}}", "position_priors: unknown key std"),
        (
            "position_priors: 5",
            "position_priors: must be a mapping with the keys positions, stddev, loss",
        ),
        (
            "position_priors: {positions: [[1, 2, 3]]}",
            "position_priors: positions: must be a mapping from images",
        ),
        (
            "position_priors: {positions: {9: [1, 2]}}",
            "position_priors: positions: 9: must be three numbers, not [1, 2]",
        ),
        (
            "position_priors: {positions: {9: [1, 2, north]}}",
            "positions: 9: must be three numbers, not [1, 2, north]",
        ),
        (
            "position_priors: {positions: {9: [1, 2, .nan]}}",
            "positions: 9: must be three numbers, not [1, 2, .nan]",
        ),
        ("position_priors: {positions: {9: [1, 2, 3]}}", "none of the images is in the problem: 9"),
        (f"{POSITIONS}, stddev: 0}}", "stddev: must be a positive number, or three, not 0"),
        (f"{POSITIONS}, stddev: 2cm}}", "stddev: must be a positive number, or three, not 2cm"),
        (
            f"{POSITIONS}, stddev: [1, -1, 1]}}",
            "stddev: must be a positive number, or three, not [1, -1, 1]",
        ),
        (f"{POSITIONS}, stddev: [1, 2]}}", "one or three for each of 4 images, not 2 values"),
        (
            f"{POSITIONS}, stddev: [1, 2, [0, 1, 1], 1]}}",
            "stddev: 3: must be a positive number, or three, not [0, 1, 1]",
        ),
        (f"{POSITIONS}, stddev: {{1: 1, 3: 1}}}}", "stddev: missing for 2, 4"),
        (f"{POSITIONS}, loss: gauss}}", "position_priors: unknown loss 'gauss'"),
        (f"{POSITIONS}, loss_scale: wide}}", "loss_scale: must be a number, not wide"),
        (f"{POSITIONS}, align: maybe}}", "align: must be true or false, not maybe"),
        (
            "constant_poses: {a: 1}",
            "constant_poses: must be a list (names or ids of images), not {a: 1}",
        ),
        (
            "constant_poses: [[1]]",
            "constant_poses: must be a list (names or ids of images), not [1]",
        ),
        ("constant_cameras: 1.5", "constant_cameras: there is no camera '1.5'"),
        ("constant_numbers: [k1, '']", "constant_numbers: must be a list (focal, principal_point"),
        ("constant_points: [true]", "constant_points: "),
        ("constant_numbers: k9", "constant_numbers: no lens has a number 'k9'"),
        ("constant_poses: [absent.jpg]", "constant_poses: there is no image 'absent.jpg'"),
        ("constant_points: [99999999999999999999]", "constant_points: there is no point"),
    ],
)
def test_mistakes_in_a_file_of_constraints_are_one_line(model, tmp_path, capsys, text, message):
    (tmp_path / "c.yaml").write_text(text + "\n")
    assert run([str(model), "--constraints", str(tmp_path / "c.yaml")]) == 2
    error = capsys.readouterr().err
    assert message in error.partition("c.yaml: ")[2]
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "--BundleAdjustment.refine_focal_length",
            "--BundleAdjustment.refine_focal_length needs a value",
        ),
        ("--BundleAdjustment.refine_focal_length 2", "refine_focal_length must be 0 or 1, not '2'"),
        (
            "--BundleAdjustment.lens 1",
            "--BundleAdjustment.lens is not an option here; of COLMAP's are refine_",
        ),
        (
            "--BundleAdjustment.min_track_length 3",
            "put part: {min_track: 3} in the file of --constraints",
        ),
        (
            "--constant k9",
            "--constant: no lens has a number 'k9'; there are focal, principal_point",
        ),
        ("--covariance c.npz", "--covariance needs --gauge, constants or priors"),
        ("--covariance p.txt --gauge two-cameras", "--covariance p.txt: is a file of the problem"),
        (
            "--covariance a.txt --output a.txt",
            "--output and --covariance name the same file, a.txt",
        ),
        (
            "--survey s.csv",
            "--survey needs control points or distances in the file of --constraints",
        ),
        ("--refine-principal-point", "--refine-principal-point is for COLMAP models"),
        ("--constraints none.yaml", "--constraints none.yaml: No such file"),
    ],
)
def test_what_cannot_be_is_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    support_file = tmp_path / "p.txt"
    from jaxba import write_bal

    write_bal(support.tiny(), support_file)
    assert run([str(support_file), *words.split()]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_file_of_constants_names_images_and_points_of_the_model(model, tmp_path, capsys):
    problem = read_problem(model)
    (tmp_path / "c.yaml").write_text(
        "constant_poses: [image0001.jpg, 3]\nconstant_points: [2]\nconstant_numbers: [k2]\ngauge: "
        "free\n",
        encoding="utf-16",  # as older editors of Windows save text
    )
    out = str(tmp_path / "out")
    spread = tmp_path / "c.npz"
    words = [
        "--constraints",
        str(tmp_path / "c.yaml"),
        "--output",
        out,
        "--covariance",
        str(spread),
        "--policy",
        "ceres",
    ]
    assert run([str(model), *words]) == 0
    assert "2 constant poses, 1 constant point" in capsys.readouterr().out
    found = read_problem(out)
    assert (found.cameras[[0, 2], :6] == problem.cameras[[0, 2], :6]).all()
    assert (found.points[1] == problem.points[1]).all()
    assert (found.cameras[:, 8] == problem.cameras[:, 8]).all()
    assert (found.cameras[1, :6] != problem.cameras[1, :6]).all()
    with np.load(spread) as arrays:
        assert (arrays["poses"][0] == 0).all()
        assert (arrays["poses"][1].diagonal() > 0).all()
        assert arrays["image_names"][[0, 2]].tolist() == ["image0001.jpg", "image0003.jpg"]
        assert arrays["point_ids"][1] == 2
        assert "looks along -z" in str(arrays["axes"])


def test_a_file_of_constants_names_a_part_of_the_images(model, tmp_path):
    problem = read_problem(model)
    (tmp_path / "c.yaml").write_text(
        "part: {images: [image0001.jpg, 3], points: all, ignored: [2], min_track: 2}\n"
    )
    found = constrained(problem, (), None, str(tmp_path / "c.yaml"))
    assert np.flatnonzero(~found.constants.poses.any(axis=1)).tolist() == [0, 2]
    assert 1 not in found.point_index
    (tmp_path / "c.yaml").write_text("part: {image: [1]}\n")
    with pytest.raises(
        UsageError, match="part: unknown key image; there are images, points, ignored, min_track"
    ):
        constrained(problem, (), None, str(tmp_path / "c.yaml"))
    (tmp_path / "c.yaml").write_text("part: {min_track: many}\n")
    with pytest.raises(UsageError, match="min_track: must be a whole number, not many"):
        constrained(problem, (), None, str(tmp_path / "c.yaml"))


NAMES = ("000010", "1_000", "0x10", "1e3", "yes", "2024-01-01")


@pytest.mark.parametrize(
    ("text", "held"),
    [
        ("[000010, 1e3, 2024-01-01]", [0, 3, 5]),  # an octal 8, a number and a date for YAML
        ("\n- 1_000\n- 0x10\n- yes", [1, 2, 4]),
        ("1e3", [3]),
        ("[2]", [1]),  # the id of an image, as there is no such name
        ("all", [0, 1, 2, 3, 4, 5]),
        ("", []),
    ],
)
def test_names_that_look_like_numbers_are_names(text, held, model, tmp_path):
    problem = read_problem(model)
    problem = problem.replace(labels=replace(problem.labels, names=NAMES))
    (tmp_path / "c.yaml").write_text(f"constant_poses: {text}\n")
    found = constrained(problem, (), None, str(tmp_path / "c.yaml"))
    constant = np.zeros(6, bool) if found.constants is None else found.constants.poses.all(axis=1)
    assert np.flatnonzero(constant).tolist() == held


def test_a_name_goes_before_an_id_and_another_form_of_a_number_is_no_id(model, tmp_path):
    problem = read_problem(model)
    problem = problem.replace(
        labels=replace(problem.labels, names=("3", *problem.labels.names[1:]))
    )
    (tmp_path / "c.yaml").write_text('constant_poses: [3, "4"]\n')
    found = constrained(problem, (), None, str(tmp_path / "c.yaml"))
    assert np.flatnonzero(found.constants.poses.all(axis=1)).tolist() == [0, 3]
    for key in ("constant_poses", "constant_points", "constant_cameras"):
        (tmp_path / "c.yaml").write_text(f"{key}: [01]\n")
        with pytest.raises(UsageError, match=rf"{key}: there is no (image|point|camera) '01'"):
            constrained(problem, (), None, str(tmp_path / "c.yaml"))


@pytest.mark.slow("another file has a sample of it")
def test_priors_of_the_file_pull_images_to_their_positions(model, tmp_path):
    from jaxba.problem import geometry

    problem = read_problem(model)
    goal = 3.0 * geometry.camera_centers(problem.cameras) + 7.0
    rows = "\n".join(
        f"    {i}: [{', '.join(map(str, c))}]"
        for i, c in zip(problem.labels.images, goal, strict=True)
    )
    (tmp_path / "c.yaml").write_text(f"position_priors:\n  stddev: 0.01\n  positions:\n{rows}\n")
    assert (
        run(
            [
                str(model),
                "--constraints",
                str(tmp_path / "c.yaml"),
                "--output",
                str(tmp_path / "out"),
            ]
        )
        == 0
    )
    centers = geometry.camera_centers(read_problem(tmp_path / "out").cameras)
    np.testing.assert_allclose(centers, goal, atol=0.3)
    (tmp_path / "c.yaml").write_text("constant_images: [1]\n")
    assert run([str(model), "--constraints", str(tmp_path / "c.yaml")]) == 2


def test_positions_of_other_images_are_left_out_with_a_note(model, tmp_path):
    from support import constrained

    from jaxba.cli.common import UsageError
    from jaxba.problem import geometry

    problem = read_problem(model)
    file = tmp_path / "log.yaml"
    centers = geometry.camera_centers(problem.cameras)
    rows = {name: at for name, at in zip(problem.labels.names[:5], centers.tolist(), strict=False)}
    rows |= {f"later{k}.jpg": [0, 0, 0] for k in range(6)}
    accuracy = ["0.01", 1e3] * 5 + [1]
    text = "".join(f"    {name}: {row}\n" for name, row in rows.items())
    file.write_text(
        f"position_priors:\n  align: false\n  stddev: [{', '.join(map(str, accuracy))}]\n  "
        f"positions:\n{text}"
    )
    left = (
        "positions of 6 images that the problem does not have: later0.jpg, later1.jpg, "
        "later2.jpg and 3 more"
    )
    with pytest.warns(ProblemWarning, match=f"log.yaml: position_priors: left out {left}"):
        found = constrained(problem, (), None, str(file))
    (rows,) = found.residuals.rows
    position, whitening = rows.data
    assert (position == centers[:5]).all()
    np.testing.assert_allclose(whitening[:, 0, 0], [100, 1e-3, 100, 1e-3, 100])
    with pytest.raises(UsageError, match=f"log.yaml: position_priors: {left}"):
        constrained(problem, (), None, str(file), strict=True)


def test_notes_of_a_solve_know_what_is_constant(unchecked):
    from jaxba.cli import table

    def remarks(problem: BundleProblem) -> str:
        return "".join(
            table.remarks(
                problem, SimpleNamespace(problem=problem, set_aside=np.zeros(0, int), rejected=None)
            )
        )

    problem = support.odd()
    free = remarks(problem)
    assert all(
        words in free
        for words in ("seen once", "positions stay as they are", "poses stay as they are")
    )
    for part, words in (("points", ("seen once", "positions stay")), ("poses", ("poses stay",))):
        text = remarks(hold(problem, **{part: "all"}))
        assert not any(word in text for word in words), text


def test_options_say_the_same_as_the_functions_of_python(model):
    problem = read_problem(model)
    wanted: BundleProblem = with_gauge(
        hold(problem, rotations="all", numbers=["focal"]), "two-cameras"
    )
    found = constrained(problem, ("rotations", "focal"), "two-cameras", None)
    assert (found.constants.poses == wanted.constants.poses).all()
    assert (found.lenses.free == wanted.lenses.free).all()
