"""Positions on the earth in one metric frame: a projected coordinate system, or east, north and up of a place.

Needs pyproj (extra `survey`). Horizontal coordinates are in the order east, north, so longitude stands before latitude.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

GEODETIC, GEOCENTRIC = "EPSG:4979", "EPSG:4978"
"""WGS 84 as longitude, latitude and height, and as metres from the centre of the earth."""


@dataclass(frozen=True)
class Frame:
    """A metric frame of a scene."""

    crs: str = ""
    """A projected coordinate system; empty: east, north and up of the origin."""

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Longitude and latitude, degrees, and height, metres, of WGS 84."""

    def __str__(self) -> str:
        east, north, up = self.origin
        at = f"latitude {north:.7f}, longitude {east:.7f}, height {up:.3f} of WGS 84"
        return self.crs or f"metres east, north and up of {at}"


def projected(crs: str) -> Frame:
    """The frame of a coordinate system. Raises ValueError: it is none, or not one of metres; one line."""
    found = _system(crs)
    if not found.is_projected or any(one.unit_name != "metre" for one in found.axis_info):
        raise ValueError(f"{crs} is no projected coordinate system in metres")
    return Frame(crs)


def is_geographic(crs: str) -> bool:
    """Whether coordinates are longitudes and latitudes. Raises ValueError: there is no such system; one line."""
    return _system(crs).is_geographic


def in_frame(
    positions: Float[np.ndarray, "n 3"], crs: str, frame: Frame | None = None
) -> tuple[Float[np.ndarray, "n 3"], Frame]:
    """Positions of a coordinate system, with heights above the ellipsoid unless it says others, in a frame of metres;
    without one in east, north and up of their mean. Raises ValueError: no such system or place; one line."""
    source = _system(crs)
    if frame is not None and frame.crs:
        return _transformed(positions, source, _system(frame.crs)), frame
    centred = _transformed(positions, source, _system(GEOCENTRIC))
    if frame is None:
        (east, north, _), *_ = _transformed(centred.mean(axis=0)[None], _system(GEOCENTRIC), _system(GEODETIC))
        height = _transformed(positions, source, _system(GEODETIC))[:, 2].mean()
        frame = Frame(origin=(round(float(east), 7), round(float(north), 7), round(float(height), 3)))
    (origin,) = _transformed(np.array([frame.origin]), _system(GEODETIC), _system(GEOCENTRIC))
    (sin_east, sin_north), (cos_east, cos_north) = (f(np.radians(frame.origin[:2])) for f in (np.sin, np.cos))
    axes = np.array(
        [
            [-sin_east, cos_east, 0.0],
            [-sin_north * cos_east, -sin_north * sin_east, cos_north],
            [cos_north * cos_east, cos_north * sin_east, sin_north],
        ]
    )
    return (centred - origin) @ axes.T, frame


def _system(crs: str) -> Any:
    """A coordinate system with heights. Raises ValueError: there is none of that name, or no pyproj; one line."""
    try:
        import pyproj
        from pyproj.exceptions import CRSError
    except ModuleNotFoundError:
        raise ValueError("coordinate systems need pyproj: pip install jaxba[survey]") from None
    try:
        return pyproj.CRS(crs).to_3d()
    except CRSError:
        raise ValueError(f"there is no coordinate system {crs!r}") from None


def _transformed(positions: Float[np.ndarray, "n 3"], source: Any, target: Any) -> Float[np.ndarray, "n 3"]:
    import pyproj

    found = np.stack(pyproj.Transformer.from_crs(source, target, always_xy=True).transform(*positions.T), axis=1)
    bad = np.flatnonzero(~np.isfinite(found).all(axis=1))
    if bad.size:
        raise ValueError(f"{positions[bad[0]].tolist()} is no place of {source.name}")
    return found
