"""What `pycolmap.BundleAdjustmentOptions` say, for pycolmap 3.12 to 4.2.

COLMAP 4 keeps what is Ceres' in a group `ceres`; COLMAP 3 has it beside the others, and lacks the
newer options."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from typing import Any

from jaxba.problem.checks import shown
from jaxba.problem.losses import Loss

READ = {
    *("refine_focal_length", "refine_principal_point", "refine_extra_params", "refine_points3D"),
    *("refine_rig_from_world", "refine_sensor_from_rig", "constant_rig_from_world_rotation"),
    *("min_track_length", "loss_function_type", "loss_function_scale"),
    *("solver_options.function_tolerance", "solver_options.gradient_tolerance"),
    *("solver_options.parameter_tolerance", "solver_options.max_num_iterations"),
    "solver_options.max_solver_time_in_seconds",
}
"""Options that mean here what they mean in COLMAP, by name, without the group `ceres`."""

HOW = re.compile(
    r"print_summary|backend|use_gpu|gpu_index|auto_select_solver_type|min_num_.*|max_num_images_.*"
    r"|solver_options\.(?!min_trust_region_radius|max_num_consecutive_invalid_steps).*"
    r"|caspar\.(gpu_index|pcg_.*|diag_(init|min|scaling_.*))"
)
"""Names of options that say how and where COLMAP computes, but neither what is optimised nor when
it stops."""


def options_of(options: Any) -> Any:
    """Options as pycolmap's object. Raises ValueError: they are something else, or have other
    names; one line.

    Args:
        options: a `pycolmap.BundleAdjustmentOptions`, or a dictionary of its values by name, in
            which groups are dictionaries; None: COLMAP's defaults."""
    if options is None or isinstance(options, Mapping):
        return _made(options or {})
    if not hasattr(options, "refine_focal_length"):
        kinds = "a pycolmap.BundleAdjustmentOptions or a dictionary of its values"
        raise ValueError(f"options must be {kinds}, not {shown(options)}")
    return options


def _made(values: Mapping[str, Any]) -> Any:
    """pycolmap's object of a dictionary. Raises ValueError: as `options_of`."""
    pycolmap = importlib.import_module("pycolmap")
    made = pycolmap.BundleAdjustmentOptions()
    known = named_values(made.todict())
    unknown = [name for name in named_values(values) if name not in known]
    if unknown:
        raise ValueError(f"options: pycolmap {pycolmap.__version__} has no option {unknown[0]}")
    try:
        made.mergedict(dict(values))
    except (TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = str(error).rpartition(": ")[2]
        raise ValueError(f"options: pycolmap {reason[:1].lower()}{reason[1:]}") from None
    return made


def named_values(values: Mapping[str, Any], group: str = "") -> dict[str, Any]:
    """Values by name, those of a group as `group.name`."""
    named: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            named |= named_values(value, f"{group}{name}.")
        else:
            named[f"{group}{name}"] = value
    return named


def ceres_options(options: Any) -> Any:
    """Where options keep the loss and `solver_options`."""
    return getattr(options, "ceres", options)


def ignored(options: Any) -> list[str]:
    """Names of options that differ from COLMAP's defaults, change where COLMAP ends, and mean
    nothing here."""
    given = named_values(options.todict())
    usual = named_values(type(options)().todict())
    changed = [name for name in given if str(given[name]) != str(usual.get(name))]
    if "CASPAR" not in str(given.get("backend")):
        changed = [name for name in changed if not name.startswith("caspar.")]
    plain = {name: name.removeprefix("ceres.") for name in changed}
    return [name for name in changed if plain[name] not in READ and not HOW.fullmatch(plain[name])]


def changed(options: Any, name: str) -> bool:
    """Whether an option of Ceres differs from COLMAP's default."""
    given = ceres_options(options).solver_options
    usual = ceres_options(type(options)()).solver_options
    return getattr(given, name) != getattr(usual, name)


def loss_of(kind: str, scale: float) -> Loss:
    """A loss by COLMAP's name."""
    return Loss() if kind == "TRIVIAL" else Loss(kind.lower(), scale)
