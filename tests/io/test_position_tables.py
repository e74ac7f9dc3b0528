"""Tables of positions as other programs write them, and what they do not say."""

from __future__ import annotations

import re

import numpy as np
import pytest

from jaxba import ProblemError
from jaxba.io.control_points import read_control_points
from jaxba.io.position_tables import read_table
from jaxba.io.tables import has_fix

UTM = [[592772.75, 6582035.5, 122.25], [592789.5, 6582037.25, 122.5]]
DEGREES = [[8.5, 47.25, 500.0], [8.5625, 47.3125, 620.5]]

FORMS = {
    "geo.txt of a projected system": ("WGS84 UTM 33N", "{0} {x} {y} {z}", "EPSG:32633", None),
    "geo.txt with angles": (
        "EPSG:32633",
        "{0} {x} {y} {z} 12.0 -90 0 0.25 0.5",
        "EPSG:32633",
        (0.25, 0.25, 0.5),
    ),
    "geo.txt between tabs": (
        "EPSG:32633",
        "{0}\t{x}\t{y}\t{z}\t0.25\t0.5",
        "EPSG:32633",
        (0.25, 0.25, 0.5),
    ),
    "geo.txt of PROJ": (
        "+proj=utm +zone=33\n# name x y z\n",
        "{0} {x} {y} {z}",
        "+proj=utm +zone=33",
        None,
    ),
    "geo.txt between commas": ("EPSG:32633", "{0}, {x}, {y}, {z}", "EPSG:32633", None),
    "Metashape": (
        '#CoordinateSystem: PROJCS["WGS 84 / UTM zone 33N"]\n'
        "#Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_X/Y_(m),Accuracy_Z_(m),X_est,Y_est,Z_est",
        "{0},{x},{y},{z},0.25,0.5,1,2,3",
        'PROJCS["WGS 84 / UTM zone 33N"]',
        (0.25, 0.25, 0.5),
    ),
    "a spreadsheet": (
        "Image;X;Y;Z;Accuracy [cm]",
        "{0};{cx};{cy};{cz};25,0",
        "",
        (0.25, 0.25, 0.25),
    ),
    "quoted decimal commas": ('Label,"X","Y","Z"', '"{0}","{cx}","{cy}","{cz}"', "", None),
    "blanks between names": (
        "image x y z sigma_x sigma_y sigma_z",
        "{0} {x} {y} {z} 1 2 3",
        "",
        (1, 2, 3),
    ),
}
"""What a file begins with, a line of values, and the coordinate system and standard deviations that
it says."""


def line_of(form: str, name: str, place: list[float]) -> str:
    numbers = dict(zip("xyz", map(repr, place), strict=True))
    commas = {f"c{axis}": number.replace(".", ",") for axis, number in numbers.items()}
    return form.format(name, **numbers, **commas)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("form", FORMS)
def test_tables_of_other_programs_are_read(form, encoding, tmp_path):
    first, line, crs, deviations = FORMS[form]
    names = ["IMG 1.JPG", "IMG 2.JPG"]
    lines = [
        first,
        *(line_of(line, name, place) for name, place in zip(names, UTM, strict=True)),
        "",
        "#end",
    ]
    (tmp_path / "log.csv").write_bytes("\r\n".join(lines).encode(encoding))
    found = read_table(tmp_path / "log.csv")
    assert (found.names, found.crs, found.notes) == (names, crs, ())
    assert found.places.tolist() == UTM
    if deviations is None:
        assert found.covariances is None
    else:
        assert found.covariances is not None
        np.testing.assert_allclose(
            np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2)), [deviations] * 2
        )


def test_a_table_of_degrees_without_names_of_columns_has_latitude_first(tmp_path):
    """As Pix4D writes it; with a coordinate system before it is OpenDroneMap's, with longitude
    first."""
    lines = [f"IMG{at}.JPG,{47.25 + 1e-4 * at},{8.5 + 1e-4 * at},500,1,2,3" for at in range(3)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    found = read_table(tmp_path / "log.csv")
    assert (found.places[0].tolist(), found.crs) == ([8.5, 47.25, 500.0], "EPSG:4326")
    (tmp_path / "log.csv").write_text("\n".join(["EPSG:4326", *lines]))
    assert read_table(tmp_path / "log.csv").places[0].tolist() == [47.25, 8.5, 500.0]
    (tmp_path / "log.csv").write_text("a.jpg,1,2,3\nb.jpg,4,5,6\nc.jpg,7,8,9\n")
    # degrees, or metres of a scene
    with pytest.raises(ProblemError, match="no line names the columns"):
        read_table(tmp_path / "log.csv")


@pytest.mark.parametrize(
    ("title", "units"),
    [
        ("x [m],y [m],altitude (ft)", (1.0, 0.3048)),
        ("easting_m,northing_m,height [US survey feet]", (1.0, 1200 / 3937)),
        ("x,y,z", (np.nan, np.nan)),
        (
            "latitude [decimal degrees],longitude [decimal degrees],altitude [meter] (WGS84)",
            (1.0, 1.0),
        ),
    ],
)
def test_units_are_those_of_the_names_of_columns(title, units, tmp_path):
    (tmp_path / "log.csv").write_text(f"image,{title}\na.jpg,1,2,3\n")
    np.testing.assert_array_equal(read_table(tmp_path / "log.csv").units, units)


@pytest.mark.parametrize(
    ("columns", "cells", "deviations", "note"),
    [
        (
            "accuracy",
            ["0.1", "", "0.3"],
            [[0.1] * 3, [0.3] * 3, [0.3] * 3],
            "no accuracy of 1 image, .*: b.jpg$",
        ),
        (
            "accuracy",
            ["0.1", "0", "-1"],
            [[0.1] * 3] * 3,
            "no accuracy of 2 images, .* others: b.jpg, c.jpg$",
        ),
        (
            "hacc,vacc",
            ["1,4", "2,", ",5"],
            [[1, 1, 4], [2, 2, 5], [2, 2, 5]],
            "no accuracy of 2 images",
        ),
        (
            "accuracy_horizontal",
            ["1", "2", "3"],
            [[1, 1, 2], [2, 2, 4], [3, 3, 6]],
            "they get 2 times the horizontal",
        ),
        (
            "accuracy_vertical",
            ["1", "2", "3"],
            [[1] * 3, [2] * 3, [3] * 3],
            "positions get that of heights",
        ),
        (
            "accuracy class",
            ["1", "2", "3"],
            None,
            "accuracies in column accuracy class are not used: .* is 1$",
        ),
        (
            "sigma lat [deg]",
            ["1", "2", "3"],
            None,
            r"accuracies in column sigma lat \[deg\] are not used: .* is 1$",
        ),
        (
            "accuracy",
            ["fixed", "float", ""],
            None,
            "accuracies in column accuracy are not used: .* is 1$",
        ),
    ],
)
def test_what_a_table_lacks_of_accuracies_is_said(columns, cells, deviations, note, tmp_path):
    lines = [f"{name}.jpg,1,2,3,{cell}" for name, cell in zip("abc", cells, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join([f"image,x,y,z,{columns}", *lines]))
    found = read_table(tmp_path / "log.csv")
    (said,) = found.notes
    assert said.startswith(str(tmp_path / "log.csv: "))
    assert re.search(note, said)
    if deviations is None:
        assert found.covariances is None
    else:
        np.testing.assert_allclose(
            np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2)), deviations
        )


@pytest.mark.parametrize(
    "columns",
    [
        "Std. dev. East [m],Std. dev. North [m],Std. dev. Up [m]",
        "RtkStdLon,RtkStdLat,RtkStdHgt",
        "Easting RMS,Northing RMS,Elevation RMS",
        "sigma_x,sigma_y,sigma_z",
        "sdE,sdN,sdU",
        "x precision,y precision,z precision",
    ],
)
def test_accuracies_have_the_names_that_programs_give_them(columns, tmp_path):
    (tmp_path / "log.csv").write_text(f"image,x,y,z,yaw accuracy,{columns}\na.jpg,1,2,3,9,1,2,3\n")
    found = read_table(tmp_path / "log.csv")
    assert found.covariances is not None
    assert (np.diagonal(found.covariances[0]).tolist(), found.notes) == ([1, 4, 9], ())


def test_coordinates_of_exiftool_and_a_spreadsheet_in_the_encoding_of_windows_are_read(tmp_path):
    lines = [
        "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude",
        './a.jpg,"47 deg 15\' 0.00"" S","8 deg 30\' 0.00"" E",12.5 m Below Sea Level',
        "./b.jpg,47.25 N,8.5 W,12.5 m",
    ]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    assert read_table(tmp_path / "log.csv").places.tolist() == [
        [8.5, -47.25, -12.5],
        [-8.5, 47.25, 12.5],
    ]
    (tmp_path / "log.csv").write_bytes(
        "Bild;Rechtswert;Hochwert;Höhe\nä.jpg;1,5;2,5;3,5\n".encode("cp1252")
    )
    found = read_table(tmp_path / "log.csv")
    assert (found.names, found.places.tolist()) == (["ä.jpg"], [[1.5, 2.5, 3.5]])


NO_FIX = {
    "degrees": [
        [0, 0, 0],
        [0, 0, 120.5],
        [np.nan, 47, 5],
        [8.5, -9999, 5],
        [8.5, 95, 5],
        [8.5, 47, -32768],
    ],
    "metres": [[0, 0, 0], [0, 0, 120.5], [np.nan, 47, 5], [592772, -9999, 5]],
}


@pytest.mark.parametrize("kind", NO_FIX)
def test_places_of_a_receiver_without_a_fix_are_none(kind):
    there = DEGREES * 2 if kind == "degrees" else UTM * 2
    found = has_fix(np.array([*there, *NO_FIX[kind]]), kind == "degrees")
    assert found.tolist() == [True] * 4 + [False] * len(NO_FIX[kind])


def test_the_origin_of_a_map_is_a_place_among_others():
    places = np.array([[0, 0, 0], [10, 0, 1], [0, 10, 1], [10, 10, 2.0]])
    assert has_fix(places, False).all()


CONTROL = {
    "blanks": "{x} {y} {z} 4.5 5.5 IMG 1.JPG gcp1 more words",
    "tabs": "{x}\t{y}\t{z}\t4.5\t5.5\tIMG 1.JPG\tgcp1",
    "quotes": '{x} {y} {z} 4.5 5.5 "IMG 1.JPG" gcp1',
    "decimal commas": "{cx} {cy} {cz} 4,5 5,5 IMG 1.JPG gcp1",
    "a spreadsheet": "{cx};{cy};{cz};4,5;5,5;IMG 1.JPG;gcp1",
    "commas": "{x},{y},{z},4.5,5.5,IMG 1.JPG,gcp1",
}


@pytest.mark.parametrize("form", CONTROL)
def test_control_points_of_other_programs_are_read(form, tmp_path):
    (tmp_path / "gcp_list.txt").write_text(
        "WGS84 UTM 33N\nx y z im_x im_y image_name "
        f"gcp_name\n{line_of(CONTROL[form], '', UTM[0])}\n"
    )
    found = read_control_points(tmp_path / "gcp_list.txt")
    assert (found.crs, found.names, found.images) == ("EPSG:32633", ["gcp1"], ["IMG 1.JPG"])
    assert (found.places.tolist(), found.pixels.tolist()) == ([UTM[0]], [[4.5, 5.5]])


@pytest.mark.parametrize(
    "line",
    ["1 2 4 5 a.JPG g", "1 2 nan 4 5 a.JPG g", "1\t2\t\t4\t5\ta.JPG\tg", "- - - 4 5 a.JPG g"],
)
def test_control_points_without_height_or_place_have_none(line, tmp_path):
    (tmp_path / "gcp_list.txt").write_text(f"EPSG:32633\n{line}\n")
    found = read_control_points(tmp_path / "gcp_list.txt")
    assert (found.names, found.images, found.pixels.tolist()) == (["g"], ["a.JPG"], [[4, 5]])
    assert np.isnan(found.places[0, 2])
