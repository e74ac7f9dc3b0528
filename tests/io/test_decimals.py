"""Decimal numbers: blocks are parsed as their words are one by one, and what is written reads back
bit by bit."""

from __future__ import annotations

import itertools
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxba.io import decimals
from jaxba.io.decimals import number_lines, observation_lines, parse

# What the documents of BAL and C's strtod call a decimal number, with Fortran's exponents
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eEdD][+-]?[0-9]+)?")
FINITE = st.floats(allow_nan=False, allow_infinity=False)


@pytest.fixture(params=[0, decimals.SMALL], ids=["large", "small"], scope="module", autouse=True)
def written_size(request):
    """Both ways of writing, whatever the number of numbers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decimals, "SMALL", request.param)
        yield


def expected(text: str) -> tuple[list[float], str | None]:
    """The numbers of a text by Python's `float`, word by word, and what is wrong with the next
    word."""
    found = []
    for word in text.split():
        if not NUMBER.fullmatch(word):
            return found, "is not a number"
        value = float(word.lower().replace("d", "e"))
        if math.isinf(value):
            return found, "is not a finite number"
        found.append(value)
    return found, None


def assert_parsed(text: str) -> None:
    good, wrong = expected(text)
    for large in (False, True):
        values, complaint = parse(text.encode(), large=large)
        assert (values.tobytes(), complaint) == (np.array(good, np.float64).tobytes(), wrong), text


@given(st.text(alphabet="0123456789+-.eEdDx_ \n\t", max_size=40))
def test_a_block_is_parsed_as_its_words_are(text):
    assert_parsed(text)


@pytest.mark.parametrize("around", ["{}", "1 {}", "{}\n1", " {}\r\n", "1\t{} 2\n"])
def test_every_short_word_is_a_number_or_refused_as_it_is_alone(around):
    for length in range(1, 6 if around == "{}" else 4):
        for letters in itertools.product("07+-.e", repeat=length):
            assert_parsed(around.format("".join(letters)))


@given(
    st.lists(
        st.tuples(FINITE, st.sampled_from(["{!r}", "{:.17e}", "{:.3E}", "{:+.20g}", "{:f}"])),
        min_size=1,
    )
)
def test_numbers_in_every_form_are_rounded_correctly(numbers):
    assert_parsed(" ".join(form.format(value) for value, form in numbers))


def test_words_halfway_between_two_numbers_are_rounded_to_even():
    rng = np.random.default_rng(0)
    values = rng.integers(0, 0x7FE0 << 48, size=300, dtype=np.uint64).view(np.float64)
    halves = [value.as_integer_ratio() for value in values.tolist()]
    steps = [math.ulp(value).as_integer_ratio() for value in values.tolist()]
    words = []
    for (over, under), (step_over, step_under) in zip(halves, steps, strict=True):
        # the value and half a step
        top = 2 * over * step_under + under * step_over
        bottom = 2 * under * step_under
        shift = max(bottom.bit_length() - 1, 0)  # a power of two: exact with so many decimal digits
        digits = str(top * 5**shift * 2**shift // bottom).rjust(shift + 1, "0")
        words.append(f"{digits[: len(digits) - shift]}.{digits[len(digits) - shift :]}")
    assert_parsed("\n".join(words))


@given(st.lists(FINITE, min_size=1))
def test_written_numbers_read_back_bit_by_bit_in_the_fewest_digits(values):
    lines = number_lines(np.array(values)).decode().split()
    assert np.array(list(map(float, lines))).tobytes() == np.array(values).tobytes()

    def count(word):
        return len(word.lstrip("-").partition("e")[0].replace(".", "").strip("0"))

    assert list(map(count, lines)) == [count(repr(value)) for value in values]


@given(
    st.lists(
        st.tuples(st.integers(0, 2**31 - 2), st.integers(0, 2**31 - 2), FINITE, FINITE), min_size=1
    )
)
def test_lines_of_observations_hold_two_integers_and_a_pixel(rows):
    cameras, points, x, y = map(np.array, zip(*rows, strict=True))
    text = observation_lines(
        cameras.astype(np.int32), points.astype(np.int32), np.stack([x, y], axis=1)
    )
    words = [line.split(" ") for line in text.decode().splitlines()]
    assert [(int(camera), int(point)) for camera, point, _, _ in words] == [row[:2] for row in rows]
    pixels = np.array([[float(x), float(y)] for _, _, x, y in words])
    assert pixels.tobytes() == np.stack([x, y], axis=1).tobytes()
