"""Values in the file of `--constraints`: what each key may hold, with one line in the file's own words if it does not.

The file is read as text alone: `000010` is a name, and a number where a number is meant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.problem.checks import SHOWN
from jaxba.problem.losses import Loss

NAMED = 3
"""Names that a message gives of a longer list."""

PARTS = ("positions", "stddev", "loss", "loss_scale", "align")
"""Keys of `position_priors`."""


def names_of(names: Sequence[str]) -> str:
    """Some names of a list, as text."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def parse_items(value: Any, what: str) -> list[str]:
    """A list of names or ids; one alone counts as a list, an empty value as an empty one.

    Raises:
        ValueError: something else; one line.
    """
    items = value if isinstance(value, list) else [value] if value != "" else []
    for item in items:
        if not isinstance(item, str) or not item:
            raise ValueError(f"must be a list ({what}), not {_written(value if items is not value else item)}")
    return items


def parse_position_priors(value: Any) -> tuple[list[str], Float[np.ndarray, "2 n 3"], dict[str, Any]]:
    """The value of `position_priors`: names or ids of images, their positions and standard deviations along x, y and z,
    and the arguments `loss` and `align` of `with_position_priors`.

    `stddev` is one number, three (x, y, z), a mapping from each image to one or three, or a list of these in the order
    of the positions.

    Raises:
        ValueError: something that this cannot be; one line that names the key and the image.
    """
    if not isinstance(value, dict):
        raise ValueError(f"must be a mapping with the keys {', '.join(PARTS)}, not {_written(value)}")
    unknown = [key for key in value if key not in PARTS]
    if unknown:
        raise ValueError(f"unknown key {_written(unknown[0])}; there are {', '.join(PARTS)}")
    if "positions" not in value:
        raise ValueError("'positions' is missing")
    given = value["positions"]
    if not isinstance(given, dict) or not given:
        raise ValueError(f"positions: must be a mapping from images to [x, y, z], not {_written(given)}")
    images = parse_items(list(given), "names or ids of images")
    places = [_numbers(f"positions: {image}", place, "three numbers", (3,)) for image, place in given.items()]
    stddev = _stddev(value.get("stddev", "1"), images)
    scale = _numbers("loss_scale", value.get("loss_scale", "1"), "a number", ())
    loss, align = Loss(value.get("loss", "squared"), float(scale)), _truth("align", value.get("align", "true"))
    return images, np.stack([places, stddev]), {"loss": loss, "align": align}


def _written(value: Any) -> str:
    """A value as the file has it, on one line and not too long."""
    if isinstance(value, list):
        text = f"[{', '.join(map(_written, value))}]"
    elif isinstance(value, dict):
        text = f"{{{', '.join(f'{key}: {_written(item)}' for key, item in value.items())}}}"
    else:
        text = " ".join(str(value).split()) or "nothing"
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def _stddev(value: Any, images: list[str]) -> Float[np.ndarray, "n 3"]:
    """Standard deviations of each image."""
    if isinstance(value, list) and (len(value) != 3 or any(isinstance(one, list) for one in value)):
        if len(value) != len(images):
            what = f"must be one number, three, or one or three for each of {len(images)} images"
            raise ValueError(f"stddev: {what}, not {len(value)} values")
        value = dict(zip(images, value, strict=True))
    if not isinstance(value, dict):
        return np.tile(_deviations("stddev", value), (len(images), 1))
    missing = [image for image in images if image not in value]
    if missing:
        raise ValueError(f"stddev: missing for {names_of(missing)}")
    return np.stack([_deviations(f"stddev: {image}", value[image]) for image in images])


def _deviations(where: str, value: Any) -> Float[np.ndarray, "3"]:
    numbers = _numbers(where, value, "a positive number, or three", (), (3,))
    if not (numbers > 0).all():
        raise ValueError(f"{where}: must be a positive number, or three, not {_written(value)}")
    return np.broadcast_to(numbers, 3)


def _numbers(where: str, value: Any, what: str, *shapes: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Finite numbers, also written as text."""
    single = not isinstance(value, list)
    try:
        if not all(isinstance(one, str) for one in ([value] if single else value)):
            raise TypeError
        numbers = np.array(float(value) if single else [float(one) for one in value])
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(np.nan)
    if numbers.shape not in shapes or not np.isfinite(numbers).all():
        raise ValueError(f"{where}: must be {what}, not {_written(value)}")
    return numbers


def _truth(where: str, value: Any) -> bool:
    known = {"true": True, "false": False}
    if not isinstance(value, str) or value.lower() not in known:
        raise ValueError(f"{where}: must be true or false, not {_written(value)}")
    return known[value.lower()]
