"""A `pycolmap.Reconstruction` as a COLMAP model, without files, and a model's numbers back into it.

Every object that pycolmap hands out costs about a microsecond. So only those are asked for that a
part of the reconstruction needs, and the key-points of an image come together."""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from jaxba.io.colmap.model import (
    CAMERA_SENSOR,
    KEY,
    NO_POINT,
    POINT,
    Camera,
    Frame,
    Image,
    Model,
    Rig,
    Sensor,
    check_model,
)
from jaxba.io.colmap.poses import Pose

NAME = "the reconstruction"
"""What messages call it."""

Keys = Shaped[np.ndarray, " keys"]
"""Key-points of an image, of type `KEY`: in their places those that were read, in others ones that
see no point."""


def read_part(
    reconstruction: Any, images: Iterable[int], points: Iterable[int], min_track: int = 0
) -> Model:
    """The model of what some images see and of all that sees some points.

    Key-points say what an image sees, and tracks what images besides the given ones see of the
    points. Images that are not registered are left out. Records are as in the files, but for
    colours, errors, and poses of images, which are those of their frames; lengths of tracks are
    those of the whole reconstruction.

    Args:
        reconstruction: a `pycolmap.Reconstruction`.
        images: ids of images that it has.
        points: ids of points that it has.
        min_track: length of the shortest track of a point that counts.

    Raises ProblemError: as `check_model`."""
    points = list(points)
    keys = _keys_of_images(reconstruction, images)
    keys |= _other_keys(reconstruction, points, keys)
    return _with_points(reconstruction, keys, points, min_track)


def read_whole(reconstruction: Any, min_track: int = 0) -> Model:
    """The model of all registered images and all points. Arguments and errors as for
    `read_part`."""
    keys = _keys_of_images(reconstruction, reconstruction.reg_image_ids())
    return _with_points(reconstruction, keys, list(reconstruction.point3D_ids()), min_track)


def read_records(reconstruction: Any, images: Iterable[int]) -> Model:
    """The model of some registered images without key-points and points: their poses, cameras and
    rigs. Raises ProblemError: as `check_model`."""
    keys = {number: np.empty(0, KEY) for number in _registered(reconstruction, images)}
    return _model(reconstruction, keys, np.empty(0, POINT))


def write_records(reconstruction: Any, old: Model, new: Model) -> None:
    """Gives a reconstruction the cameras, rigs and frames of a model that are not as in the model
    that was read."""
    import pycolmap

    def rotation(pose: Pose) -> Any:
        w, *xyz = pose[:4]
        return pycolmap.Rotation3d(np.array([*xyz, w]))

    for number, camera in new.cameras.items():
        if camera.params != old.cameras[number].params:
            reconstruction.camera(number).params = np.array(camera.params)
    for number, rig in (new.rigs or {}).items():
        if rig != (old.rigs or {})[number]:
            places = {(sensor.type, sensor.id): sensor.from_rig for sensor in rig.sensors}
            for sensor, place in reconstruction.rig(number).non_ref_sensors.items():
                pose = places[int(sensor.type), sensor.id]
                if pose is not None:
                    place.rotation, place.translation = rotation(pose), np.array(pose[4:])
    for number, frame in (new.frames or {}).items():
        if frame.pose != (old.frames or {})[number].pose:
            pose = pycolmap.Rigid3d(rotation(frame.pose), np.array(frame.pose[4:]))
            reconstruction.frame(number).rig_from_world = pose


def _registered(reconstruction: Any, images: Iterable[int]) -> dict[int, Any]:
    """Those of some images that have a pose, by id."""
    of_ids = {number: reconstruction.image(number) for number in sorted(images)}
    return {number: image for number, image in of_ids.items() if image.has_pose}


def _keys_of_images(reconstruction: Any, images: Iterable[int]) -> dict[int, Keys]:
    """The key-points of registered images that see a point, by their images."""
    keys = {}
    for number, image in _registered(reconstruction, images).items():
        keys[number] = of_image = _no_keys(image)
        seen = image.get_observation_points2D()
        if len(seen):
            at = image.get_observation_point2D_idxs()
            of_image["xy"][at] = _pixels(seen)
            of_image["point"][at] = _points_of(seen)
    return keys


def _pixels(keys: Any) -> Float[np.ndarray, "keys 2"]:
    """Where key-points are, in one array: pycolmap gives those of single ones as an array each."""
    import pycolmap

    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[1.0, 0.0, 0.0])
    return np.asarray(camera.cam_from_img(keys))  # its rays are the pixels


def _points_of(keys: Any) -> Shaped[np.ndarray, " keys"]:
    """The ids of the points that key-points are of."""
    return np.array([key.point3D_id for key in keys], np.uint64)


def _no_keys(image: Any) -> Keys:
    keys = np.zeros(image.num_points2D(), KEY)
    keys["point"] = NO_POINT
    return keys


def _other_keys(
    reconstruction: Any, points: Iterable[int], known: dict[int, Keys]
) -> dict[int, Keys]:
    """The key-points of some points in registered images of which none are known yet, by their
    images. One that says it is of another point than the track does is left out."""
    import pycolmap

    # of their key-points in each image, and their points
    places: dict[int, tuple[list[int], list[int]]] = {}
    for point in points:
        for element in reconstruction.point3D(point).track.elements:
            image = element.image_id
            if image not in known:
                at, of_points = places.setdefault(image, ([], []))
                at.append(element.point2D_idx)
                of_points.append(point)
    others = {}
    for number, image in _registered(reconstruction, places).items():
        at, of_points = map(np.array, places[number])
        seen = pycolmap.Point2DList([image.point2D(k) for k in at.tolist()])
        agrees = _points_of(seen) == of_points.astype(np.uint64)
        if agrees.any():
            others[number] = of_image = _no_keys(image)
            of_image["xy"][at[agrees]] = _pixels(seen)[agrees]
            of_image["point"][at[agrees]] = of_points[agrees]
    return others


def _with_points(
    reconstruction: Any, keys: dict[int, Keys], points: list[int], min_track: int
) -> Model:
    """The model of images with key-points, of the points of these, and of other points; those of
    short tracks are left out."""
    seen = [of["point"][of["point"] != NO_POINT] for of in keys.values()]
    heads = _points(reconstruction, np.unique(np.concatenate([np.array(points, np.uint64), *seen])))
    short = heads["id"][heads["length"] < min_track]
    for of_image in keys.values() if len(short) else ():
        of_image["point"][np.isin(of_image["point"], short)] = NO_POINT
    return _model(reconstruction, keys, heads[heads["length"] >= min_track])


def _points(reconstruction: Any, ids: Shaped[np.ndarray, " ids"]) -> Shaped[np.ndarray, " points"]:
    """Those of some points that are there, of type `POINT`, without colours and errors."""
    points3D = reconstruction.points3D
    there = [number for number in ids.tolist() if number in points3D]
    points = [points3D[number] for number in there]
    heads = np.zeros(len(there), POINT)
    if there:
        heads["id"] = there
        heads["xyz"] = np.concatenate([point.xyz for point in points]).reshape(-1, 3)
        heads["length"] = [point.track.length() for point in points]
    return heads


def _model(
    reconstruction: Any, keys: dict[int, Keys], points: Shaped[np.ndarray, " points"]
) -> Model:
    """The model of some registered images with key-points, and of points."""
    of_ids = {number: reconstruction.image(number) for number in sorted(keys)}
    of_frames = {image.frame_id for image in of_ids.values()}
    frames = {number: _frame_of(reconstruction.frame(number), keys) for number in sorted(of_frames)}
    images = {
        number: Image(
            number, frames[image.frame_id].pose, image.camera_id, _name_of(image), keys[number]
        )
        for number, image in of_ids.items()
    }
    of_rigs = {frame.rig for frame in frames.values()}
    rigs = {number: _rig_of(reconstruction.rig(number)) for number in sorted(of_rigs)}
    of_cameras = {image.camera for image in images.values()}
    cameras = {number: _camera_of(reconstruction.camera(number)) for number in sorted(of_cameras)}
    model = Model(NAME, "", cameras, images, points, None, rigs, frames)
    check_model(model)
    return model


def _name_of(image: Any) -> bytes:
    try:
        return image.name.encode()
    # pycolmap gives names as text, in which not every name of a file can be
    except UnicodeDecodeError as error:
        return error.object


def _pose_of(rigid: Any) -> Pose:
    x, y, z, w = rigid.rotation.quat.tolist()
    return w, x, y, z, *rigid.translation.tolist()


def _camera_of(camera: Any) -> Camera:
    return Camera(
        camera.camera_id,
        camera.model.name,
        camera.width,
        camera.height,
        tuple(camera.params.tolist()),
    )


def _frame_of(frame: Any, images: Container[int]) -> Frame:
    """A frame with what cameras took for it of some images."""
    data = [(int(datum.sensor_id.type), datum.sensor_id.id, datum.id) for datum in frame.data_ids]
    taken = [datum for datum in data if datum[0] == CAMERA_SENSOR and datum[2] in images]
    return Frame(frame.frame_id, frame.rig_id, _pose_of(frame.rig_from_world), tuple(sorted(taken)))


def _rig_of(rig: Any) -> Rig:
    reference = rig.ref_sensor_id
    others = [
        Sensor(int(sensor.type), sensor.id, None if place is None else _pose_of(place))
        for sensor, place in rig.non_ref_sensors.items()
    ]
    return Rig(rig.rig_id, (Sensor(int(reference.type), reference.id, None), *others))
