"""What a solve prints while it runs: that it compiles, and a table of the iterations like that of
Ceres."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress

from jaxba.runtime.announce import announced
from jaxba.solver.drivers import Callback, IterationRecord

COLUMNS = (
    "iter      cost      cost_change  |gradient|   |step|    gain      lambda    ls_iter  "
    "iter_time  total_time"
)
LONG_ITERATION_S = 5.0  # of an iteration whose seconds are counted while it runs
BEAT_S = 0.5  # compilation is announced after so long, and has a dot for each of these


class Waiting:
    """What is shown of things that take time: nothing."""

    def tell(self, text: str) -> None:
        """Before a long solve: what it takes."""

    def resume(self, iterations: int, time_s: float) -> None:
        """Before a solve goes on after so many iterations and seconds."""

    def begin_phase(self, text: str) -> None:
        """Before one of several solves: what it solves."""

    def compiling(self) -> AbstractContextManager:
        """The context in which programs compile."""
        return nullcontext()

    def iterating(self, iteration: int) -> AbstractContextManager:
        """The context of an iteration, from 1."""
        return nullcontext()


SILENT = Waiting()


class Announced(Waiting):
    """A line of the logger `jaxba.progress` if programs compile for long (runtime/announce.py)."""

    def compiling(self) -> AbstractContextManager:
        """See `Waiting`."""
        return announced("compiling programs for a problem of this kind and size")


class Printed(Waiting):
    """A line of what a long solve takes, one that grows while programs compile and, on a terminal,
    one that counts the seconds of a long iteration beside those of the last one."""

    def __init__(self) -> None:
        self._last_s = 0.0
        self.time_s = 0.0  # of the iterations so far

    def tell(self, text: str) -> None:
        """See `Waiting`."""
        print(text, flush=True)

    def resume(self, iterations: int, time_s: float) -> None:
        """See `Waiting`."""
        self.tell(f"goes on after {iterations} iterations")
        self.time_s = time_s

    def begin_phase(self, text: str) -> None:
        """See `Waiting`."""
        self.tell(f"   -- {text}")

    def compiling(self) -> AbstractContextManager:
        """See `Waiting`."""
        return _compiling()

    @contextmanager
    def iterating(self, iteration: int) -> Iterator[None]:
        """See `Waiting`."""
        began = time.perf_counter()
        last = self._last_s
        of_last = f", the last one took {last:.0f}" if last else ""

        def show(_: int) -> str:
            seconds = time.perf_counter() - began
            return (
                f"\r{iteration:4d}  {seconds:.0f} s{of_last} " if seconds > LONG_ITERATION_S else ""
            )

        shown = _beating(show, end=lambda beats: "\r\033[K" if beats else "")
        with shown if sys.stdout.isatty() else nullcontext():
            yield
        self._last_s = time.perf_counter() - began


def shown(callback: Callback | None, verbose: bool) -> tuple[Callback | None, Waiting]:
    """A callback that prints a row and calls the one that is given, and what is printed of things
    that take time."""
    if not verbose:
        return callback, Announced()
    printed = Printed()
    begun = False

    def show(record: IterationRecord) -> bool | None:
        nonlocal begun
        if not begun:
            print(
                f"{COLUMNS}\n{record.iteration - 1:4d}  {record.step.previous_cost:.6e}", flush=True
            )
        print(row(record, printed.time_s), flush=True)
        begun = True
        printed.time_s = record.time_s
        return callback and callback(record)

    return show, printed


def row(record: IterationRecord, time_before: float) -> str:
    """The row of an iteration, with the accepted cost, and the change of the cost by the
    candidate."""
    step = record.step
    cells = (
        f"{record.iteration:4d}  {step.cost:.6e}  {step.previous_cost - step.candidate_cost: .2e} "
        "  "
        f"{step.gradient_max:.2e}   {step.step_norm:.2e}  {step.gain_ratio: .2e}  "
        f"{step.damping:.2e}  "
        f"{step.cg_iterations:7d}   {record.time_s - time_before:.2e}   {record.time_s:.2e}"
    )
    return cells if step.accepted else f"{cells}  rejected"


def _compiling() -> AbstractContextManager:
    """Prints a line that grows while what is inside takes its time."""
    return _beating(
        lambda beat: "." if beat else "compiling ", end=lambda beats: "\n" * (beats > 0)
    )


@contextmanager
def _beating(show: Callable[[int], str], end: Callable[[int], str]) -> Iterator[None]:
    """Prints what `show` gives for the number of each beat while what is inside takes its time,
    then the end for how many gave something."""
    done = threading.Event()

    def beat() -> None:
        beats = 0
        with suppress(Exception):  # of standard output; the next row meets it, too
            while not done.wait(BEAT_S):
                text = show(beats)
                beats += bool(text)
                print(text, end="", flush=True)
            print(end=end(beats), flush=True)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
