"""Scenes for the game, made by one compiled program: thousands of small problems of equal shape.

Scenes of one *class* share a shape: at most C cameras and P points, an observation slot for every
pair of a camera and a point, and a mask of the pairs that are observed. Smaller scenes leave
cameras and points unobserved. Size, motion, depth, noise, wrong matches and the error of the start
are drawn per scene; `SceneFamily` says from which distributions."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.model import camera
from jaxba.rotations import angle_axis, rotation_matrix
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.structure.density import DENSE_UNKNOWNS
from jaxba.structure.track_buckets import TILED_POINTS

SceneFamily = Literal["wide", "paper", "windows"]
"""`wide`: all motions, depths, noises and starts below. `paper`: random cameras that all see all
random points. `windows`: not random, but cut from real problems (game/windows.py)."""

# motions of the cameras of a wide scene, equally often
MOTIONS = ("forward", "lateral", "orbit", "photos")
MIN_VIEWS = 5  # cameras with fewer observations are removed: nine unknowns need five observations
NOISE = (0.05, 3.0)  # sigma of a measurement in pixels, log-uniform per scene
# fraction of scenes with wrong matches; smallest and largest fraction of these in them
OUTLIERS = (0.4, 1e-3, 0.03)
OUTLIER_ERROR = (5.0, 100.0)  # largest error of a wrong match in pixels, log-uniform per scene
FOCAL = (300.0, 4000.0)  # focal length in pixels, log-uniform per scene
CANDIDATES = 3  # points drawn per point that is kept, since many are seen by one camera only

START_ROTATION = (1e-5, 0.03)
START_CENTER = (1e-3, 0.3)
START_DEPTH = (1e-3, 0.25)
"""Sigmas of the error of the start, log-uniform per scene: rotations in radians, centres in units
of the distance of neighbouring cameras, depths of points relative to the true ones."""

PAPER_START = (0.2, 2.0, 2.0)
"""Sigmas of the error of the start of a scene of the family `paper`: rotations in radians, camera
centres and points in lengths, where points fill a cube of side 4. Chosen so that lambda matters: on
790 usable scenes of 10 x 10 Gauss-Newton takes 7 iterations to convergence in the median and fails
on 6%, Ceres' rule takes 8.1 in the mean."""


MOST_CAMERAS = DENSE_UNKNOWNS // 9
MOST_POINTS = TILED_POINTS - 2
"""Of a class, 56 and 510. Its scenes share the layout of one in which every camera sees every
point: a single bucket of points, with slots ordered camera by camera, and a dense product that
forms the reduced camera system. Layouts of larger problems have tiles and pairs; from which sizes
on was measured on real problems."""


@dataclass(frozen=True)
class SceneClass:
    """Scenes of equal shape."""

    cameras: int = 10
    """Largest number of cameras; a wide scene has at least 4."""

    points: int = 40
    """Largest number of points; a wide scene has at least a quarter of it."""

    family: SceneFamily = "wide"
    """Distributions that the scenes are drawn from."""

    def __post_init__(self) -> None:
        if not (4 <= self.cameras <= MOST_CAMERAS and 10 <= self.points <= MOST_POINTS):
            sizes = f"4 to {MOST_CAMERAS} cameras and 10 to {MOST_POINTS} points"
            raise ValueError(f"a class of scenes has {sizes}, not {self.cameras} and {self.points}")


class Scenes(NamedTuple):
    """A batch of scenes of one class, in the order of its layout (`scene_layout.class_layout`)."""

    cameras: Float[Array, "scenes 9 cameras"]  # the start
    points: Float[Array, "scenes 3 points"]  # the last point is the layout's empty one
    pixels: Float[Array, "scenes 2 slots"]
    mask: Bool[Array, "scenes slots"]


class _Rig(NamedTuple):
    """True cameras of one scene."""

    rotation: Float[Array, "cameras 3 3"]  # world to camera
    center: Float[Array, "cameras 3"]
    intrinsics: Float[Array, "3 cameras"]  # f, k1, k2


@for_traces
@functools.partial(jit, once=True, static_argnames=("kind", "count"))
def make_scenes(kind: SceneClass, key: Array, count: int) -> Scenes:
    """Random scenes of the shape and family of `kind`, the unusable ones included; see
    `scene_bank.solve_scenes`. Not of the family `windows`. The same key gives the same scenes."""
    check_x64("float64")
    one = _paper_scene if kind.family == "paper" else _wide_scene
    return lax.map(lambda k: one(kind, k), jax.random.split(key, count), batch_size=256)


def _log_uniform(key: Array, low: float, high: float, shape: tuple[int, ...] = ()) -> Array:
    return jnp.exp(jax.random.uniform(key, shape, minval=jnp.log(low), maxval=jnp.log(high)))


def _look_at(forward: Array, up: Array) -> Float[Array, "n 3 3"]:
    """Rotations world to camera of cameras that look along `forward`: -z ahead, y up."""

    def unit(v):
        return v / jnp.linalg.norm(v, axis=-1, keepdims=True)

    back = -unit(forward)
    right = unit(jnp.cross(up, back))
    return jnp.stack([right, jnp.cross(back, right), back], axis=-2)


def _turns(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    return jnp.moveaxis(rotation_matrix(vectors.T), -1, 0)


def _path(motion: Array, key: Array, cameras: int) -> tuple[Array, Array]:
    """Centres and viewing directions of a motion of `MOTIONS`; the distance of neighbours is the
    unit of length."""
    keys = iter(jax.random.split(key, 12))
    i = jnp.arange(cameras)
    bend = jax.random.uniform(next(keys), minval=-0.12, maxval=0.12)
    yaw = bend * i + 0.05 * jnp.cumsum(jax.random.normal(next(keys), (cameras,)))
    ahead = jnp.stack([jnp.sin(yaw), jnp.zeros(cameras), -jnp.cos(yaw)], axis=1)
    pace = jnp.exp(0.3 * jax.random.normal(next(keys), (cameras, 1)))
    street = jnp.cumsum(ahead * pace, axis=0) + 0.05 * jax.random.normal(next(keys), (cameras, 3))
    aside = jnp.stack([-ahead[:, 2], jnp.zeros(cameras), ahead[:, 0]], axis=1)
    radius = _log_uniform(next(keys), 2.0, 30.0)
    span = _log_uniform(next(keys), 0.15, 2 * jnp.pi)
    angle = span * (i / cameras - 0.5)
    wave = 0.25 * radius * jnp.sin(3 * angle + 1)
    ring = jnp.stack([radius * jnp.sin(angle), wave, radius * jnp.cos(angle)], axis=1)
    ring = ring + 0.05 * radius * jax.random.normal(next(keys), (cameras, 3))
    away = radius * jnp.exp(0.3 * jax.random.normal(next(keys), (cameras,)))
    side = jax.random.uniform(next(keys), (cameras,), minval=-0.8, maxval=0.8)
    height = 0.1 * radius * jax.random.normal(next(keys), (cameras,))
    crowd = jnp.stack([away * jnp.sin(side), height, away * jnp.cos(side)], axis=1)
    gaze = 0.15 * radius * jax.random.normal(next(keys), (cameras, 3))
    center = jnp.stack([street, street, ring, crowd])[motion]
    forward = jnp.stack([ahead, aside, -ring + 0.3 * gaze, gaze - crowd])[motion]
    return center, forward / jnp.linalg.norm(forward, axis=1, keepdims=True)


def _wide_scene(kind: SceneClass, key: Array) -> Scenes:
    keys = iter(jax.random.split(key, 24))

    def uniform(low, high, shape=()):
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    motion = jax.random.randint(next(keys), (), 0, len(MOTIONS))
    cameras = jnp.floor(_log_uniform(next(keys), 4.0, kind.cameras + 1.0)).astype(int)
    points = jnp.floor(
        _log_uniform(next(keys), max(10.0, float(kind.points // 4)), kind.points + 1.0)
    ).astype(int)
    used = jnp.arange(kind.cameras) < cameras

    center, forward = _path(motion, next(keys), kind.cameras)
    up = jnp.array([0.0, 1.0, 0.0]) + 0.05 * jax.random.normal(next(keys), (kind.cameras, 3))
    focal = _log_uniform(next(keys), *FOCAL) * jnp.exp(
        jnp.where(motion == 3, 0.25, 0.0) * jax.random.normal(next(keys), (kind.cameras,))
    )
    # tangents of half the angles of view
    half = jax.random.uniform(next(keys), (2,), minval=0.15, maxval=0.9)
    square = jnp.sum(half**2)
    distorted = jax.random.bernoulli(next(keys), 0.7)
    k1 = distorted * uniform(-0.2, 0.1) / square
    k2 = distorted * uniform(-0.03, 0.03) / square**2
    lens = jnp.stack([focal, jnp.full_like(focal, k1), jnp.full_like(focal, k2)])
    rig = _Rig(_look_at(forward, up), center, lens)

    reference, world = _points(kind, rig, motion, cameras, half, next(keys))
    seen = (
        _visible(rig, world, half) & used[:, None] & _matched(kind, motion, reference, next(keys))
    )
    # tracks before single views
    first = jnp.argsort(jnp.sum(seen, axis=0) < 2, stable=True)[: kind.points]
    reference = reference[first]
    world = world[first]
    seen = _enough(seen[:, first] & (jnp.arange(kind.points) < points))

    wrong = jax.random.bernoulli(next(keys), OUTLIERS[0]) * _log_uniform(next(keys), *OUTLIERS[1:])
    pixels = _measure(rig, world, _log_uniform(next(keys), *NOISE), wrong, next(keys))
    start = _wide_start(rig, reference, world, next(keys))
    return _assemble(start, pixels, seen)


def _points(
    kind: SceneClass, rig: _Rig, motion: Array, cameras: Array, half: Array, key: Array
) -> tuple[Int[Array, " candidates"], Float[Array, "candidates 3"]]:
    """Each point on a random ray of a random camera, at depths over up to two decades or around an
    object."""
    a, b, c, d, e = jax.random.split(key, 5)
    count = CANDIDATES * kind.points
    reference = jax.random.randint(a, (count,), 0, cameras)
    ray = jax.random.uniform(b, (count, 2), minval=-0.9, maxval=0.9) * half
    near = _log_uniform(c, 0.7, 12.0)
    spread = _log_uniform(d, 1.3, 100.0)
    along = jax.random.uniform(e, (count,))
    focus = jnp.linalg.norm(rig.center[reference], axis=1)
    around = focus * jnp.exp((along - 0.5) * jnp.minimum(jnp.log(spread), 1.5))
    depth = jnp.where(motion >= 2, around, near * spread**along)
    local = depth[:, None] * jnp.concatenate([ray, -jnp.ones((count, 1))], axis=1)
    return reference, rig.center[reference] + jnp.einsum(
        "nji,nj->ni", rig.rotation[reference], local
    )


def _project(rig: _Rig, world: Float[Array, "points 3"]) -> Float[Array, "2 cameras points"]:
    """Pixels of every point in every camera."""
    rotation = jnp.moveaxis(rig.rotation, 0, -1)[..., None]
    frames = camera.Frames(
        rotation, _translation(rig.rotation, rig.center).T[..., None], rig.intrinsics[..., None]
    )
    return jnp.stack(list(camera.project(frames, world.T[:, None]).pixel))


def _visible(
    rig: _Rig, world: Float[Array, "points 3"], half: Array
) -> Bool[Array, "cameras points"]:
    """In front of the camera, not too close to it, and inside the image."""
    local = jnp.einsum("cij,cpj->cpi", rig.rotation, world - rig.center[:, None])
    depth = -local[..., 2]
    inside = jnp.all(jnp.abs(local[..., :2]) <= half * depth[..., None], axis=-1)
    return (depth > 0.3) & inside


def _matched(
    kind: SceneClass, motion: Array, reference: Array, key: Array
) -> Bool[Array, "cameras _"]:
    """Which of the possible views are matched: tracks of random length along a path, random views
    of photos."""
    a, b, c, d = jax.random.split(key, 4)
    window = _log_uniform(a, 1.0, float(kind.cameras))
    reach = jnp.maximum(1.0, window * _log_uniform(b, 0.5, 2.0, reference.shape))
    near = jnp.abs(jnp.arange(kind.cameras)[:, None] - reference) <= reach
    keep = jax.random.uniform(c, near.shape) < jax.random.uniform(d, minval=0.35, maxval=1.0)
    own = jnp.arange(kind.cameras)[:, None] == reference
    return (near | (motion >= 2)) & (keep | own)


def _enough(seen: Bool[Array, "cameras points"]) -> Bool[Array, "cameras points"]:
    """Repeatedly removes points that one camera sees and cameras with fewer than `MIN_VIEWS`
    observations."""

    def prune(_: Array, seen: Array) -> Array:
        seen = seen & (jnp.sum(seen, axis=0) >= 2)
        return seen & (jnp.sum(seen, axis=1, keepdims=True) >= MIN_VIEWS)

    seen = lax.fori_loop(0, 6, prune, seen)
    return seen & (jnp.sum(seen, axis=0) >= 2)


def _measure(
    rig: _Rig, world: Array, noise: Array, wrong: Array, key: Array
) -> Float[Array, "2 cameras points"]:
    a, b, c, d = jax.random.split(key, 4)
    pixels = _project(rig, world)
    pixels = pixels + noise * jax.random.normal(a, pixels.shape)
    moved = _log_uniform(b, *OUTLIER_ERROR) * jax.random.uniform(
        c, pixels.shape, minval=-1.0, maxval=1.0
    )
    return pixels + moved * jax.random.bernoulli(d, wrong, pixels.shape[1:])


def _wide_start(rig: _Rig, reference: Array, world: Array, key: Array) -> tuple[Array, Array]:
    """Start with errors: drift along the path, independent errors of cameras and points, wrong
    lens, wrong depths."""
    keys = iter(jax.random.split(key, 24))
    cameras = rig.center.shape[0]

    def sometimes(chance, low, high):
        return jax.random.bernoulli(next(keys), chance) * _log_uniform(next(keys), low, high)

    turn = jnp.cumsum(
        sometimes(0.5, 1e-5, 0.02) * jax.random.normal(next(keys), (cameras, 3)), axis=0
    )
    turns = _turns(turn)
    pace = jnp.exp(
        jnp.cumsum(sometimes(0.3, 1e-3, 0.1) * jax.random.normal(next(keys), (cameras, 1)), axis=0)
    )
    steps = jnp.einsum("nij,nj->ni", turns[:-1], jnp.diff(rig.center, axis=0)) * pace[1:]
    moved = rig.center[0] + jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(steps, axis=0)])
    follow = jax.random.bernoulli(next(keys), 0.8)  # points made with the drifted cameras
    carried = moved[reference] + jnp.einsum(
        "nij,nj->ni", turns[reference], (world - rig.center[reference]) * pace[reference]
    )
    points = jnp.where(follow, carried, world)
    ray = points - moved[reference]
    depth = jnp.exp(
        _log_uniform(next(keys), *START_DEPTH) * jax.random.normal(next(keys), (len(points), 1))
    )
    size = jnp.linalg.norm(ray, axis=1, keepdims=True)
    across = sometimes(0.7, 1e-5, 0.01) * size * jax.random.normal(next(keys), points.shape)
    points = moved[reference] + ray * depth + across

    noise = _log_uniform(next(keys), *START_ROTATION) * jax.random.normal(next(keys), (cameras, 3))
    rotation = _turns(noise) @ rig.rotation @ jnp.swapaxes(turns, 1, 2)
    center = moved + _log_uniform(next(keys), *START_CENTER) * jax.random.normal(
        next(keys), moved.shape
    )
    common = sometimes(0.5, 0.01, 0.4) * jax.random.uniform(next(keys), minval=-1.0, maxval=1.0)
    individual = sometimes(0.5, 1e-3, 0.1) * jax.random.normal(next(keys), (cameras,))
    flat = jax.random.bernoulli(next(keys), 0.6)
    focal, k1, k2 = rig.intrinsics
    lens = jnp.stack([focal * jnp.exp(common + individual), k1 * (1 - flat), k2 * (1 - flat)])
    return _camera_columns(rotation, center, lens), points


def _camera_columns(rotation: Array, center: Array, lens: Array) -> Float[Array, "9 cameras"]:
    return jnp.concatenate([angle_axis(rotation).T, _translation(rotation, center).T, lens])


def _translation(rotation: Array, center: Array) -> Float[Array, "n 3"]:
    return -jnp.einsum("nij,nj->ni", rotation, center)


def _paper_scene(kind: SceneClass, key: Array) -> Scenes:
    """Random cameras around random points, all of which they see; focal length 500 pixels, noise of
    half a pixel.

    Source: the text of Belder et al. 2023, which draws points and camera poses at random and names
    no distribution: here points in a cube, and cameras in all directions around it that look at a
    random place in it, with a random roll. The noise is that of the paper's equation 1, without
    which the best cost would be zero and a relative tolerance meaningless. The text does not say
    either how far off a start is (`PAPER_START`)."""
    keys = iter(jax.random.split(key, 10))

    def normal(*shape):
        return jax.random.normal(next(keys), shape)

    world = jax.random.uniform(next(keys), (kind.points, 3), minval=-2.0, maxval=2.0)
    away = jax.random.uniform(next(keys), (kind.cameras, 1), minval=6.0, maxval=12.0)
    direction = normal(kind.cameras, 3)
    center = away * direction / jnp.linalg.norm(direction, axis=1, keepdims=True)
    target = jax.random.uniform(next(keys), (kind.cameras, 3), minval=-1.0, maxval=1.0)
    rotation = _look_at(target - center, normal(kind.cameras, 3))
    lens = jnp.zeros((3, kind.cameras)).at[0].set(500.0)
    pixels = _measure(
        _Rig(rotation, center, lens), world, jnp.asarray(0.5), jnp.asarray(0.0), next(keys)
    )
    turn, shift, move = PAPER_START
    turned = _turns(turn * normal(kind.cameras, 3)) @ rotation
    cameras = _camera_columns(turned, center + shift * normal(kind.cameras, 3), lens)
    start = cameras, world + move * normal(kind.points, 3)
    return _assemble(start, pixels, jnp.ones((kind.cameras, kind.points), bool))


def _assemble(
    start: tuple[Array, Array], pixels: Array, seen: Bool[Array, "cameras points"]
) -> Scenes:
    """Observations in the order of the slots: camera by camera, the points of each, and an empty
    one at the end."""
    cameras, points = start

    def pad(x):
        return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, 1)])

    mask = pad(seen).reshape(-1)
    return Scenes(cameras, pad(points.T), pad(pixels).reshape(2, -1) * mask, mask)
