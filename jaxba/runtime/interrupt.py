"""Ctrl-C and SIGTERM in a command: one line at the end, and work under way that is finished
first."""

from __future__ import annotations

import _thread
import os
import signal
import socket
import sys
import threading
import time
from types import FrameType
from typing import Any

INTERRUPTED = 128 + signal.SIGINT  # exit status after Ctrl-C, as shells define it
TERMINATED = 128 + signal.SIGTERM  # exit status after SIGTERM
# last line of a command that a signal has ended
ENDED = {INTERRUPTED: "interrupted", TERMINATED: "terminated"}
# and what stops at once after one
SIGNALS = {signal.SIGINT: "Ctrl-C again", signal.SIGTERM: "another signal"}
# seconds from a second signal to the end; Python handles none while a compiled program runs
EXIT_DELAY_S = 1.0
# seconds until a Ctrl-C that was lost in a callback is raised again, when the callback has ended
RAISE_AGAIN_S = 0.01
# byte that the handler sends to the thread when it raises KeyboardInterrupt; no signal's number
_HANDLED = 0


class Interrupt:
    """Context manager. While `graceful`, the first Ctrl-C or SIGTERM only sets `requested`, and the
    second raises KeyboardInterrupt; otherwise each one raises it. A signal that is ignored, as
    Ctrl-C is under `nohup`, stays so. Nothing is changed in a thread other than the first, where
    signals are not handled.

    With a `unit` a thread receives the signals as they arrive (`signal.set_wakeup_fd`). So even
    during a compiled program the first one prints a message, and the second ends the process: files
    are atomic."""

    status = 0  # exit status after the signal that came last; 0 before any

    def __init__(self, unit: str = "", *, graceful: bool = False) -> None:
        """Does nothing yet. `unit` is what is finished after the first signal, for the message,
        e.g. `iteration`. Without it, signals that have a handler already are left alone. `graceful`
        can be changed later."""
        self.unit = unit
        self.graceful = graceful
        self.requested = False
        # signals that the thread and the handler have seen; Python calls the handler once for
        # several signals
        self._received = 0
        self._handled = 0
        self._message = [True]  # empty when the message has been printed
        self._sender: socket.socket | None = None

    def __enter__(self) -> Interrupt:
        main_thread = threading.current_thread() is threading.main_thread()
        unhandled = (signal.default_int_handler, signal.SIG_DFL)

        def replaces(handler):
            return handler in unhandled or (self.unit != "" and handler is not signal.SIG_IGN)

        ours = [number for number in SIGNALS if main_thread and replaces(signal.getsignal(number))]
        self._previous = {number: signal.signal(number, self._handle) for number in ours}
        self._previous_hook, sys.unraisablehook = (
            sys.unraisablehook,
            self._raise_again if ours else sys.unraisablehook,
        )
        if not (ours and self.unit):
            return self
        self._receiver, self._sender = socket.socketpair()
        self._sender.setblocking(False)
        self._previous_wakeup = signal.set_wakeup_fd(
            self._sender.fileno(), warn_on_full_buffer=False
        )
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        sys.unraisablehook = self._previous_hook
        if self._sender is not None:
            signal.set_wakeup_fd(self._previous_wakeup)
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        if self._sender is not None:
            self._sender.close()
            self._thread.join()
            self._receiver.close()

    def _listen(self) -> None:
        """Runs in the thread: receives signals until the socket is closed."""
        deadline = None
        while True:
            self._receiver.settimeout(
                None if deadline is None else max(1e-3, deadline - time.monotonic())
            )
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
            if self._sender is not None:
                self._sender.send(bytes([_HANDLED]))
            before = self._previous[signal.Signals(number)]
            if callable(before):
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
        print(
            f"stopping after this {self.unit}; {again} stops at once", file=sys.stderr, flush=True
        )

    def _raise_again(self, lost: Any) -> None:
        """Python drops an exception in a callback of the garbage collector, of which JAX has one:
        raise it later."""
        if lost.exc_type is KeyboardInterrupt:
            threading.Timer(RAISE_AGAIN_S, _thread.interrupt_main, [self.status - 128]).start()
        else:
            self._previous_hook(lost)
