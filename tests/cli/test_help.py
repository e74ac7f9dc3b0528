"""The help of the commands: short, in plain lines, and in their own names."""

from __future__ import annotations

import importlib
import importlib.metadata
import subprocess
import sys
from itertools import pairwise

import pytest

LINES = {
    "solve": 60,
    "bench": 44,
    "data": 20,
    "data download": 26,
    "data list": 15,
    "kitti": 65,
    "kitti evaluate": 24,
    "paper": 26,
    "train": 52,
    "view": 30,
}
"""Most lines of the help of each command on 80 columns."""


@pytest.mark.parametrize("command", LINES)
def test_help_is_short_and_names_the_command(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    module, *subcommand = command.split()
    assert importlib.import_module(f"jaxba.cli.{module}").run([*subcommand, "--help"]) == 0
    usage, *lines = capsys.readouterr().out.splitlines()
    assert usage.startswith(f"usage: jaxba-{command} [")
    assert len(lines) < LINES[command]
    assert max(map(len, lines)) <= 80
    assert not [line for line in lines if "None" in line]


def test_all_options_of_solve_fit_144_lines(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert importlib.import_module("jaxba.cli.solve").run(["--help-all"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert 100 < len(lines) <= 144
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("command", ["solve", "bench", "train", "view", "kitti"])
def test_commands_print_versions(command, capsys):
    assert importlib.import_module(f"jaxba.cli.{command}").run(["--version"]) == 0
    versions = dict(part.split() for part in capsys.readouterr().out.strip().split(", "))
    assert versions["JAX"] == importlib.metadata.version("jax")


def test_commands_run_as_a_module():
    python = [sys.executable, "-m", "jaxba"]
    shown = subprocess.run([*python, "solve", "--version"], capture_output=True, text=True)
    assert (shown.returncode, shown.stdout.split()[0]) == (0, "jaxba")
    refused = subprocess.run([*python, "sovle"], capture_output=True, text=True)
    assert (refused.returncode, refused.stdout.split()[0]) == (2, "usage:")


def test_a_text_is_reflowed(capsys, monkeypatch):
    """Each line but the last of a text ends where the next word would not fit."""
    monkeypatch.setenv("COLUMNS", "80")
    importlib.import_module("jaxba.cli.solve").run(["--help-all"])
    lines = [line.strip("│ ") for line in capsys.readouterr().out.splitlines()]
    first = next(k for k, line in enumerate(lines) if line.startswith("--policy"))
    text = lines[first + 1 : next(k for k, line in enumerate(lines) if line.startswith("--method"))]
    assert len(text) > 3
    assert all(len(line) + 1 + len(after.split()[0]) > 50 for line, after in pairwise(text))


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["--policy", "learned", "--scaling", "identity"], ["--scaling"]),
        (
            ["--constant", "fokal"],
            ["--constant", "'fokal'", "focal", "k1", "poses", "points", "extrinsics"],
        ),
    ],
)
def test_an_error_names_the_option_and_what_it_may_be(arguments, names, capsys):
    assert importlib.import_module("jaxba.cli.solve").run(arguments) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert [name for name in names if name not in printed] == []
