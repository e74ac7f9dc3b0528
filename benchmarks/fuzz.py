"""Gives damaged inputs of every kind to the commands: each is refused in one line, or solved with a
finite cost.

    python -m benchmarks.fuzz --cases 10000 --seed 0

A case is a small input (`benchmarks/fuzz_inputs.py`) with random damage (`benchmarks/damage.py`),
both determined by the seed and the number of the case. The command runs in a process that ends if
its memory grows by more than a gigabyte, and is killed after a minute. What must hold: exit status
2, one line on standard error, nothing written, all within two seconds of processor time; or exit
status 0 and a file of the result that reads back, with a finite cost. Configurations are only read:
where the work of a training or a benchmark would begin, the case ends. Needs the extras ceres and
kitti, and Linux."""

from __future__ import annotations

import importlib
import io
import math
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from multiprocessing import connection, get_context
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import tyro

from benchmarks.damage import damage_folder
from benchmarks.fuzz_inputs import INPUTS, Input, real

MOST_MEMORY = 2**30
"""Bytes by which the memory of a process may grow."""

MOST_SECONDS = 60.0
"""Of a case; compiling the step takes some of them."""

MOST_REFUSAL_SECONDS = 2.0
"""Processor time of a refusal."""

CASES_OF_A_PROCESS = 500
"""After so many cases a new process begins, since compiled programs are kept."""


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    cases: int = 10000
    """Number of cases."""

    seed: int = 0
    """Of the damage."""

    first: int = 0
    """Number of the first case: `--first N --cases 1` repeats one."""

    problems: tuple[Path, ...] = ()
    """Files and folders of other programs, as further kinds of inputs for `jaxba-solve`."""

    keep: str | None = None
    """Folder for the inputs of cases that violate what must hold."""


class Began(Exception):
    """The work of a training or a benchmark would begin."""


def _began(*_: Any, **__: Any) -> Any:
    raise Began


def kinds_of(args: Arguments) -> tuple[Input, ...]:
    """All kinds of inputs."""
    return (*INPUTS, *map(real, args.problems))


def kind_of(kinds: Sequence[Input], seed: int, number: int) -> Input:
    """The kind of input of a case."""
    weights = np.array([one.weight for one in kinds], float)
    return kinds[
        np.random.default_rng([seed, number]).choice(len(kinds), p=weights / weights.sum())
    ]


def run_case(
    kind: Input, folder: Path, masters: Path, seed: int, number: int | None
) -> tuple[str, str]:
    """Makes a damaged input (undamaged if its number is None), runs its command, and looks at what
    became of it.

    Returns:
        "refused", "solved" or "read"; or "VIOLATED" and what was.
    """
    given = folder / "in"
    out = folder / "out"
    for path in (given, out):
        shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(masters / kind.name, given)
    if number is not None:
        damage_folder(given, np.random.default_rng([seed, number, 1]))
    out.mkdir()
    arguments = [
        word.replace("IN", str(given), 1).replace("OUT", str(out), 1) for word in kind.arguments
    ]
    command = importlib.import_module(f"jaxba.cli.{kind.command}")
    said = io.StringIO()
    complained = io.StringIO()
    started = time.process_time()
    try:
        with redirect_stdout(said), redirect_stderr(complained):
            status = command.run(arguments)
    except Began:
        return "read", ""
    except BaseException:
        return "VIOLATED", f"raised {traceback.format_exc().strip()}"
    seconds = time.process_time() - started
    lines = complained.getvalue().splitlines()
    files = [path for path in out.rglob("*") if path.is_file()]
    if status == 2:
        wrong = {
            f"{len(lines)} lines: {lines}": len(lines) != 1 or not lines[0].startswith("error: "),
            f"not printable: {lines}": not all(line.isprintable() for line in lines),
            f"wrote {files}": any(path.suffix in (".txt", ".json") for path in files),
            f"took {seconds:.1f} s: {lines}": seconds > MOST_REFUSAL_SECONDS
            and kind.command == "solve",
            f"ran out of memory: {lines}": "not enough memory" in complained.getvalue(),
        }
        broken = [what for what, is_so in wrong.items() if is_so]
        return ("VIOLATED", broken[0]) if broken else ("refused", "")
    if status != 0 or lines:
        return "VIOLATED", f"status {status}, {lines}"
    return _look_at(out)


def _look_at(out: Path) -> tuple[str, str]:
    """Whether what was written reads back, with a finite cost."""
    import json

    from jaxba.io import read_problem
    from jaxba.problem import geometry

    solved = read_problem(out / "o.txt")
    if (out / "log.json").is_file():
        cost = json.loads((out / "log.json").read_text())["final_cost"]
    else:
        cost = float(np.sum((geometry.project(solved) - solved.observations) ** 2))
    return ("solved", "") if math.isfinite(cost) else ("VIOLATED", f"cost {cost}")


def work(pipe: connection.Connection, folder: Path, args: Arguments) -> None:
    """A process that runs the cases whose numbers it is sent."""
    from jaxba.bench import run
    from jaxba.training import task

    masters = folder / "masters"
    kinds = kinds_of(args)
    seed = args.seed
    with mock.patch.object(task, "build", _began), mock.patch.object(run, "execute", _began):
        warnings.simplefilter("always")  # so that each is seen by its own case
        run_case(INPUTS[0], folder, masters, seed, None)  # imports and compiles
        while (number := pipe.recv()) is not None:
            kind = kind_of(kinds, seed, number)
            before = _memory("VmRSS")
            Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
            resource.setrlimit(
                resource.RLIMIT_DATA, (_memory("VmData") + MOST_MEMORY, resource.RLIM_INFINITY)
            )
            outcome = run_case(kind, folder, masters, seed, number)
            if _memory("VmHWM") - before > MOST_MEMORY:
                outcome = "VIOLATED", "grew by more than a gigabyte"
            resource.setrlimit(
                resource.RLIMIT_DATA, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
            )
            pipe.send((kind.name, *outcome))


def _memory(field: str) -> int:
    """Bytes, of the memory of this process."""
    line = next(
        line
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith(field)
    )
    return int(line.split()[1]) * 1024


class Worker:
    """A process for cases, which is begun anew after it died, hung, or has run many."""

    def __init__(self, folder: Path, args: Arguments) -> None:
        self.folder = folder
        self.args = args
        self.process = None
        self.count = 0

    def run(self, number: int) -> tuple[str, str, str]:
        """Runs a case: name of its input, what became of it, and why."""
        if self.process is None or self.count >= CASES_OF_A_PROCESS:
            self.stop()
            self.pipe, other = get_context("spawn").Pipe()
            self.process = get_context("spawn").Process(
                target=work, args=(other, self.folder, self.args), daemon=True
            )
            self.process.start()
            other.close()
            self.count = 0
        self.count += 1
        self.pipe.send(number)
        try:
            if self.pipe.poll(MOST_SECONDS):
                return self.pipe.recv()
            why = f"took more than {MOST_SECONDS:g} s"
        except EOFError:
            self.process.join()
            why = f"the process died: {self.process.exitcode}"
        self.process.kill()
        self.process = None
        return kind_of(kinds_of(self.args), self.args.seed, number).name, "VIOLATED", why

    def stop(self) -> None:
        """Ends the process."""
        if self.process is not None:
            self.process.kill()
            self.process.join()


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark. Exit status 1 if what must hold did not."""
    args = tyro.cli(Arguments, args=argv)
    kinds = kinds_of(args)
    counts: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["JAXBA_CACHE"] = str(folder / "programs")
        for kind in kinds:
            (folder / "masters" / kind.name).mkdir(parents=True)
            kind.make(folder / "masters" / kind.name)
        for scene in (folder / "masters").glob("*.txt"):
            scene.rename(folder / scene.name)
        worker = Worker(folder, args)
        for number in range(args.first, args.first + args.cases):
            kind, outcome, why = worker.run(number)
            counts[kind, outcome] += 1
            if outcome == "VIOLATED":
                print(f"case {number}, {kind}: {why}", flush=True)
                if args.keep:
                    shutil.copytree(
                        folder / "in", Path(args.keep) / str(number), dirs_exist_ok=True
                    )
            elif args.cases == 1:
                print(f"case {number}, {kind}: {outcome}")
            if (number + 1) % 500 == 0:
                print(f"{number + 1 - args.first} cases", flush=True)
        worker.stop()
    outcomes = ("refused", "solved", "read", "VIOLATED")
    print(f"{'input':32}" + "".join(f"{outcome:>10}" for outcome in outcomes))
    for kind in kinds:
        print(
            f"{kind.name:32}" + "".join(f"{counts[kind.name, outcome]:10}" for outcome in outcomes)
        )
    violated = sum(count for (_, outcome), count in counts.items() if outcome == "VIOLATED")
    print(f"{counts.total()} cases, seed {args.seed}: {violated} violations")
    return violated > 0


if __name__ == "__main__":
    sys.exit(main())
