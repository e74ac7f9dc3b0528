"""Handles Ctrl-C and SIGTERM so that the work under way is finished first and nothing is lost."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from types import FrameType

from jaxba.cli.common import ENDED, INTERRUPTED

EXIT_DELAY_S = 1.0
"""Seconds after a second signal until the process is ended, if Python has not handled it by then. Python handles no
signals while a compiled program runs."""

SIGNALS = {signal.SIGINT: "Ctrl-C again", signal.SIGTERM: "another signal"}
"""The signals, and what after one of them stops at once."""

_HANDLED = 0
"""Byte that the signal handler sends to the thread when it raises KeyboardInterrupt; no signal has this number."""


class Interrupt:
    """Context manager. While `graceful`, the first Ctrl-C or SIGTERM only sets `requested`, and the second raises
    KeyboardInterrupt; otherwise each one raises it. A signal that is ignored, as Ctrl-C is under `nohup`, stays so.

    A thread receives the signals as they arrive (`signal.set_wakeup_fd`). So even during a long compiled program the
    first one prints a message, and the second ends the process. Ending it is safe, since commands write files
    atomically.
    """

    status = INTERRUPTED
    """Exit status of a command that ends because of the signal that came last."""

    def __init__(self, unit: str, *, graceful: bool, announce: bool = True) -> None:
        """Does nothing yet.

        Args:
            unit: what is finished after the first signal, for the message, e.g. `iteration`.
            graceful: initial value of the attribute, which can be changed later.
            announce: whether to print that message.
        """
        self.unit, self.graceful, self.requested = unit, graceful, False
        # signals that the thread and the handler have seen; Python calls the handler once for several signals
        self._received, self._handled = 0, 0
        self._message = [True] * announce  # empty when the message has been printed

    def __enter__(self) -> Interrupt:
        self._receiver, sender = socket.socketpair()
        sender.setblocking(False)
        self._sender = sender
        ours = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
        self._previous = {number: signal.signal(number, self._handle) for number in ours}
        self._previous_wakeup = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        signal.set_wakeup_fd(self._previous_wakeup)
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._sender.close()
        self._thread.join()
        self._receiver.close()

    def _listen(self) -> None:
        """Runs in the thread: receives signals until the socket is closed."""
        deadline = None
        while True:
            self._receiver.settimeout(None if deadline is None else max(1e-3, deadline - time.monotonic()))
            try:
                numbers = self._receiver.recv(1)
            except TimeoutError:
                print(ENDED[self.status], file=sys.stderr, flush=True)
                os._exit(self.status)
            if not numbers:
                return
            if numbers[0] == _HANDLED:
                deadline = None
            elif numbers[0] in self._previous:
                self._received += 1
                self.status = 128 + numbers[0]
                if self._received > 1 or (numbers[0] == signal.SIGTERM and not self.graceful):
                    deadline = deadline or time.monotonic() + EXIT_DELAY_S
                elif self.graceful:
                    self._request(numbers[0])

    def _handle(self, number: int, frame: FrameType | None) -> None:
        """The signal handler, which Python calls in the main thread between two instructions."""
        self._handled += 1
        self.status = 128 + number
        if not self.graceful or max(self._handled, self._received) > 1:
            self._sender.send(bytes([_HANDLED]))
            if callable(before := self._previous[signal.Signals(number)]):
                before(number, frame)
            raise KeyboardInterrupt
        self._request(number)

    def _request(self, number: int) -> None:
        self.requested = True
        try:
            self._message.pop()  # succeeds in one of the two threads only
        except IndexError:
            return
        again = SIGNALS[signal.Signals(number)]
        print(f"stopping after this {self.unit}; {again} stops at once", file=sys.stderr, flush=True)
