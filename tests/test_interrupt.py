"""Ctrl-C while a long program computes, where Python itself hears nothing."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no SIGINT to another process")

BUSY = """
import hashlib
from jaxba.cli.interrupt import Interrupt
with Interrupt("iteration", gentle={gentle}):
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # many minutes in one call that hears no signal
"""


@pytest.mark.parametrize("gentle", [True, False])
def test_the_first_is_answered_and_the_second_ends_a_program_that_hears_nothing(gentle):
    child = subprocess.Popen(
        [sys.executable, "-c", BUSY.format(gentle=gentle)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    with child:
        try:
            assert child.stdout is not None
            assert child.stderr is not None
            assert child.stdout.readline() == "ready\n"
            child.send_signal(signal.SIGINT)
            if gentle:
                assert child.stderr.readline() == "stopping after this iteration; Ctrl-C again stops at once\n"
            time.sleep(0.2)  # two signals that come at once are one
            assert child.poll() is None
            child.send_signal(signal.SIGINT)
            assert child.wait(60) == 130
            assert child.stderr.read() == "interrupted\n"
        finally:
            child.kill()
