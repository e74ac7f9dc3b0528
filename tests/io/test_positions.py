"""Positions on the earth in metric frames, and the files that have positions of images."""

from __future__ import annotations

import json
import sqlite3
import sys
import warnings

import numpy as np
import pyproj
import pytest
from PIL import Image

from jaxba import ProblemError, ProblemWarning
from jaxba.io.geodesy import Frame, in_frame, projected, system_of
from jaxba.io.image_files import files_of_images
from jaxba.io.positions import read_database, read_photos, read_table, read_transforms

PLACES = np.array([[8.5, 47.3, 500.0], [8.51, 47.31, 620.0], [8.52, 47.29, 480.0]])


def geocentric(places: np.ndarray) -> np.ndarray:
    """The textbook's formula for WGS 84."""
    (lon, lat) = np.radians(places[:, :2]).T
    h = places[:, 2]
    a = 6378137.0
    f = 1 / 298.257223563
    e2 = f * (2 - f)
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (n + h) * np.cos(lat) * np.cos(lon),
            (n + h) * np.cos(lat) * np.sin(lon),
            (n * (1 - e2) + h) * np.sin(lat),
        ],
        axis=1,
    )


def test_east_north_and_up_are_those_of_the_textbook():
    found, frame = in_frame(PLACES, "EPSG:4326")
    middle = np.array(frame.origin)
    np.testing.assert_allclose(middle, np.median(PLACES, axis=0), atol=1e-3)
    step = np.eye(3) * [1e-6, 1e-6, 1e-2]
    axes = geocentric(middle + step) - geocentric(middle - step)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    np.testing.assert_allclose(
        found, (geocentric(PLACES) - geocentric(middle[None])) @ axes.T, atol=1e-4
    )


def test_a_projected_system_is_a_frame_and_goes_back():
    found, frame = in_frame(PLACES, "EPSG:4326", projected("EPSG:32632"))
    assert frame == Frame("EPSG:32632")
    assert (found[:, 2] == PLACES[:, 2]).all()
    # east of 9 degrees
    assert abs(found[0, 0] - (500_000 - 0.5 * np.cos(np.radians(47.3)) * 111_320 * 0.9996)) < 100
    local, own = in_frame(PLACES, "EPSG:4326")
    np.testing.assert_allclose(in_frame(found, "EPSG:32632", own)[0], local, atol=1e-6)


US_FOOT = 1200 / 3937
OHIO = np.array([[2_286_175.0, 360_404.0, 812.5], [2_286_300.0, 360_500.0, 900.0]])
"""Eastings, northings and heights of EPSG:3734, in US survey feet."""


@pytest.mark.parametrize(
    ("crs", "units", "unit", "said"),
    [
        (
            "EPSG:3734",
            (np.nan, np.nan),
            US_FOOT,
            ["log: heights are taken in the unit of EPSG:3734: US survey foot"],
        ),
        # a file that says feet means those of its system
        ("EPSG:3734", (0.3048, 0.3048), US_FOOT, []),
        ("EPSG:3734", (np.nan, 1.0), 1.0, []),
        ("EPSG:32617", (np.nan, np.nan), 1.0, []),
        ("EPSG:32617", (np.nan, 0.3048), 0.3048, []),
    ],
)
def test_heights_are_in_the_unit_of_their_system_or_file(crs, units, unit, said):
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        found, _ = in_frame(OHIO, crs, projected("EPSG:32617"), units=units, where="log")
    assert [str(note.message) for note in notes] == said
    np.testing.assert_allclose(found[:, 2], unit * OHIO[:, 2], rtol=1e-9)
    flat = pyproj.Transformer.from_crs(crs, "EPSG:32617", always_xy=True).transform(*OHIO[:, :2].T)
    np.testing.assert_allclose(found[:, :2], np.stack(flat, axis=1), atol=1e-6)


@pytest.mark.filterwarnings(
    "ignore:heights. heights are taken in the unit of EPSG.3734:jaxba.ProblemWarning"
)
def test_heights_above_a_geoid_without_its_grid_stay_and_are_not_mixed_with_others():
    """PROJ would take them for heights above the ellipsoid, without a word."""
    note = (
        r"above North American Vertical Datum 1988 and stay as they are: the grid .*\.tif is "
        r"not installed"
    )
    with pytest.warns(ProblemWarning, match=note):
        found, frame = in_frame(OHIO * [1, 1, US_FOOT], "EPSG:3734+5703", projected("EPSG:32617"))
    np.testing.assert_allclose(found[:, 2], US_FOOT * OHIO[:, 2])
    with pytest.warns(ProblemWarning, match=note):  # of which there are two: it is in feet, too
        np.testing.assert_allclose(in_frame(OHIO, "EPSG:3734+6360", frame)[0], found, atol=1e-6)
    with pytest.raises(
        ValueError,
        match="EPSG:32617 are above the ellipsoid, those of the scene above North American",
    ):
        in_frame(found, "EPSG:32617", frame)
    _, frame = in_frame(found, "EPSG:32617")
    with pytest.raises(
        ValueError, match=r"those of the scene above the ellipsoid, and the grid .*\.tif is not"
    ):
        in_frame(found, "EPSG:32617+5773", frame)


def test_a_wrong_place_does_not_move_the_frame_far():
    """Nor do places on both sides of the date line."""
    _, frame = in_frame(np.vstack([PLACES, PLACES + 1e-3, [[0.1, 0.1, 0.0]]]), "EPSG:4326")
    np.testing.assert_allclose(frame.origin[:2], PLACES[:, :2].mean(axis=0), atol=0.02)
    _, frame = in_frame(
        np.array([[179.99, 10, 5], [-179.99, 10, 5], [-179.98, 10, 5]]), "EPSG:4326"
    )
    assert abs(frame.origin[0]) == pytest.approx(179.99)


@pytest.mark.parametrize(
    ("line", "crs"),
    [
        ("EPSG:32633", "EPSG:32633"),
        ("WGS84 UTM 32N", "EPSG:32632"),
        ("WGS 84 / UTM zone 7S", "EPSG:32707"),
        ("#CoordinateSystem: WGS84 UTM 32N", "EPSG:32632"),
        ("+proj=utm +zone=32 +units=us-ft", "+proj=utm +zone=32 +units=us-ft"),
        ("# a comment", ""),
        ("image,x,y,z", ""),
        ('#CoordinateSystem: LOCAL_CS["Local Coordinates (m)"]', ""),
    ],
)
def test_a_line_may_be_a_coordinate_system(line, crs):
    assert system_of(line) == crs


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:9", "there is no coordinate system 'EPSG:9'"),
        ("EPSG:4326", "EPSG:4326 is no projected"),
        ("ft", "'ft'"),
    ],
)
def test_what_is_no_frame_is_refused(crs, message):
    with pytest.raises(ValueError, match=message):
        projected(crs)


def test_a_latitude_beyond_the_pole_is_no_place():
    with pytest.raises(ValueError, match=r"\[8\.0, 95\.0, 0\.0\] is no place of WGS 84"):
        in_frame(np.array([[8.0, 95.0, 0.0]]), "EPSG:4326")


def test_without_pyproj_a_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(
        ValueError, match=r"^coordinate systems need pyproj: pip install jaxba\[survey\]$"
    ):
        in_frame(PLACES, "EPSG:4326")


TABLES = {
    "plain": "Image,Latitude,Longitude,Altitude\na.jpg,47.3,8.5,500\nb.jpg,47.31,8.51,620\n",
    "gaps": "filename;lat;lon;height;roll\n"
    "a.jpg;47.3;8.5;500;1\nz.jpg;;;;\nb.jpg;47.31;8.51;620;1\n",
    "units": "imagename,longitude [deg],latitude [deg],altitude "
    "(m)\r\na.jpg,8.5,47.3,500\r\nb.jpg,8.51,47.31,620\r\n",
    "metashape": "# CoordinateSystem: WGS 84\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Error_(m)\n"
    "a.jpg,8.5,47.3,500,1\nb.jpg,8.51,47.31,620,1\n# Total Error\n",
}


@pytest.mark.parametrize("table", TABLES)
def test_flight_logs_are_tables_with_the_usual_names(table, tmp_path):
    (tmp_path / "log.csv").write_text(TABLES[table])
    found = read_table(tmp_path / "log.csv")
    there = np.isfinite(found.places).all(axis=1)
    assert [name for name, kept in zip(found.names, there, strict=True) if kept] == [
        "a.jpg",
        "b.jpg",
    ]
    assert (found.places[there] == PLACES[:2]).all()
    assert found.covariances is None
    assert found.crs == "EPSG:4326"


@pytest.mark.parametrize(
    ("columns", "cells", "variances"),
    [
        ("sigma_x,sigma_y,sigma_z", "1,2,3", [1, 4, 9]),
        ("accuracy horizontal [meter],accuracy vertical [meter]", "2,3", [4, 4, 9]),
        ("accuracy", "2", [4, 4, 4]),
    ],
)
def test_columns_of_accuracy_are_standard_deviations(columns, cells, variances, tmp_path):
    (tmp_path / "log.csv").write_text(f"image,easting,northing,z,{columns}\na.jpg,1,2,3,{cells}\n")
    found = read_table(tmp_path / "log.csv")
    assert found.places.tolist() == [[1, 2, 3]]
    assert found.covariances.tolist() == [np.diag(variances).tolist()]
    assert (found.crs, found.notes) == ("", ())


FRAME = '{"frames": [{"transform_matrix": %s}]}'


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("log.csv", "a.jpg,1,2,3\n", ": no line names the columns"),
        ("log.csv", "image,lat,lon\na.jpg,1,2\n", " line 1: there is no column height"),
        (
            "log.csv",
            "image,lat,lon,alt\n\na.jpg,1,x,3\n",
            " line 3: 'x' is not a number (longitude)",
        ),
        ("log.csv", "image,lat,lon,alt\n,1,2,3\n", " line 2: names no image"),
        ("log.csv", "image,lat,lon,alt\n", ": has no positions"),
        ("transforms.json", '{"frames": []}', ": has no frames"),
        (
            "transforms.json",
            '{"frames": [{"file_path": "a"}]}',
            ": frames[0] has no transform_matrix",
        ),
        (
            "transforms.json",
            FRAME % "[[1, 2, 3, 4]]",
            "transform_matrix must have three or four rows",
        ),
        (
            "transforms.json",
            FRAME % "[[1, 2], [3, 4], [5, 6]]",
            "transform_matrix[0] must be a list of 4",
        ),
    ],
)
def test_a_bad_file_is_one_line_with_its_name_and_place(name, text, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(ProblemError) as caught:
        (read_table if name == "log.csv" else read_transforms)(tmp_path / name)
    assert name in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def old_database(path, system: int = 0) -> None:
    """Positions as COLMAP 3.12 stores them, beside an image that has none."""
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
    base.execute(
        "CREATE TABLE pose_priors (image_id INTEGER, position BLOB, coordinate_system INTEGER)"
    )
    base.executemany("INSERT INTO images VALUES (?, ?)", [(1, "a.jpg"), (2, "b.jpg"), (3, "c.jpg")])
    rows = [(2, PLACES[1, [1, 0, 2]].tobytes(), system), (1, PLACES[0, [1, 0, 2]].tobytes(), 0)]
    base.executemany(
        "INSERT INTO pose_priors VALUES (?, ?, ?)", [*rows, (3, np.full(3, np.nan).tobytes(), 0)]
    )
    base.commit()
    base.close()


def test_a_database_of_an_earlier_colmap_has_positions_by_image(tmp_path):
    old_database(tmp_path / "d.db")
    names, places, covariances, crs, *_ = read_database(tmp_path / "d.db")
    assert (names, covariances, crs) == (["a.jpg", "b.jpg"], None, "EPSG:4326")
    assert (places == PLACES[:2]).all()


def test_names_in_a_database_may_be_any_bytes_as_in_a_model(tmp_path):
    old_database(tmp_path / "d.db")
    base = sqlite3.connect(tmp_path / "d.db")
    # \xe9.jpg in Latin-1
    base.execute("UPDATE images SET name = CAST(x'E92E6A7067' AS TEXT) WHERE image_id = 2")
    base.commit()
    base.close()
    assert read_database(tmp_path / "d.db").names == [
        "a.jpg",
        b"\xe9.jpg".decode("utf-8", "surrogateescape"),
    ]


@pytest.mark.extra
@pytest.mark.parametrize("geographic", [True, False])
def test_a_database_of_pycolmap_has_positions_and_covariances(geographic, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    base = pycolmap.Database.open(str(tmp_path / "d.db"))
    base.write_camera(
        pycolmap.Camera(model="SIMPLE_PINHOLE", width=10, height=10, params=[9, 5, 5])
    )
    systems = pycolmap.PosePriorCoordinateSystem
    covariances = np.array([np.diag([1.0, 2.0, 3.0]), np.eye(3) + 0.2])
    for at, name in enumerate(("a.jpg", "b.jpg")):
        number = base.write_image(pycolmap.Image(name=name, camera_id=1))
        prior = pycolmap.PosePrior(
            position=PLACES[at, [1, 0, 2]] if geographic else PLACES[at],
            position_covariance=covariances[at],
        )
        prior.coordinate_system = systems.WGS84 if geographic else systems.CARTESIAN
        prior.corr_data_id = base.read_image(number).data_id
        base.write_pose_prior(prior)
    base.close()
    names, places, found, crs, *_ = read_database(tmp_path / "d.db")
    assert (names, crs) == (["a.jpg", "b.jpg"], "EPSG:4326" if geographic else "")
    assert (places == PLACES[:2]).all()
    assert (found == covariances).all()


def test_other_databases_are_one_line(tmp_path):
    (tmp_path / "text.db").write_text("no database, but long enough to be one" * 10)
    old_database(tmp_path / "mixed.db", 1)
    for name, message in (
        ("gone.db", "gone.db: is no database of COLMAP with positions: unable to open"),
        ("text.db", "text.db: is no database of COLMAP with positions: file is not a database"),
        ("mixed.db", "mixed.db: has positions of different coordinate systems"),
    ):
        with pytest.raises(ProblemError, match=message):
            read_database(tmp_path / name)


def test_photos_have_the_position_of_their_camera(tmp_path):
    for name, gps in {
        "a.jpg": {1: "S", 2: (47.0, 18.0, 0.0), 3: "W", 4: (8.0, 30.0, 36.0), 5: b"\x00", 6: 500.0},
        "b.jpg": {1: "N", 2: (47.0, 18.0, 0.0), 3: "E", 4: (8.0, 30.0, 36.0), 5: b"\x01", 6: 2.5},
        "c.jpg": {1: "N"},
    }.items():
        image = Image.new("RGB", (4, 3))
        exif = image.getexif()
        exif[0x8825] = gps
        image.save(tmp_path / name, exif=exif)
    names, places, covariances, crs, *_ = read_photos(
        tmp_path, ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    )
    assert (names, crs) == (["a.jpg", "b.jpg"], "EPSG:4326")
    np.testing.assert_allclose(places, [[-8.51, -47.3, 500], [8.51, 47.3, -2.5]], atol=1e-9)
    assert covariances is None
    image = Image.new("RGB", (4, 3))
    exif = image.getexif()
    exif[0x8825] = {1: "N", 2: (47.0, 18.0, 0.0), 3: "E", 4: (8.0, 30.0, 36.0), 6: 500.0, 31: 4.5}
    image.save(tmp_path / "d.jpg", exif=exif)
    found = read_photos(tmp_path, ["a.jpg", "d.jpg"])
    assert found.covariances is not None
    np.testing.assert_allclose(
        np.diagonal(found.covariances, axis1=1, axis2=2), [[4.5**2, 4.5**2, 81]] * 2
    )
    assert ["no accuracy of heights" in found.notes[0], found.notes[1][-5:]] == [True, "a.jpg"]
    with pytest.raises(ProblemError, match="no photo of the model there has a GPS position"):
        read_photos(tmp_path, ["c.jpg"])


def test_files_of_images_are_found_by_other_names(tmp_path):
    for name in ("a.JPG", "deep/b.tif", "deep/b.jpg.npy", "c.npy", "one/d.png", "two/d.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = files_of_images(tmp_path, ["flight/a.jpg", "b.jpg", "d.png", "two/d.png", "e.png"])
    assert found == [
        tmp_path / "a.JPG",
        tmp_path / "deep/b.tif",
        None,
        tmp_path / "two/d.png",
        None,
    ]
    found = files_of_images(tmp_path, ["a.jpg", "b.jpg", "C.JPG"], ".npy")
    assert found == [None, tmp_path / "deep/b.jpg.npy", tmp_path / "c.npy"]


def test_positions_of_nerfstudio_are_in_the_world_before_its_transform(tmp_path):
    """As its converter makes them of COLMAP's: x, z and -y of the world, then scaled."""
    frames = [
        {
            "file_path": name,
            "transform_matrix": [
                [1, 0, 0, 2 * x],
                [0, 1, 0, 2 * z],
                [0, 0, 1, -2 * y],
                [0, 0, 0, 1],
            ],
        }
        for name, (x, y, z) in zip(
            ("./images/a.jpg", "images/left/b.jpg", "c.jpg"), PLACES.tolist(), strict=True
        )
    ]
    applied = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    (file := tmp_path / "transforms.json").write_text(
        json.dumps({"frames": frames, "applied_transform": applied, "applied_scale": 2})
    )
    names, places, covariances, crs, *_ = read_transforms(file)
    assert names == ["a.jpg", "left/b.jpg", "c.jpg"]
    np.testing.assert_array_equal(places, PLACES)
    assert (covariances, crs) == (None, "")
