"""Names of images as other files have them."""

from __future__ import annotations

import numpy as np
import pytest

import jaxba
from jaxba.problem.image_names import last_part, named_images
from jaxba.problem.labels import Labels
from jaxba.scenes import SceneConfig

MATCHED = {
    "the same name": ("a/IMG_1.JPG", "a/IMG_1.JPG"),
    "a folder of Unix": ("/data/flight/IMG_1.JPG", "IMG_1.JPG"),
    "a folder of Windows": (r"C:\flights\07\IMG_1.JPG", "IMG_1.JPG"),
    "a share of Windows": (r"\\server\flights\IMG_1.JPG", "IMG_1.JPG"),
    "no folder": ("IMG_1.JPG", "left/IMG_1.JPG"),
    "this folder": ("./IMG_1.JPG", "IMG_1.JPG"),
    "another case": ("img_1.jpg", "IMG_1.JPG"),
    "another ending": ("IMG_1.tif", "IMG_1.JPG"),
    "no ending": ("IMG_1", "IMG_1.JPG"),
    "an ending more": ("IMG_1.JPG", "IMG_1"),
    "a number of a frame": ("frame.0001", "frame.0001.png"),
    "letters of a Mac": ("Mu\u0308nchen.JPG", "M\u00fcnchen.jpg"),
}
"""A name of a file, and the image of that name."""


@pytest.mark.parametrize("kind", MATCHED)
def test_a_name_means_the_image_whose_path_ends_alike(kind):
    given, name = MATCHED[kind]
    found = named_images([given], ["IMG_2.JPG", name, "frame.0002.png"])
    assert (found.positions, found.doubts) == ({given: 1}, {})


@pytest.mark.parametrize("given", ["IMG_10.JPG", "IMG.JPG", "", "frame.0003"])
def test_a_name_that_no_image_has_means_none(given):
    found = named_images([given], ["IMG_1.JPG", "frame.0001", "frame.0002"])
    assert (found.positions, found.doubts) == ({}, {})


def test_more_of_the_path_tells_images_of_one_name_apart():
    names = ["a/IMG_1.jpg", "b/IMG_1.jpg"]
    assert named_images([r"D:\survey\B\IMG_1.JPG"], names).positions == {
        r"D:\survey\B\IMG_1.JPG": 1
    }
    found = named_images(["IMG_1.jpg"], names)
    assert not found.positions
    assert (
        found.doubts["IMG_1.jpg"]
        == "a/IMG_1.jpg and b/IMG_1.jpg may both be IMG_1.jpg: give more of the path"
    )


def test_two_names_do_not_mean_one_image():
    found = named_images(["07/IMG_1.jpg", "08/IMG_1.jpg"], ["IMG_1.jpg"])
    assert not found.positions
    assert set(found.doubts) == {"07/IMG_1.jpg", "08/IMG_1.jpg"}
    found = named_images(["IMG_1.dng", "IMG_1.jpg"], ["IMG_1.jpg"])
    assert (found.positions, found.doubts) == ({"IMG_1.jpg": 0}, {})
    found = named_images(["other/IMG_1.jpg", "a/IMG_1.jpg"], ["a/IMG_1.jpg"])
    assert found.positions == {"a/IMG_1.jpg": 0}


def test_the_last_part_of_a_path_is_that_of_its_system():
    assert [last_part(name) for name in (r"C:\a\b.jpg", "/a/b.jpg", "b.jpg", "/")] == [
        "b.jpg"
    ] * 3 + ["/"]


def test_functions_of_problems_understand_such_names_and_say_what_is_wrong():
    names = ("a/IMG_1.JPG", "b/IMG_1.JPG", "a/IMG_2.JPG")
    problem = jaxba.random_scene(SceneConfig(3, 10, 25), 0)
    problem = problem.replace(labels=Labels(names, np.arange(1, 4), np.arange(3), np.arange(10)))
    held = jaxba.hold(problem, poses=[r"C:\x\img_2.jpg", r"B\IMG_1.JPG"])
    assert held.constants is not None
    assert held.constants.poses.all(axis=1).tolist() == [False, True, True]
    with pytest.raises(
        ValueError, match=r"^a/IMG_1.JPG and b/IMG_1.JPG may both be IMG_1.JPG: give more"
    ):
        jaxba.hold(problem, poses=["IMG_1.JPG"])
    with pytest.raises(
        ValueError, match=r"^there is no image 'IMG_3.JPG'; there is 'a/IMG_1.JPG'$"
    ):
        jaxba.hold(problem, poses=["IMG_3.JPG"])
