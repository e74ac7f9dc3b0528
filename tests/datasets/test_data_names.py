"""Names of the BAL data set, and the commands that take them."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
import support
import yaml

from jaxba import ProblemError, write_bal
from jaxba.bench.sources import sources
from jaxba.cli import bench, data, solve
from jaxba.datasets.bal.paths import ENTRIES, data_folder, local_path, resolve, select
from jaxba.scenes.config import LIKE


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The folder of downloaded problems, empty, and a working directory without files."""
    monkeypatch.setenv("JAXBA_BAL", str(tmp_path / "bal"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "bal"


@pytest.fixture
def stored(folder) -> Path:
    """A small problem in the place of Ladybug-49: what lies in the folder is taken as it is."""
    path = folder / "ladybug" / "problem-49-7776-pre.txt.bz2"
    path.parent.mkdir(parents=True)
    write_bal(support.tiny(), path)
    return path


def check_one_line(error: str, message: str) -> None:
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error


# The names


def test_the_catalogue_holds_the_data_sets_families_in_full():
    """The numbers of problems that its pages and papers count: 31 + 14 + 16 + 29 + 8."""
    families = [entry.family for entry in ENTRIES]
    counts = {family: families.count(family) for family in families}
    assert counts == {"ladybug": 31, "trafalgar": 14, "dubrovnik": 16, "venice": 29, "final": 8}


def test_names_and_files_are_unique_and_in_the_order_of_size():
    assert (
        len({entry.name for entry in ENTRIES})
        == len({Path(entry.file).name for entry in ENTRIES})
        == 98
    )
    assert list(ENTRIES) == select([*dict.fromkeys(entry.family for entry in ENTRIES)])
    for family in ("ladybug", "trafalgar", "dubrovnik", "venice", "final"):
        sizes = [entry.cameras for entry in select([family])]
        assert sizes == sorted(sizes)


def test_checksums_are_64_hexadecimal_digits_all_different():
    known = [entry.sha256 for entry in ENTRIES if entry.sha256]
    assert len(known) == len(set(known)) == 82
    assert all(len(text) == 64 and set(text) <= set("0123456789abcdef") for text in known)


@pytest.mark.parametrize(
    "name", [name for name in LIKE if name.partition("-")[0] in {e.family for e in ENTRIES}]
)
def test_random_scenes_named_after_problems_have_their_sizes(name):
    (entry,) = select([name])
    assert (entry.cameras, entry.points) == (LIKE[name].cameras, LIKE[name].points)


def test_a_family_stands_for_its_problems_and_nothing_comes_twice():
    names = [entry.name for entry in select(["final-93", "FINAL", "Ladybug-49", "final-93"])]
    assert names[:2] == ["final-93", "final-394"]
    assert (len(names), names[-1]) == (9, "ladybug-49")


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("ladybug-50", "did you mean ladybug-49, "),
        ("ladybug-1198", "ladybug-1197"),
        ("ladibug-49", "ladybug-49"),
        ("venise", "venice"),
        ("problem-49-7776-pre", "jaxba-data list"),
    ],
)
def test_an_unknown_name_is_refused_with_close_ones(name, hint):
    with pytest.raises(ProblemError, match="no problem of BAL is called") as caught:
        select([name])
    assert hint in str(caught.value)


# Paths


def test_problems_lie_beside_the_compiled_programs_by_default(monkeypatch, tmp_path):
    monkeypatch.delenv("JAXBA_BAL", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert data_folder() == tmp_path / "jaxba" / "bal"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert data_folder() == tmp_path / ".cache" / "jaxba" / "bal"
    monkeypatch.setenv("JAXBA_BAL", str(tmp_path / "mine"))
    assert data_folder() == tmp_path / "mine"


def test_a_name_is_the_path_of_the_downloaded_file(stored):
    assert local_path("Ladybug-49") == stored
    assert resolve("ladybug-49") == str(stored)


def test_a_file_of_the_same_name_wins(stored):
    Path("ladybug-49").write_text("mine")
    assert resolve("ladybug-49") == "ladybug-49"


@pytest.mark.parametrize(
    "location", ["scene:tiny", "ladybug-49.txt", "x/ladybug-49", "ladybug", "problem-49-7776-pre"]
)
def test_what_has_not_the_form_of_a_name_stays_a_path(folder, location):
    assert resolve(location) == location


# The commands


def test_path_prints_the_path_alone(stored, capsys):
    assert data.run(["path", "ladybug-49"]) == 0
    assert capsys.readouterr().out == f"{stored}\n"


def test_path_of_what_is_not_here_says_how_to_get_it(folder, capsys):
    assert data.run(["path", "ladybug-49"]) == 2
    check_one_line(capsys.readouterr().err, "get it with: jaxba-data download ladybug-49")


def test_list_shows_what_is_here(stored, capsys):
    assert data.run(["list"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == ["name", "cameras", "points", "file", "sha256", "here"]
    assert len(lines) == 1 + 98 + 1
    assert lines[1] == ["ladybug-49", "49", "7776", "problem-49-7776-pre.txt.bz2", "known", "yes"]
    assert [line[-1] for line in lines[2:-1]] == ["no"] * 97
    assert [line[-2] for line in lines[1:-1]].count("no") == 16
    assert lines[-1] == ["folder:", str(stored.parent.parent)]


def test_the_list_fits_a_narrow_terminal(folder, capsys):
    assert data.run(["list"]) == 0
    assert max(len(line.rstrip()) for line in capsys.readouterr().out.splitlines()[:-1]) <= 80


def test_list_of_some_names(folder, capsys):
    assert data.run(["list", "final", "ladybug-1723"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + 9 + 1
    assert data.run(["list", "finale-93"]) == 2
    check_one_line(capsys.readouterr().err, "final-93")


def test_download_without_names_and_without_requests_are_one_line(folder, capsys, monkeypatch):
    assert data.run(["download"]) == 2
    check_one_line(capsys.readouterr().err, "name a problem or a family")
    monkeypatch.delitem(sys.modules, "jaxba.datasets.bal.download", raising=False)
    monkeypatch.delattr(sys.modules["jaxba.datasets.bal"], "download", raising=False)
    monkeypatch.setitem(sys.modules, "requests", None)
    assert data.run(["download", "ladybug-49"]) == 2
    check_one_line(capsys.readouterr().err, "pip install jaxba[data]")


def test_solve_takes_a_name(stored, tmp_path, capsys):
    log = tmp_path / "log.json"
    assert (
        solve.run(["ladybug-49", "--policy", "ceres", "--max-iterations", "1", "--log", str(log)])
        == 0
    )
    assert capsys.readouterr().out.startswith(
        "ladybug-49: 6 cameras, 40 points, 200 observations\n"
    )
    assert json.loads(log.read_text())["problem"] == "ladybug-49"


@pytest.mark.parametrize("command", [solve.run, bench.run])
@pytest.mark.parametrize(
    ("name", "message"),
    [("ladybug-49", "jaxba-data download ladybug-49"), ("ladybug-50", "did you mean ladybug-49")],
)
def test_a_name_that_is_not_here_says_what_to_do(folder, capsys, command, name, message):
    assert command([name]) == 2
    check_one_line(capsys.readouterr().err, message)


def test_benchmarks_keep_the_name_and_the_family(stored):
    copy = shutil.copy(stored, "problem-49-7776-pre.txt.bz2")
    found = sources(["ladybug-49", copy, "scene:ladybug-49"])
    assert [(s.name, s.family) for s in found] == [
        ("ladybug-49", "ladybug"),
        ("problem-49-7776-pre", "work"),
        ("scene-ladybug-49", "scene"),
    ]
    assert found[0].read().num_cameras == 6


def test_suites_may_name_problems(stored, tmp_path, capsys):
    suite = tmp_path / "suite.yaml"
    suite.write_text(
        yaml.safe_dump({"problems": ["ladybug-49", "trafalgar-21"], "solvers": ["ceres"]})
    )
    assert bench.run(["--suite", str(suite), "--out", str(tmp_path / "out")]) == 2
    check_one_line(
        capsys.readouterr().err,
        "trafalgar-21 is not here; get it with: jaxba-data download trafalgar-21",
    )
