"""Configurations: found by name in a clone and from a wheel, and what one that extends another
says."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import get_args

import pytest

from jaxba.settings import configurations
from jaxba.settings.configurations import Kind, SettingsError, find, names, read

REPOSITORY = Path(__file__).parents[2]
KINDS = get_args(Kind)


def write(folder: Path, **files: str) -> str:
    """Writes NAME.yaml for each name; the path of the first."""
    for name, text in files.items():
        (folder / f"{name}.yaml").write_text(text)
    return str(folder / f"{next(iter(files))}.yaml")


def refused(kind: Kind, name: str) -> str:
    with pytest.raises(SettingsError) as error:
        read(kind, name)
    assert "\n" not in str(error.value)
    return str(error.value)


# Names


def test_every_folder_of_configurations_is_a_kind():
    assert sorted(KINDS) == sorted(path.name for path in (REPOSITORY / "configs").iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_every_file_of_the_repository_is_found_by_its_name_and_as_a_path(kind):
    files = sorted((REPOSITORY / "configs" / kind).glob("*.yaml"), key=lambda file: file.stem)
    assert names(kind) == [file.stem for file in files] != []
    for file in files:
        assert find(kind, file.stem).samefile(file)
        assert read(kind, file.stem) == read(kind, str(file)) != {}


def test_hidden_files_are_no_configurations(tmp_path, monkeypatch):
    monkeypatch.setattr(configurations, "_PACKAGE", tmp_path)
    (tmp_path / "configs" / "train").mkdir(parents=True)
    for name in ("one.yaml", "._one.yaml", ".yaml"):
        (tmp_path / "configs" / "train" / name).touch()
    assert names("train") == ["one"]


@pytest.mark.parametrize("kind", KINDS)
def test_an_unknown_name_lists_those_that_are_known(kind):
    known = ", ".join(names(kind))
    assert (
        refused(kind, "nothing")
        == f"no configuration 'nothing'; known: {known}, or the path of a file"
    )


def test_a_name_is_no_file_of_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "mine").write_text("seed: 1\n")
    monkeypatch.chdir(tmp_path)
    assert "no configuration 'mine'" in refused("train", "mine")
    assert read("train", f"{tmp_path}/mine") == {"seed": 1}


# What extends what


def test_mappings_are_merged_key_by_key_and_the_file_wins(tmp_path):
    path = write(
        tmp_path,
        top="extends: ./middle.yaml\na: {b: {c: 1}}\nlist: [9]\nnone: null\n",
        middle="extends: low.yaml\na: {b: {c: 2, d: 2}}\nnone: {x: 1}\n",
        low="a: {b: {d: 3, e: 3}, f: 3}\nlist: [1, 2]\ng: {h: 3}\n",
    )
    merged = {
        "a": {"b": {"c": 1, "d": 2, "e": 3}, "f": 3},
        "list": [9],
        "none": None,
        "g": {"h": 3},
    }
    assert read("train", path) == merged


def test_a_base_is_a_name_or_a_path_relative_to_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bases").mkdir()
    write(tmp_path / "bases", base="extends: default\nchunks: 3\n")
    path = write(tmp_path, mine="extends: bases/base.yaml\nseed: 3\n")
    assert read("train", path) == read("train", "default") | {"chunks": 3, "seed": 3}
    outer = write(tmp_path / "bases", outer="extends: ../mine.yaml\n")
    assert read("train", outer) == read("train", path)


def test_what_is_read_is_the_readers_own():
    read("train", "paper")["game"]["agent"]["history"] = 7
    assert read("train", "paper")["game"]["agent"]["history"] == 5


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            {"a": "extends: plane"},
            "{0}/a.yaml: extends: no configuration 'plane'; known: default, fast, paper",
        ),
        ({"a": "extends: b.yaml"}, "{0}/a.yaml: extends: b.yaml: No such file or directory"),
        ({"a": "extends: ./"}, "{0}/a.yaml: extends: ./: Is a directory"),
        (
            {"a": "extends: [plain]"},
            "{0}/a.yaml: extends must be a name or the path of a file, is ['plain']",
        ),
        ({"a": "extends:"}, "{0}/a.yaml: extends must be a name or the path of a file, is None"),
        ({"a": "extends: a.yaml"}, "{0}/a.yaml extends a.yaml: a circle"),
        (
            {"a": "extends: b.yaml", "b": "extends: c.yaml", "c": "extends: ./b.yaml"},
            "{0}/a.yaml extends b.yaml extends c.yaml extends ./b.yaml: a circle",
        ),
        (
            {"a": "extends: b.yaml", "b": "extends: plane"},
            "b.yaml: extends: no configuration 'plane'",
        ),
        ({"a": "extends: b.yaml", "b": "- 1"}, "{0}/a.yaml: extends: b.yaml: must be a mapping"),
        (
            {"a": "extends: b.yaml", "b": "x: 1\ny: ["},
            "{0}/a.yaml: extends: b.yaml line 2: not YAML",
        ),
        ({"a": "x: 1\ny: {z: 1}\nx: 2"}, "{0}/a.yaml line 3: x is there twice"),
        ({"a": "x: 1\ny: [{z: 1, w: 2,\n z: 3}]"}, "{0}/a.yaml line 3: z is there twice"),
        ({"a": "x: &a {y: *a, z: 1, z: 1}"}, "{0}/a.yaml: z is there twice"),
        ({"a": "[" * 3000}, "{0}/a.yaml: not YAML"),
        (
            {"a": 'extends: "x\\ny.yaml"'},
            "{0}/a.yaml: extends: x\\ny.yaml: No such file or directory",
        ),
        ({"a": 'extends: "x\\0.yaml"'}, "{0}/a.yaml: extends: x\\x00.yaml: embedded null"),
    ],
)
def test_circles_and_bases_that_cannot_be_read_are_one_line(files, message, tmp_path):
    assert refused("train", write(tmp_path, **files)).startswith(message.format(tmp_path))


# Wheels


@pytest.mark.slow
def test_a_wheel_carries_every_configuration_and_so_does_one_from_a_source_distribution(tmp_path):
    backend = tmp_path / "backend"
    clone = tmp_path / "clone"
    requires = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["build-system"][
        "requires"
    ]
    pip = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    subprocess.run([*pip, "--target", str(backend), *requires], check=True, timeout=300)
    clone.mkdir()
    for name in ("jaxba", "configs"):
        shutil.copytree(REPOSITORY / name, clone / name)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, clone)

    def build(what: str, source: Path) -> Path:
        code = f"from setuptools import build_meta; build_meta.build_{what}({str(tmp_path)!r})"
        env = {**os.environ, "PYTHONPATH": str(backend)}
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=source,
            env=env,
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr
        (file,) = tmp_path.glob("*.whl" if what == "wheel" else "*.tar.gz")
        return file

    with tarfile.open(build("sdist", clone)) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (source,) = (tmp_path / "unpacked").iterdir()
    expected = {kind: {name: read(kind, name) for name in names(kind)} for kind in KINDS}
    for tree in (clone, source):
        wheel = build("wheel", tree)
        installed = tmp_path.resolve() / f"installed-{tree.name}"
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(installed)
        wheel.unlink()
        code = (
            "from jaxba.settings.configurations import find, names, read\n"
            f"kinds, expected, at = {KINDS!r}, {expected!r}, "
            f"{str(installed / 'jaxba/configs/train/default.yaml')!r}\n"
            "assert str(find('train', 'default')) == at\n"
            "assert {kind: {name: read(kind, name) for name in names(kind)} for kind in kinds} == "
            "expected\n"
        )
        env = {**os.environ, "PYTHONPATH": str(installed)}
        found = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True
        )
        assert found.returncode == 0, found.stderr
