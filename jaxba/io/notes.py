"""Notes of readers: what was left out of a problem, and what is implausible in it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.io.files import StrPath, display_name
from jaxba.problem.bundle_problem import ProblemError, ProblemWarning

EDGE = 0.1
"""Share of the width or height of an image: a principal point as near to the border, or outside, is
implausible. Those of real lenses lie within a few percent of the middle; 0 is that of a calibration
left empty, or of another origin."""

# observations that must lie on one side of the origin for a note; with fewer it may be chance
LEAST_PIXELS = 16


def report(notes: Iterable[str], *, strict: bool = False) -> None:
    """Warns of each note in one line. Raises ProblemError: the first note, if `strict`."""
    for text in notes:
        if strict:
            raise ProblemError(text)
        warnings.warn(text, ProblemWarning, stacklevel=3)


@contextmanager
def notes_to(tell: Callable[[str], object]) -> Iterator[None]:
    """Hands the notes of all that is read inside to a function, at once and each time; shows other
    warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", ProblemWarning)
        show = warnings.showwarning

        def hand_on(
            message: Warning | str, category: type[Warning], *where: object, **more: object
        ) -> None:
            if issubclass(category, ProblemWarning):
                tell(str(message))
            else:
                show(message, category, *where, **more)  # type: ignore[arg-type]

        warnings.showwarning = hand_on
        yield


def counted(
    file: str,
    found: Sequence[Any] | np.ndarray,
    noun: str,
    what: str,
    name: Callable[..., str] = str,
) -> list[str]:
    """A line that counts the records of a file that were found (or positions of them), says
    something of them and names the first one; no line if there are none. `noun` is what one is
    called."""
    if not len(found):
        return []
    first = found[0].item() if isinstance(found, np.ndarray) else found[0]
    return [f"{file}: {len(found)} {noun}{'' if len(found) == 1 else 's'} {what} ({name(first)})"]


def note(path: StrPath, text: str) -> None:
    """Warns about a file; the message begins with its name."""
    report([f"{display_name(path)}: {text}"])


def note_unused(path: StrPath, counts: Mapping[str, int]) -> None:
    """Warns in one line of what a file holds and no reader uses, such as priors: how many, by their
    names."""
    there = [f"{what} ({count})" for what, count in counts.items() if count]
    if there:
        note(path, f"not used: {', '.join(there)}")


def note_center(
    path: StrPath, what: str, center: tuple[float, float], size: tuple[float, float]
) -> None:
    """Warns if a principal point, pixels from the corner, is not inside its image. `what` is its
    camera."""
    if any(
        not EDGE * extent <= at <= (1 - EDGE) * extent
        for at, extent in zip(center, size, strict=True)
    ):
        shown = f"({center[0]:g}, {center[1]:g}) of {size[0]:g} x {size[1]:g} pixels"
        note(
            path,
            f"the principal point of {what} lies at the edge of the image: {shown}; is the "
            "calibration its own?",
        )


def note_origin(path: StrPath, pixels: Float[np.ndarray, "n 2"]) -> None:
    """Warns if all pixels lie in one quadrant, as they do from a corner of the image; the formats
    have its centre."""
    x, y = pixels.T
    if len(pixels) >= LEAST_PIXELS and x.min() >= 0 and (y.min() >= 0 or y.max() <= 0):
        extent = f"x in {x.min():g}..{x.max():g}, y in {y.min():g}..{y.max():g}"
        note(
            path,
            f"pixels seem to be measured from a corner of the image ({extent}), not from its "
            "centre",
        )
