"""Long work is announced, short work is not."""

from __future__ import annotations

import logging
import time

import pytest

import jaxba
from jaxba.runtime import announce
from jaxba.runtime.announce import announced


@pytest.fixture
def heard(caplog, monkeypatch):
    monkeypatch.setattr(announce, "LONG_S", 0.05)
    level = announce.LOGGER.level
    announce.LOGGER.setLevel(logging.WARNING)
    yield caplog
    announce.LOGGER.setLevel(level)


def test_long_work_is_announced_once(heard):
    with announced("thinking"):
        time.sleep(0.2)
    assert heard.messages == ["jaxba: thinking ..."]


def test_short_and_failed_work_is_not_announced(heard):
    with pytest.raises(KeyError), announced("thinking"):
        raise KeyError
    time.sleep(0.1)
    assert heard.messages == []


def test_the_logger_can_be_kept_quiet(heard):
    announce.announce_nothing()
    with announced("thinking"):
        time.sleep(0.1)
    assert heard.messages == []


def test_a_solve_says_that_it_compiles(heard):
    problem = jaxba.random_scene(jaxba.SceneConfig(5, 37, 150), 0)
    options = jaxba.SolveOptions(max_iterations=1, pad=False)
    jaxba.solve(problem, "classic", options)
    assert "jaxba: compiling programs for a problem of this kind and size ..." in heard.messages
