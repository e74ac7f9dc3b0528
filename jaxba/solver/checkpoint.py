"""A file from which a solve that was killed continues."""

from __future__ import annotations

import hashlib
import os
import re
import time
import warnings
import zlib
from dataclasses import replace
from typing import Any, NamedTuple
from zipfile import BadZipFile

import jax
import numpy as np

from jaxba.lm.records import StepInfo
from jaxba.lm.termination import Tolerances
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.runtime.atomic import atomic_write
from jaxba.solver.iteration import Carry
from jaxba.solver.options import SolveOptions

EVERY_S = 60.0  # seconds between two checkpoints


class Saved(NamedTuple):
    """A solve after some of its iterations."""

    problem: BundleProblem
    """The problem with the parameters after them."""

    away: np.ndarray
    """See `Setup`."""

    initial_cost: float
    """Pixels^2."""

    total_s: float
    """Seconds of the iterations."""

    steps: list[StepInfo]
    """Their records, as Python scalars."""

    carry: Any
    """The carry; that of a file has no parameters and is a list of arrays."""

    def continued(self, begun: Carry) -> Carry:
        """The carry from which the solve continues, for the one before a first iteration from the
        same parameters."""
        rest = jax.tree.structure(begun._replace(state=None))
        found = jax.tree.unflatten(rest, [jax.numpy.asarray(leaf) for leaf in self.carry])
        return found._replace(state=begun.state, termination=begun.termination)


class Checkpoint:
    """A file that belongs to one problem, policy and options, whatever their limits and
    tolerances."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        problem: BundleProblem,
        policy: Any,
        options: SolveOptions,
    ) -> None:
        """Raises ValueError: there are several processes. Raises ProblemError: the folder of the
        file is missing."""
        if jax.process_count() > 1:
            raise ValueError("a checkpoint is of one process")
        if not os.path.isdir(os.path.dirname(os.path.abspath(path))):
            raise ProblemError(f"cannot write {path}: its folder is missing")
        options = replace(options, max_iterations=1, tolerances=Tolerances(), within=0.0)
        self._path, self._last, self._labels = path, time.monotonic(), problem.labels
        self._start, self._tree = jax.tree.flatten(problem)
        losses = options.loss, *(rows.loss for rows in problem.residuals.rows)
        own = [
            jax.make_jaxpr(loss.rho)(np.zeros(1, np.float32))
            for loss in losses
            if callable(loss.rho)
        ]
        found = hashlib.blake2b(settings_text(policy, options, self._tree, own).encode())
        for leaf in self._start:
            found.update(np.ascontiguousarray(leaf).data)
        self._key = found.hexdigest()

    def load(self) -> Saved | None:
        """What was saved; None if there is no file. Raises ProblemError: it is that of another
        solve, or no checkpoint."""
        if not os.path.exists(self._path):
            return None
        try:
            with open(self._path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
                found = {name: file[name] for name in file.files}
            if str(found["key"]) != self._key:
                raise ProblemError(
                    f"{self._path} is the checkpoint of another problem, policy or options: remove "
                    "it"
                )
            steps = [
                StepInfo(*(x.item() for x in row))
                for row in zip(*_numbered(found, "step"), strict=True)
            ]
            there = [found.get(f"problem {k}", leaf) for k, leaf in enumerate(self._start)]
            costs = float(found["initial_cost"]), float(found["total_s"])
            problem = jax.tree.unflatten(self._tree, there).replace(labels=self._labels)
            return Saved(problem, found["away"], *costs, steps, _numbered(found, "carry"))
        # one array is a TypeError; flipped bytes may name another compression, or say that there is
        # a password
        except (
            OSError,
            LookupError,
            ValueError,
            TypeError,
            EOFError,
            RuntimeError,
            BadZipFile,
            zlib.error,
        ) as error:
            if isinstance(error, ProblemError):
                raise
            raise ProblemError(f"{self._path} is no checkpoint: {error}") from error

    @property
    def due(self) -> bool:
        """Whether the last one is old enough."""
        return time.monotonic() - self._last > EVERY_S

    def save(self, saved: Saved) -> None:
        """Replaces the file. Warns with a ProblemWarning if it cannot be written: the solve is
        worth more."""
        pairs = enumerate(zip(jax.tree.leaves(saved.problem), self._start, strict=True))
        parts: dict[str, Any] = {
            f"problem {k}": now for k, (now, start) in pairs if now is not start
        }
        parts |= {f"step {k}": column for k, column in enumerate(zip(*saved.steps, strict=True))}
        leaves = jax.tree.leaves(saved.carry._replace(state=None))
        parts |= {f"carry {k}": leaf for k, leaf in enumerate(leaves)}
        parts |= {
            "key": self._key,
            "away": saved.away,
            "initial_cost": saved.initial_cost,
            "total_s": saved.total_s,
        }
        try:
            with atomic_write(self._path) as file:
                np.savez(file, **parts)
        except OSError as error:
            text = f"cannot write {self._path}: {error.strerror or error}; the solve goes on"
            warnings.warn(text, ProblemWarning, stacklevel=2)
        self._last = time.monotonic()


def settings_text(policy: Any, options: SolveOptions, *more: Any) -> str:
    """What determines a solve besides its problem, the same in every process."""
    # `repr` has no weights of a network
    numbers = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(policy)]
    # functions by what they compute: each process has them at other addresses
    return re.sub(" at 0x[0-9a-f]+", "", repr((policy, numbers, options, *more)))


def _numbered(found: dict[str, np.ndarray], name: str) -> list[np.ndarray]:
    return [found[f"{name} {k}"] for k in range(sum(one.startswith(f"{name} ") for one in found))]
