"""Ctrl-C or SIGTERM while a long compiled program runs, in which Python handles no signals."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from jaxba.runtime.interrupt import EXIT_DELAY_S

pytestmark = pytest.mark.skipif(
    sys.platform == "win32", reason="Windows sends no SIGINT to another process"
)

BUSY = """
import hashlib
from jaxba.runtime.interrupt import Interrupt
with Interrupt("iteration", graceful=True):
    print("ready", flush=True)
    # many minutes in one call in which Python handles no signals
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
"""


@pytest.mark.parametrize(
    ("number", "again", "status", "last"),
    [
        (signal.SIGINT, "Ctrl-C again", 130, "interrupted"),
        (signal.SIGTERM, "another signal", 143, "terminated"),
    ],
)
def test_the_first_prints_a_message_and_the_second_ends_the_process(number, again, status, last):
    child = subprocess.Popen(
        [sys.executable, "-c", BUSY], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    with child:
        try:
            assert child.stdout is not None
            assert child.stderr is not None
            assert child.stdout.readline() == "ready\n"
            child.send_signal(number)
            assert (
                child.stderr.readline() == f"stopping after this iteration; {again} stops at once\n"
            )
            with pytest.raises(subprocess.TimeoutExpired):  # the first one alone does not end it
                child.wait(1.5 * EXIT_DELAY_S)
            child.send_signal(number)
            assert child.wait(60) == status
            assert child.stderr.read() == f"{last}\n"
        finally:
            child.kill()
