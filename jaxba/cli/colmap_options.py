"""COLMAP's names of options, as those of `jaxba-solve`.

Source: COLMAP 4.2, `colmap bundle_adjuster --help`; `BundleAdjustment.max_num_iterations` and the like are those of
COLMAP 3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from jaxba.cli.common import UsageError

PREFIXES = ("--BundleAdjustment.", "--BundleAdjustmentCeres.")


Option = Callable[[str], list[str]]
"""From the value of an option of COLMAP to arguments of `jaxba-solve`."""


def _flag(name: str, if_true: list[str], if_false: list[str]) -> Option:
    words = {"1": if_true, "true": if_true, "0": if_false, "false": if_false}

    def arguments(value: str) -> list[str]:
        if value.lower() not in words:
            raise UsageError(f"{name} must be 0 or 1, not {value!r}")
        return words[value.lower()]

    return arguments


def _same(option: str) -> Option:
    return lambda value: [option, value]


def _loss(value: str) -> list[str]:
    known = {"TRIVIAL": "squared", "SOFT_L1": "soft_l1", "CAUCHY": "cauchy", "HUBER": "huber"}
    if value.upper() not in known:
        raise UsageError(f"BundleAdjustmentCeres.loss_function_type must be one of {', '.join(known)}, not {value!r}")
    return ["--loss", known[value.upper()]]


def _constant(what: str) -> list[str]:
    return ["--constant", what]


OPTIONS: dict[str, Option] = {
    "refine_focal_length": _flag("refine_focal_length", [], _constant("focal")),
    "refine_principal_point": _flag("refine_principal_point", ["--refine-principal-point"], []),
    "refine_extra_params": _flag("refine_extra_params", [], _constant("distortion")),
    "refine_points3D": _flag("refine_points3D", [], _constant("points")),
    "refine_rig_from_world": _flag("refine_rig_from_world", [], _constant("frames")),
    "refine_sensor_from_rig": _flag("refine_sensor_from_rig", [], _constant("extrinsics")),
    "refine_extrinsics": _flag("refine_extrinsics", [], _constant("poses")),
    "constant_rig_from_world_rotation": _flag("constant_rig_from_world_rotation", _constant("frame-rotations"), []),
    "max_num_iterations": _same("--max-iterations"),
    "function_tolerance": _same("--ftol"),
    "gradient_tolerance": _same("--gtol"),
    "parameter_tolerance": _same("--xtol"),
    "loss_function_type": _loss,
    "loss_function_scale": _same("--loss-scale"),
}
"""Options of COLMAP's bundle adjustment by name."""

PATHS = {"--input_path": None, "--output_path": "--output"}
"""COLMAP's paths; the problem is a positional argument here."""


def translated(argv: Sequence[str]) -> list[str]:
    """A command line with COLMAP's options replaced. Its constants are gathered in one `--constant`.

    Raises:
        UsageError: an option of COLMAP that has no meaning here, or no value; one line.
    """
    found, paths, constants, words = [], [], [], list(argv)
    while words:
        word = words.pop(0)
        if word == "--constant":  # gathered with those of COLMAP's options
            while words and not words[0].startswith("--"):
                constants.append(words.pop(0))
            continue
        name, equals, value = word.partition("=")
        if name not in PATHS and not name.startswith(PREFIXES):
            found.append(word)
            continue
        if not equals:
            if not words:
                raise UsageError(f"{name} needs a value")
            value = words.pop(0)
        if name in PATHS:
            option = PATHS[name]
            paths += [value] if option is None else []
            found += [] if option is None else [option, value]
            continue
        own = name.rpartition(".")[2]
        if own not in OPTIONS:
            raise UsageError(f"{name} is not an option here; of COLMAP's are {', '.join(OPTIONS)}")
        arguments = OPTIONS[own](value)
        if arguments[:1] == ["--constant"]:
            constants += arguments[1:]
        else:
            found += arguments
    return [*paths, *found, *(["--constant", *constants] if constants else [])]
