"""Runs solvers on problems and appends a record of each run to a results file, so that a run can be
continued."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax

import jaxba
from jaxba.bench.sources import SCENE_PREFIX, Source
from jaxba.damping.registry import fault, file_of
from jaxba.io import json_lines
from jaxba.io.files import visible
from jaxba.lm.termination import Tolerances
from jaxba.peers import require
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.runtime.atomic import write_text
from jaxba.runtime.process import out_of_memory, threads
from jaxba.solver.drivers import IterationRecord
from jaxba.solver.methods import DEFAULT_METHOD
from jaxba.solver.names import SolverName, parse_solver
from jaxba.solver.options import MAX_ITERATIONS
from jaxba.solver.record import Record, record_of
from jaxba.solver.solve import Solution, solve
from jaxba.typing import InputError

RESULTS = "results.jsonl"  # file of the records, one line per run
# file of the settings that all runs in a folder share; other settings are refused there
SETTINGS = "settings.json"


@dataclass(frozen=True)
class RunSettings:
    """Settings shared by all runs of a benchmark."""

    max_iterations: int = MAX_ITERATIONS  # limit of linear solves
    linear_solver: str = "auto"  # of the method `lm`; others have their own
    # whether problems are padded, so that those of one capacity share compiled programs
    pad: bool = False


@dataclass(frozen=True)
class Job:
    """One run to do."""

    source: Source
    solver: SolverName
    repeat: int


def run_solver(
    problem: BundleProblem, source: Source, solver: SolverName, repeat: int, settings: RunSettings
) -> Record:
    """Solves one problem once, with a Python callback after each iteration, and so with measured
    times. The name and family of the source and the number of the repeat, from 0, go into the
    record."""
    steps: list[IterationRecord] = []

    def watch(step):
        return steps.append(step)

    limits = {"max_iterations": settings.max_iterations, "tolerances": Tolerances()}
    if solver.peer:
        solution, backend = _solve_by_peer(
            problem, solver, callback=watch, threads=threads(), **limits
        )
    else:
        policy, options = solver.build()
        linear_solver = settings.linear_solver if solver.method == DEFAULT_METHOD else "auto"
        options = replace(
            options, linear_solver=linear_solver, pad=settings.pad, compilation="full", **limits
        )
        solution = solve(problem, policy, options, callback=watch)
        backend = ""
    record = record_of(
        solution, steps, name=source.name, family=source.family, solver=solver, repeat=repeat
    )
    if solver.peer:
        record = replace(record, backend=backend, device="cpu: host")
    # rounding errors of its own sums are larger than the differences between solvers
    if solver.dtype == "float32":
        record = replace(
            record, initial_cost=geometry.cost(problem), final_cost=geometry.cost(solution.problem)
        )
    return record


def _solve_by_peer(
    problem: BundleProblem, solver: SolverName, **options: Any
) -> tuple[Solution, str]:
    """The solution by another library, which computes on the host, and what the library is
    called."""
    from jaxba.peers.ceres import solve_by_ceres
    from jaxba.peers.colmap import backend

    mode = solver.peer.partition(":")[2]
    return solve_by_ceres(problem, mode, **options), backend(mode)


def machine() -> dict[str, str]:
    """Device, processor and versions, for a report."""
    device = jax.devices()[0]
    return {
        "device": f"{device.platform}: {device.device_kind}",
        "processor": f"{platform.machine()}, {threads()} threads",
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxba": jaxba.__version__,
    }


def plan(sources: Sequence[Source], solvers: Sequence[str], repeats: int) -> list[Job]:
    """All runs of a benchmark, ordered by problem, solver and repeat. Repeated solver names count
    once. Raises InputError: an unknown solver, one whose type its method does not have, or one
    whose library is not installed."""
    names = list(dict.fromkeys(str(parse_solver(name)) for name in solvers))
    parsed = [parse_solver(name) for name in names]
    for solver in parsed:
        require(solver)
        if not solver.peer:
            policy, options = solver.build()
            try:
                options.step_options(policy)
            except ValueError as error:
                raise InputError(f"{error} (in {str(solver)!r})") from None
    return [
        Job(source, solver, repeat)
        for source in sources
        for solver in parsed
        for repeat in range(repeats)
    ]


def open_folder(
    folder: Path, settings: RunSettings, jobs: Sequence[Job], command: str = ""
) -> list[Record]:
    """Creates the folder, or continues a benchmark in it. Writes the settings and the command.
    Returns the records that the folder already has, one for each run. Raises ProblemError: the
    folder has runs with other settings, or results of other problems or policies (by checksum)
    under the same names."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / SETTINGS
    sources = dict.fromkeys(job.source for job in jobs)
    paths = {s.name: s.location for s in sources if not s.location.startswith(SCENE_PREFIX)}
    paths |= {job.solver.policy: file for job in jobs if (file := file_of(job.solver.policy))}
    files = {name: digest for name, file in paths.items() if (digest := _digest(Path(file)))}
    names = {source.name: source.location for source in sources}
    current: dict[str, Any] = {
        "command": command,
        **asdict(settings),
        "problems": names,
        "files": files,
    }
    done = _results(folder / RESULTS)
    solved = {record.problem for record in done}

    def used(name):
        return name in solved or (file_of(name) and any(name in record.solver for record in done))

    if path.exists():
        try:
            previous = json.loads(path.read_text())
            known = dict(previous.pop("problems"))
            known_files = dict(previous.pop("files", {}))  # absent in folders of older versions
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ProblemError(
                f"{path}: not the settings of a benchmark ({type(error).__name__})"
            ) from None
        changed = [
            key for key, value in asdict(settings).items() if previous.get(key, value) != value
        ]
        changed += [
            name
            for name, file in current["problems"].items()
            if used(name) and known.get(name, file) != file
        ]
        changed += [
            name
            for name, digest in files.items()
            if used(name) and known_files.get(name, digest) != digest
        ]
        if changed:
            raise ProblemError(
                f"{folder} holds a run with another {changed[0]}; give another --out, or remove it"
            )
        current["problems"] = {**known, **current["problems"]}
        current["files"] = {**known_files, **files}
    write_text(path, json.dumps(current, indent=1) + "\n")
    return done


def _results(path: Path) -> list[Record]:
    first: dict[tuple[str, str, int], Record] = {}
    for record in json_lines.read(path, Record) if path.exists() else []:
        # a run may have been done twice
        first.setdefault((record.problem, record.solver, record.repeat), record)
    return list(first.values())


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of all files of a COLMAP model. Empty if one cannot be read: later
    reading reports it."""
    total = hashlib.sha256()
    try:
        for part in visible(path) if path.is_dir() else [path]:
            if part != path and (part.suffix not in (".bin", ".txt") or not part.is_file()):
                continue
            with open(part, "rb") as file:
                total.update(hashlib.file_digest(file, "sha256").digest())
    except OSError:
        return ""
    return total.hexdigest()


def execute(
    jobs: Sequence[Job],
    done: Sequence[Record],
    folder: Path,
    settings: RunSettings,
    on_error: Callable[[ProblemError], Any],
    *,
    strict: bool = False,
) -> Iterator[Record]:
    """Runs the jobs that have no record yet. Appends each record to the results file, then yields
    it.

    A problem that cannot be read is reported once and skipped. A solver that refuses a problem, or
    runs out of memory on it, is reported and skipped for this problem. `done` are records of
    earlier runs; `on_error` is called for what is skipped, with `strict` also problems that would
    lose a part. Raises OSError: a result cannot be written."""
    finished = {(r.problem, r.solver, r.repeat) for r in done}
    problem = None
    loaded = None
    broken = set()
    for job in jobs:
        if (job.source.name, str(job.solver), job.repeat) in finished or job.source in broken:
            continue
        if loaded != job.source:
            try:
                problem = job.source.read(strict=strict)
                loaded = job.source
            except ProblemError as error:
                broken.add(job.source)
                on_error(error)
                continue
        assert problem is not None
        try:
            record = run_solver(problem, job.source, job.solver, job.repeat, settings)
        except ProblemError as error:  # another solver may be able to solve it
            on_error(ProblemError(f"{job.source.name}, {job.solver}: {error}"))
            continue
        except Exception as error:
            own = file_of(job.solver.policy)
            if not (memory := out_of_memory(error)) and not own:
                raise
            reason = "not enough memory" if memory or not own else fault(error, own)
            on_error(ProblemError(f"{job.source.name}, {job.solver}: {reason}"))
            continue
        json_lines.append(folder / RESULTS, record)
        yield record
