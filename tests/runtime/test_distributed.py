"""Bad input to the start of several processes and devices. Training and solves have the tests with
two of them."""

from __future__ import annotations

import socket

import jax
import pytest

from jaxba.runtime import distributed
from jaxba.typing import InputError


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("localhost:1234", 2, None), "must be given together"),
        ((None, None, 1), "must be given together"),
        (("localhost", 2, 1), "coordinator must be HOST:PORT, not 'localhost'"),
        (("localhost:port", 2, 1), "coordinator must be HOST:PORT, not 'localhost:port'"),
        (("localhost:1234", 2, 2), "process 2 is none of 0 to 1"),
    ],
)
def test_what_does_not_name_a_process_is_one_line(arguments, message):
    with pytest.raises(InputError, match=message) as caught:
        distributed.initialize(*arguments)
    assert "\n" not in str(caught.value)


def test_a_port_that_is_taken_is_named():
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        address = f"localhost:{taken.getsockname()[1]}"
        with pytest.raises(InputError, match=f"{address}: Address already in use"):
            distributed.initialize(address, 2, 0)


def test_more_devices_than_there_are_and_none_are_one_line():
    count = len(jax.local_devices())
    with pytest.raises(
        InputError, match=rf"{count + 1} devices asked for, {count} of kind \w+ found"
    ):
        distributed.use_devices(count + 1)
    with pytest.raises(InputError, match="at least one device is needed, not 0"):
        distributed.use_devices(0)


def test_one_process_is_the_main_one_and_has_what_it_found():
    assert distributed.is_main()
    assert distributed.together(lambda: 3) == 3
    assert distributed.use_devices(None) == jax.devices()[:1]
