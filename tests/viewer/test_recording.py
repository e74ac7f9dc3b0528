"""A recording holds what the solve came to, iteration by iteration, and comes back from its
file."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

import jaxba
from jaxba.viewer.recording import Recorder, evenly, of_points, read_recording, write_recording

SLEPT_S = 0.2
"""Much longer than an iteration of the problem takes."""


@pytest.fixture(scope="module")
def problem():
    return jaxba.random_scene(jaxba.SceneConfig(cameras=6, points=60), 0)


@pytest.fixture(scope="module")
def recorded(problem):
    recorder = Recorder(problem, "here")
    seen = []

    def watch(record, now):
        return (
            recorder(record, now),
            seen.append(record.time_s),
            time.sleep(SLEPT_S),
        )

    options = jaxba.SolveOptions(max_iterations=6)
    return recorder.recording, jaxba.solve(problem, "ceres", options, watch=watch), seen


def test_a_recording_ends_with_the_solution_and_has_its_history(recorded, problem):
    recording, solution, seen = recorded[0](), *recorded[1:]
    np.testing.assert_array_equal(recording.at(0).points, problem.points)
    np.testing.assert_array_equal(recording.at(recording.last).points, solution.problem.points)
    np.testing.assert_array_equal(recording.at(recording.last).cameras, solution.problem.cameras)
    np.testing.assert_array_equal(recording.cost, [solution.initial_cost, *solution.history.cost])
    np.testing.assert_array_equal(recording.damping[1:], solution.history.damping)
    np.testing.assert_array_equal(recording.accepted[1:], solution.history.accepted)
    assert list(recording.time_s) == [0.0, *seen]


def test_parameters_of_every_iteration_have_its_cost(recorded):
    from jaxba.problem import geometry

    recording = recorded[0]()
    costs = [geometry.cost(recording.at(k)) for k in range(recording.last + 1)]
    np.testing.assert_allclose(costs, recording.cost, rtol=1e-9)


def test_a_recording_comes_back_from_its_file(recorded, tmp_path):
    recording = recorded[0]()
    write_recording(recording, tmp_path / "run.npz")
    back = read_recording(str(tmp_path / "run.npz"))
    np.testing.assert_allclose(back.points, recording.points, atol=1e-5)  # float32
    for name in ("cameras", "state", "cost", "damping", "gain_ratio", "time_s", "whole", "source"):
        np.testing.assert_array_equal(getattr(back, name), getattr(recording, name))


def test_a_point_that_has_run_away_leaves_the_rest_of_a_recording(recorded, tmp_path):
    recording = recorded[0]()
    points = recording.points.copy()
    points[-1, 3] = [1e200, -1e39, 0.0]  # beyond float32
    write_recording(replace(recording, points=points), tmp_path / "run.npz")
    back = read_recording(tmp_path / "run.npz").points
    others = np.arange(points.shape[1]) != 3
    np.testing.assert_allclose(back[:, others], points[:, others], rtol=1e-5, atol=1e-5)
    assert back[-1, 3, 0] > 1e38
    assert back[-1, 3, 1] < -1e38


def test_what_is_no_recording_is_refused_in_one_line(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", a=1)
    data = (tmp_path / "other.npz").read_bytes()
    flags = data.rindex(b"PK\x01\x02") + 8  # the first says that a password is needed
    (tmp_path / "locked.npz").write_bytes(data[:flags] + b"\x01" + data[flags + 1 :])
    for name in ("text.npz", "other.npz", "locked.npz"):
        with pytest.raises(jaxba.ProblemError, match="is not a recording"):
            read_recording(str(tmp_path / name))


@pytest.mark.parametrize(
    "change",
    [
        {"state": np.zeros(0, int)},
        {"state": np.array([0.0, 1.0])},
        {"cost": np.zeros(1)},
        {"time_s": np.zeros((2, 2))},
        {"names": np.array(["one"])},
        {"cameras": np.full((2, 6, 9), np.nan)},
        {"points": np.zeros((2, 1, 3), np.float32)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_recording_whose_parts_do_not_fit_is_one_line(recorded, tmp_path, change):
    write_recording(recorded[0](), tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as file:
        arrays = {key: file[key] for key in file.files}
    np.savez(tmp_path / "bad.npz", **(arrays | change))
    with pytest.raises(jaxba.ProblemError, match=r"bad\.npz: is not a recording"):
        read_recording(str(tmp_path / "bad.npz"))


def test_a_thinned_problem_has_the_errors_of_its_points(problem):
    from jaxba.viewer.measures import measure

    kept = evenly(problem.num_points, 7)
    thinned = of_points(problem, kept)
    assert (thinned.num_points, thinned.num_cameras) == (7, problem.num_cameras)
    np.testing.assert_array_equal(measure(thinned).of_point, measure(problem).of_point[kept])


def test_time_to_watch_is_not_counted(recorded):
    _, solution, _ = recorded
    assert solution.total_s < SLEPT_S * solution.iterations


def test_names_of_images_are_kept(problem, tmp_path):
    ids = np.arange(problem.num_cameras)
    names = tuple(f"{k}.png" for k in ids)
    labels = jaxba.problem.labels.Labels(names, ids, ids[:1], np.arange(problem.num_points))
    write_recording(Recorder(replace(problem, labels=labels)).recording(), tmp_path / "run.npz")
    labels = read_recording(str(tmp_path / "run.npz")).problem.labels
    assert labels is not None
    assert labels.names == names


def test_a_figure_shows_cost_and_damping_of_every_iteration(recorded):
    _, solution, _ = recorded
    above, below = solution.plot().axes
    np.testing.assert_array_equal(
        above.lines[0].get_ydata(), [solution.initial_cost, *solution.history.cost]
    )
    np.testing.assert_array_equal(below.lines[0].get_ydata(), solution.history.damping)
