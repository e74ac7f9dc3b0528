"""OpenMVG's `sfm_data.json`: views, intrinsics, extrinsics and structure, as its serialisation library writes them.

A camera at c maps X to `K d((R (X - c)).xy / z)`, pixels from the corner of the image. A class that comes again has its
number without the name. Source: OpenMVG, sfm/sfm_data_io_cereal.cpp, cameras/*_io.hpp; cereal, "Polymorphism"."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaxba.io.files import StrPath
from jaxba.io.foreign.cameras import BROWN, FISHEYE, UNDEFINED, ForeignLens, Landmark, build, checked_pose, part
from jaxba.io.foreign.json_records import Record
from jaxba.io.notes import note_unused
from jaxba.problem.bundle_problem import BundleProblem

VERSION = "sfm_data_version"  # key that only OpenMVG's files have

MODELS = {
    "pinhole": (None, 0),
    "pinhole_radial_k1": ("disto_k1", 1),
    "pinhole_radial_k3": ("disto_k3", 3),
    "pinhole_brown_t2": ("disto_t2", 5),
    "fisheye": ("fisheye", 4),
}
"""Camera models that are read: where their coefficients stand, and how many they are."""

PRIORS = {"use_pose_center_prior": "priors of positions", "use_pose_rotation_prior": "priors of rotations"}
"""What views may hold besides, and the flags that say so. Source: OpenMVG, sfm/sfm_view_priors_io.cpp."""

PARTS = (VERSION, "root_path", "views", "intrinsics", "extrinsics", "structure")  # what is read, or known
_FIRST = 1 << 31  # bit that marks the first coming of a class or an object. Source: cereal, `detail::msb_32bit`

_PROGRAM = "OpenMVG"


def recognises(document: Record) -> bool:
    """Whether a JSON document is of OpenMVG."""
    return isinstance(document.value, dict) and VERSION in document.value


def from_document(document: Record, path: StrPath) -> BundleProblem:
    """The problem of a whole result of OpenMVG.

    Cameras are the views that have a pose and see a point; they share the lens of their intrinsic. `pinhole`,
    `pinhole_radial_k1` and, where k3 is 0, `pinhole_radial_k3` are optimised. The intrinsics of the others in `MODELS`
    stay as they are. Raises ProblemError: the file lacks a part, names a camera model that is not in `MODELS`, or views
    share a pose; one line that names the file, the record and the field."""
    views = {}
    unused = dict.fromkeys(PRIORS.values(), 0)
    for key, value in part(document, "views", _PROGRAM).numbered("key", "view", "value"):
        data = value.get("ptr_wrapper").get("data").called(value.where)
        for flag, what in PRIORS.items():
            unused[what] += data.get(flag, False).flag()
        pose, intrinsic = (data.get(one, UNDEFINED).integer() for one in ("id_pose", "id_intrinsic"))
        views[data.get("id_view", key).integer()] = pose, intrinsic
    intrinsics = _intrinsics(part(document, "intrinsics", _PROGRAM))
    poses = {}
    for key, value in part(document, "extrinsics", _PROGRAM).numbered("key", "pose", "value"):
        rotation = [row.vector(3) for row in value.get("rotation").rows()]
        poses[key] = checked_pose(value, np.array(rotation), value.get("center").vector(3))
    landmarks = _landmarks(part(document, "structure", _PROGRAM))
    note_unused(path, unused | document.unknown(PARTS))
    return build(path, views, poses, intrinsics, lambda key: _lens(*intrinsics[key]), landmarks)


def _intrinsics(record: Record) -> dict[int, tuple[str, Record]]:
    """Model and parameters of each intrinsic, with the references of the serialisation library resolved."""
    found = {}
    models, objects = {}, {}
    for key, value in record.numbered("key", "intrinsic", "value"):
        identity = value.get("polymorphic_id").integer()
        if value.has("polymorphic_name"):
            models[identity & ~_FIRST] = value.get("polymorphic_name").text()
        if identity & ~_FIRST not in models:
            value.fail(f"has polymorphic_id {identity}, whose name was not given before")
        wrapper = value.get("ptr_wrapper")
        number = wrapper.get("id").integer() & ~_FIRST
        if wrapper.has("data"):
            objects[number] = wrapper.get("data").called(value.where)
        if number not in objects:
            value.fail(f"has no data, and none before has its id {number}")
        found[key] = models[identity & ~_FIRST], objects[number]
    return found


def _lens(model: str, data: Record) -> ForeignLens:
    if model not in MODELS:
        data.fail(f"is of the model {model!a}, which is not read; read are {', '.join(MODELS)}")
    key, count = MODELS[model]
    numbers = data.get(key).vector(count) if key else []
    focal, size = data.get("focal_length").number(), (data.get("width").number(), data.get("height").number())
    x, y = data.get("principal_point").vector(2)
    fisheye = model == "fisheye"
    distortion = dict(zip(FISHEYE if fisheye else BROWN, numbers, strict=False))
    return ForeignLens(data.where, (focal, focal), (x, y), distortion, fisheye, size)


def _landmarks(structure: Record) -> Iterator[Landmark]:
    for key, value in structure.numbered("key", "landmark", "value"):
        seen = list(value.get("observations").numbered("key", f"landmark {key}: observation in view", "value"))
        yield value.get("X").vector(3), [view for view, _ in seen], [one.get("x").vector(2) for _, one in seen]
