"""Lines of `results.jsonl`: one record per problem, solver and repeat.

The JSON keys are the field names below, except that `TracePoint.damping` is written as `"lambda"`, a reserved word in
Python. The keys must not change, since other tools and old result files rely on them. JSON has no NaN and no infinity,
so a non-finite number is written as null, and null is read as NaN.
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from jaxba.problem.bundle_problem import ProblemError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TracePoint:
    """State after one iteration, accepted or rejected. The first point of a trace is the start."""

    iteration: int
    """Number of linear solves so far; 0 is the start."""

    time_s: float
    """Seconds since the start of the solve, without compilation."""

    cost: float
    """Accepted cost after this iteration, `1/2 sum rho` in pixels squared; unchanged by a rejected step."""

    damping: float
    """Lambda of this iteration, dimensionless; written as `"lambda"`. NaN where unknown."""

    accepted: bool
    """Whether the step was accepted."""

    cg_iterations: int
    """Conjugate gradient iterations of this linear solve; 0 for a direct solver."""

    gain_ratio: float
    """Actual over predicted decrease of the cost. NaN where there was no step, e.g. after a failed factorisation."""


@dataclass(frozen=True)
class Record:
    """One run of one solver on one problem."""

    problem: str
    """Name, the same for every solver of the problem."""

    family: str
    """Group of problems, e.g. ladybug."""

    cameras: int
    """Number of cameras."""

    points: int
    """Number of points."""

    observations: int
    """Number of observations."""

    solver: str
    """Name, `[method+]policy[+refineK|+embedded][@dtype]`, or that of another library, e.g. `pyceres:dense`."""

    backend: str
    """Library that ran, with its version and linear solver."""

    device: str
    """Platform and device kind, e.g. `cpu: cpu`."""

    dtype: str
    """Floating point type, e.g. float64."""

    threads: int
    """Number of threads available to the run."""

    repeat: int
    """Number of the repeat, from 0."""

    setup_s: float
    """Seconds to build the layout or the problem of another library."""

    compile_s: float
    """Seconds of compilation; not part of the other times, except perhaps of `total_s`."""

    total_s: float
    """Seconds from the problem in memory to the solution."""

    initial_cost: float
    """Cost at the start, pixels squared."""

    final_cost: float
    """Last accepted cost, pixels squared."""

    iterations: int
    """Linear solves, accepted or rejected."""

    accepted: int
    """Number of iterations whose step was accepted."""

    cg_iterations: int
    """Conjugate gradient iterations, summed over the linear solves."""

    termination: str
    """Why the solve stopped; `jaxba.bench.profile.CONVERGED` lists the reasons that count as converged."""

    trace: tuple[TracePoint, ...]
    """The start and every iteration."""


def _number(value: Any) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError("a number")
    return float(value)


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError("a whole number")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("a text")
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError("true or false")
    return value


def _trace(value: Any) -> tuple[TracePoint, ...]:
    if not isinstance(value, list):
        raise TypeError("a list")
    return tuple(TracePoint(**_values(TracePoint, point, f"trace[{i}].")) for i, point in enumerate(value))


_READERS: dict[str, Callable[[Any], Any]] = {
    "float": _number,
    "int": _whole,
    "str": _text,
    "bool": _flag,
    "tuple[TracePoint, ...]": _trace,
}


def _key(name: str) -> str:
    return "lambda" if name == "damping" else name


def _values(kind: type, data: Any, where: str = "") -> dict[str, Any]:
    """Constructor arguments of `kind` from a JSON object, with checked types. Unknown keys are ignored."""
    if not isinstance(data, Mapping):
        raise ProblemError(f"{where.rstrip('.') or 'the record'} is no object")
    values = {}
    for field in fields(kind):
        key = _key(field.name)
        if key not in data:
            raise ProblemError(f"{where}{key} is missing")
        try:
            values[field.name] = _READERS[str(field.type)](data[key])
        except (TypeError, OverflowError) as error:
            raise ProblemError(f"{where}{key} must be {error}") from None
    return values


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def record_from_json(data: Mapping[str, Any]) -> Record:
    """A record from one parsed line. Unknown keys are ignored, and null is read as NaN.

    Raises:
        ProblemError: a key is missing or its value has the wrong type; the message names the key.
    """
    return Record(**_values(Record, data))


def record_to_json(record: Record) -> dict[str, Any]:
    """The JSON object of a record, with keys in the order of the fields and non-finite numbers as None."""
    data: dict[str, Any] = {field.name: _finite(getattr(record, field.name)) for field in fields(record)}
    data["trace"] = [{_key(f.name): _finite(getattr(p, f.name)) for f in fields(p)} for p in record.trace]
    return data


def read_records(path: str | os.PathLike[str]) -> list[Record]:
    """All records of a `results.jsonl`, in the order of the file. Empty lines are skipped.

    An interrupted run can leave an incomplete last line without a newline. It is ignored with a warning in the log.

    Raises:
        ProblemError: the file cannot be read, or another line is malformed; the message names the file and the line.
    """
    try:
        lines = Path(path).read_bytes().split(b"\n")
    except OSError as error:
        raise ProblemError(f"{path}: {error.strerror or error}") from None
    records = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            records.append(Record(**_values(Record, json.loads(line))))
        except ProblemError as error:
            raise ProblemError(f"{path}, line {number}: {error}") from None
        except (ValueError, RecursionError):  # no JSON or no UTF-8
            if number < len(lines):
                raise ProblemError(f"{path}, line {number}: this is no JSON") from None
            _log.warning("%s, line %d: half-written last line of an interrupted run dropped", path, number)
    return records


def append_record(path: str | os.PathLike[str], record: Record) -> None:
    """Appends one line to a file in a single write, followed by fsync.

    If the file ends in an incomplete line, that line is removed first. If only the newline after a complete line is
    missing, it is added. Only one process may write at a time.

    Raises:
        OSError: the file cannot be written.
    """
    line = json.dumps(record_to_json(record), allow_nan=False, separators=(",", ":")).encode() + b"\n"
    with open(path, "a+b") as file:
        tail_start, tail = _unterminated_tail(file)
        if tail:
            try:
                json.loads(tail)
                line = b"\n" + line
            except ValueError:
                file.truncate(tail_start)
                _log.warning("%s: half-written last line of an interrupted run removed", path)
        file.write(line)
        file.flush()
        os.fsync(file.fileno())


def _unterminated_tail(file: Any, block: int = 1 << 16) -> tuple[int, bytes]:
    """Offset and bytes of what follows the last newline. Reads backwards from the end, so that the size of the file
    does not matter."""
    start, tail = file.seek(0, os.SEEK_END), b""
    while start > 0 and b"\n" not in tail:
        step = min(block, start)
        start -= step
        file.seek(start)
        tail = file.read(step) + tail
    cut = tail.rfind(b"\n") + 1
    return start + cut, tail[cut:]
