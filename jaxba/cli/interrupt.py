"""Ctrl-C as a question: the work under way ends where nothing is lost."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time

from jaxba.cli.common import INTERRUPTED

PATIENCE_S = 1.0
"""Seconds after which a second Ctrl-C ends the process, where Python has not come to hear of it. It hears nothing while
a compiled program runs."""

_HEARD = 0
"""What Python tells the thread once a Ctrl-C became an exception; no signal has this number."""


class Interrupt:
    """While `gentle`, the first Ctrl-C only sets `asked`, and the second is real; otherwise every one is real.

    Signals are told to a thread as they come (`signal.set_wakeup_fd`), so that the first is answered, and the second
    ends the process, in the middle of a long program too. What commands write is a whole file or none.
    """

    def __init__(self, unit: str, *, gentle: bool) -> None:
        """`unit`: what is finished first, in a word for the person who pressed the keys."""
        self.unit, self.gentle, self.asked = unit, gentle, False
        self._came, self._heard = 0, 0  # signals: told to the thread, and to Python, which takes several for one
        self._untold = [True]

    def __enter__(self) -> Interrupt:
        self._ear, mouth = socket.socketpair()
        mouth.setblocking(False)
        self._mouth = mouth
        self._before = signal.signal(signal.SIGINT, self._handle)
        self._mouth_before = signal.set_wakeup_fd(mouth.fileno(), warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        signal.set_wakeup_fd(self._mouth_before)
        signal.signal(signal.SIGINT, self._before)
        self._mouth.close()
        self._thread.join()
        self._ear.close()

    def _listen(self) -> None:
        """In the thread: counts signals until the other end is closed."""
        deadline = None
        while True:
            self._ear.settimeout(None if deadline is None else max(1e-3, deadline - time.monotonic()))
            try:
                numbers = self._ear.recv(1)
            except TimeoutError:
                print("interrupted", file=sys.stderr, flush=True)
                os._exit(INTERRUPTED)
            if not numbers:
                return
            if numbers[0] == _HEARD:
                deadline = None
            elif numbers[0] == signal.SIGINT:
                self._came += 1
                if self._came > 1:
                    deadline = deadline or time.monotonic() + PATIENCE_S
                elif self.gentle:
                    self._ask()

    def _handle(self, *_: object) -> None:
        """In Python's own time; once for several signals that came meanwhile."""
        self._heard += 1
        if not self.gentle or max(self._heard, self._came) > 1:
            self._mouth.send(bytes([_HEARD]))
            raise KeyboardInterrupt
        self._ask()

    def _ask(self) -> None:
        self.asked = True
        try:
            self._untold.pop()  # one thread gets it
        except IndexError:
            return
        print(f"stopping after this {self.unit}; Ctrl-C again stops at once", file=sys.stderr, flush=True)
