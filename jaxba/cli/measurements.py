"""What the file of `--constraints` says that was measured besides pixels, as residuals (`jaxba.residuals`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba import residuals
from jaxba.cli import constraint_values as values
from jaxba.cli.common import counted
from jaxba.io.files import reason
from jaxba.io.notes import report
from jaxba.model.registration import with_residual
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.hold import every_lens
from jaxba.problem.labels import Part
from jaxba.problem.measured import with_position_priors

MEASURED = {
    "position_priors": "positions: {name or id: [x, y, z]}, stddev, loss, loss_scale and align",
    "control_points": "positions: {id: [x, y, z]}, stddev, loss and loss_scale",
    "distances": "a list of {points: [id, id], length, stddev}",
    "gravity": "up, directions: {name or id: [x, y, z]}, stddev, loss and loss_scale",
    "relative_poses": "a list of {images: [name or id, name or id], rotation, translation, stddev}",
    "depths": "folder, stddev, loss and loss_scale",
}
"""Keys of the file, and what they hold."""


def with_measured(problem: BundleProblem, where: str, key: str, value: Any, strict: bool) -> BundleProblem:
    """The problem with what a key of `MEASURED` says.

    What is measured of images and points that the problem does not have is left out with a note that begins with
    `where`, or refused if `strict`. Raises ValueError: something that the value cannot be; one line.
    """
    if key == "depths":
        return _with_depths(problem, where, value, strict)
    if key == "relative_poses":
        shapes = {"rotation": ((3,), (4,)), "translation": ((3,),), "stddev": ((2,), (6,))}
        pairs, found = values.parse_pairs(value, "images", shapes)
        at, kept = _parts(problem, where, "image", pairs, "relative poses", strict)
        turns = np.stack([_rotation(found[k]["rotation"]) for k in kept])
        shifts = np.stack([found[k]["translation"] for k in kept])
        stddev = np.stack([np.repeat(found[k]["stddev"], 6 // len(found[k]["stddev"])) for k in kept])
        whitening = np.eye(6) / stddev[:, None]
        data = {"rotation": turns, "translation": shifts, "whitening": whitening}
        return with_residual(problem, residuals.relative_pose(pose=at[:, 0], pose_2=at[:, 1], **data))
    if key == "distances":
        pairs, found = values.parse_pairs(value, "points", {"length": ((),), "stddev": ((),)})
        at, kept = _parts(problem, where, "point", pairs, key, strict)
        length, sigma = (np.array([found[k][name] for k in kept]) for name in ("length", "stddev"))
        return with_residual(problem, residuals.distance(point=at[:, 0], point_2=at[:, 1], length=length, sigma=sigma))
    kind, name = "point" if key == "control_points" else "image", "directions" if key == "gravity" else "positions"
    more = {"gravity": (["up"], []), "position_priors": ([], ["align"])}.get(key, ([], []))
    items, vectors, loss = values.parse_vectors(value, name, kind, *more)
    at, kept = _parts(problem, where, kind, [[item] for item in items], name, strict)
    at, (vectors, stddev) = at[:, 0], vectors[:, kept]
    if key == "position_priors":
        align = values.parse_truth("align", value.get("align", "true"))
        return with_position_priors(problem, vectors, stddev=stddev, images=at.tolist(), loss=loss, align=align)
    if key == "control_points":
        rows = residuals.control_point(point=at, position=vectors, whitening=np.eye(3) / stddev[:, None])
    else:
        up = values.parse_numbers("up", value["up"], "three numbers", (3,))
        rows = residuals.gravity(pose=at, direction=vectors, up=up[None], sigma=stddev)
    return with_residual(problem, rows, loss=loss)


def _parts(
    problem: BundleProblem, where: str, kind: Part, rows: list[list[str]], what: str, strict: bool
) -> tuple[Int[np.ndarray, "kept n"], Int[np.ndarray, " kept"]]:
    """Images or points of those rows that name no others, and which rows these are."""
    labels, image = problem.labels, kind == "image"
    names = frozenset(labels.names if labels is not None and image else ())
    ids: Any = range(problem.num_cameras if image else problem.num_points)
    if labels is not None:
        ids = frozenset((labels.images if image else labels.points).tolist())
    wanted = [values.meant(row, names) for row in rows]
    known = [[one in names or one in ids for one in row] for row in wanted]
    kept = np.flatnonzero([all(row) for row in known])
    pairs = zip(sum(rows, []), sum(known, []), strict=True)
    others = list(dict.fromkeys(one for one, ok in pairs if not ok))
    if not len(kept):
        raise ValueError(f"none of the {kind}s is in the problem: {values.names_of(others) or f'no {what}'}")
    _leave_out(where, f"{what} of {counted(len(others), kind)} that the problem does not have", others, strict)
    flat = sum((wanted[k] for k in kept), [])
    at = np.array(flat) if labels is None else labels.positions(kind, flat)
    return at.reshape(len(kept), -1), kept


def _leave_out(where: str, what: str, names: list[str], strict: bool) -> None:
    if names and strict:
        raise ValueError(f"{what}: {values.names_of(names)}")
    report([f"{where}: left out {what}: {values.names_of(names)}"] if names else [])


def _rotation(given: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3 3"]:
    """Of an angle-axis vector, or a quaternion wxyz."""
    from scipy.spatial.transform import Rotation  # imported late, as in geometry.py

    if not given.any() and len(given) == 4:
        raise ValueError("rotation: the quaternion is zero")
    return (Rotation.from_rotvec(given) if len(given) == 3 else Rotation.from_quat(np.roll(given, -1))).as_matrix()


def _with_depths(problem: BundleProblem, where: str, value: Any, strict: bool) -> BundleProblem:
    """Depths from maps of the size of their images, each with a scale, at first the median, and a shift, at first 0.

    Of a BAL lens, whose pixels do not say where the image is, the principal point is the middle of the map.
    """
    values.parse_mapping(value, ["folder", "stddev"], ["loss", "loss_scale"])
    folder, loss = Path(where.rpartition(": ")[0]).parent / str(value["folder"]), values.parse_loss(value)
    (relative, *_) = values.parse_deviations("stddev", value["stddev"])
    names = list(map(str, range(problem.num_cameras))) if problem.labels is None else problem.labels.names
    measured, missing, ahead = np.full(problem.num_observations, np.nan), [], geometry.depths(problem)
    camera, scales = np.asarray(problem.camera_index), np.ones(problem.num_cameras)
    for at, name in enumerate(names):
        own = np.flatnonzero(camera == at)
        files = [x for x in (folder / f"{name}.npy", (folder / name).with_suffix(".npy")) if x.is_file()]
        if not files:
            missing.append(name)
            continue
        pixels = np.asarray(problem.observations)[own]
        measured[own] = _looked_up(files[0], pixels, centred=every_lens(problem).all_bal)
        if (good := own[np.isfinite(measured[own])]).size:
            scales[at] = 1 / np.median(ahead[good] / measured[good])
    _leave_out(where, f"{counted(len(missing), 'image')} without a map", missing, strict)
    kept = np.flatnonzero(np.isfinite(measured))
    if not len(kept):
        raise ValueError(f"{folder}: no map has a depth at a pixel of the problem")
    images, image = np.unique(camera[kept], return_inverse=True)
    index = {"pose": camera[kept], "point": np.asarray(problem.point_index)[kept], "image": image}
    rows = residuals.depth(**index, measured=measured[kept], sigma=relative * measured[kept])
    start = np.stack([scales[images], np.zeros(len(images))], axis=1)
    return with_residual(problem, rows, loss=loss, unknowns={"image": start})


def _looked_up(file: Path, pixels: Float[np.ndarray, "n 2"], *, centred: bool) -> Float[np.ndarray, " n"]:
    """Depths of a map at pixels, whose origin is the upper left corner, or its middle with y upwards; NaN where there
    is none."""
    try:
        depths = np.asarray(np.load(file, allow_pickle=False), np.float64)
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{file}: {reason(error)}") from None
    if depths.ndim != 2:
        raise ValueError(f"{file}: must be a matrix of depths, not an array of shape {depths.shape}")
    height, width = depths.shape
    if centred:
        pixels = pixels * [1, -1] + [width / 2, height / 2]
    column, row = np.floor(pixels).astype(int).T
    found = depths[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.where(inside & (found > 0) & np.isfinite(found), found, np.nan)
