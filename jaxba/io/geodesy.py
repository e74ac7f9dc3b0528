"""Positions on the earth in one metric frame: a projected coordinate system, or east, north and up
of a place.

Needs pyproj (extra `survey`). Horizontal coordinates are in the order east, north, so longitude
stands before latitude."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.io.notes import report
from jaxba.problem.checks import shown

GEODETIC = "EPSG:4979"
GEOCENTRIC = "EPSG:4978"
"""WGS 84 as longitude, latitude and height, and as metres from the centre of the earth."""

SAME_UNIT = 1e-5
"""Units are the same if they differ by a smaller share: the feet of files are those of their
coordinate system, whose two kinds (US survey and international) differ by 2e-6."""

NOT_SAID = (np.nan, np.nan)  # units of a file that does not say in which ones it is


_UTM = re.compile(r"WGS\s*84\s*(?:/|)\s*UTM\s*(?:zone|)\s*(\d{1,2})\s*([NS]?)", re.IGNORECASE)
_STATED = re.compile(r"#?\s*coordinate\s*system\s*[:=]?\s*(.*)", re.IGNORECASE)
_SYSTEM = re.compile(
    r"epsg:\d+(\+(epsg:)?\d+)?|\+(proj|init)=.*|(PROJ|GEOG|COMPD|COMPOUND|BOUND|GEOD)\w*\[.*|.+ / "
    r".+",
    re.I,
)
_NAMED = re.compile(r"\w+\[\s*\"([^\"]*)\"")


@dataclass(frozen=True)
class Frame:
    """A metric frame of a scene."""

    crs: str = ""
    """A projected coordinate system; empty: east, north and up of the origin."""

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Longitude and latitude, degrees, and height, metres, of WGS 84."""

    heights: str | None = field(default=None, compare=False)
    """Datum of heights that are as their file has them, since the grid of its geoid is not
    installed; empty: they are what the frame says. None: nothing is in the frame yet."""

    def __str__(self) -> str:
        east, north, up = self.origin
        at = f"latitude {north:.7f}, longitude {east:.7f}, height {up:.3f} of WGS 84"
        return self.crs or f"metres east, north and up of {at}"


def system_of(line: str) -> str:
    """The coordinate system that a line of a file is, such as `EPSG:32632`, `WGS84 UTM 32N`, a
    string of PROJ, or WKT, perhaps after `#CoordinateSystem:` as Metashape has it; empty: none."""
    text = line.strip()
    if (stated := _STATED.fullmatch(text)) is not None:
        text = stated[1].strip()
    if (utm := _UTM.fullmatch(text)) is not None:
        return f"EPSG:{327 if utm[2].upper() == 'S' else 326}{int(utm[1]):02d}"
    return text if _SYSTEM.fullmatch(text) else ""


def projected(crs: str) -> Frame:
    """The frame of a coordinate system. Raises ValueError: it is none, or not one of metres; one
    line."""
    found = _system(crs).to_3d()
    if not found.is_projected or any(axis.unit_name != "metre" for axis in found.axis_info):
        raise ValueError(f"{crs} is no projected coordinate system in metres")
    return Frame(crs)


def is_geographic(crs: str) -> bool:
    """Whether coordinates are longitudes and latitudes. Raises ValueError: there is no such system;
    one line."""
    return _system(crs).is_geographic


def in_frame(
    positions: Float[np.ndarray, "n 3"],
    crs: str,
    frame: Frame | None = None,
    *,
    units: Sequence[float] = NOT_SAID,
    origin_of: Float[np.ndarray, "k 3"] | None = None,
    where: str = "heights",
) -> tuple[Float[np.ndarray, "n 3"], Frame]:
    """Positions of a coordinate system in a frame of metres.

    Heights are above the ellipsoid unless the system says others. Heights of a system in feet are
    in feet, which a note says. Heights above a geoid whose grid is not installed stay as they are,
    with a note.

    Args:
        positions: longitude, latitude and height, or easting, northing and height.
        crs: their coordinate system.
        frame: None: east, north and up of a place in the middle.
        units: metres of the unit of horizontal coordinates, and of that of heights, where the file
            says them; else NaN.
        origin_of: positions whose median is this middle; None: all.
        where: what notes begin with.

    Returns:
        The positions, and the frame.

    Raises:
        ValueError: no such system or place, or heights of another kind than those in the frame; one
            line."""
    source = _system(crs)
    called = source.name if "[" in crs else crs
    scales = _scales(source, called, units, where)
    if frame is None:
        frame = _middle((positions if origin_of is None else origin_of) * scales, source)
    target = _system(frame.crs or GEOCENTRIC).to_3d()
    found, missing = _transformed(positions * scales, source.to_3d(), target)
    heights = _vertical_datum(source) if missing else ""
    if frame.heights not in (None, heights) or (missing and _vertical_datum(target)):
        own = heights or _vertical_datum(source) or "the ellipsoid"
        other = frame.heights or _vertical_datum(target) or "the ellipsoid"
        grid = (
            f", and the grid {missing} is not installed (pyproj sync --file {missing})"
            if missing
            else ""
        )
        raise ValueError(
            f"heights of {called} are above {own}, those of the scene above {other}{grid}"
        )
    if missing:
        report(
            [
                f"{where}: heights are above {heights} and stay as they are: the grid {missing} is "
                "not installed"
            ]
        )
        metres = scales * [1.0, 1.0, source.axis_info[2].unit_conversion_factor]
        found, _ = _transformed(positions * metres, source.sub_crs_list[0].to_3d(), target)
    frame = replace(frame, heights=heights)
    return (found if frame.crs else _east_north_up(found, frame.origin)), frame


def _scales(source: Any, called: str, units: Sequence[float], where: str) -> Float[np.ndarray, "3"]:
    """What positions are multiplied by to be in the units of their system with heights, where those
    of a system without heights are metres. Notes in which unit heights are, where the file does not
    say it and it is no metre."""
    axes = source.axis_info
    flat = 1.0 if source.is_geographic else axes[0].unit_conversion_factor
    up = axes[min(2, len(axes) - 1)]
    unit_of_system = up.unit_conversion_factor if len(axes) > 2 or not source.is_geographic else 1.0
    horizontal = units[0] / flat if np.isfinite(units[0]) and not source.is_geographic else 1.0
    if abs(horizontal - 1) < SAME_UNIT:
        horizontal = 1.0
    said = np.isfinite(units[1])
    height = units[1] if said and abs(units[1] / unit_of_system - 1) > SAME_UNIT else unit_of_system
    if not said and unit_of_system != 1.0:
        report([f"{where}: heights are taken in the unit of {called}: {up.unit_name}"])
    return np.array([horizontal, horizontal, height / (unit_of_system if len(axes) > 2 else 1.0)])


def _middle(positions: Float[np.ndarray, "n 3"], source: Any) -> Frame:
    """East, north and up of the median of positions, which a few wrong ones do not move far."""
    places, _ = _transformed(positions, source.to_3d(), _system(GEODETIC))
    # so that those about the longitude of 180 have a median
    east = (places[:, 0] - places[0, 0] + 180) % 360 - 180
    middle = np.median(np.column_stack([places[0, 0] + east, places[:, 1:]]), axis=0)
    middle[0] -= 360 * np.round(middle[0] / 360)
    return Frame(
        origin=(round(float(middle[0]), 7), round(float(middle[1]), 7), round(float(middle[2]), 3))
    )


def _east_north_up(
    centred: Float[np.ndarray, "n 3"], origin: tuple[float, float, float]
) -> Float[np.ndarray, "n 3"]:
    """Geocentric positions as metres east, north and up of a place."""
    (start,), _ = _transformed(np.array([origin]), _system(GEODETIC), _system(GEOCENTRIC))
    (sin_east, sin_north), (cos_east, cos_north) = (
        f(np.radians(origin[:2])) for f in (np.sin, np.cos)
    )
    axes = np.array(
        [
            [-sin_east, cos_east, 0.0],
            [-sin_north * cos_east, -sin_north * sin_east, cos_north],
            [cos_north * cos_east, cos_north * sin_east, sin_north],
        ]
    )
    return (centred - start) @ axes.T


def _vertical_datum(system: Any) -> str:
    """The datum of heights above a geoid or the sea; empty: heights are above the ellipsoid, or
    there are none."""
    parts = system.sub_crs_list
    return parts[1].datum.name if system.is_compound and parts[1].is_vertical else ""


def _system(crs: str) -> Any:
    """A coordinate system. Raises ValueError: there is none of that name, or no pyproj; one
    line."""
    try:
        import pyproj
        from pyproj.exceptions import CRSError
    except ModuleNotFoundError:
        raise ValueError("coordinate systems need pyproj: pip install jaxba[survey]") from None
    if not isinstance(crs, str | int):
        raise ValueError(f"a coordinate system is a text such as EPSG:32633, not {shown(crs)}")
    crs = str(crs)  # a number is EPSG's
    shortened = _NAMED.match(crs)  # WKT without its parameters
    for text in (crs, *([shortened[1]] if shortened else [])):
        try:
            return pyproj.CRS(text)
        except CRSError:
            continue
    raise ValueError(f"there is no coordinate system {shown(crs)}")


def _transformed(
    positions: Float[np.ndarray, "n 3"], source: Any, target: Any
) -> tuple[Float[np.ndarray, "n 3"], str]:
    """Positions in another system, and the grid of a geoid that it needs and is not installed;
    empty: none."""
    import pyproj
    from pyproj.exceptions import ProjError

    transformer = pyproj.Transformer.from_crs(source, target, always_xy=True)
    transformed = np.stack(transformer.transform(*positions.T), axis=1)
    bad = np.flatnonzero(~np.isfinite(transformed).all(axis=1))
    if bad.size:
        raise ValueError(f"{positions[bad[0]].tolist()} is no place of {source.name}")
    try:
        used = transformer.get_last_used_operation().description
    except ProjError:  # both systems are the same
        used = ""
    return transformed, _missing_grid(source, target) if "ballpark vertical" in used else ""


def _missing_grid(source: Any, target: Any) -> str:
    """The grid that a transformation of heights lacks."""
    from pyproj.transformer import TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the best one is not available
        others = TransformerGroup(source, target, always_xy=True).unavailable_operations
    missing = [
        [grid.short_name for grid in operation.grids if not grid.available] for operation in others
    ]
    return min(filter(None, missing), key=len, default=["of its geoid"])[0]
