"""COLMAP's names of options, as those of `jaxba-solve`.

Source: COLMAP 4.2, `colmap bundle_adjuster --help`; `BundleAdjustment.*` is COLMAP 3's."""

from __future__ import annotations

from collections.abc import Sequence

from jaxba.cli.common import UsageError

PREFIXES = ("--BundleAdjustment.", "--BundleAdjustmentCeres.")

PATHS = ("--input_path", "--output_path")


def _constant(part: str, value: str = "0") -> dict[str, list[str]]:
    """A flag that holds a part constant at this value."""
    return {"0": [], "1": [], value: ["--constant", part]}


OPTIONS: dict[str, str | dict[str, list[str]]] = {
    "refine_focal_length": _constant("focal"),
    "refine_principal_point": {"0": [], "1": ["--refine-principal-point"]},
    "refine_extra_params": _constant("distortion"),
    "refine_points3D": _constant("points"),
    "refine_rig_from_world": _constant("frames"),
    "refine_sensor_from_rig": _constant("extrinsics"),
    "refine_extrinsics": _constant("poses"),
    "constant_rig_from_world_rotation": _constant("frame-rotations", "1"),
    "max_num_iterations": "--max-iterations",
    "function_tolerance": "--ftol",
    "gradient_tolerance": "--gtol",
    "parameter_tolerance": "--xtol",
    "loss_function_type": {
        "TRIVIAL": ["--loss", "squared"],
        "SOFT_L1": ["--loss", "soft_l1"],
        "CAUCHY": ["--loss", "cauchy"],
        "HUBER": ["--loss", "huber"],
    },
    "loss_function_scale": "--loss-scale",
    "min_track_length": {"0": [], "1": []},
}
"""Options of COLMAP's bundle adjustment by name: the option of the same meaning, or arguments for
each value."""

MACHINE = (
    *(
        "backend",
        "use_gpu",
        "gpu_index",
        "num_threads",
        "auto_select_solver_type",
        "max_linear_solver_iterations",
    ),
    *("min_num_images_gpu_solver", "min_num_residuals_for_cpu_multi_threading"),
    *(
        f"max_num_images_direct_{kind}_{where}_solver"
        for kind in ("dense", "sparse")
        for where in ("cpu", "gpu")
    ),
)
"""Those that say how and where Ceres solves its linear systems: accepted, and of no effect."""


def translated(argv: Sequence[str]) -> list[str]:
    """A command line with COLMAP's options replaced. All constants are gathered in one
    `--constant`. Raises UsageError: an option of COLMAP that has no meaning here, or no value; one
    line."""
    found = []
    paths = []
    constants = []
    words = list(argv)
    while words:
        word = words.pop(0)
        name, equals, value = word.partition("=")
        if word == "--constant":
            while words and not words[0].startswith("--"):
                constants.append(words.pop(0))
        elif name not in PATHS and not name.startswith(PREFIXES):
            found.append(word)
        else:
            if not equals and not words:
                raise UsageError(f"{name} needs a value")
            arguments = _arguments(name, value if equals else words.pop(0))
            whole = (
                {"--input_path": paths, "--constant": constants}.get(arguments[0])
                if arguments
                else None
            )
            if whole is None:
                found += arguments
            else:
                whole += arguments[1:]
    return [*paths, *found, *(["--constant", *constants] if constants else [])]


def _arguments(name: str, value: str) -> list[str]:
    """What stands for an option of COLMAP; its path of the input stays as it is."""
    if name in PATHS:
        return ["--output" if name == "--output_path" else name, value]
    own = name.rpartition(".")[2]
    if own in MACHINE:
        return []
    if own not in OPTIONS:
        raise UsageError(f"{name} is not an option here; of COLMAP's are {', '.join(OPTIONS)}")
    meaning = OPTIONS[own]
    if isinstance(meaning, str):
        return [meaning, value]
    known = {"true": "1", "false": "0"}.get(value.lower(), value.upper())
    if own == "min_track_length" and known not in meaning:
        raise UsageError(f"{name}: put part: {{min_track: {value}}} in the file of --constraints")
    if known not in meaning:
        raise UsageError(f"{own} must be {' or '.join(sorted(meaning))}, not {value!r}")
    return meaning[known]
