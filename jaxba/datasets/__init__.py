"""Published data sets: BAL problems by name; and the example that comes with the package."""

from pathlib import Path

from jaxba.io import read_bal
from jaxba.problem.bundle_problem import BundleProblem

# of a random street (tests/datasets/test_example.py)
EXAMPLE = Path(__file__).with_name("example.txt.bz2")


def example_problem() -> BundleProblem:
    """The commands' `example`: a street, 24 images, 1,600 points, 7,200 observations, one in 200 of
    them wrong."""
    return read_bal(EXAMPLE)
