"""Values in a file of constraints: what each key may hold, with one line in the file's own words if
it does not.

The file is read as text alone: `000010` is a name, and a number where a number is meant."""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.problem.checks import SHOWN
from jaxba.problem.image_names import named_images
from jaxba.problem.losses import Loss
from jaxba.problem.row_data import is_positive

NAMED = 3  # names that a message gives of a longer list


def names_of(names: Sequence[str]) -> str:
    """Some names of a list, as text."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def meant(items: Sequence[str], names: Container[str] = ()) -> list[Any]:
    """What items of the file mean: of each text a name if there is such a one, else an id or a
    position.

    Only the plain form of a number is one: `000010` and `0x10` are not, in contrast to YAML's
    rules."""
    numbers = {
        item for item in items if re.fullmatch(r"0|[1-9]\d*", item, re.ASCII) and item not in names
    }
    return [int(item) if item in numbers else item for item in items]


def parse_items(value: Any, what: str) -> list[str]:
    """A list of names or ids; one alone counts as a list, nothing as an empty one. Raises
    ValueError: one line."""
    items = value if isinstance(value, list) else [value] if value != "" else []
    for item in items:
        if not isinstance(item, str) or not item:
            raise ValueError(
                f"must be a list ({what}), not {_written(value if items is not value else item)}"
            )
    return items


def parse_mapping(value: Any, needed: Sequence[str], others: Sequence[str] = ()) -> dict[str, Any]:
    """A mapping with all of some keys, and no more than some others. Raises ValueError: something
    else; one line."""
    keys = (*needed, *others)
    if not isinstance(value, dict):
        raise ValueError(
            f"must be a mapping with the keys {', '.join(keys)}, not {_written(value)}"
        )
    unknown = [key for key in value if key not in keys]
    if unknown:
        raise ValueError(f"unknown key {_written(unknown[0])}; there are {', '.join(keys)}")
    if missing := [key for key in needed if key not in value]:
        raise ValueError(f"{missing[0]!r} is missing")
    return value


def parse_vectors(
    value: Any, name: str, kind: str, needed: Sequence[str] = (), others: Sequence[str] = ()
) -> tuple[list[list[str]], dict[str, Any]]:
    """Images or points, with a vector of each, such as `positions`, and standard deviations along
    x, y and z: `stddev` is one number, three, a mapping from each image or point to one or three,
    or a list of these in the order of the vectors. Raises ValueError: something else; one line that
    names the key and the image or point."""
    parse_mapping(value, [name, *needed], ["stddev", "loss", "loss_scale", *others])
    given = value[name]
    if not isinstance(given, dict) or not given:
        raise ValueError(
            f"{name}: must be a mapping from {kind}s to [x, y, z], not {_written(given)}"
        )
    items = parse_items(list(given), f"names or ids of {kind}s")
    vectors = [
        parse_numbers(f"{name}: {item}", place, "three numbers", (3,))
        for item, place in given.items()
    ]
    return [[item] for item in items], {name: vectors, "stddev": parse_stddev(value, items, kind)}


def parse_pairs(
    value: Any, kind: str, shapes: dict[str, tuple[tuple[int, ...], ...]]
) -> tuple[list[list[str]], dict[str, Any]]:
    """A list of pairs of images or points, and numbers of some shapes. Raises ValueError: something
    else; one line."""
    if not isinstance(value, list) or not value:
        raise ValueError(f"must be a list of mappings, not {_written(value)}")
    pairs = []
    columns = {name: [] for name in shapes}
    for item in value:
        pairs.append(
            parse_items(parse_mapping(item, [f"{kind}s", *shapes])[f"{kind}s"], f"two {kind}s")
        )
        if len(pairs[-1]) != 2 or pairs[-1][0] == pairs[-1][1]:
            raise ValueError(f"{kind}s: must be two, not {_written(item[f'{kind}s'])}")
        for name, allowed in shapes.items():
            what = " or ".join(f"{shape[0]} numbers" if shape else "a number" for shape in allowed)
            columns[name].append(
                parse_numbers(f"{', '.join(pairs[-1])}: {name}", item[name], what, *allowed)
            )
            if name in ("stddev", "length") and not is_positive(columns[name][-1][None]).all():
                raise ValueError(
                    f"{', '.join(pairs[-1])}: {name}: must be positive, not {_written(item[name])}"
                )
    return pairs, columns


def parse_loss(value: dict[str, Any]) -> Loss:
    """The loss of a mapping. Raises ValueError: there is no such loss; one line."""
    scale = parse_numbers("loss_scale", value.get("loss_scale", "1"), "a number", ())
    return Loss(value.get("loss", "squared"), float(scale))


def _written(value: Any) -> str:
    """A value as the file has it, on one line and not too long."""
    if isinstance(value, list):
        text = f"[{', '.join(map(_written, value))}]"
    elif isinstance(value, dict):
        text = f"{{{', '.join(f'{key}: {_written(item)}' for key, item in value.items())}}}"
    else:
        text = " ".join(str(value).split()) or "nothing"
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def parse_stddev(
    value: dict[str, Any], names: list[str], kind: str, *, partly: bool = False
) -> Float[np.ndarray, "n 3"]:
    """Standard deviations of images or points; 1 if nothing is said.

    Args:
        value: the mapping that may have the key `stddev`.
        names: what it calls the images or points.
        kind: which they are.
        partly: whether some may be missing, which are NaN.

    Raises:
        ValueError: something else; one line."""
    given = value.get("stddev", "1")
    if isinstance(given, list) and (
        len(given) != 3 or any(isinstance(item, list) for item in given)
    ):
        if len(given) != len(names):
            what = f"must be one number, three, or one or three for each of {len(names)} {kind}s"
            raise ValueError(f"stddev: {what}, not {len(given)} values")
        return np.stack(
            [
                parse_deviations(f"stddev: {name}", item)
                for name, item in zip(names, given, strict=True)
            ]
        )
    if not isinstance(given, dict):
        return np.tile(parse_deviations("stddev", given), (len(names), 1))
    if kind == "image":
        means = named_images(given, names).positions
        given = {names[means[key]] if key in means else key: item for key, item in given.items()}
    missing = [name for name in names if name not in given]
    if missing and not (partly and len(missing) < len(names)):
        raise ValueError(f"stddev: missing for {names_of(missing)}")
    none = np.full(3, np.nan)
    return np.stack(
        [
            parse_deviations(f"stddev: {name}", given[name]) if name in given else none
            for name in names
        ]
    )


def parse_deviations(where: str, value: Any) -> Float[np.ndarray, "3"]:
    numbers = parse_numbers(where, value, "a positive number, or three", (), (3,))
    if not is_positive(numbers[None]).all():
        raise ValueError(f"{where}: must be a positive number, or three, not {_written(value)}")
    return np.broadcast_to(numbers, 3)


def parse_numbers(
    where: str, value: Any, what: str, *shapes: tuple[int, ...]
) -> Float[np.ndarray, "..."]:
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


def parse_word(value: dict[str, Any], key: str) -> str:
    if not isinstance(value[key], str) or not value[key]:
        raise ValueError(f"{key}: must be a name, not {_written(value[key])}")
    return value[key]


def parse_crs(value: dict[str, Any]) -> str:
    """The coordinate system of the key `crs`, empty if there is none. Raises ValueError: it is no
    word; one line."""
    return parse_word(value, "crs") if "crs" in value else ""


def beside(where: str, value: dict[str, Any], key: str) -> Path:
    """The path that a key says, beside the file with which `where` begins."""
    return Path(where.rpartition(": ")[0]).parent / parse_word(value, key)


def parse_truth(where: str, value: Any) -> bool:
    known = {"true": True, "false": False}
    if not isinstance(value, str) or value.lower() not in known:
        raise ValueError(f"{where}: must be true or false, not {_written(value)}")
    return known[value.lower()]
