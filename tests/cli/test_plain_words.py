"""What is wrong with the value of an option is said without words of Python or of its libraries."""

from __future__ import annotations

import pytest

from jaxba.cli import bench, solve


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--ftol", "abc"], "--ftol must be a number, not 'abc'"),
        (["--loss-scale", "1,5"], "--loss-scale must be a number, not '1,5'"),
        (["--max-iterations", "2.5"], "--max-iterations must be a whole number, not '2.5'"),
        (["--devices", "two"], "--devices must be a whole number, not 'two'"),
        (
            ["--loss", "l1"],
            "--loss must be one of cauchy, huber, soft_l1, squared, tukey, not 'l1'",
        ),
        (["--gauge", "four"], "--gauge must be one of free, three-points, two-cameras, not 'four'"),
        (["--ftol"], "--ftol needs a value"),
    ],
)
def test_a_wrong_value_of_an_option_is_said_in_plain_words(capsys, words, said):
    assert solve.run(["problem.txt", *words]) == 2
    assert capsys.readouterr().err == f"error: {said}\n"


def test_other_commands_say_it_alike(capsys):
    assert bench.run(["scene:tiny", "--repeats", "x"]) == 2
    assert capsys.readouterr().err == "error: --repeats must be a whole number, not 'x'\n"
