"""A run as a recording of ROS 2 messages, in an MCAP file for Foxglove, Rerun and ROS 2.

Lengths are in metres there.  The frame ``world`` is the head's at position 0, x to the right, y
along the track, z up; ``head`` moves along; ``camera`` is the picture's, x to the right, y down, z
ahead, and its place is known where a calibration knows the camera.

References
----------
ROS Enhancement Proposal 103, standard units of measure and coordinate conventions.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from lscan.acquisition.run import MANIFEST, TABLE, Run, most_table_bytes
from lscan.acquisition.writer import PNG
from lscan.calibration.check import map_for_rig
from lscan.calibration.maps.auto import Auto
from lscan.calibration.physical import PhysicalMap
from lscan.calibration.planemap import PlaneMap
from lscan.camera import CameraModel, project, rays
from lscan.camera.optics import meet_plane
from lscan.camera.posedboards import camera_of
from lscan.config.rig import BENDS, Rig
from lscan.errors import InputError
from lscan.files.disk import MOST_TEXT_BYTES, read_bytes
from lscan.files.pictures import encode_picture, with_bits
from lscan.files.rosmessages import LAST_S, POINT_FIELD, MessageFile, message_file, time_of
from lscan.records import Floats, Picture, Progress, Status, Surface, select
from lscan.surface.shaft import shaft_of

Message = dict[str, Any]
WORLD, HEAD, CAMERA = "world", "head", "camera"
FRAME_OF = {"head": WORLD, "workpiece": "workpiece"}
"""The frame of a surface's points, by ``Surface.frame``."""
PICTURE, BACKGROUND = "/camera/image_raw/compressed", "/camera/dark/compressed"
LENS, TRACK, POINTS, TRANSFORMS = "/camera/camera_info", "/track/pose", "/points", "/tf"
STATUS_CODES = "status-codes.txt"  # attached: what the field status means
_KINDS = {
    PICTURE: "sensor_msgs/CompressedImage",
    BACKGROUND: "sensor_msgs/CompressedImage",
    LENS: "sensor_msgs/CameraInfo",
    TRACK: "geometry_msgs/PoseStamped",
    POINTS: "sensor_msgs/PointCloud2",
    TRANSFORMS: "tf2_msgs/TFMessage",
}
SAME_PLACE_MM = 1e-3
_GRID = 13, 11  # pixels along u and v at which a lens behind a port is looked at


@dataclass(frozen=True)
class HeadCamera:
    """A camera's place in the head, and a lens that sees the sheet as it does.

    Attributes
    ----------
    rotation : (3, 3) array, from the camera's frame to the head's
    place_mm : (3,) array, mm, of the pinhole, frame of the head
    lens : CameraModel, without a port
    off_px : float, px, by how much the lens misses what the camera sees of the sheet, at most
    """

    rotation: Floats
    place_mm: Floats
    lens: CameraModel
    off_px: float


def head_camera(plane_map: PlaneMap, rig: Rig) -> HeadCamera | None:
    """The camera of a plane map; None where the map knows none.

    What reads a CameraInfo knows of no port.  A pinhole with Brown's distortion stands for one on
    the sheet, where each pixel sees one distance, and not before or behind it.

    Parameters
    ----------
    plane_map : PlaneMap, as calibrated
    rig : Rig, of the run, whose water counts
    """
    solved = map_for_rig(plane_map, rig)
    solved = solved.chosen if isinstance(solved, Auto) else solved
    if not isinstance(solved, PhysicalMap):
        return None
    geometry, (x_mm, z_mm) = solved.geometry, solved.geometry.at_mm
    rotation = geometry.axes.T
    place_mm = np.array([x_mm, 0.0, z_mm]) - rotation @ geometry.place_mm
    camera = camera_of(geometry.theta, geometry.port)
    if camera.port is None:
        return HeadCamera(rotation, place_mm, camera, 0.0)
    sides = zip(rig.camera.size_px, _GRID, strict=True)
    axes = np.meshgrid(*(np.linspace(0, size - 1, count) for size, count in sides))
    pixels = np.stack(axes, axis=-1).reshape(-1, 2)
    points = meet_plane(rays(camera, pixels), geometry.axes[:, 1], geometry.place_mm)
    seen = np.isfinite(points).all(axis=1)

    def lens_of(numbers: Floats) -> CameraModel:
        focal_px, u, v, *bends = numbers.tolist()
        return CameraModel(focal_px, (u, v), *bends)

    def off_px(numbers: Floats) -> Floats:
        return (project(lens_of(numbers), points[seen]) - pixels[seen]).ravel()

    start = [camera.focal_px * camera.port.water_index, *camera.centre_px, *[0.0] * 5]
    found = least_squares(off_px, start, x_scale="jac").x
    most_px = float(np.linalg.norm(off_px(found).reshape(-1, 2), axis=1).max())
    return HeadCamera(rotation, place_mm, lens_of(found), most_px)


def stamps_ns(run: Run, start: datetime | None = None) -> list[int]:
    """The time of each picture, ns: by the camera's own clock, or from a time of the first one.

    Parameters
    ----------
    run : Run
    start : datetime, optional, with its time zone: when the first picture was taken

    Raises
    ------
    InputError
        There is no picture, or one was taken at a time that a stamp cannot hold.
    """
    if len(run) == 0:
        raise InputError("holds no picture yet", where=run.path)
    first_s, first_ns = 0.0, 0
    if start is not None:
        first_s = run.rows[0].time_s
        first_ns = 1000 * ((start - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1))
    stamps = [first_ns + round(1e9 * (row.time_s - first_s)) for row in run.rows]
    for row, stamp in zip(run.rows, stamps, strict=True):
        if not 0 <= stamp < (LAST_S + 1) * 10**9:
            what = f"frame {row.index} was taken at a time that a ROS message cannot hold"
            allowed = f"0 to {LAST_S} s; --start counts from another time"
            raise InputError(what, where=run.path, value=stamp / 1e9, allowed=allowed)
    return stamps


def write_recording(
    path: Path,
    run: Run,
    stamps: list[int],
    clouds: Iterable[Surface] | None = None,
    camera: HeadCamera | None = None,
    progress: Progress | None = None,
) -> dict[str, int]:
    """Write a run's pictures and positions, and what they were turned into, to an MCAP file.

    Topics: the pictures, to the byte, as sensor_msgs/CompressedImage; the head's place as
    geometry_msgs/PoseStamped and in /tf; with a camera, sensor_msgs/CameraInfo and its place in
    /tf; of each cloud a sensor_msgs/PointCloud2 with x, y, z, sigma_x, sigma_z (m), status, and,
    where they are known, sigma_y (m) and intensity (DN).  The run's tables are attached.

    Parameters
    ----------
    path : Path, of the file
    run : Run
    stamps : list of int, ns, of each picture, as ``stamps_ns`` gives them
    clouds : iterable of Surface, optional, mm, of one profile each, in the order of the pictures
    camera : HeadCamera, optional
    progress : callable, optional, called with the number of pictures done, and of all

    Returns
    -------
    dict, number of messages by topic

    Raises
    ------
    InputError
        A picture is missing or not the one that was recorded, the disk refuses, or the package mcap
        is missing.
    """
    counts, rig = Counter[str](), run.rig_file.rig
    profiles = itertools.repeat(None, len(run)) if clouds is None else clouds
    with message_file(path) as file:
        for row, stamp, profile in zip(run.rows, stamps, profiles, strict=True):
            pictures = {PICTURE: run.picture_bytes(row)}
            if row.dark_sha256 is not None:
                pictures[BACKGROUND] = run.picture_bytes(row, dark=True)
            for topic, message in _messages(rig, row.position_mm, stamp, pictures, camera, profile):
                file.write(topic, _KINDS[topic], stamp, message, row.index)
                counts[topic] += 1
            if progress:
                progress(row.index + 1, len(run))
        manifest = read_bytes(run.path / MANIFEST, MOST_TEXT_BYTES, within=run.path)
        table = read_bytes(run.path / TABLE, most_table_bytes(rig.plan), within=run.path)
        codes = "".join(f"{int(status)} {status.name}\n" for status in Status)
        file.attach(MANIFEST, "application/json", manifest)
        file.attach(TABLE, "text/csv", table)
        file.attach(STATUS_CODES, "text/plain", codes.encode())
    return dict(counts)


class LiveRecording:
    """A recording that pictures are added to as they are looked at, of the same topics.

    Parameters
    ----------
    file : MessageFile
    rig : Rig, whose camera and track they are of
    """

    def __init__(self, file: MessageFile, rig: Rig) -> None:
        self._file, self._rig = file, rig
        self._camera: tuple[PlaneMap, HeadCamera | None] | None = None
        self._number = 0

    def add(
        self, stamp: int, image: Picture, position_mm: float | None, profile: Surface | None = None,
        plane_map: PlaneMap | None = None,
    ) -> None:  # fmt: skip
        """Add a picture; the head's place where it is known, and then the points and the camera.

        Parameters
        ----------
        stamp : int, ns, since 1970, when it was taken
        image : (H, W) or (H, W, 3) array, uint8 or uint16
        position_mm : float or None, mm, of the track
        profile : Surface, optional, mm, the points of this picture
        plane_map : PlaneMap, optional, that they are by
        """
        png = with_bits(encode_picture(image, ".png", PNG), image)
        if position_mm is None:
            parts = _pictures({PICTURE: png}, stamp)
        else:
            if plane_map is not None and (self._camera is None or self._camera[0] is not plane_map):
                self._camera = plane_map, head_camera(plane_map, self._rig)
            camera = self._camera[1] if plane_map is not None and self._camera else None
            parts = _messages(self._rig, position_mm, stamp, {PICTURE: png}, camera, profile)
        for topic, message in parts:
            self._file.write(topic, _KINDS[topic], stamp, message, self._number)
        self._number += 1


def _messages(
    rig: Rig,
    position_mm: float,
    stamp: int,
    pictures: Mapping[str, bytes],
    camera: HeadCamera | None,
    profile: Surface | None,
) -> Iterator[tuple[str, Message]]:
    """The messages of one picture, each with its topic; pictures: PNG files, by theirs."""
    turn, place_mm = _head_pose(rig, position_mm)
    in_world, of_camera = _header(stamp, WORLD), _header(stamp, CAMERA)
    pose = {"position": _vector(place_mm), "orientation": _quaternion(turn)}
    yield TRACK, {"header": in_world, "pose": pose}
    transforms = [_transform(in_world, HEAD, turn, place_mm)]
    if camera is not None:
        in_head = _header(stamp, HEAD)
        transforms.append(_transform(in_head, CAMERA, camera.rotation, camera.place_mm))
        yield LENS, {"header": of_camera, **_camera_info(camera.lens, rig)}
    yield TRANSFORMS, {"transforms": transforms}
    yield from _pictures(pictures, stamp)
    if profile is not None:
        yield POINTS, {"header": _header(stamp, FRAME_OF[profile.frame]), **_cloud(profile)}


def _pictures(pictures: Mapping[str, bytes], stamp: int) -> Iterator[tuple[str, Message]]:
    for topic, png in pictures.items():
        yield topic, {"header": _header(stamp, CAMERA), "format": "png", "data": png}


def profiles_of(surface: Surface, run: Run, where: Path) -> Iterable[Surface]:
    """The surface's profiles one by one, each a surface of its own.

    Parameters
    ----------
    surface : Surface, mm, in either frame
    run : Run, whose pictures it is to have been made from
    where : Path, of the surface, for the error

    Raises
    ------
    InputError
        Its profiles do not lie where the run's pictures were taken.
    """
    places = surface.position_mm, run.positions_mm
    # Another program may have rewritten the file, in metres say.
    if len(surface.position_mm) != len(run) or np.abs(np.subtract(*places)).max() > SAME_PLACE_MM:
        what = "is not a surface of that run: its profiles lie at other positions"
        value, allowed = f"{len(surface.position_mm)} profiles", f"the {len(run)} of {run.path}"
        raise InputError(what, where=where, value=value, allowed=allowed)
    return (select(surface, slice(index, index + 1)) for index in range(len(run)))


def _head_pose(rig: Rig, position_mm: float) -> tuple[Floats, Floats]:
    """(3, 3) and (3,) mm: from the head's frame there to the world's."""
    if rig.shaft is None:
        return np.eye(3), np.array([0.0, position_mm, 0.0])
    shaft, position = shaft_of(rig.shaft), np.asarray(position_mm)
    return shaft.rotation(position), shaft.turn(np.zeros(3), position)


def _header(stamp_ns: int, frame: str) -> Message:
    return {"stamp": time_of(stamp_ns), "frame_id": frame}


def _vector(place_mm: Floats) -> Message:
    return dict(zip("xyz", (place_mm / 1000.0).tolist(), strict=True))


def _quaternion(turn: Floats) -> Message:
    return dict(zip("xyzw", Rotation.from_matrix(turn).as_quat().tolist(), strict=True))


def _transform(header: Message, child: str, turn: Floats, place_mm: Floats) -> Message:
    transform = {"translation": _vector(place_mm), "rotation": _quaternion(turn)}
    return {"header": header, "child_frame_id": child, "transform": transform}


def _camera_info(lens: CameraModel, rig: Rig) -> Message:
    focal, (u, v) = lens.focal_px, lens.centre_px
    model, bends = "plumb_bob", tuple[str, ...](BENDS[:5])
    if lens.fisheye:
        model, bends = "equidistant", ("k1", "k2", "k3", "k4")
    elif (lens.k4, lens.k5, lens.k6) != (0.0, 0.0, 0.0):
        model, bends = "rational_polynomial", BENDS
    unused = dict.fromkeys(("x_offset", "y_offset", "height", "width", "do_rectify"), 0)
    return {
        "height": rig.camera.height_px,
        "width": rig.camera.width_px,
        "distortion_model": model,
        "d": [getattr(lens, name) for name in bends],
        "k": [focal, 0.0, u, 0.0, focal, v, 0.0, 0.0, 1.0],
        "r": np.eye(3).ravel().tolist(),
        "p": [focal, 0.0, u, 0.0, 0.0, focal, v, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": unused,
    }


def _cloud(profile: Surface) -> Message:
    """The points of a profile, all of them: one without a value is NaN, as its status says."""
    in_mm = {
        **dict(zip("xyz", profile.xyz_mm[0].T, strict=True)),
        "sigma_x": profile.sigma_x_mm[0],
        "sigma_z": profile.sigma_z_mm[0],
    }
    if profile.sigma_y_mm is not None:
        in_mm["sigma_y"] = profile.sigma_y_mm[0]
    columns = {name: values / 1000.0 for name, values in in_mm.items()}
    if profile.brightness is not None:
        columns["intensity"] = profile.brightness[0]
    columns["status"] = profile.status[0]
    types = {name: "u1" if name == "status" else "<f4" for name in columns}
    table = np.zeros(len(profile.status[0]), np.dtype([*types.items()], align=True))
    for name, values in columns.items():
        table[name] = values
    places: Mapping[str, Any] = table.dtype.fields or {}
    fields = [
        {"name": name, "offset": places[name][1], "datatype": POINT_FIELD[kind], "count": 1}
        for name, kind in types.items()
    ]
    return {
        "height": 1,
        "width": len(table),
        "fields": fields,
        "is_bigendian": False,
        "point_step": table.itemsize,
        "row_step": table.nbytes,
        "data": table.tobytes(),
        "is_dense": bool(np.isfinite(profile.xyz_mm).all()),
    }
