"""Surveys in the file of `--constraints`: positions on the earth."""

from __future__ import annotations

import functools
import json
import sqlite3
import warnings
from pathlib import Path

import numpy as np
import pyproj
import pytest
import support
from PIL import Image
from support import constrained

import jaxba
from jaxba import ProblemError, ProblemWarning
from jaxba.cli.common import MISFIT, UsageError
from jaxba.cli.solve import run
from jaxba.model.registration import costs_by_kind
from jaxba.problem import geometry
from jaxba.problem.labels import Labels
from jaxba.problem.similarity import Similarity, transformed

ORIGIN = (8.5, 47.3, 500.0)
"""Longitude, latitude and height of the scene's origin."""


def on_earth(places: np.ndarray) -> np.ndarray:
    """Latitude, longitude and height of metres east, north and up."""
    lon, lat, height = ORIGIN
    pipeline = (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={lon} +lat_0={lat} "
        f"+h_0={height} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    lon, lat, height = pyproj.Transformer.from_pipeline(pipeline).transform(*places.T)
    return np.stack([lat, lon, height], axis=1)


@functools.cache
def _solved() -> jaxba.BundleProblem:
    return support.solve(support.tiny()).problem


@pytest.fixture
def scene(tmp_path) -> tuple[Path, jaxba.BundleProblem, np.ndarray]:
    """A solved model of six images, and where the images are on the earth: another frame of ten
    times its size."""
    jaxba.write_colmap(_solved(), folder := tmp_path / "model")
    problem = jaxba.read_colmap(folder)
    turn = geometry.rotation_matrices(np.array([[0.3, -0.2, 1.0]]))[0]
    return folder, problem, on_earth(10 * geometry.camera_centers(problem.cameras) @ turn.T)


def distances(places: np.ndarray) -> np.ndarray:
    return np.linalg.norm(places[:, None] - places, axis=2)


def write_log(path: Path, problem: jaxba.BundleProblem, places: np.ndarray) -> None:
    rows = zip((*problem.labels.names, "other.jpg"), [*places.tolist(), [0, 0, 0]], strict=True)
    path.write_text(
        "image,lat,lon,alt,accuracy\n"
        + "".join(f"{n},{a!r},{b!r},{c!r},0.05\n" for n, (a, b, c) in rows)
    )


def write_database(path: Path, problem: jaxba.BundleProblem, places: np.ndarray) -> None:
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
    base.execute(
        "CREATE TABLE pose_priors (corr_data_id INTEGER, corr_sensor_type INTEGER, position BLOB,"
        " position_covariance BLOB, coordinate_system INTEGER)"
    )
    for at, (name, place) in enumerate(zip(problem.labels.names, places, strict=True)):
        base.execute("INSERT INTO images VALUES (?, ?)", (at, name))
        blobs = place.tobytes(), (0.05**2 * np.eye(3)).tobytes()
        base.execute("INSERT INTO pose_priors VALUES (?, 0, ?, ?, 0)", (at, *blobs))
    base.commit()
    base.close()


def write_photos(folder: Path, problem: jaxba.BundleProblem, places: np.ndarray) -> None:
    folder.mkdir()
    for name, (lat, lon, height) in zip(problem.labels.names, places, strict=True):
        image = Image.new("RGB", (4, 3))
        exif = image.getexif()
        exif[0x8825] = {1: "N", 2: (lat, 0.0, 0.0), 3: "E", 4: (lon, 0.0, 0.0), 5: b"\0", 6: height}
        image.save(folder / name, exif=exif)


@pytest.mark.parametrize("source", ["positions", "file", "database", "photos", "projected"])
def test_positions_on_the_earth_make_a_scene_in_metres(source, scene, tmp_path):
    _, problem, places = scene
    names = problem.labels.names
    text = {"file": "file: log.csv", "database": "database: d.db"}
    text["photos"] = "photos: images, stddev: 0.05"
    rows = ", ".join(f"{name}: {place}" for name, place in zip(names, places.tolist(), strict=True))
    inline = f"positions: {{{rows}}}, crs: EPSG:4326, stddev: 0.05"
    write_log(tmp_path / "log.csv", problem, places)
    write_database(tmp_path / "d.db", problem, places)
    write_photos(tmp_path / "images", problem, places)
    crs = "crs: EPSG:32632\n" if source == "projected" else ""
    (tmp_path / "c.yaml").write_text(f"{crs}position_priors: {{{text.get(source, inline)}}}\n")
    with pytest.warns(ProblemWarning) as notes:
        found = constrained(problem, (), None, str(tmp_path / "c.yaml"))
    said = "\n".join(str(one.message) for one in notes)
    assert ("left out positions of 1 image that the problem does not have: other.jpg" in said) == (
        source == "file"
    )
    assert (
        f"the scene is in {'EPSG:32632' if crs else 'metres east, north and up of latitude 47.'}"
        in said
    )
    (rows,) = found.residuals.rows
    np.testing.assert_allclose(
        np.asarray(rows.data[1]), np.tile(np.eye(3) / 0.05, (6, 1, 1)), atol=1e-9
    )
    centers = geometry.camera_centers(found.cameras)
    before = geometry.camera_centers(problem.cameras)
    np.testing.assert_allclose(
        distances(centers),
        10 * distances(before),
        rtol={"projected": 1e-3, "photos": 1e-4}.get(source, 1e-9),
    )
    if crs:
        expected = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632").transform(*places.T[:2])
        np.testing.assert_allclose(centers[:, :2], np.stack(expected, axis=1), atol=0.05)


def test_positions_of_nerfstudio_give_the_scene_their_scale(scene, tmp_path):
    _, problem, _ = scene
    jaxba.write_transforms(
        transformed(problem, Similarity(3.0, np.eye(3), np.ones(3))), tmp_path / "transforms.json"
    )
    (tmp_path / "c.yaml").write_text("position_priors: {file: transforms.json, stddev: 0.05}\n")
    found = constrained(problem, (), None, str(tmp_path / "c.yaml"))
    np.testing.assert_allclose(
        geometry.camera_centers(found.cameras),
        3 * geometry.camera_centers(problem.cameras) + 1,
        atol=1e-9,
    )


def test_images_are_found_by_the_names_of_their_files(scene, tmp_path):
    _, problem, places = scene
    labels = problem.labels
    write_log(tmp_path / "log.csv", problem, places)
    problem = problem.replace(
        labels=Labels(
            tuple(f"flight/{name}" for name in labels.names),
            labels.images,
            labels.lenses,
            labels.points,
        )
    )
    (tmp_path / "c.yaml").write_text("position_priors: {file: log.csv}\n")
    with pytest.warns(ProblemWarning):
        found = constrained(problem, (), None, str(tmp_path / "c.yaml"))
    assert found.residuals.rows[0].index[0].tolist() == list(range(6))


def surveyed(problem: jaxba.BundleProblem, **constraints) -> tuple[jaxba.BundleProblem, list[str]]:
    """A problem with constraints, and the notes."""
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        found = jaxba.survey(problem, constraints).problem
    return found, [str(note.message) for note in notes]


def deviations(problem: jaxba.BundleProblem) -> np.ndarray:
    """Standard deviations of positions."""
    (rows,) = problem.residuals.rows
    return 1 / np.diagonal(np.asarray(rows.data[1]), axis1=1, axis2=2)


@pytest.mark.parametrize("prefix", ["C:\\flights\\07\\", "/data/flights/", "other/"])
@pytest.mark.parametrize("case", [str.upper, str.lower])
def test_images_are_found_by_paths_of_any_system_and_case(prefix, case, scene, tmp_path):
    _, problem, places = scene
    rows = [
        f"{prefix}{case(name)},{','.join(map(repr, place))}"
        for name, place in zip(problem.labels.names, places.tolist(), strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join(["image,lat,lon,alt", *rows[::-1]]))
    found, notes = surveyed(problem, position_priors={"file": tmp_path / "log.csv", "stddev": 0.5})
    assert found.residuals.rows[0].index[0].tolist() == [5, 4, 3, 2, 1, 0]
    assert len(notes) == 1


def test_names_that_are_not_there_or_not_clear_are_noted_beside_one_that_is(scene, tmp_path):
    _, problem, places = scene
    labels = problem.labels
    names = ("a/IMG_1.jpg", "b/IMG_1.jpg", *(f"a/{name}" for name in labels.names[2:]))
    problem = problem.replace(labels=Labels(names, labels.images, labels.lenses, labels.points))
    rows = [
        f"{name},{','.join(map(repr, place))}"
        for name, place in zip(("IMG_1.jpg", "gone.jpg", *names[2:]), places.tolist(), strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join(["image,lat,lon,alt", *rows]))
    found, notes = surveyed(problem, position_priors={"file": tmp_path / "log.csv"})
    assert found.residuals.rows[0].index[0].tolist() == [2, 3, 4, 5]
    assert notes[0].endswith(
        "left out positions of 1 image that the problem does not have: gone.jpg; it has a/IMG_1.jpg"
    )
    assert (
        "positions of 1 image whose names are not clear: IMG_1.jpg; a/IMG_1.jpg and b/IMG_1.jpg "
        "may both" in notes[1]
    )


@pytest.mark.parametrize("source", ["file", "database", "photos", "positions"])
def test_images_without_a_fix_are_left_out_and_do_not_move_the_frame(source, scene, tmp_path):
    _, problem, places = scene
    names = problem.labels.names
    places = places.copy()
    places[1] = 0
    places[4] = [0, 0, 120]
    write_log(tmp_path / "log.csv", problem, places)
    write_database(tmp_path / "d.db", problem, places)
    write_photos(tmp_path / "images", problem, places)
    inline = {name: place for name, place in zip(names, places.tolist(), strict=True)}
    value = {
        "file": tmp_path / "log.csv",
        "database": tmp_path / "d.db",
        "photos": tmp_path / "images",
    }
    given = {source: value.get(source, inline), "stddev": 0.5} | (
        {} if source in value else {"crs": "EPSG:4326"}
    )
    found, notes = surveyed(problem, position_priors=given)
    assert found.residuals.rows[0].index[0].tolist() == [0, 2, 3, 5]
    assert any(
        f"left out positions of 2 images without a fix: {names[1]}, {names[4]}" in note
        for note in notes
    )
    assert np.abs(np.asarray(found.residuals.rows[0].data[0])).max() < 1000
    with pytest.raises(ProblemError, match=r"position_priors: .*positions of .* image"):
        jaxba.survey(problem, {"position_priors": given}, strict=True)


def test_accuracies_of_a_table_that_are_not_all_there_count(scene, tmp_path):
    _, problem, places = scene
    rows = [
        f"{name},{a!r},{b!r},{c!r}"
        for name, (a, b, c) in zip(problem.labels.names, places.tolist(), strict=True)
    ]
    (tmp_path / "log.csv").write_text(
        "\n".join(["image,lat,lon,alt,hacc", *(f"{row},0.02" for row in rows)])
    )
    found, notes = surveyed(problem, position_priors={"file": tmp_path / "log.csv"})
    assert any(
        "no accuracy of heights: they get 2 times the horizontal one" in note for note in notes
    )
    np.testing.assert_allclose(deviations(found), np.tile([0.02, 0.02, 0.04], (6, 1)))
    found, notes = surveyed(problem, position_priors={"file": tmp_path / "log.csv", "stddev": 0.5})
    assert not any("accuracy" in note for note in notes)
    mapping = {problem.labels.names[0].upper(): 0.25}
    found, _ = surveyed(problem, position_priors={"file": tmp_path / "log.csv", "stddev": mapping})
    np.testing.assert_allclose(deviations(found)[:2], [[0.25] * 3, [0.02, 0.02, 0.04]])
    base = tmp_path / "d.db"
    write_database(base, problem, places)
    with sqlite3.connect(base) as connection:
        for image, covariance in (
            (2, np.full((3, 3), np.nan)),
            (3, np.eye(3)),
            (4, np.zeros((3, 3))),
        ):
            connection.execute(
                "UPDATE pose_priors SET position_covariance = ? WHERE corr_data_id = ?",
                (covariance.tobytes(), image),
            )
    connection.close()
    found, notes = surveyed(problem, position_priors={"database": base})
    assert any(
        f"no accuracy of 2 images, which get the largest of the others: {problem.labels.names[2]}"
        in note
        for note in notes
    )
    np.testing.assert_allclose(deviations(found)[:, 0], [0.05, 0.05, 1, 1, 1, 0.05])


def test_an_image_with_two_positions_has_none(scene, tmp_path):
    _, problem, places = scene
    rows = [
        f"{name},{a!r},{b!r},{c!r}"
        for name, (a, b, c) in zip(problem.labels.names, places.tolist(), strict=True)
    ]
    other = f"{rows[1].rpartition(',')[0]},{float(places[1, 2]) + 0.5!r}"
    (tmp_path / "log.csv").write_text("\n".join(["image,lat,lon,alt", *rows, rows[0], other]))
    found, notes = surveyed(problem, position_priors={"file": tmp_path / "log.csv"})
    assert found.residuals.rows[0].index[0].tolist() == [0, 2, 3, 4, 5]
    name = problem.labels.names[1]
    assert any(
        note.endswith(f"positions of 1 image with other ones in another row, in 2 rows: {name}")
        for note in notes
    )


def test_a_coordinate_system_of_the_scene_counts_for_positions_without_one_or_is_noted(
    scene, tmp_path
):
    _, problem, places = scene
    east, north = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632").transform(*places.T[:2])
    rows = [
        f"{name};{x:.4f};{y:.4f};{z:.4f}".replace(".", ",").replace(",jpg", ".jpg")
        for name, x, y, z in zip(problem.labels.names, east, north, places[:, 2], strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join(["Label;X/Easting;Y/Northing;Z/Altitude", *rows]))
    found, notes = surveyed(
        problem, crs="EPSG:32632", position_priors={"file": tmp_path / "log.csv"}
    )
    assert any("positions are taken as of EPSG:32632" in note for note in notes)
    np.testing.assert_allclose(found.residuals.rows[0].data[0][:, 0], east, atol=1e-3)
    _, notes = surveyed(problem, crs="EPSG:32632", constant_poses=[problem.labels.names[0]])
    assert notes == [
        "constraints: crs: nothing moves the scene there: it needs position_priors or a file of "
        "control_points"
    ]


@pytest.mark.slow
def test_the_written_model_stays_in_metres(scene, tmp_path, capsys):
    folder, problem, places = scene
    write_log(tmp_path / "log.csv", problem, places)
    (tmp_path / "c.yaml").write_text("position_priors: {file: log.csv}\n")
    assert (
        run(
            [
                str(folder),
                "--constraints",
                str(tmp_path / "c.yaml"),
                "--output",
                str(tmp_path / "out"),
            ]
        )
        == 0
    )
    assert (
        "c.yaml: position_priors: the scene is in metres east, north and up of"
        in capsys.readouterr().out
    )
    centers = geometry.camera_centers(jaxba.read_colmap(tmp_path / "out").cameras)
    np.testing.assert_allclose(
        distances(centers), distances(10 * geometry.camera_centers(problem.cameras)), atol=0.1
    )


@pytest.mark.slow
def test_a_position_that_does_not_fit_is_named_and_strict_ends_with_a_status(
    scene, tmp_path, capsys
):
    """The solution is written, and the log has the note."""
    folder, problem, places = scene
    wrong = np.array(places)
    wrong[2, 2] += 10.0  # metres up, 200 standard deviations
    write_log(tmp_path / "log.csv", problem, wrong)
    log = (tmp_path / "log.csv").read_text().splitlines()
    # strict refuses the image that is not there
    (tmp_path / "log.csv").write_text("\n".join([*log[:-1], ""]))
    (tmp_path / "c.yaml").write_text("position_priors: {file: log.csv}\n")
    files = {"--constraints": "c.yaml", "--output": "out", "--log": "log.json"}
    options = [word for option, name in files.items() for word in (option, str(tmp_path / name))]
    assert run([str(folder), *options, "--strict", "--policy", "ceres"]) == MISFIT
    shown = capsys.readouterr()
    (note,) = [
        line
        for line in shown.out.splitlines()
        if line.startswith("note: position_prior: does not fit the rest")
    ]
    assert problem.labels.names[2] in note
    assert not [
        name for name in problem.labels.names if name in note and name != problem.labels.names[2]
    ]
    assert shown.err.endswith(
        "error: --strict: what was measured does not fit, see the notes above\n"
    )
    assert len(jaxba.read_colmap(tmp_path / "out").cameras) == 6
    assert json.loads((tmp_path / "log.json").read_text())["notes"] == [note.removeprefix("note: ")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("crs: EPSG:4326", "crs: EPSG:4326 is no projected coordinate system in metres"),
        ("position_priors: {file: gone.csv}", "position_priors: cannot read"),
        ("position_priors: {file: [1]}", "position_priors: file: must be a name, not"),
        ("position_priors: {file: bad.csv}", "bad.csv line 2: 'north' is not a number (latitude)"),
        (
            "position_priors: {file: log.csv, crs: EPSG:32632}",
            "crs: latitudes and longitudes are not of EPSG:32632",
        ),
        ("position_priors: {file: log.csv, crs: [1]}", "crs: must be a name, not"),
        (
            "position_priors: {database: log.csv}",
            "log.csv: is no database of COLMAP with positions",
        ),
        ("position_priors: {photos: .}", "no photo of the model there has a GPS position"),
        (
            "position_priors: {file: log.csv, database: d.db}",
            "position_priors: unknown key database; there are file",
        ),
    ],
)
def test_mistakes_are_one_line_that_names_the_key(text, message, scene, tmp_path):
    write_log(tmp_path / "log.csv", scene[1], scene[2])
    (tmp_path / "bad.csv").write_text("image,lat,lon,alt\nimage0001.jpg,north,1,2\n")
    (tmp_path / "c.yaml").write_text(f"{text}\n")
    with pytest.raises(UsageError) as caught:
        constrained(scene[1], (), None, str(tmp_path / "c.yaml"))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.extra
@pytest.mark.parametrize("down", [(0.0, 1.0, 0.0), (0.6, 0.0, -0.8)])
def test_gravity_of_colmaps_database_is_down_in_the_images(down, tmp_path):
    """COLMAP makes rigs of two cameras, with and without gravity; its own poses have no
    residual."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")
    options = {
        "num_rigs": 1,
        "num_cameras_per_rig": 2,
        "prior_gravity": True,
        "prior_gravity_in_world": down,
    }
    with pycolmap.Database.open(tmp_path / "d.db") as base:
        made = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(**options), base)
        (first, *_) = base.read_all_pose_priors()
        first.gravity = np.full(3, np.nan)
        base.update_pose_prior(first)
    problem = jaxba.from_pycolmap(made)
    constraints = {"database": tmp_path / "d.db", "stddev": 0.02}

    def surveyed(up):
        return jaxba.survey(problem, {"gravity": {"up": up, **constraints}}).problem

    found = surveyed(-np.array(down))
    (rows,) = found.residuals.rows
    assert len(rows) == problem.num_cameras - 1
    assert costs_by_kind(found)["gravity"] < 1e-20
    assert costs_by_kind(surveyed(down))["gravity"] == pytest.approx(
        len(rows) * 0.5 * (2 / 0.02) ** 2
    )
    with pytest.raises(ProblemError, match=r"gravity: .*no\.db: is no database of COLMAP"):
        jaxba.survey(problem, {"gravity": {"up": down, "database": tmp_path / "no.db"}})
    write_database(tmp_path / "old.db", problem, np.zeros((problem.num_cameras, 3)))
    with pytest.raises(ProblemError, match=r"gravity: .*old\.db: has no directions of gravity"):
        jaxba.survey(problem, {"gravity": {"up": down, "database": tmp_path / "old.db"}})
