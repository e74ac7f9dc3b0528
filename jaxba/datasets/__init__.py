"""Published data sets: BAL problems by name; and the example that comes with the package."""

from pathlib import Path

from jaxba.io import read_bal
from jaxba.problem.bundle_problem import BundleProblem

EXAMPLE = Path(__file__).with_name("example.txt.bz2")
"""A BAL file of a random street; `tests/datasets/test_example.py` says which."""


def example_problem() -> BundleProblem:
    """The problem that commands call `example`: a street of 24 images and 1,600 points; one in 200 of the
    7,200 observations is wrong."""
    return read_bal(EXAMPLE)
