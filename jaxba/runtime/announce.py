"""Work that takes long is announced: by the logger `jaxba.progress`, after two seconds.

Without further settings Python shows that on stderr;
`logging.getLogger("jaxba.progress").setLevel("ERROR")` keeps it quiet. The commands, which show
progress of their own, do so."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

LONG_S = 2.0
"""Seconds of work that nobody wonders about."""

LOGGER = logging.getLogger("jaxba.progress")


@contextmanager
def announced(work: str) -> Iterator[None]:
    """A context of work that is announced if it takes longer than `LONG_S`.

    Args:
        work: what is done, such as `compiling programs`."""
    timer = threading.Timer(LONG_S, LOGGER.warning, [f"jaxba: {work} ..."])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def announce_nothing() -> None:
    """Keeps this process quiet."""
    LOGGER.setLevel(logging.ERROR)
