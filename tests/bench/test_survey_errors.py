"""A short run of the benchmark of surveys with a gross error each; docs/how-to/surveys.md has its
numbers."""

from __future__ import annotations

import pytest

from benchmarks import survey_errors


@pytest.mark.slow
def test_gross_errors_of_surveys_are_said_by_name_and_clean_ones_get_no_note(capsys):
    pytest.importorskip("pyproj")
    assert (
        survey_errors.main(["--surveys", "10", "--clean", "4", "--seed", "2", "--command", "5"])
        == 0
    )
    assert "NOT NAMED" not in capsys.readouterr().out
