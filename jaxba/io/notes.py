"""Notes of readers: what was left out of a problem, and what looks wrong in it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from jaxba.problem.bundle_problem import ProblemError, ProblemWarning


def report(notes: Iterable[str], *, strict: bool = False) -> None:
    """Warns of each note.

    Args:
        notes: one line each.
        strict: refuse the problem instead.

    Raises:
        ProblemError: the first note, if `strict`.
    """
    for note in notes:
        if strict:
            raise ProblemError(note)
        warnings.warn(note, ProblemWarning, stacklevel=3)


@contextmanager
def told(tell: Callable[[str], object]) -> Iterator[None]:
    """Hands the notes of everything that is read inside to a function, at once and each time; other warnings are shown
    as before."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", ProblemWarning)
        show = warnings.showwarning

        def note(message: Warning | str, category: type[Warning], *where: object, **more: object) -> None:
            if issubclass(category, ProblemWarning):
                tell(str(message))
            else:
                show(message, category, *where, **more)  # type: ignore[arg-type]

        warnings.showwarning = note
        yield
