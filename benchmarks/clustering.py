"""Time of a random clustering of the cameras on the host, compared with an iteration of the methods that use it.

    python -m benchmarks.clustering PROBLEM ... [--methods stba,stba:16]

A solve draws a fixed number of clusterings once, with the layout, and uses them in turn. The table shows what it would
cost to draw a new one for every iteration. The time of an iteration is the median over a solve under Ceres' rule,
without compilation.
"""

from __future__ import annotations

import argparse
import itertools
import time

import jax
import numpy as np

from benchmarks.suite import iteration_seconds
from jaxba import StepOptions, make_method
from jaxba.bench.sources import sources
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime import process
from jaxba.structure.layout import layout_for
from jaxba.structure.louvain import camera_graph, clusterings
from jaxba.structure.random_partitions import PARTITIONS, SEED

ITERATIONS = 8


def main() -> None:
    """Prints a Markdown row for each pair of problem and method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problem", nargs="+", help="as for jaxba-bench")
    parser.add_argument("--methods", default="stba,stba:16")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    print("| problem, method | graph, ms | a clustering, ms | iteration, ms | clustering over iteration | layout, ms |")
    print("| --- | --: | --: | --: | --: | --: |")
    for source in sources(args.problem):
        problem = source.read()
        for name in args.methods.split(","):
            options = make_method(name).options(StepOptions())
            graph, drawing = _clustering_seconds(problem, options.cluster_cameras or 0)
            with process.single_blas_thread():
                iteration, _ = iteration_seconds(problem, repeats=1, method=name)
            started = time.perf_counter()
            layout_for(problem, options)
            layout = time.perf_counter() - started
            cells = (f"{1e3 * graph:.1f}", f"{1e3 * drawing:.1f}", f"{1e3 * iteration:.0f}")
            ratio = f"{drawing / iteration:.3f}"
            print(f"| {source.name}, `{name}` |", " | ".join((*cells, ratio, f"{1e3 * layout:.0f}")), "|", flush=True)


def _clustering_seconds(problem: BundleProblem, largest: int) -> tuple[float, float]:
    """Seconds to build the camera graph, and to draw one clustering of it."""
    camera, point = np.asarray(problem.camera_index), np.asarray(problem.point_index)
    order = np.lexsort((camera, point))
    camera, point = camera[order], point[order]
    started = time.perf_counter()
    graph = camera_graph(camera, point, problem.num_cameras, problem.num_points)
    made = time.perf_counter()
    drawn = list(itertools.islice(clusterings(graph, largest, np.random.default_rng(SEED)), PARTITIONS))
    return made - started, (time.perf_counter() - made) / len(drawn)


if __name__ == "__main__":
    main()
