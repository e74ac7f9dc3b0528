"""Ground control points and RTK positions of a drone's block, by the command, against theory and
COLMAP."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path

import numpy as np
import pytest
import support
from drone_block import CHECKS, CLICKED, CONTROLS, RTK, SURVEYED, Block, drone_block

import jaxba
from jaxba import ProblemError, ProblemWarning
from jaxba.cli.common import UsageError
from jaxba.cli.constraints import surveyed
from jaxba.cli.solve import run
from jaxba.problem import geometry
from jaxba.problem.marks import found_at

FILES = ("c.yaml", "log.csv")
"""What says how to solve a block, besides the control points."""


@pytest.fixture(scope="module")
def block(tmp_path_factory) -> Block:
    return drone_block(tmp_path_factory.mktemp("block"))


@pytest.fixture(scope="module")
def solved(block) -> Block:
    """The block with the model `out` and the report `survey.csv`."""
    files = {"--constraints": "c.yaml", "--output": "out", "--survey": "survey.csv"}
    options = [
        word for option, name in files.items() for word in (option, str(block.folder / name))
    ]
    assert run([str(block.folder / "model"), *options, "--policy", "ceres"]) == 0
    return block


def told(file: Path, folder: Path, **more) -> tuple:
    """The problem of a model with what a file says, and its marks."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProblemWarning)
        found = surveyed(jaxba.read_colmap(folder), (), None, str(file), path=str(folder), **more)
    return found.problem, found.marks


def rows_of(folder: Path) -> list[dict[str, str]]:
    with open(folder / "survey.csv") as file:
        return list(csv.DictReader(file))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_check_points_are_as_far_off_as_theory_says(solved):
    """The covariance of the marks is theory's; the RMS of twenty points is within a factor of
    it."""
    rows = rows_of(solved.folder)
    assert [row["kind"] for row in rows] == ["control"] * CONTROLS + ["check"] * CHECKS
    found = np.array([[float(row[axis]) for axis in ("dx", "dy", "dz")] for row in rows])
    problem, _ = told(solved.folder / "c.yaml", solved.folder / "out")
    theory = np.sqrt(
        np.diagonal(jaxba.covariance(problem).points[-CONTROLS - CHECKS :], axis1=1, axis2=2)
    )
    for axes in ([0, 1], [2]):
        assert 0.6 < rms(found[CONTROLS:, axes]) / rms(theory[CONTROLS:, axes]) < 1.5
    # which pixels pull on, and move by less than the survey's noise
    assert rms(found[:CONTROLS]) < SURVEYED


def test_the_written_model_has_no_point_more_or_less(solved):
    before, after = (jaxba.read_colmap(solved.folder / name) for name in ("model", "out"))
    assert (after.labels.points == before.labels.points).all()
    assert (after.observations == before.observations).all()
    assert (after.point_index == before.point_index).all()


def test_a_survey_from_python_is_that_of_the_command(solved, tmp_path):
    """A mapping with numbers, and files elsewhere, gives the scene, the report and the model of the
    file."""
    folder = solved.folder
    text = (solved.folder / "c.yaml").read_text()
    checks = [f"gcp{one}" for one in range(CONTROLS, CONTROLS + CHECKS)]
    assert f"stddev: {SURVEYED}, pixels: {CLICKED}, check: [{', '.join(checks)}]" in text
    accuracy = {"stddev": np.full(3, SURVEYED), "pixels": CLICKED}
    constraints = {
        "position_priors": {"file": str(folder / "log.csv"), "align": True},
        "control_points": {"file": folder / "gcp_list.txt", "check": checks, **accuracy},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProblemWarning)
        found = jaxba.survey(
            jaxba.read_colmap(folder / "model"), constraints, model=folder / "model"
        )
    solution = jaxba.solve(found.problem, "ceres")
    report = found.report(solution)
    for row, own in zip(rows_of(folder), report.rows, strict=True):
        assert (row["kind"], row["name"], int(row["images"])) == (own.kind, own.name, own.images)
        np.testing.assert_allclose(
            [float(row[f"d{axis}"]) for axis in "xyz"], own.difference, atol=1e-6
        )
    differences = np.array([row.difference for row in report.rows])[CONTROLS:]
    assert found.marks is not None
    np.testing.assert_array_equal(
        differences, solution.problem.points[-CHECKS:] - found.marks.places[CONTROLS:]
    )
    flat = np.hypot(rms(differences[:, 0]), rms(differences[:, 1]))
    assert (
        f"check points: RMS {flat:.4f} horizontally, {rms(differences[:, 2]):.4f} vertically"
        in str(report)
    )
    jaxba.write_colmap(
        found.without_marks(solution).problem, tmp_path / "out", like=folder / "model"
    )
    of_command, of_python = (jaxba.read_colmap(one) for one in (folder / "out", tmp_path / "out"))
    np.testing.assert_allclose(of_command.points, of_python.points, atol=1e-6)


@pytest.mark.parametrize(
    ("constraints", "message"),
    [
        (
            {"gauge": "none"},
            "constraints: gauge: must be one of free, two-cameras, three-points, not 'none'",
        ),
        ({"gauges": "free"}, "constraints: unknown key 'gauges'; there are"),
        ({"position_priors": {"file": "gone.csv"}}, "constraints: position_priors: cannot read"),
        ({"control_points": {"file": "gcp_list.txt"}}, "needs the COLMAP model of the problem"),
        ({"constant_points": [True]}, "constraints: constant_points: there is no point 'true'"),
    ],
)
def test_mistakes_from_python_are_one_line_that_names_the_key(constraints, message, block):
    with pytest.raises(ProblemError) as caught:
        jaxba.survey(jaxba.read_colmap(block.folder / "model"), constraints)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings(
    "ignore:.* all are check points, and nothing moves the scene:jaxba.ProblemWarning"
)
@pytest.mark.parametrize("refined", [False, True])
def test_a_mark_with_the_pixels_of_a_point_is_where_that_is(refined, solved, tmp_path):
    """With BAL's lenses, whose pixels count from the principal point, and with COLMAP's."""
    folder = solved.folder / "out"
    model = jaxba.read_colmap(folder, refine_principal_point=True)
    lines = ["local"]
    points = np.argsort(-np.bincount(model.point_index))[:3]
    for at in np.flatnonzero(np.isin(model.point_index, points)):
        x, y = model.observations[at]
        lines.append(
            f"0 0 0 {x} {y} {model.labels.names[model.camera_index[at]]} {model.point_index[at]}"
        )
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines))
    (tmp_path / "c.yaml").write_text(
        f"control_points: {{file: gcp_list.txt, check: [{', '.join(map(str, points))}]}}"
    )
    problem = jaxba.read_colmap(folder, refine_principal_point=refined)
    found = jaxba.survey(problem, tmp_path / "c.yaml", model=None if refined else folder)
    assert found.marks is not None
    own = problem.points[list(map(int, found.marks.names))]
    np.testing.assert_allclose(found.problem.points[-3:], own, atol=1e-3)


def test_the_report_is_printed(solved, capsys):
    args = [
        str(solved.folder / "out"),
        "--constraints",
        str(solved.folder / "c.yaml"),
        "--max-iterations",
        "0",
    ]
    assert run(args) == 0
    out = capsys.readouterr().out
    assert "gcp0                 control " in out
    assert "gcp24                check " in out
    assert "check points: RMS 0.0" in out


def test_distances_and_points_by_id_are_in_the_report(block, tmp_path, capsys):
    model = jaxba.read_colmap(block.folder / "model")
    first, second = model.labels.points[:2].tolist()
    length = float(np.linalg.norm(model.points[1] - model.points[0]))
    place = model.points[0].tolist()
    text = f"distances: [{{points: [{first}, {second}], length: {length + 0.25}, stddev: 0.125}}]\n"
    (tmp_path / "c.yaml").write_text(
        f"{text}control_points: {{positions: {{{first}: {place}}}, stddev: 0.1}}\n"
    )
    args = [
        "--constraints",
        str(tmp_path / "c.yaml"),
        "--max-iterations",
        "0",
        "--survey",
        str(tmp_path / "s.csv"),
    ]
    assert run([str(block.folder / "model"), *args]) == 0
    assert f"{length + 0.25:11.4f}{length:11.4f}    -0.2500" in capsys.readouterr().out
    with open(tmp_path / "s.csv") as file:
        point, distance = csv.DictReader(file)
    assert (point["kind"], point["name"], float(point["dx"])) == ("control", str(first), 0)
    assert int(point["images"]) == np.sum(model.point_index == 0)
    seen = model.subset(model.point_index == 0)
    errors = np.sum((seen.observations - geometry.project(seen)) ** 2, axis=1)
    assert float(point["pixels"]) == pytest.approx(np.sqrt(errors.mean()))
    assert (distance["name"], float(distance["sigmas"])) == (f"{first}-{second}", pytest.approx(2))


def test_control_points_alone_move_the_scene_to_them(block, tmp_path):
    """Without positions of images the scene is aligned with the marks; positions of a start are
    metres off."""
    text = (
        (block.folder / "c.yaml")
        .read_text()
        .split("\n")[1]
        .replace("file: ", f"file: {block.folder}/")
    )
    (tmp_path / "c.yaml").write_text(text)
    problem, marks = told(tmp_path / "c.yaml", block.folder / "model")
    found = found_at(
        problem, problem.num_points + np.arange(-CONTROLS - CHECKS, 0), marks.places, marks.stddev
    )
    assert np.abs(found.difference).max() < 5
    assert marks.check.tolist() == [False] * CONTROLS + [True] * CHECKS


@pytest.mark.extra
@pytest.mark.slow
def test_positions_give_the_scene_that_they_give_colmap(block, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")
    (tmp_path / "c.yaml").write_text(f"position_priors: {{file: {block.folder}/log.csv}}")
    problem, _ = told(tmp_path / "c.yaml", block.folder / "model")
    (rows,) = problem.residuals.rows
    found = support.solve(problem).problem
    model = pycolmap.Reconstruction(block.folder / "model")
    config = pycolmap.BundleAdjustmentConfig()
    priors = []
    for at, place in zip(*map(np.asarray, (rows.index[0], rows.data[0])), strict=True):
        image = model.image(int(problem.labels.images[at]))
        config.add_image(image.image_id)
        systems = pycolmap.PosePriorCoordinateSystem
        known = {
            "position": place,
            "position_covariance": RTK**2 * np.eye(3),
            "coordinate_system": systems.CARTESIAN,
        }
        priors.append(
            pycolmap.PosePrior(pose_prior_id=int(at) + 1, corr_data_id=image.data_id, **known)
        )
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    own = pycolmap.PosePriorBundleAdjustmentOptions()
    pycolmap.create_pose_prior_bundle_adjuster(options, own, config, priors, model).solve()
    points = np.array([model.point3D(int(one)).xyz for one in problem.labels.points])
    np.testing.assert_allclose(found.points, points, atol=1e-3)
    centers = [model.image(int(one)).projection_center() for one in problem.labels.images]
    np.testing.assert_allclose(geometry.camera_centers(found.cameras), centers, atol=1e-3)


@pytest.mark.slow
def test_wrong_matches_and_clicks_are_rejected_and_check_points_are_as_far_off_as_without(
    solved, tmp_path
):
    """A fifth of the matches is anywhere, a click of a control point is wrong, and one of the two
    of a check point."""
    model = jaxba.read_colmap(solved.folder / "model")
    rng = np.random.default_rng(1)
    pixels = np.array(model.observations)
    edge = np.ceil(np.abs(pixels).max(axis=0))  # which says how large the written images are
    wrong = (rng.random(len(pixels)) < 0.2) & (np.ceil(np.abs(pixels)) < edge).all(axis=1)
    pixels[wrong] = rng.uniform(-0.9 * edge, 0.9 * edge, pixels.shape)[wrong]
    jaxba.write_colmap(model.replace(observations=pixels), tmp_path / "model")
    lines = [
        line.split() for line in (solved.folder / "gcp_list.txt").read_text().split("\n")[1:-1]
    ]

    def of(name):
        return [at for at, line in enumerate(lines) if line[6] == name]

    for at in (of("gcp0")[0], of("gcp5")[0]):
        # across the strip, along which the next image is
        lines[at][4] = str(float(lines[at][4]) + 40)
    kept = [" ".join(line) for at, line in enumerate(lines) if at not in of("gcp5")[2:]]
    text = "\n".join(["WGS84 UTM 32N", *kept, ""])
    for name, content in (
        ("gcp_list.txt", text),
        *((one, (solved.folder / one).read_text()) for one in FILES),
    ):
        (tmp_path / name).write_text(content)
    files = {"--constraints": "c.yaml", "--output": "out", "--survey": "survey.csv"}
    options = [word for option, name in files.items() for word in (option, str(tmp_path / name))]
    assert run([str(tmp_path / "model"), *options, "--reject", "--policy", "ceres"]) == 0
    rows, without = (
        {row["name"]: row for row in rows_of(folder)} for folder in (tmp_path, solved.folder)
    )
    assert int(rows["gcp0"]["images"]) == int(without["gcp0"]["images"]) - 1
    assert (rows["gcp5"]["images"], rows["gcp5"]["dx"]) == ("0", "nan")

    def places(rows):
        return np.array([[float(row[f"d{axis}"]) for axis in "xyz"] for row in rows.values()])[
            CONTROLS + 1 :
        ]

    assert 0.8 < rms(places(rows)) / rms(places(without)) < 1.25
    after = jaxba.read_colmap(tmp_path / "out")
    assert after.num_observations < 1.01 * np.sum(~wrong)


@pytest.mark.parametrize(
    ("text", "more", "message"),
    [
        ("EPSG:32632\n", "", "gcp_list.txt: has no points"),
        (
            "1 2 3 4 5 a.jpg\n1 2 3 4 5 b.jpg\n",
            "",
            "gcp_list.txt line 1: is no coordinate system, such as EPSG:32632",
        ),
        (
            "# c\nlocal\n1 2 3 a.jpg\n",
            "",
            "gcp_list.txt line 3: has 4 words, not x y z px py image [name]",
        ),
        ("local\n1 2 3 4 x a.jpg\n", "", "gcp_list.txt line 2: 'x' is not a number (pixel y)"),
        (
            "local\n1 2 3 4 5 a.jpg g\n1 2 4 4 5 b.jpg g\n",
            "",
            "gcp_list.txt line 3: g has another place than before",
        ),
        (
            "local\n1 2 3 4 5 a.jpg g\n1 2 3 4 6 a.jpg g\n",
            "",
            "gcp_list.txt line 3: g is in a.jpg twice",
        ),
        ("local\n1 2 3 4 5 a.jpg g\n", "", "none of the images is in the problem: a.jpg"),
        ("local\n1 2 3 4 5 image0001.jpg g\n", "", "no point is in two images of the problem"),
        (
            "nowhere\n1 2 3 4 5 image0001.jpg g\n1 2 3 4 5 image0002.jpg g\n",
            "",
            "coordinate system 'nowhere'",
        ),
        (
            "local\n1 2 3 4 5 image0001.jpg g\n",
            "check: [h]",
            "check: there is no point h; there are g",
        ),
        (
            "local\n1 2 3 4 5 image0001.jpg g\n",
            "pixels: 0",
            "pixels: must be a positive number, not 0",
        ),
        (
            "local\n1 2 3 4 5 image0001.jpg g\n",
            "sigma: 1",
            "unknown key sigma; there are file, check, pixels",
        ),
    ],
)
def test_mistakes_are_one_line_with_file_and_line(text, more, message, block, tmp_path):
    (tmp_path / "gcp_list.txt").write_text(text)
    (tmp_path / "c.yaml").write_text(f"control_points: {{file: gcp_list.txt, {more}}}\n")
    with pytest.raises(UsageError) as caught:
        told(tmp_path / "c.yaml", block.folder / "model")
    assert message in str(caught.value)
    assert "control_points: " in str(caught.value)
    assert "\n" not in str(caught.value)


def test_check_points_alone_are_not_compared_with_places_of_another_frame(block, tmp_path):
    """The report has no differences, and no note says that the scene is anywhere."""
    names = ", ".join(f"gcp{at}" for at in range(CONTROLS + CHECKS))
    folder = block.folder / "model"
    for line, alone in (("WGS84 UTM 32N", True), ("local", False)):
        text = (block.folder / "gcp_list.txt").read_text().replace("WGS84 UTM 32N", line)
        (tmp_path / "gcp_list.txt").write_text(text)
        (tmp_path / "c.yaml").write_text(
            f"control_points: {{file: gcp_list.txt, check: [{names}]}}\n"
        )
        with pytest.warns(ProblemWarning, match="all are check points") as notes:
            found = jaxba.survey(jaxba.read_colmap(folder), tmp_path / "c.yaml", model=folder)
        assert not any("the scene is in" in str(note.message) for note in notes)
        assert found.marks is not None
        assert np.isnan(found.marks.places).all() == alone
        assert not found.problem.residuals


def test_what_lacks_of_control_points_leaves_out_these_alone(block, tmp_path):
    lines = (block.folder / "gcp_list.txt").read_text().split("\n")[:-1]
    changed = [lines[0]]
    for line in lines[1:]:
        east, north, up, rest = line.split(" ", 3)
        place = {"gcp1": f"{east} {north}", "gcp2": "- - -"}.get(
            line.split()[-1], f"{east} {north} {up}"
        )
        changed.append(
            f"{place} {rest}".replace("image0", r"D:\Flight\IMAGE0").replace(".jpg", ".JPG")
        )
    (tmp_path / "gcp_list.txt").write_text("\n".join(changed))
    constraints = {"control_points": {"file": tmp_path / "gcp_list.txt"}}
    folder = block.folder / "model"
    with pytest.warns(ProblemWarning) as notes:
        found = jaxba.survey(jaxba.read_colmap(folder), constraints, model=folder)
    assert any(
        "left out 2 points without a place or height: gcp1, gcp2" in str(note.message)
        for note in notes
    )
    assert found.marks is not None
    assert set(found.marks.names) == {f"gcp{at}" for at in range(CONTROLS + CHECKS)} - {
        "gcp1",
        "gcp2",
    }


def test_points_of_other_images_are_left_out(block, tmp_path):
    lines = (block.folder / "gcp_list.txt").read_text().split("\n")[1:-1]
    mine = [line for line in lines if line.endswith("gcp0")]
    text = ["EPSG:32632", *mine, mine[0].replace("gcp0", "once"), mine[1].replace("image", "other")]
    (tmp_path / "gcp_list.txt").write_text("\n".join(text))
    (tmp_path / "c.yaml").write_text("control_points: {file: gcp_list.txt, check: gcp0}\n")
    folder = block.folder / "model"
    with pytest.warns(ProblemWarning) as notes:
        found = jaxba.survey(jaxba.read_colmap(folder), tmp_path / "c.yaml", model=folder)
    said = "\n".join(str(one.message) for one in notes)
    assert "left out pixels of 1 image that the problem does not have: other" in said
    assert "left out 1 point in fewer than two images of the problem: once" in said
    assert found.marks is not None
    assert found.marks.names == ("gcp0",)
    assert not found.problem.residuals
    with pytest.raises(UsageError, match="pixels of 1 image that the problem does not have"):
        told(tmp_path / "c.yaml", folder, strict=True)
