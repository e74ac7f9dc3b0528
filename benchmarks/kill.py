"""Kills trainings at random moments, resumes them, and compares the end with that of a training
that ran through.

    python -m benchmarks.kill --times 100 --seed 0

A training is `jaxba-train` on few small scenes, in a process of its own that is ended by SIGKILL
(on Windows: TerminateProcess): after one of the lines that it prints, drawn uniformly, and a part,
drawn uniformly too, of the time that an unbroken training takes from that line to the next. So most
kills fall between two chunks of training, into evaluations and the writing of log, policy and
checkpoints. After some kills a training is left to end. Its policy file must then be the same byte
by byte, and its log but for the clocks."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from jaxba.training import checkpoint, log
from jaxba.training.driver import CHECKPOINTS, CONFIG

SETTINGS = [
    *("chunks=48", "evaluate_every=1", "envs=8"),
    *(
        "bank.kind={cameras: 4, points: 12, family: paper}",
        "bank.scenes=160",
        "bank.refine_points=0",
    ),
    *(
        "game.max_iterations=12",
        "game.agent.refine_points=0",
        "game.agent.trials=1",
        "game.agent.camera_rounds=0",
    ),
    "game.agent.pattern_moves=0",
    *(
        "sac.width=8",
        "sac.batch=16",
        "loop.replay_capacity=500",
        "loop.warmup_steps=16",
        "loop.steps_per_chunk=8",
    ),
]
"""A training of seconds, with a checkpoint after every chunk."""

CLOCKS = ("wall_s", "chunk_s", "steps_per_s", "updates_per_s", "cpu_per_wall", "evaluate_s")
"""Fields of the log that no two trainings have in common."""

FEWEST_LINES = 3
"""Lines that a resumed training prints before its first chunk and after its last one."""

POLICY = "policy.safetensors"

COMMAND = "import sys; from jaxba.cli.train import main; sys.argv[0] = 'jaxba-train'; main()"


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    times: int = 100
    """Number of kills."""

    seed: int = 0
    """Of the moments."""

    per_run: int = 10
    """Most kills of one training, which is then left to end."""


class Trainings:
    """Trainings with one configuration in folders of their own; compiled programs are kept between
    processes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {**os.environ, "JAXBA_CACHE": str(folder / "programs")}

    def begin(self, run: Path) -> subprocess.Popen[str]:
        """Starts a training, or resumes what is in its folder."""
        arguments = ["--out", str(run)]
        arguments += (
            ["--resume"]
            if (run / CONFIG).is_file()
            else ["--config", "default", "--set", *SETTINGS]
        )
        command = [sys.executable, "-c", COMMAND, *arguments]
        pipe = subprocess.PIPE
        both = subprocess.STDOUT
        return subprocess.Popen(
            command,
            env=self.environment,
            text=True,
            start_new_session=True,
            stdout=pipe,
            stderr=both,
        )

    def finish(self, run: Path) -> list[float]:
        """Lets a training end; the seconds after which it printed its lines.

        Raises:
            RuntimeError: it failed, with what it printed.
        """
        started = time.perf_counter()
        times = []
        printed = []
        with self.begin(run) as process:
            assert process.stdout is not None
            for line in process.stdout:
                times.append(time.perf_counter() - started)
                printed.append(line)
        if process.returncode:
            raise RuntimeError(f"{run}: status {process.returncode}: {''.join(printed)}")
        return times

    def kill(self, run: Path, lines: int, after_s: float) -> bool:
        """Starts a training and kills it some seconds after it has printed so many lines; false if
        it had ended before.

        Raises:
            RuntimeError: it had failed before, with what it printed.
        """
        with self.begin(run) as process:
            assert process.stdout is not None
            printed = [line for line, _ in zip(process.stdout, range(lines), strict=False)]
            try:
                process.wait(after_s)
            except subprocess.TimeoutExpired:
                process.kill()
                return True
            printed += process.stdout
        if process.returncode:
            raise RuntimeError(f"{run}: status {process.returncode}: {''.join(printed)}")
        return False


def result(run: Path) -> tuple[bytes, list[log.Row]]:
    """Policy file, and log without clocks."""
    rows = [{name: x for name, x in row.items() if name not in CLOCKS} for row in log.read(run)]
    return (run / POLICY).read_bytes(), rows


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark. Exit status 1 if a training ended differently or could not be resumed."""
    args = tyro.cli(Arguments, args=argv)
    rng = np.random.default_rng(args.seed)
    with tempfile.TemporaryDirectory() as name:
        trainings = Trainings(Path(name))
        trainings.finish(Path(name) / "first")  # compiles
        times = [0.0, *trainings.finish(Path(name) / "unbroken")]
        expected = result(Path(name) / "unbroken")
        if result(Path(name) / "first") != expected:
            print("two unbroken trainings differ")
            return 1
        last = len(expected[1])
        kills = 0
        runs = 0
        stages = Counter[str]()
        while kills < args.times:
            run = Path(name) / f"run-{runs}"
            runs = runs + 1
            for _ in range(min(args.per_run, args.times - kills)):
                left = last - max(checkpoint.steps(run / CHECKPOINTS), default=0)
                line = int(
                    rng.integers(FEWEST_LINES + (len(times) - FEWEST_LINES - 1) * left // last)
                )
                if not trainings.kill(run, line, rng.uniform() * (times[line + 1] - times[line])):
                    break  # less was left
                kills += 1
                done = max(checkpoint.steps(run / CHECKPOINTS), default=0)
                stages[
                    "between chunks"
                    if 0 < done < last
                    else "at the end"
                    if done
                    else "before a checkpoint"
                ] += 1
            trainings.finish(run)
            if result(run) != expected:
                print(f"run {runs} ended differently, seed {args.seed}")
                return 1
            print(f"{kills} kills, {runs} trainings: as the unbroken one", flush=True)
        places = ", ".join(f"{count} {place}" for place, count in stages.items())
        print(
            f"{kills} kills of {runs} trainings, seed {args.seed}: policies and logs are those of "
            "an unbroken one"
        )
        print(f"({places}; an unbroken training takes {times[-1]:.1f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
