"""Parts of the reproduction: sub-problems, schedules, rows, claims, results, configuration and real
problems."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from jaxba import BundleProblem, ProblemError
from jaxba.bench.sources import Source
from jaxba.paper import agents, claims, config, real_problems, results
from jaxba.paper.results import PLAYS, SOLVES, Outcome, Play, Row, Store, average_schedule
from jaxba.paper.runner import method_named
from jaxba.paper.subproblem import neighbourhood, neighbouring_cameras, sub_problem
from jaxba.paper.tables_and_figures import common, figures
from jaxba.settings import SettingsError, configurations, to_yaml
from jaxba.solver.record import Record, TracePoint

# Sub-problems


def hand_made() -> BundleProblem:
    """Cameras that observe each point: 0: cameras 0, 1, 2; 1: 0, 1; 2: 2, 3; 3: camera 3 twice; 4:
    1, 3."""
    seen = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 2), (3, 2), (3, 3), (3, 3), (1, 4), (3, 4)]
    cameras = np.zeros((4, 9))
    cameras[:, 0], cameras[:, 6] = np.arange(4), 100.0
    points = np.stack([np.arange(5.0), np.zeros(5), -10.0 - np.arange(5)], axis=1)
    pixels = np.arange(22.0).reshape(11, 2)
    return BundleProblem.create(cameras, points, pixels, [c for c, _ in seen], [p for _, p in seen])


def test_a_sub_problem_has_the_given_cameras_and_the_points_that_two_of_them_observe():
    whole = hand_made()
    part = sub_problem(whole, [0, 1, 3])
    assert part.cameras[:, 0].tolist() == [0.0, 1.0, 3.0]
    # 2 keeps one camera, 3 has two observations of a single one
    assert part.points[:, 0].tolist() == [0.0, 1.0, 4.0]
    pairs = list(zip(part.camera_index.tolist(), part.point_index.tolist(), strict=True))
    assert pairs == [(0, 0), (1, 0), (0, 1), (1, 1), (1, 2), (2, 2)]
    assert part.observations[:, 0].tolist() == [0.0, 2.0, 6.0, 8.0, 18.0, 20.0]


def test_only_the_given_points_are_kept():
    part = sub_problem(hand_made(), [0, 1, 2], points=[1, 2])
    assert part.points[:, 0].tolist() == [1.0]
    assert part.num_observations == 2


def test_a_sub_problem_of_all_cameras_keeps_all_cameras():
    whole = hand_made()
    part = sub_problem(sub_problem(whole, range(4)), range(4))
    assert part.num_points == 4
    assert part.cameras.tobytes() == whole.cameras.tobytes()


@pytest.mark.parametrize(
    ("cameras", "points", "words"),
    [
        ([0, 4], None, "no camera 4 among 4"),
        ([-1], None, "no camera -1"),
        ([0, 1], [9], "no point 9"),
        ([0, 3], None, "no point is seen"),
    ],
)
def test_an_impossible_sub_problem_is_an_error_of_one_line(cameras, points, words):
    with pytest.raises(ProblemError, match=words):
        sub_problem(hand_made(), cameras, points)


def test_neighbouring_cameras_start_with_the_one_that_observes_most_points():
    # camera 1 and 3 see three points each, the first of them is 1; it shares two points with 0, one
    # with 2 and with 3
    assert neighbouring_cameras(hand_made(), 1).tolist() == [1]
    assert neighbouring_cameras(hand_made(), 2).tolist() == [0, 1]
    assert neighbouring_cameras(hand_made(), 4).tolist() == [0, 1, 2, 3]
    with pytest.raises(ProblemError, match="cannot take 5 of 4"):
        neighbouring_cameras(hand_made(), 5)


def test_a_sub_problem_of_a_scene_is_made_when_it_is_read():
    part = neighbourhood(Source("tiny", "scene", "scene:tiny"), 3).read()
    assert part.num_cameras == 3
    tracks = np.bincount(part.point_index)
    assert tracks.min() >= 2


# Average schedules


def test_a_schedule_is_the_arithmetic_mean_at_each_iteration():
    assert average_schedule([[1.0, 2.0, 3.0, 4.0, 9.0], [3.0, 4.0, 5.0, 8.0]]) == (
        2.0,
        3.0,
        4.0,
        6.0,
    )


def test_a_solve_that_ended_early_does_not_enter_the_later_means():
    assert average_schedule([[1e-15, 1e-15], [1e-15, 3e-15, 0.4, 0.6], [1e-15]]) == pytest.approx(
        (1e-15, 2e-15, 0.4, 0.6)
    )


def test_a_schedule_is_as_long_as_the_longest_solve_at_most():
    assert average_schedule([[0.5], [1.5, 2.0]]) == (1.0, 2.0)
    assert average_schedule([[], []]) == ()


# Rows


def solved(
    iterations: float,
    converged: bool = True,
    near: float = 2.0,
    end: float = 0.0,
    seconds: float = 1.0,
) -> Outcome:
    return Outcome(float(iterations), converged, near, end, seconds)


def test_a_row_has_the_mean_over_problems_and_the_range_over_seeds():
    found = results.row_of(
        "x",
        {0: [solved(4), solved(6)], 1: [solved(8, end=0.02), solved(100, False, near=100.0)]},
        trained=True,
    )
    assert (found.iterations, found.low, found.high) == (29.5, 5.0, 54.0)
    assert (found.success, found.good_ends, found.near) == (0.75, 0.75, 26.5)
    assert (found.seeds, found.solves, found.seconds) == (2, 2, 1.0)


def test_a_rule_has_no_seeds_and_without_solves_the_mean_is_nan():
    assert results.row_of("x", {0: [solved(4)]}, trained=False).seeds == 0
    nothing = results.row_of("x", {}, trained=True)
    assert nothing.solves == 0
    assert math.isnan(nothing.iterations)


def test_a_failure_counts_as_the_limit_in_a_play():
    play = Play(
        "test",
        "x",
        0,
        (3, 100, 120),
        (True, False, True),
        (0.0, math.inf, 4.0),
        (0.0, 0.5, 0.0),
        ((), (), ()),
        0.0,
    )
    found = results.of_play(play)
    assert [o.iterations for o in found] == [3.0, 100.0, 100.0]
    assert [o.converged for o in found] == [True, False, False]
    assert [o.near for o in found] == [1.0, 100.0, 4.0]


def record(
    problem: str,
    costs: list[float],
    setup_s: float = 0.5,
    repeat: int = 0,
    termination: str = "cost",
    step_s: float = 1.0,
) -> Record:
    trace = tuple(TracePoint(k, k * step_s, c, 1.0, True, 0, 1.0) for k, c in enumerate(costs))
    sizes = {"cameras": 2, "points": 3, "observations": 6}
    where = {
        "solver": "s",
        "backend": "b",
        "device": "d",
        "dtype": "float64",
        "threads": 1,
        "repeat": repeat,
        "family": "f",
    }
    ends = {
        "initial_cost": costs[0],
        "final_cost": costs[-1],
        "iterations": len(costs) - 1,
        "accepted": len(costs) - 1,
    }
    times = {
        "setup_s": setup_s,
        "compile_s": 9.0,
        "total_s": 99.0,
        "cg_iterations": 0,
        "termination": termination,
    }
    return Record(problem=problem, trace=trace, **sizes, **where, **ends, **times)


def test_outcomes_of_records_agree_with_numbers_by_hand():
    records = [
        record("a", [100.0, 50.0, 10.005, 10.0]),
        record("a", [100.0, 50.0, 10.005, 10.0], repeat=1, step_s=3.0),
        record("b", [8.0, 4.0], termination="max_iterations"),
    ]
    a, b = results.of_records(records, {"a": 10.0, "b": 2.0})
    assert (a.iterations, a.converged, a.near, a.end, a.seconds) == (3.0, True, 2.0, 0.0, 0.5 + 6.0)
    assert (b.iterations, b.converged, b.near, b.end, b.seconds) == (100.0, False, 100.0, 1.0, 1.5)


# Claims


def of(
    iterations: float,
    low: float | None = None,
    high: float | None = None,
    success: float = 1.0,
    seeds: int = 2,
) -> Row:
    ends = (iterations if low is None else low, iterations if high is None else high)
    low, high = map(float, ends)
    return Row(
        "x",
        float(iterations),
        low,
        high,
        near=1.0,
        success=success,
        good_ends=1.0,
        seeds=seeds,
        solves=3,
    )


@pytest.mark.parametrize(
    ("ours", "base", "status"),
    [
        (of(4), of(20), "reproduced"),
        (of(5), of(20), "reproduced"),
        (of(5.1), of(20), "partly"),
        (of(3.1), of(20), "partly"),  # a gain, but a larger one
        (of(18), of(20), "partly"),
        (of(4)._replace(collapsed=True), of(20), "not run"),
        (of(18.1), of(20), "not"),
        (of(4, success=0.9), of(20), "not"),
        (of(4, success=0.96), of(20), "reproduced"),
        (None, of(20), "not run"),
        (of(math.nan), of(20), "not run"),
        (of(4)._replace(solves=2), of(20), "not run"),  # not on all problems
    ],
)
def test_rule_for_ratios(ours, base, status):
    assert claims.ratio_claim("claim", 0.2, ours, base).status == status


@pytest.mark.parametrize(
    ("ours_s", "success", "status"),
    [
        (2.5, 1.0, "reproduced"),
        (2.6, 1.0, "partly"),
        (9.1, 1.0, "not"),
        (2.0, 0.9, "not"),
        (math.nan, 1.0, "not run"),
    ],
)
def test_rule_for_times_is_that_for_ratios(ours_s, success, status):
    ours = of(4, success=success)._replace(seconds=ours_s)
    base = of(20)._replace(seconds=10.0)
    assert claims.time_claim("claim", 0.2, ours, base).status == status


@pytest.mark.parametrize(
    ("better", "worse", "status"),
    [
        (of(4, 3, 5), of(8, 7, 9), "reproduced"),
        (of(4, 3, 7.5), of(8, 7, 9), "partly"),
        (of(8), of(8), "not"),
        (of(9), of(8), "not"),
        (of(4, success=0.8), of(8), "not"),
        (of(7.5, 7.4, 7.6), of(8, 7.9, 8.1), "partly"),
        (of(9.5, seeds=0), of(10, seeds=0), "partly"),
        (of(8.9, seeds=0), of(10, seeds=0), "reproduced"),
        (of(4), None, "not run"),
    ],
)
def test_rule_for_orders_uses_the_ranges_over_the_seeds(better, worse, status):
    assert claims.order_claim("claim", "4 against 8", better, worse).status == status


@pytest.mark.parametrize(
    ("ours", "status"), [(0.66, "reproduced"), (0.6, "partly"), (0.5, "not"), (math.nan, "not run")]
)
def test_rule_for_fractions(ours, status):
    assert claims.success_claim("claim", 0.7, of(4, success=ours)).status == status


@pytest.mark.parametrize(
    ("excess", "status"),
    [
        ([-1.0, 0.002], "reproduced"),
        ([0.002, 0.004], "partly"),
        ([0.002, 0.004, 0.01], "not"),
        ([], "not run"),
    ],
)
def test_rule_for_errors(excess, status):
    assert claims.error_claim("claim", 0.003, excess).status == status


@pytest.mark.parametrize(
    ("ours", "faster", "status"),
    [
        ({"a": 1.0, "b": 1.0}, True, "reproduced"),
        ({"a": 3.0, "b": 3.0}, True, "not"),
        ({"a": 1.0}, True, "not"),  # faster, but not everywhere
        ({"a": 3.0, "b": 3.0}, False, "partly"),  # classic is not as fast, but faster
        ({"a": 2.1, "b": 2.1}, False, "reproduced"),
        ({"a": 1.0}, False, "not"),
    ],
)
def test_a_claim_about_speed_asks_for_the_same_success(ours, faster, status):
    """Seconds to tau = 0.001 of two problems, where classic takes two."""

    def solve(name, solver, seconds, end):
        return dataclasses.replace(
            record(name, [100.0, end], step_s=seconds, setup_s=0.0), solver=solver
        )

    records = [solve(name, "classic", 2.0, 1.0) for name in "ab"]
    records += [
        solve(name, agents.BEST.name, ours.get(name, 1.0), 1.0 if name in ours else 50.0)
        for name in "ab"
    ]
    assert figures.speed_claim(records, 0.001, "claim", faster).status == status


def test_more_seconds_are_a_claim_of_their_own():
    ours = of(4)._replace(seconds=1.25)
    base = of(20)._replace(seconds=1.0)
    found = claims.longer_claim("claim", "+0.5 s", ours, base)
    assert (found.status, found.ours) == ("reproduced", "+250.0 ms (1250 / 1000 ms)")
    assert claims.longer_claim("claim", "+0.5 s", base, ours).status == "not"
    # the other was not measured
    assert claims.longer_claim("claim", "+0.5 s", ours, of(20)).status == "not run"


def test_a_table_has_the_numbers_of_the_paper_and_both_ratios():
    lines = [
        common.named("classic", "classic", 20.0),
        common.Line("ours", method_named("bold"), 4.0),
    ]
    rows = {"classic": of(20, seeds=0), "ceres": of(8, seeds=0), "bold": of(4, 3, 5)}
    text = common._comparison(lines, rows)
    cells = [cell.strip() for cell in text.splitlines()[-1].strip("|").split("|")]
    assert cells == ["ours", "4", "4", "2: 3 to 5", "100 %", "1", "100 %", "0.2", "0.2", "0.5"]


# Records


def test_results_are_read_as_they_were_written(tmp_path):
    play = Play(
        "test",
        "x",
        1,
        (3, 4),
        (True, False),
        (1.0, math.inf),
        (0.0, 1e-3),
        ((1e-15, 2.0), ()),
        0.25,
    )
    store = Store(tmp_path)
    store.add_play(play)
    store.add_solve(record("a", [4.0, 2.0]))
    again = Store(tmp_path)
    assert again.play("test", "x", 1) == play
    assert again.play("test", "x", 0) is None
    assert again.solve("a", "s", 0).final_cost == 2.0
    assert json.loads((tmp_path / PLAYS).read_text())["near"] == [1.0, None]


def test_an_incomplete_line_is_removed_before_the_next_is_written(tmp_path):
    play = Play("test", "x", 1, (3,), (True,), (1.0,), (0.0,), ((1.0,),), 0.25)
    Store(tmp_path).add_play(play)
    with (tmp_path / PLAYS).open("a") as file:
        file.write('{"scenes": "test", "meth')
    store = Store(tmp_path)
    assert store.plays == [play]
    store.add_play(Play("test", "y", 0, (3,), (True,), (1.0,), (0.0,), ((1.0,),), 0.25))
    assert [p.method for p in Store(tmp_path).plays] == ["x", "y"]


def test_the_error_names_a_damaged_line(tmp_path):
    (tmp_path / PLAYS).write_text("{}\n")
    with pytest.raises(ProblemError, match=r"plays.jsonl, line 1: scenes is missing"):
        Store(tmp_path)
    assert not (tmp_path / SOLVES).exists()


# Configuration and real problems


@pytest.mark.parametrize("name", configurations.names("paper"))
def test_presets_are_read_as_they_were_written(name, tmp_path):
    loaded = config.load(name)
    path = tmp_path / "again.yaml"
    path.write_text(to_yaml(loaded))
    assert config.load(str(path)) == loaded


def test_the_presets_are_full_and_fast():
    assert configurations.names("paper") == ["fast", "full"]
    assert config.load("fast").agents.seeds < config.load("full").agents.seeds


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("agent: {}", "unknown key agent; did you mean agents"),
        ("agents: {seed: 2}", "unknown key agents.seed"),
        ("real: {bal: [{name: X, files: [], sizes: [1]}]}", r"unknown key real.bal\[0\].sizes"),
        ("agents: {seeds: 0}", "agents.seeds must be at least 1"),
        ("agents: {state_sizes: [1, 10]}", "must have 5"),
        ("agents: [", "not YAML"),
    ],
)
def test_a_wrong_file_is_an_error_of_one_line(text, words, tmp_path):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=words):
        config.load(str(path))


def test_the_error_names_an_unknown_preset():
    with pytest.raises(SettingsError, match="no configuration 'quick'; known: fast, full"):
        config.load("quick")


def test_without_the_variable_there_are_no_real_problems(monkeypatch):
    monkeypatch.delenv("JAXBA_DATA", raising=False)
    settings = config.load("fast").real
    assert real_problems.find(settings.kitti).reason == "not run: JAXBA_DATA is not set"
    assert real_problems.bal(settings).reason == "not run: JAXBA_DATA is not set"
    assert real_problems.bal(settings).sources == ()


def test_files_and_their_sub_problems_are_found_and_missing_ones_are_reported(
    monkeypatch, tmp_path
):
    monkeypatch.setenv("JAXBA_DATA", str(tmp_path))
    (tmp_path / "problem-6-40-pre.txt").write_text("")
    family = config.FamilyConfig(
        "Ladybug", ("$JAXBA_DATA/problem-*.txt", "$JAXBA_DATA/other.txt"), (3, 4)
    )
    found = real_problems.find(family)
    assert [source.name for source in found.sources] == [
        "problem-6-40-pre",
        "problem-6-40-pre-first3",
        "problem-6-40-pre-first4",
    ]
    assert found.missing == ("$JAXBA_DATA/other.txt",)
    assert found.reason == ""

    def names(whole):
        return [
            s.name
            for s in real_problems.bal(
                config.RealConfig((dataclasses.replace(family, whole=whole),))
            ).sources
        ]

    assert names(True) == [source.name for source in found.sources]
    assert names(False) == names(True)[1:]


def test_an_agent_is_trained_on_other_problems_than_those_it_is_judged_on(monkeypatch, tmp_path):
    monkeypatch.setenv("JAXBA_DATA", str(tmp_path))
    for name in ("a-30", "a-40", "b-50", "drive-1", "drive-2"):
        (tmp_path / f"{name}.txt").write_text("")

    def of(name):
        return config.FamilyConfig(name, (f"$JAXBA_DATA/{name}-*.txt",), (5,))

    real = config.RealConfig((of("a"), of("b")), of("drive"))

    def path(name):
        return str(tmp_path / f"{name}.txt")

    for source in real_problems.find(real.bal[0]).sources:  # a whole family of BAL is one place
        assert real_problems.training_files(real, source) == ("a", (path("b-50"),))
    *_, part = real_problems.find(real.kitti).sources
    assert real_problems.training_files(real, part) == ("drive-2", (path("drive-1"),))
    settings = dataclasses.replace(config.load("fast"), real=real)
    judged_on_a, judged_on_b = (
        agents.trained_elsewhere(
            settings, real_problems.find(family).sources[0], agents.BEST, "stba"
        )
        for family in real.bal
    )
    assert judged_on_a
    assert judged_on_b
    assert judged_on_b.problems == (path("a-30"), path("a-40"))
    assert judged_on_a.name != judged_on_b.name
    found = agents.train_config(settings, judged_on_a)
    assert (found.bank.problems, found.bank.kind.family) == ((path("b-50"),), "windows")
    # with the steps that it drives, on their unknowns
    assert (found.method, found.bank.intrinsics) == ("stba", "free")
    kitti = agents.trained_elsewhere(settings, part, agents.PRINTED)
    assert kitti
    assert agents.train_config(settings, kitti).bank.intrinsics == "fixed"
    assert (
        agents.trained_elsewhere(settings, Source("x", "scene", "scene:tiny"), agents.BEST) is None
    )
