"""Camera models: functions from a point in the camera's frame and the numbers of its lens to a
pixel.

The frame is that of COLMAP and OpenCV: x to the right, y downwards, z forwards. A model is written
once, for NumPy and JAX, elementwise over arrays of any shape; its derivatives come by forward mode
(`jaxba.model.camera`).

Perspective models project to `(u, v) = (x, y) / z`. Fisheye models project to `theta (x, y) / r`
with `r^2 = x^2 + y^2` and `theta = atan2(r, z)`. Both then distort (u, v) and map it to `(fx u +
cx, fy v + cy)`.

Source: COLMAP 4.2, src/colmap/sensor/models.h, whose names, numbers and order of parameters these
are."""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jaxba.runtime.trace_errors import advice

FOV_SMALL = 1e-4  # squared radius or squared omega below which FOV is a series, as in COLMAP

# `r^2 / z^2` below which a fisheye projects as a pinhole: the difference is below rounding
NEARLY_ON_AXIS = 1e-20

# focal length with which a user's model is tried, pixels; everything else of its lens is zero
EXAMPLE_FOCAL = 500.0
LONGEST_REASON = 200  # characters of a message that is passed on

Pixel = tuple[Any, Any]


@dataclass(frozen=True)
class CameraModel:
    """A camera model. Hashable: a problem's models are part of its compiled programs."""

    name: str
    """Name in the registry and in files of COLMAP."""

    parameters: tuple[str, ...]
    """Names of the numbers of a lens, in COLMAP's order: `f` or `fx`, `fy`; `cx`, `cy`; then
    distortion."""

    project: Callable[[Sequence[Any], Any, Any, Any], Pixel]
    """From the numbers of lenses, and x, y and z of points in the camera's frame, to pixels."""

    def __reduce__(self) -> tuple[Any, ...]:
        """By name, so that a problem may be pickled: of a model that is registered where it is
        unpickled."""
        return _registered, (self.name,)

    def __len__(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def focal(self) -> tuple[int, ...]:
        """Positions of the focal lengths."""
        return self._named("f", "fx", "fy")

    @property
    def principal_point(self) -> tuple[int, ...]:
        """Positions of the principal point."""
        return self._named("cx", "cy")

    @property
    def distortion(self) -> tuple[int, ...]:
        """Positions of all other parameters."""
        return tuple(sorted(set(range(len(self))) - set(self.focal) - set(self.principal_point)))

    def _named(self, *names: str) -> tuple[int, ...]:
        return tuple(k for k, name in enumerate(self.parameters) if name in names)


CAMERA_MODELS: dict[str, CameraModel] = {}
"""All camera models by name."""


def _registered(name: str) -> CameraModel:
    return CAMERA_MODELS[name]


def register_camera_model(name: str, parameters: str, project: Callable[..., Pixel]) -> CameraModel:
    """Adds a camera model to `CAMERA_MODELS`. `parameters` are the names of the numbers of a lens,
    separated by spaces: focal lengths are called `f`, or `fx` and `fy`; the principal point `cx`
    and `cy`; everything else counts as distortion. `project` goes from a sequence of these numbers,
    and x, y and z in the camera's frame (x right, y down, z forwards, scene units), to the two
    coordinates of a pixel. Written with operators and functions of `x.__array_namespace__()`, it
    serves NumPy and JAX. Raises ValueError: another model has the name, or `project` cannot be
    computed, by NumPy or by JAX, or does not return two coordinates."""
    model = CameraModel(name, tuple(parameters.split()), project)
    if CAMERA_MODELS.get(name, model) != model:
        raise ValueError(f"there is a camera model {name} already")
    if project.__module__ != __name__:
        _check_projection(model)
    CAMERA_MODELS[name] = model
    return model


def _check_projection(model: CameraModel) -> None:
    """Raises a ValueError of one line unless NumPy and JAX can project two points."""
    lens = [np.full(2, EXAMPLE_FOCAL if k in model.focal else 0.0) for k in range(len(model))]
    point = (np.array([0.1, -0.2]), np.array([0.2, 0.1]), np.array([1.0, 2.0]))

    def by_numpy() -> Any:
        return model.project(lens, *point)

    def by_jax() -> Any:
        return jax.eval_shape(model.project, lens, *point)

    for library, project in (("NumPy", by_numpy), ("JAX", by_jax)):
        try:
            pixel = project()
        except Exception as error:
            reason = textwrap.shorten(advice(error), LONGEST_REASON)
            raise ValueError(
                f"camera model {model.name} cannot be computed by {library}: {reason}"
            ) from error
        shapes = [getattr(coordinate, "shape", ()) for coordinate in pixel]
        if shapes != [(2,), (2,)]:
            raise ValueError(
                f"camera model {model.name} must return two coordinates of the shape of x, "
                f"not {len(shapes)} of shapes {shapes}"
            )


def _bal(lens: Sequence[Any], x: Any, y: Any, z: Any) -> Pixel:
    """BAL's camera: pixels have y upwards. Source: Agarwal et al. 2010, "Bundle Adjustment in the
    Large"."""
    f, k1, k2 = lens
    u = x / z
    v = y / z
    r2 = u * u + v * v
    scale = f * (1 + r2 * (k1 + r2 * k2))
    return scale * u, -scale * v


def _perspective(x: Any, y: Any, z: Any) -> Pixel:
    return x / z, y / z


def _equidistant(x: Any, y: Any, z: Any) -> Pixel:
    """`theta (x, y) / r`, smooth on the axis."""
    xp = x.__array_namespace__()
    r2 = x * x + y * y
    near = r2 < NEARLY_ON_AXIS * z * z
    r = xp.sqrt(xp.where(near, xp.ones_like(r2), r2))
    scale = xp.where(near, 1 / xp.where(near, z, xp.ones_like(z)), xp.atan2(r, z) / r)
    return scale * x, scale * y


def _radial(u: Any, v: Any, coefficients: Sequence[Any]) -> tuple[Any, Any]:
    """`1 + k1 r^2 + k2 r^4 + ...` and r^2."""
    r2 = u * u + v * v
    total = 0.0
    for k in reversed(coefficients):
        total = r2 * (k + total)
    return 1 + total, r2


def _tangential(u: Any, v: Any, r2: Any, p1: Any, p2: Any) -> Pixel:
    return 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def _no_distortion(u: Any, v: Any) -> Pixel:
    return u, v


def _polynomial(u: Any, v: Any, *k: Any) -> Pixel:
    factor, _ = _radial(u, v, k)
    return factor * u, factor * v


def _brown(u: Any, v: Any, k1: Any, k2: Any, p1: Any, p2: Any) -> Pixel:
    """Source: Brown 1966, "Decentering distortion of lenses"."""
    factor, r2 = _radial(u, v, (k1, k2))
    du, dv = _tangential(u, v, r2, p1, p2)
    return factor * u + du, factor * v + dv


def _rational(
    u: Any, v: Any, k1: Any, k2: Any, p1: Any, p2: Any, k3: Any, k4: Any, k5: Any, k6: Any
) -> Pixel:
    factor, r2 = _radial(u, v, (k1, k2, k3))
    factor = factor / _radial(u, v, (k4, k5, k6))[0]
    du, dv = _tangential(u, v, r2, p1, p2)
    return factor * u + du, factor * v + dv


def _thin_prism(
    u: Any, v: Any, k1: Any, k2: Any, p1: Any, p2: Any, k3: Any, k4: Any, sx1: Any, sy1: Any
) -> Pixel:
    factor, r2 = _radial(u, v, (k1, k2, k3, k4))
    du, dv = _tangential(u, v, r2, p1, p2)
    return factor * u + du + sx1 * r2, factor * v + dv + sy1 * r2


def _rad_tan_thin_prism(u: Any, v: Any, *numbers: Any) -> Pixel:
    """Source: Project Aria, "Fisheye62" with thin prism terms."""
    *k, p0, p1, s0, s1, s2, s3 = numbers
    factor, _ = _radial(u, v, k)
    u = factor * u
    v = factor * v
    r2 = u * u + v * v
    du, dv = _tangential(u, v, r2, p1, p0)
    return u + du + r2 * (s0 + r2 * s1), v + dv + r2 * (s2 + r2 * s3)


def _field_of_view(u: Any, v: Any, omega: Any) -> Pixel:
    """`atan(2 r tan(omega / 2)) / (r omega)`. Source: Devernay and Faugeras 2001, "Straight lines
    have to be straight"; the two series are COLMAP's."""
    xp = u.__array_namespace__()
    r2 = u * u + v * v
    omega2 = omega * omega
    flat = omega2 < FOV_SMALL
    near = r2 < FOV_SMALL
    safe = xp.where(flat, xp.ones_like(omega), omega)
    tangent = xp.tan(safe / 2)
    r = xp.sqrt(xp.where(near, xp.ones_like(r2), r2))
    factor = xp.atan(2 * r * tangent) / (r * safe)
    factor = xp.where(near, -2 * tangent * (4 * r2 * tangent * tangent - 3) / (3 * safe), factor)
    factor = xp.where(flat, 1 + omega2 * r2 / 3 - omega2 / 12, factor)
    return factor * u, factor * v


def _division(lens: Sequence[Any], x: Any, y: Any, z: Any) -> Pixel:
    """The distorted point whose undistorted one is `(u, v) / (1 + k r^2)`. Source: Fitzgibbon 2001,
    "Simultaneous linear estimation of multiple view geometry and lens distortion"."""
    *focal, cx, cy, k = lens
    xp = x.__array_namespace__()
    scale = 2 / (z + xp.sqrt(z * z - 4 * k * (x * x + y * y)))
    return focal[0] * scale * x + cx, focal[-1] * scale * y + cy


def _enhanced_unified(lens: Sequence[Any], x: Any, y: Any, z: Any) -> Pixel:
    """Source: Khomutenko et al. 2016, "An Enhanced Unified Camera Model"."""
    fx, fy, cx, cy, alpha, beta = lens
    xp = x.__array_namespace__()
    depth = alpha * xp.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
    return fx * x / depth + cx, fy * y / depth + cy


def _equirectangular(lens: Sequence[Any], x: Any, y: Any, z: Any) -> Pixel:
    """Pixels jump by the width where x = 0 behind the camera: an error there is not taken around
    the seam."""
    width, height = lens
    xp = x.__array_namespace__()
    pi = 3.141592653589793
    return width * (xp.atan2(x, z) / (2 * pi) + 0.5), height * (
        xp.atan2(y, xp.sqrt(x * x + z * z)) / pi + 0.5
    )


def _distorted(
    to_plane: Callable[..., Pixel],
    distort: Callable[..., Pixel],
    focals: int,
    lens: Sequence[Any],
    *place: Any,
) -> Pixel:
    """The pixel of a model that projects to the plane, distorts there, and scales to pixels."""
    cx, cy, *coefficients = lens[focals:]
    u, v = distort(*to_plane(*place), *coefficients)
    return lens[0] * u + cx, lens[focals - 1] * v + cy


_ONE = "f cx cy"
_TWO = "fx fy cx cy"

BAL = register_camera_model("BAL", "f k1 k2", _bal)
"""The model of BAL, with analytic derivatives in a solve where all lenses are of it."""

for _name, _focals, _coefficients, _to_plane, _distort in (
    ("SIMPLE_PINHOLE", 1, "", _perspective, _no_distortion),
    ("PINHOLE", 2, "", _perspective, _no_distortion),
    ("SIMPLE_RADIAL", 1, "k1", _perspective, _polynomial),
    ("RADIAL", 1, "k1 k2", _perspective, _polynomial),
    ("OPENCV", 2, "k1 k2 p1 p2", _perspective, _brown),
    ("OPENCV_FISHEYE", 2, "k1 k2 k3 k4", _equidistant, _polynomial),
    ("FULL_OPENCV", 2, "k1 k2 p1 p2 k3 k4 k5 k6", _perspective, _rational),
    ("FOV", 2, "omega", _perspective, _field_of_view),
    ("SIMPLE_RADIAL_FISHEYE", 1, "k1", _equidistant, _polynomial),
    ("RADIAL_FISHEYE", 1, "k1 k2", _equidistant, _polynomial),
    ("THIN_PRISM_FISHEYE", 2, "k1 k2 p1 p2 k3 k4 sx1 sy1", _equidistant, _thin_prism),
    (
        "RAD_TAN_THIN_PRISM_FISHEYE",
        2,
        "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
        _equidistant,
        _rad_tan_thin_prism,
    ),
    ("SIMPLE_FISHEYE", 1, "", _equidistant, _no_distortion),
    ("FISHEYE", 2, "", _equidistant, _no_distortion),
):
    _project = functools.partial(_distorted, _to_plane, _distort, _focals)
    register_camera_model(_name, f"{(_ONE, _TWO)[_focals - 1]} {_coefficients}", _project)
register_camera_model("SIMPLE_DIVISION", f"{_ONE} k", _division)
register_camera_model("DIVISION", f"{_TWO} k", _division)
register_camera_model("EUCM", f"{_TWO} alpha beta", _enhanced_unified)
register_camera_model("EQUIRECTANGULAR", "width height", _equirectangular)
