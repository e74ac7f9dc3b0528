"""What a file of constraints says that was measured besides pixels, as residuals
(`jaxba.residuals`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Int

from jaxba import residuals
from jaxba.constraints import depth_maps, values
from jaxba.io.files import StrPath
from jaxba.io.image_files import files_of_images
from jaxba.io.notes import report
from jaxba.io.positions import read_gravity
from jaxba.model.registration import with_residual
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.image_names import named_images
from jaxba.problem.labels import Part
from jaxba.problem.row_data import is_unit

MEASURED = {
    "control_points": "positions: {id: [x, y, z]}, or file, check, pixels, crs and align; stddev, "
    "loss and loss_scale",
    "distances": "a list of {points: [id, id], length, stddev}",
    "gravity": "up, directions: {name or id: [x, y, z]}, or database; stddev, loss and loss_scale",
    "relative_poses": "a list of {images: [name or id, name or id], rotation, translation, stddev}",
    "depths": "folder, stddev, loss and loss_scale",
}
"""Keys of the file, and what they hold."""


def with_measured(
    problem: BundleProblem,
    where: str,
    key: str,
    value: Any,
    strict: bool,
    model: StrPath | None = None,
) -> BundleProblem:
    """The problem, perhaps of a COLMAP model, with what a key of `MEASURED` says.

    What is measured of images and points that the problem does not have is left out with a note
    that begins with `where`, or refused if `strict`. Raises ValueError: something that the value
    cannot be; one line."""
    if key == "depths":
        return _with_depths(problem, where, value, strict, model)
    kind = "point" if key in ("control_points", "distances") else "image"
    what = "pairs"
    loss = None
    if key == "distances":
        items, columns = values.parse_pairs(value, kind, {"length": ((),), "stddev": ((),)})
    elif key == "relative_poses":
        shapes = {"rotation": ((3,), (4,)), "translation": ((3,),), "stddev": ((2,),)}
        items, columns = values.parse_pairs(value, kind, shapes)
    else:
        what = "directions" if key == "gravity" else "positions"
        if (
            key == "gravity"
            and isinstance(value, dict)
            and "database" in value
            and what not in value
        ):
            found = read_gravity(values.beside(where, value, "database"))
            value = {name: one for name, one in value.items() if name != "database"}
            value[what] = {name: list(map(str, up.tolist())) for name, up in found.items()}
        items, columns = values.parse_vectors(value, what, kind, ["up"] if key == "gravity" else [])
        loss = values.parse_loss(value)
    at, kept = parts_of(problem, where, kind, items, what, strict)
    if (at[:1] == at[1:]).any():
        raise ValueError(f"a pair has the same {kind} twice")
    columns = {name: [column[k] for k in kept] for name, column in columns.items()}
    stddev = np.stack(columns["stddev"])
    of = columns.get(what)
    if key == "control_points":
        rows = residuals.control_point(
            point=at[0], position=of, whitening=np.eye(3) / stddev[:, None]
        )
    elif key == "gravity":
        up = values.parse_numbers("up", value["up"], "three numbers", (3,))
        rows = residuals.gravity(pose=at[0], direction=of, up=up[None], sigma=stddev)
    elif key == "distances":
        rows = residuals.distance(
            point=at[0], point_2=at[1], length=columns["length"], sigma=stddev
        )
    else:
        from scipy.spatial.transform import Rotation  # imported late, as in geometry.py

        for k, turn in zip(kept, columns["rotation"], strict=True):
            if len(turn) == 4 and not is_unit(turn[None]).all():
                pair = ", ".join(items[k])
                written = ", ".join(f"{number:g}" for number in turn)
                raise ValueError(
                    f"{pair}: rotation: must be a quaternion of length one, not [{written}]"
                )

        def read(x):
            return Rotation.from_quat(np.roll(x, -1)) if len(x) == 4 else Rotation.from_rotvec(x)

        rotation = np.stack([read(x).as_matrix() for x in columns["rotation"]])
        whitening = np.eye(6) / np.repeat(stddev, 3, axis=1)[:, None]
        data = {"rotation": rotation, "translation": columns["translation"], "whitening": whitening}
        rows = residuals.relative_pose(pose=at[0], pose_2=at[1], **data)
    return with_residual(problem, rows, loss=loss)


def parts_of(
    problem: BundleProblem,
    where: str,
    kind: Part,
    items: list[list[str]],
    what: str,
    strict: bool,
    *,
    table: bool = False,
) -> tuple[Int[np.ndarray, "n kept"], Int[np.ndarray, " kept"]]:
    """Images or points of those items that name no others, and which items these are.

    Args:
        problem: the problem.
        where: what notes begin with.
        kind: what the items are.
        items: names or ids, as text; each item has n of them.
        what: what is left out with an item.
        strict: whether to refuse what would be left out with a note.
        table: whether another program wrote the names, so that numbers are names of images rather
            than ids.

    Returns:
        Positions in the problem, and which items they are of.

    Raises:
        ValueError: none is left, or one is left out and `strict`; one line."""
    positions, doubts = _positions_of(
        problem, kind, [name for item in items for name in item], table
    )
    known = np.array([[name in positions for name in item] for item in items])
    kept = np.flatnonzero(known.all(axis=1))
    others = list(dict.fromkeys(np.array(items, object)[~known]))
    example = (
        f"; it has {problem.labels.names[0]}"
        if kind == "image" and problem.labels is not None
        else ""
    )
    unclear = [name for name in others if name in doubts]
    unknown = [name for name in others if name not in doubts]
    if not len(kept):
        doubt = f"; {doubts[unclear[0]]}" if unclear else example
        raise ValueError(f"none of the {kind}s is in the problem: {values.names_of(others)}{doubt}")
    leave_out(
        where, kind, f"{what} of {{}} that the problem does not have", unknown, strict, example
    )
    if unclear:
        leave_out(
            where,
            kind,
            f"{what} of {{}} whose names are not clear",
            unclear,
            strict,
            f"; {doubts[unclear[0]]}",
        )
    at = np.array([[positions[name] for name in items[k]] for k in kept], np.int64)
    return at.T, kept


def _positions_of(
    problem: BundleProblem, kind: Part, names: list[str], table: bool
) -> tuple[dict[str, int], dict[str, str]]:
    """Positions of images or points by names or ids, and why other names of images are not
    clear."""
    labels = problem.labels
    if labels is None:
        numbers = range(problem.num_cameras if kind == "image" else problem.num_points)
    else:
        numbers = (labels.images if kind == "image" else labels.points).tolist()
    by_id = {str(number): at for at, number in enumerate(numbers)}
    by_id = {name: by_id[name] for name in names if name in by_id}
    if labels is None or kind != "image":
        return by_id, {}
    by_name, doubts = named_images(names, labels.names)
    if table:
        return by_name or by_id, doubts
    exact = {name: at for name, at in by_name.items() if labels.names[at] == name}
    return by_name | by_id | exact, {
        name: doubt for name, doubt in doubts.items() if name not in by_id
    }


def leave_out(
    where: str, noun: str, what: str, names: list[str], strict: bool, more: str = ""
) -> None:
    """Notes what is left out, if it is anything.

    Args:
        where: what the note begins with.
        noun: what the names are of.
        what: what is left out, with `{}` for the number of them.
        names: of what it is left out.
        strict: whether to refuse it.
        more: what the note ends with.

    Raises:
        ValueError: `strict`; one line."""
    what = what.format(f"{len(names)} {noun}{'s' * (len(names) != 1)}")
    if names and strict:
        raise ValueError(f"{what}: {values.names_of(names)}{more}")
    report([f"{where}: left out {what}: {values.names_of(names)}{more}"] if names else [])


def _with_depths(
    problem: BundleProblem, where: str, value: Any, strict: bool, model: StrPath | None
) -> BundleProblem:
    """Depths from maps of the shape of their images, each with a scale, at first the median, and a
    shift, at first 0.

    Of a BAL lens, whose pixels do not say where the image is, the principal point is that of the
    model, or else the middle of the map. Raises ValueError: a map has another shape than its image,
    or disparities; one line."""
    values.parse_mapping(value, ["folder", "stddev"], ["loss", "loss_scale"])
    folder = values.beside(where, value, "folder")
    loss = values.parse_loss(value)
    if not folder.is_dir():
        raise ValueError(f"folder: there is no folder {folder}")
    relative = values.parse_deviations("stddev", value["stddev"])[0]
    names = (
        list(map(str, range(problem.num_cameras)))
        if problem.labels is None
        else problem.labels.names
    )
    files = files_of_images(folder, names, ".npy")
    missing = [name for name, file in zip(names, files, strict=True) if file is None]
    leave_out(where, "image", "{} without a map", missing, strict)
    camera = np.asarray(problem.camera_index)
    measured = np.full(problem.num_observations, np.nan)
    placed = depth_maps.pixels_of_images(problem, model)
    for at, file in enumerate(files):
        if file is not None:
            own = np.flatnonzero(camera == at)
            measured[own] = depth_maps.looked_up(file, placed, own, at)
    kept = np.flatnonzero(np.isfinite(measured))
    if not len(kept):
        raise ValueError(f"{folder}: no map has a depth at a pixel of the problem")
    images, image = np.unique(camera[kept], return_inverse=True)
    measured = measured[kept]
    depths = geometry.depths(problem)[kept]
    depth_maps.refuse_disparities(folder, image, measured, depths)
    ratio = measured / depths
    start = [[np.median(ratio[image == k]), 0.0] for k in range(len(images))]
    index = {"pose": camera[kept], "point": np.asarray(problem.point_index)[kept], "image": image}
    rows = residuals.depth(**index, measured=measured, sigma=relative * measured)
    return with_residual(problem, rows, loss=loss, unknowns={"image": start})
