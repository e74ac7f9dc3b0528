"""What gauges cost: final costs above that without a gauge, on reconstructions that COLMAP makes
up.

    python -m benchmarks.gauges [--seeds 5] [--points 100]

Needs the extra `ceres`. Of each kind of model the least, the median and the largest of `cost with /
cost without - 1`."""

from __future__ import annotations

import argparse
import tempfile
import warnings
from typing import Literal

import numpy as np

import jaxba
from benchmarks.colmap_models import TIGHT, reconstruction

MODELS = {
    "4 images, one lens": (4, 1),
    "10 images, one lens": (10, 1),
    "5 frames of a rig of 3": (5, 3),
}
"""Frames and cameras of each."""

GAUGES: tuple[Literal["two-cameras", "three-points"], ...] = ("two-cameras", "three-points")


def excess(frames: int, cameras: int, points: int, seed: int) -> list[float]:
    """The final cost of each gauge over that of none, less one."""
    with tempfile.TemporaryDirectory() as folder:
        reconstruction("SIMPLE_RADIAL", 1, frames, points, seed, in_rig=cameras).write(folder)
        problem = jaxba.read_colmap(folder)
    free, *fixed = (
        jaxba.solve(p, "ceres", TIGHT)
        for p in (problem, *(jaxba.with_gauge(problem, g) for g in GAUGES))
    )
    return [one.final_cost / free.final_cost - 1 for one in fixed]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--points", type=int, default=100)
    args = parser.parse_args()
    warnings.simplefilter("ignore", jaxba.ProblemWarning)
    for name, (frames, cameras) in MODELS.items():
        found = np.array([excess(frames, cameras, args.points, seed) for seed in range(args.seeds)])
        for gauge, values in zip(GAUGES, found.T, strict=True):
            least, median, largest = np.quantile(values, [0, 0.5, 1])
            print(f"{name:24s}{gauge:14s}{least:10.1e}{median:10.1e}{largest:10.1e}", flush=True)


if __name__ == "__main__":
    main()
