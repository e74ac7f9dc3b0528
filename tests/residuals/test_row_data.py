"""Data of residuals: one value, or one a row, of the shape that a value has, and of values that
make sense."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from ready_made import EACH, row_of, scene

import jaxba
from jaxba import residuals
from jaxba.problem.labels import Labels

COUNT = len(EACH)

READY = [name for name in residuals.__all__ if name != "preintegrated"]

MIRROR = np.diag([1.0, 1.0, -1.0])


@jaxba.residual
def span(point, point_2, *, length):
    return jnp.linalg.norm(point_2 - point) - length


@jaxba.residual
def near(point, *, place, sigma):
    return (point - place) / sigma


@jaxba.residual
def height(point, *, up, measured):
    return up @ point - measured


def again(name: str, **changed):
    """Rows of a ready-made residual with other data; by keyword a function of the data."""
    rows, _ = row_of(name, scene())
    of = rows.residual
    given = dict(zip((*of.unknowns, *of.data), (*rows.index, *rows.data), strict=True))
    return of(**given | {key: change(given[key]) for key, change in changed.items()})


@pytest.mark.parametrize("name", READY)
def test_ready_made_residuals_take_one_value_or_one_a_row(name):
    """And an array of rows that are not as many is refused, for each of their keywords."""
    rows, _ = row_of(name, scene())
    for key, values in zip(rows.residual.data, rows.data, strict=True):
        for one in (values[:1], values[0]):
            same = dict(
                zip(rows.residual.data, again(name, **{key: lambda _, x=one: x}).data, strict=True)
            )
            np.testing.assert_array_equal(same[key], np.broadcast_to(values[0], values.shape))
        for count in (len(values) - 1, len(values) + 1):
            message = f"^{key} of {name} has {count} rows, there are {len(values)} residuals"
            with pytest.raises(ValueError, match=message) as caught:
                again(name, **{key: lambda x, n=count: np.resize(x, (n, *x.shape[1:]))})
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 6])
def test_a_value_of_its_own_shape_is_one_for_all_of_any_number_of_rows(count):
    at = np.arange(count)
    shared = {"position": np.arange(3.0), "whitening": np.eye(3)}
    rows = residuals.control_point(point=at, **shared)
    for values, one in zip(rows.data, shared.values(), strict=True):
        np.testing.assert_array_equal(values, np.broadcast_to(one, (count, *one.shape)))
    bars = residuals.distance(point=at, point_2=at + 1, length=2.0, sigma=[0.1])
    assert [values.shape for values in bars.data] == [(count,), (count,)]


def test_no_rows_are_rows():
    nothing = np.zeros(0, int)
    rows = residuals.control_point(point=nothing, position=[], whitening=np.eye(3))
    assert [values.shape for values in rows.data] == [(0, 3), (0, 3, 3)]


@pytest.mark.parametrize(
    ("name", "key", "value", "message"),
    [
        (
            "distance",
            "length",
            np.ones((COUNT, 3)),
            r"must be a number in a row, not an array of shape \(4, 3\)",
        ),
        (
            "control_point",
            "position",
            0.0,
            r"must be 3 numbers in a row, not an array of shape \(\)",
        ),
        ("control_point", "whitening", np.ones(3), "must be n x 3 numbers in a row"),
        (
            "relative_pose",
            "whitening",
            np.eye(3),
            r"must be n x 6 numbers in a row, not an array of shape \(3, 3\)",
        ),
        ("gravity", "sigma", np.ones(3), "sigma of gravity has 3 rows, there are 4 residuals"),
    ],
)
def test_values_of_other_shapes_are_refused(name, key, value, message):
    with pytest.raises(ValueError, match=message):
        again(name, **{key: lambda _: value})


@pytest.mark.parametrize(
    ("name", "key", "change", "what"),
    [
        ("baseline", "length", lambda x: -x, "positive"),
        ("distance", "length", lambda x: 0 * x, "positive"),
        ("distance", "sigma", lambda x: -x, "positive"),
        ("depth", "sigma", lambda x: 0 * x, "positive"),
        ("gravity", "direction", lambda x: 0 * x, "other than zero"),
        ("heading", "north", lambda x: 0 * x, "other than zero"),
        ("control_point", "whitening", lambda x: 0 * x, "other than zero"),
        ("point_to_plane", "normal", lambda x: 2 * x, "a unit vector"),
        ("relative_pose", "rotation", lambda x: 2 * x, "a rotation matrix"),
        ("relative_pose", "rotation", lambda x: x @ MIRROR, "a rotation matrix"),
        ("imu", "mount", lambda x: MIRROR @ x, "a rotation matrix and a translation"),
    ],
)
def test_values_that_cannot_be_are_refused_with_the_name_of_the_row(name, key, change, what):
    """One of the rows has them."""
    problem = scene()
    names = tuple(f"view{k}.jpg" for k in range(problem.num_cameras))
    ids = np.arange(10, 10 + problem.num_points)
    problem = problem.replace(labels=Labels(names, np.arange(5) + 1, np.arange(5), ids))
    _, unknowns = row_of(name, problem)
    rows = again(name, **{key: lambda x: np.concatenate([x[:2], change(x[2:3]), x[3:]])})
    kind = rows.residual.unknowns[0]
    place = "point 12" if kind == "point" else f"image {rows.index[0][2] + 1} "
    with pytest.raises(
        ValueError, match=f"^{key} of {name} must be {what}, not .*{place}"
    ) as caught:
        jaxba.with_residual(problem, rows, unknowns=unknowns)
    assert "\n" not in str(caught.value)


def test_rotations_and_normals_may_be_rounded_as_they_are_written():
    rounded = again("relative_pose", rotation=lambda x: np.round(x, 4))
    assert jaxba.with_residual(scene(), rounded).residuals


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            lambda: span(point=EACH, point_2=EACH + 1, length=np.ones(3)),
            "length of span has 3 rows, there are 4 residuals",
        ),
        (
            lambda: span(point=EACH, point_2=EACH + 1, length=np.ones(5)),
            "length of span has 5 rows, there are 4 residuals",
        ),
        (
            lambda: near(point=EACH, place=np.ones((3, 3)), sigma=1.0),
            "place of near has 3 rows, there are 4 residuals",
        ),
        (
            lambda: near(point=EACH, place=np.ones((5, 3)), sigma=1.0),
            "place of near has 5 rows, there are 4 residuals",
        ),
        (
            lambda: near(point=EACH, place=0.0, sigma=np.ones(5)),
            "sigma of near has 5 rows, there are 4 residuals",
        ),
        (
            lambda: height(point=EACH, up=np.eye(3), measured=1.0),
            "up of height has 3 rows, there are 4 residuals",
        ),
    ],
)
def test_arrays_that_would_be_broadcast_are_refused_of_residuals_of_ones_own(rows, message):
    with pytest.raises(ValueError, match=message):
        jaxba.with_residual(scene(), rows())


@pytest.mark.slow
def test_vectors_that_every_row_needs_whole_are_taken_and_explicit_ones_always():
    problem = scene()
    up = np.array([0.0, 0.0, 1.0])
    rows = height(point=EACH, up=up, measured=1.0)
    others = near(point=EACH, place=up, sigma=np.array([1.0, 1.0, 2.0]))
    explicit = span(point=EACH, point_2=EACH + 1, length=np.ones((1, 3)))
    for part, size in ((rows, 1), (others, 3), (explicit, 3)):
        assert jaxba.with_residual(problem, part).residuals.rows[0].size == size
