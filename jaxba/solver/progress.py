"""What a solve prints while it runs: that it compiles, and a table of the iterations like that of Ceres."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress

from jaxba.solver.drivers import Callback, IterationRecord

COLUMNS = "iter      cost      cost_change  |gradient|   |step|    gain      lambda    ls_iter  iter_time  total_time"
BEAT_S = 0.5  # compilation is announced after so long, and has a dot for each of these


def shown(callback: Callback | None, verbose: bool) -> tuple[Callback | None, Callable[[], AbstractContextManager]]:
    """A callback that prints a row and calls the one that is given, and the context of compilation."""
    if not verbose:
        return callback, nullcontext
    time_before = None

    def show(record: IterationRecord) -> bool | None:
        nonlocal time_before
        if time_before is None:
            print(f"{COLUMNS}\n{0:4d}  {record.step.previous_cost:.6e}", flush=True)
        print(row(record, time_before or 0.0), flush=True)
        time_before = record.time_s
        return callback and callback(record)

    return show, compiling


def row(record: IterationRecord, time_before: float) -> str:
    """The row of an iteration, with the accepted cost, and the change of the cost by the candidate."""
    step = record.step
    cells = (
        f"{record.iteration:4d}  {step.cost:.6e}  {step.previous_cost - step.candidate_cost: .2e}   "
        f"{step.gradient_max:.2e}   {step.step_norm:.2e}  {step.gain_ratio: .2e}  {step.damping:.2e}  "
        f"{step.cg_iterations:7d}   {record.time_s - time_before:.2e}   {record.time_s:.2e}"
    )
    return cells if step.accepted else f"{cells}  rejected"


@contextmanager
def compiling() -> Iterator[None]:
    """Prints a line that grows while what is inside takes its time."""
    done = threading.Event()

    def grow() -> None:
        text = "compiling "
        with suppress(Exception):  # of standard output; the next row meets it, too
            while not done.wait(BEAT_S):
                print(text, end="", flush=True)
                text = "."
            print(end="\n" * (text == "."), flush=True)

    thread = threading.Thread(target=grow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
