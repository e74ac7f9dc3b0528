"""Ctrl-C as a question: the work under way ends where nothing is lost."""

from __future__ import annotations

import signal
import sys


class Interrupt:
    """While `gentle`, the first Ctrl-C only sets `asked`, and the second is real; otherwise every one is real."""

    def __init__(self, unit: str, *, gentle: bool) -> None:
        """`unit`: what is finished first, in a word for the person who pressed the keys."""
        self.unit, self.gentle, self.asked = unit, gentle, False

    def __enter__(self) -> Interrupt:
        self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _handle(self, *_: object) -> None:
        if self.asked or not self.gentle:
            raise KeyboardInterrupt
        self.asked = True
        print(f"stopping after this {self.unit}; Ctrl-C again stops at once", file=sys.stderr)
