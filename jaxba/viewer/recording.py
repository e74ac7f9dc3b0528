"""Recorded solves: the parameters after every accepted step, and what each iteration came to.

A recording is a NumPy archive (`.npz`) of the arrays of the problem and those of `Recording`. Of a
large problem it holds an even choice of the points, and the observations of these."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.io.files import StrPath, display_name, open_output, reason
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.camera_models import CAMERA_MODELS
from jaxba.problem.intrinsics import Lenses
from jaxba.problem.labels import Labels
from jaxba.solver.drivers import IterationRecord

RECORDED_POINTS = 20_000  # most points of a recording: a hundred iterations take some 20 MB
ENDING = ".npz"  # of the names of recordings


@dataclass(frozen=True)
class Recording:
    """A solve, iteration by iteration. Entry 0 of the per-iteration arrays is the start."""

    problem: BundleProblem  # the start, thinned
    whole: int  # number of points of the problem, recorded or not
    # cameras at the start and after each accepted step
    cameras: Float[np.ndarray, "states cameras parameters"]
    points: Float[np.ndarray, "states points 3"]  # the same of points
    state: Int[np.ndarray, " iterations"]  # position in `cameras` and `points` after each iteration
    cost: Float[np.ndarray, " iterations"]  # accepted cost after each iteration, pixels^2
    damping: Float[np.ndarray, " iterations"]  # lambda; NaN for the start
    # actual over predicted decrease; NaN for the start
    gain_ratio: Float[np.ndarray, " iterations"]
    time_s: Float[np.ndarray, " iterations"]  # seconds since the start
    source: str = ""  # where the problem was read

    @property
    def last(self) -> int:
        """The last iteration."""
        return len(self.state) - 1

    @property
    def accepted(self) -> Bool[np.ndarray, " iterations"]:
        """Whether the step of each iteration was accepted; true for the start."""
        return np.diff(self.state, prepend=-1) > 0

    def at(self, iteration: int) -> BundleProblem:
        """The thinned problem with the parameters after an iteration."""
        state = self.state[iteration]
        return self.problem.replace(cameras=self.cameras[state], points=self.points[state])


def evenly(count: int, limit: int) -> Int[np.ndarray, " kept"]:
    """At most `limit` of `count` positions, evenly spread."""
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).astype(np.int64)


def of_points(problem: BundleProblem, kept: Int[np.ndarray, " kept"]) -> BundleProblem:
    """A problem of some of the points, their observations and other rows, for looking at: without
    constants."""
    labels = problem.labels
    none = dict.fromkeys(("whitening", "constants", "rigs"))
    found = problem.replace(**none).subset(np.isin(problem.point_index, kept), points=kept)
    labels = labels and Labels(labels.names, labels.images, labels.lenses, labels.points[kept])
    return found.replace(cameras=np.asarray(problem.cameras), labels=labels)


def still(problem: BundleProblem) -> Recording:
    """A recording of no iterations, of the whole problem."""
    none = np.array([np.nan])
    zero = np.zeros(1)
    cameras = np.asarray(problem.cameras)
    points = np.asarray(problem.points)
    return Recording(
        problem, len(points), cameras[None], points[None], np.zeros(1, int), none, none, none, zero
    )


class Recorder:
    """What makes a recording: `watch` of `jaxba.solve`."""

    def __init__(
        self, problem: BundleProblem, source: str = "", limit: int = RECORDED_POINTS
    ) -> None:
        self._kept = evenly(problem.num_points, limit)
        self._problem, self._whole, self._source = (
            of_points(problem, self._kept),
            problem.num_points,
            source,
        )
        self._states = [(np.asarray(problem.cameras), np.asarray(problem.points)[self._kept])]
        self._rows = [(0, np.nan, np.nan, np.nan, 0.0)]

    def __call__(self, record: IterationRecord, now: Callable[[], BundleProblem]) -> None:
        """Records an iteration; `now` gives the problem with the parameters after it."""
        step = record.step
        if len(self._rows) == 1:
            self._rows[0] = (0, float(step.previous_cost), np.nan, np.nan, 0.0)
        if step.accepted:
            found = now()
            self._states.append((np.asarray(found.cameras), np.asarray(found.points)[self._kept]))
        numbers = float(step.cost), float(step.damping), float(step.gain_ratio), record.time_s
        self._rows.append((len(self._states) - 1, *numbers))

    def recording(self) -> Recording:
        """What was recorded so far."""
        cameras, points = zip(*self._states, strict=True)
        state, cost, damping, gain, seconds = map(np.array, zip(*self._rows, strict=True))
        states = state, cost, damping, gain, seconds
        return Recording(
            self._problem, self._whole, np.stack(cameras), np.stack(points), *states, self._source
        )


_ARRAYS = ("observations", "camera_index", "point_index")
_HISTORY = ("cameras", "state", "cost", "damping", "gain_ratio", "time_s")


def write_recording(recording: Recording, path: StrPath) -> None:
    """Writes a recording, whole or not at all; points are float32 from their middle. Raises
    ProblemError."""
    problem = recording.problem
    lenses = recording.problem.lenses
    middle = np.median(recording.points[-1], axis=0)
    limits = np.finfo(np.float32)
    arrays: dict[str, Any] = {name: getattr(problem, name) for name in _ARRAYS}
    arrays |= {name: getattr(recording, name) for name in _HISTORY}
    points = np.clip(recording.points - middle, limits.min, limits.max)  # some run away
    arrays |= {"points": points.astype(np.float32), "middle": middle}
    arrays |= {"whole": recording.whole, "source": recording.source}
    if lenses is not None:
        model = np.zeros(len(lenses.free), np.int32) if lenses.model is None else lenses.model
        arrays |= {"lens": lenses.index, "lens_free": lenses.free, "lens_model": model}
        arrays["lens_models"] = np.array([one.name for one in lenses.models])
    if problem.labels is not None:
        arrays["names"] = np.array(problem.labels.names)
    with open_output(path) as file:
        np.savez_compressed(file, **arrays)


def read_recording(path: StrPath) -> Recording:
    """Reads a recording. Raises ProblemError: it is not one of `jaxba-solve --record`; one line."""
    name = display_name(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {key: file[key] for key in file.files}
        lenses = None
        if "lens" in found:
            models = tuple(CAMERA_MODELS[str(one)] for one in found["lens_models"])
            lenses = Lenses(found["lens"], found["lens_free"], found["lens_model"], models)
        points = found["points"].astype(np.float64) + found["middle"]
        problem = BundleProblem.create(
            found["cameras"][0], points[0], *(found[key] for key in _ARRAYS), lenses=lenses
        )
        if "names" in found:
            ids = np.arange(problem.num_cameras)
            problem = problem.replace(
                labels=Labels(tuple(map(str, found["names"])), ids, ids[:0], ids[:0])
            )
        history: dict[str, Any] = {key: found[key] for key in _HISTORY}
        _check(problem, points, history, len(found.get("names", problem.cameras)))
        return Recording(
            problem, int(found["whole"]), points=points, source=str(found["source"]), **history
        )
    except OSError as error:
        raise ProblemError(f"cannot read {name}: {reason(error)}") from None
    # zipfile raises the RuntimeError, for a compression that a flipped byte names, or a password
    except (
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        EOFError,
        RuntimeError,
        zipfile.BadZipFile,
        zlib.error,
    ):
        raise ProblemError(f"{name}: is not a recording of jaxba-solve --record") from None


def _check(
    problem: BundleProblem, points: np.ndarray, history: dict[str, np.ndarray], names: int
) -> None:
    """Raises a ValueError if the parts of a recording do not fit each other."""
    state = history["state"]
    cameras = history["cameras"]
    rows = [
        history[key].shape == (len(state),)
        for key in ("state", "cost", "damping", "gain_ratio", "time_s")
    ]
    steps = np.diff(state, prepend=0)
    whole = (
        state.dtype.kind in "iu"
        and len(state)
        and state[0] == 0
        and ((steps == 0) | (steps == 1)).all()
    )
    shapes = cameras.shape[1:] == problem.cameras.shape and points.shape == (
        len(cameras),
        *problem.points.shape,
    )
    fit = (
        all(rows)
        and whole
        and shapes
        and state[-1] == len(cameras) - 1
        and names == problem.num_cameras
    )
    if not (fit and np.isfinite(cameras).all() and np.isfinite(points).all()):
        raise ValueError("the parts of the recording do not fit")
