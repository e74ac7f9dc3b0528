"""results.jsonl: the line format, damaged files, and the messages about them."""

import json
import math

import pytest

from jaxba.io import json_lines
from jaxba.problem.bundle_problem import ProblemError
from jaxba.solver.record import Record, TracePoint

CONTRACT_KEYS = [
    *(
        "problem",
        "family",
        "cameras",
        "points",
        "observations",
        "solver",
        "backend",
        "device",
        "dtype",
        "threads",
    ),
    *(
        "repeat",
        "setup_s",
        "compile_s",
        "total_s",
        "initial_cost",
        "final_cost",
        "iterations",
        "accepted",
    ),
    *("cg_iterations", "termination", "trace", "notes"),
]
TRACE_KEYS = ["iteration", "time_s", "cost", "lambda", "accepted", "cg_iterations", "gain_ratio"]


def make_record(repeat=0, problem="ladybug"):
    trace = (
        TracePoint(0, 0.0, 8.0, math.nan, True, 0, math.nan),
        TracePoint(1, 0.5, 2.0, 1e-4, True, 3, 0.75),
    )
    sizes = (problem, "bal", 2, 3, 4, "ceres", "jax", "cpu", "float64", 2, repeat)
    return Record(*sizes, 0.1, 1.5, 2.1, 8.0, 2.0, 1, 1, 3, "ftol", trace)


def test_a_line_has_exactly_the_documented_keys_in_order():
    data = json_lines.plain(make_record())
    assert list(data) == CONTRACT_KEYS
    assert list(data["trace"][0]) == TRACE_KEYS


def test_round_trip_keeps_every_number_and_writes_nan_and_infinity_as_null(tmp_path):
    path = tmp_path / "results.jsonl"
    json_lines.append(path, make_record(0))
    json_lines.append(path, make_record(1))
    first, second = json_lines.read(path, Record)
    assert (first.repeat, second.repeat) == (0, 1)
    assert math.isnan(first.trace[0].damping)
    assert math.isnan(first.trace[0].gain_ratio)
    assert first.trace[1] == make_record().trace[1]
    assert json_lines.plain(first) == json_lines.plain(make_record())
    assert "NaN" not in path.read_text()
    assert path.read_text().endswith("}\n")
    infinite = json_lines.plain(Record(**{**vars(make_record()), "final_cost": math.inf}))
    assert infinite["final_cost"] is None


def test_unknown_keys_are_ignored_and_whole_numbers_serve_as_floats():
    data = json_lines.plain(make_record()) | {"future": [1], "initial_cost": 8}
    record = json_lines.from_plain(Record, data)
    assert record.initial_cost == 8.0
    assert isinstance(record.initial_cost, float)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": 1.5}, "cameras must be a whole number"),
        ({"cameras": True}, "cameras must be a whole number"),
        ({"solver": None}, "solver must be a text"),
        ({"total_s": "1"}, "total_s must be a number"),
        ({"trace": {}}, "trace must be a list"),
        ({"trace": [{"iteration": 0}]}, r"trace\[0\]\.time_s is missing"),
        ({"trace": [3]}, r"trace\[0\] is no object"),
    ],
)
def test_wrong_values_are_named(change, message):
    with pytest.raises(ProblemError, match=message):
        json_lines.from_plain(Record, json_lines.plain(make_record()) | change)


def test_half_written_last_line_is_dropped_with_a_warning(tmp_path, caplog):
    path = tmp_path / "results.jsonl"
    json_lines.append(path, make_record(0))
    json_lines.append(path, make_record(1))
    whole = path.read_bytes()
    first = whole.index(b"\n") + 1
    for end in (first + 1, first + 40, len(whole) - 2):
        caplog.clear()
        path.write_bytes(whole[:end])
        assert [r.repeat for r in json_lines.read(path, Record)] == [0]
        assert "line 2" in caplog.text
        assert "half-written" in caplog.text


def test_appending_after_a_cut_leaves_a_readable_file(tmp_path):
    path = tmp_path / "results.jsonl"
    json_lines.append(path, make_record(0))
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:50])
    json_lines.append(path, make_record(2))
    assert [r.repeat for r in json_lines.read(path, Record)] == [0, 2]
    path.write_bytes(whole[:-1])  # only the newline is lost: the record stays
    json_lines.append(path, make_record(3))
    assert [r.repeat for r in json_lines.read(path, Record)] == [0, 3]
    # nothing but a half line, and one longer than a block of the search
    path.write_bytes(whole[:50])
    json_lines.append(path, make_record(4))
    assert [r.repeat for r in json_lines.read(path, Record)] == [4]
    path.write_bytes(whole + b'{"x": "' + b"y" * 200_000)
    json_lines.append(path, make_record(5))
    assert [r.repeat for r in json_lines.read(path, Record)] == [0, 5]


@pytest.mark.parametrize(
    "bad",
    [
        '{"problem": "a"',
        "[]",
        '{"problem": "a"}',
        '{"problem": "a", "problem": "b"}',
        "\u00ff\u00fe",
    ],
)
def test_malformed_line_elsewhere_is_one_clear_error(tmp_path, bad):
    path = tmp_path / "results.jsonl"
    line = json.dumps(json_lines.plain(make_record()))
    path.write_bytes(f"{line}\n\n".encode() + bad.encode("latin-1") + f"\n{line}\n".encode())
    with pytest.raises(ProblemError, match=r"results\.jsonl, line 3: ") as caught:
        json_lines.read(path, Record)
    assert "\n" not in str(caught.value)


def test_missing_file_is_one_clear_error_and_an_empty_one_has_no_records(tmp_path):
    with pytest.raises(ProblemError, match="No such file"):
        json_lines.read(tmp_path / "absent.jsonl", Record)
    (tmp_path / "empty.jsonl").write_text("")
    assert json_lines.read(tmp_path / "empty.jsonl", Record) == []
