"""Short runs of the benchmarks that look for what must not happen; docs/results/robustness.md has
long ones."""

from __future__ import annotations

import sys

import pytest

from benchmarks import invariants


@pytest.mark.slow
def test_no_cost_rises_and_every_number_is_finite(capsys):
    assert (
        invariants.main(
            ["--scenes", "24", "--seed", "5", "--iterations", "12", "--solvers", "learned"]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert printed.count("everything holds") == 2
    assert "0 costs that rose" in printed


@pytest.mark.extra
@pytest.mark.skipif(sys.platform != "linux", reason="limits and measures memory as Linux does")
def test_damaged_inputs_are_refused_in_a_line_or_solved(capsys):
    pytest.importorskip("cv2")
    pytest.importorskip("pycolmap")
    from benchmarks import fuzz

    assert fuzz.main(["--cases", "40", "--seed", "4"]) == 0
    assert "40 cases, seed 4: 0 violations" in capsys.readouterr().out
