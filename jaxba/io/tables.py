"""Tables as spreadsheets and other programs write them: separators, decimal commas, units, cells
without a value."""

from __future__ import annotations

import csv
import re

import numpy as np
from jaxtyping import Bool, Float

from jaxba.io.text import finite_numbers

# what separates cells, in the order in which they are tried; if none does, blanks do
SEPARATORS = "\t;,"

NO_VALUE = frozenset(("", "-", "--", "?", "nan", "n/a", "na", "#n/a", "#nv", "none", "null", "nil"))
"""Cells that say that there is no value, in small letters."""

NO_NUMBER = (-999.0, -9999.0, -99999.0, -32767.0, -32768.0)
"""Numbers that stand for no value: no place on the earth is so low."""

# distance of a map's origin from positions, over their extent, from which it is none of them
FAR = 20.0

LEAST_POSITIONS = 3  # without which they have no extent

UNITS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **{"km": 1e3, "cm": 1e-2, "mm": 1e-3},
    **dict.fromkeys(("ft", "foot", "feet", "ift", "intlft", "internationalfeet"), 0.3048),
    **dict.fromkeys(
        ("usft", "ftus", "usfeet", "sft", "ussurveyfeet", "ussurveyfoot", "ussurveyft"), 1200 / 3937
    ),
    **dict.fromkeys(("deg", "degree", "degrees", "decimaldegree", "decimaldegrees", "dd"), 1.0),
    **dict.fromkeys(("rad", "radian", "radians"), 180 / np.pi),
}
"""Metres or degrees of a unit, by its letters. Feet are international, or those of US surveys until
2022 (NIST)."""

_FILE = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,3}$")
_NUMBER = re.compile(r"[-+]?[.,]?\d([\d.,]*\d)?\.?([eE][-+]?\d+)?")
_ANGLE = re.compile(
    r"([\d.]+)\s*(?:°|deg)?\s*(?:([\d.]+)\s*')?\s*(?:([\d.]+)\s*\")?\s*([NSEW])", re.IGNORECASE
)
_HEIGHT = re.compile(r"([-+]?[\d.,]+)\s*m(?:\s+(above|below) sea level)?", re.IGNORECASE)
_QUOTED = re.compile(r'"([^"]*)"|(\S+)')
_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]?")


def separator_of(line: str) -> str:
    """What separates the cells of a line; empty: blanks."""
    return next((mark for mark in SEPARATORS if line.count(mark) > 1), "")


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of a line, without blanks and quotes around them."""
    if not separator:
        return [quoted or word for quoted, word in _QUOTED.findall(line)]
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return [line]


def file_joined(words: list[str], at: int) -> list[str]:
    """Words with those from one on joined as far as the ending of a file, whose name may have
    blanks."""
    end = next((k for k in range(at, len(words)) if is_file(words[k])), at)
    return (
        [*words[:at], " ".join(words[at : end + 1]), *words[end + 1 :]]
        if at < len(words)
        else words
    )


def is_file(word: str) -> bool:
    """Whether a word ends as names of files do, such as `.JPG`."""
    return _FILE.search(word) is not None


def title_of(cell: str) -> tuple[str, float]:
    """The letters of a column's name without its unit, in small ones, and the unit; NaN: the name
    does not say it."""
    units = [letters(part) for part in _BRACKETS.findall(cell)]
    words = re.findall(r"[^\W\d_]+", _BRACKETS.split(cell)[0])
    if len(words) > 1 and words[-1].lower() in UNITS:
        units.append(words.pop().lower())
    return "".join(words).lower(), next((UNITS[unit] for unit in units if unit in UNITS), np.nan)


def letters(text: str) -> str:
    """The letters of a text, small."""
    return re.sub(r"[\W\d_]", "", text).lower()


def is_value(cell: str) -> bool:
    """Whether a cell is a number, or says that there is none."""
    return bool(_NUMBER.fullmatch(cell)) or cell.lower() in NO_VALUE


def value_of(cell: str, field: str, where: str) -> float:
    """The number of a cell, also with a decimal comma; NaN if it says that there is none. Raises
    ProblemError, beginning with `where`: it says something else."""
    if cell.strip().lower() in NO_VALUE:
        return np.nan
    plain = re.sub(r"[\s']", "", cell)
    last = max(plain.rfind(","), plain.rfind("."))
    mark = plain[last : last + 1]
    if "," in plain and plain.count(mark) == 1:
        plain = plain[:last].translate({ord(","): None, ord("."): None}) + "." + plain[last + 1 :]
    (number,) = finite_numbers([plain.replace(",", "") if "," in plain else plain], [field], where)
    return np.nan if number in NO_NUMBER else number


def plain(cell: str) -> str:
    """The number of a cell as ExifTool writes coordinates: `47 deg 18' 5.25" S`, `12.5 m Below Sea
    Level`."""
    angle = _ANGLE.fullmatch(cell)
    if angle is not None:
        parts = [float(part or 0) for part in angle.groups()[:3]]
        degrees = parts[0] + parts[1] / 60 + parts[2] / 3600
        return repr(-degrees if angle[4].upper() in "SW" else degrees)
    height = _HEIGHT.fullmatch(cell)
    if height is not None:
        return f"-{height[1]}" if height[2] and height[2].lower() == "below" else height[1]
    return cell


def has_fix(places: Float[np.ndarray, "n 3"], degrees: bool) -> Bool[np.ndarray, " n"]:
    """Which places are such: all numbers are there, and they are not those of a receiver without a
    fix.

    Those are latitude and longitude 0, or no angles; or x and y 0, far away from all others.

    Args:
        places: x, y and z, or longitude and latitude (degrees) and height; NaN where there is none.
        degrees: whether they are longitude and latitude."""
    there = np.asarray(np.isfinite(places).all(axis=1) & ~np.isin(places, NO_NUMBER).any(axis=1))
    zero = np.asarray((places[:, :2] == 0).all(axis=1))
    if degrees:
        return there & ~zero & (np.abs(places[:, :2]) <= [180.0, 90.0]).all(axis=1)
    others = places[there & ~zero, :2]
    if len(others) < LEAST_POSITIONS:
        return there
    middle = np.median(others, axis=0)
    extent = np.linalg.norm(others - middle, axis=1).max()
    return there & ~(zero & (np.linalg.norm(middle) > FAR * extent))
