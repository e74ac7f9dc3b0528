"""What a command does before anything else is imported, which takes a second: Ctrl-C ends it with one line."""

import os
import signal
import sys

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells define it."""


COMMANDS = tuple(f"jaxba-{name}" for name in ("bench", "data", "kitti", "paper", "solve", "train", "view"))
"""Names of the commands."""


def quiet_interrupt() -> None:
    """If this process is one of the commands: until `jaxba.cli.common.run_command` begins, Ctrl-C ends it at once.

    Nothing has been begun by then. Processes that import jaxba for themselves are left alone.
    """
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    if name.removesuffix(".exe") in COMMANDS and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, on_early_interrupt)


def on_early_interrupt(*_: object) -> None:
    """The handler of Ctrl-C while a command starts."""
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)
