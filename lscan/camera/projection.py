"""From pixels to rays in the water, and from points in the water to pixels."""

from dataclasses import dataclass

import numpy as np

from lscan.camera.lens import distort, undistort
from lscan.camera.model import CameraModel
from lscan.camera.port import aim_through_port, leave_port
from lscan.errors import InputError
from lscan.records import Floats


@dataclass(frozen=True)
class Rays:
    """N rays in front of a camera; NaN where a pixel has none.

    Attributes
    ----------
    origin_mm : (N, 3) array, mm, camera frame, where the ray enters the water; the pinhole for a
        camera in air
    direction : (N, 3) array, unit, camera frame, away from the camera
    """

    origin_mm: Floats
    direction: Floats


def rays(camera: CameraModel, image_px: Floats) -> Rays:
    """The rays in the water on which a camera sees pixels.

    Parameters
    ----------
    camera : CameraModel, in air or behind a port
    image_px : (N, 2) array, px, of (u, v)

    Returns
    -------
    Rays
        N of them, camera frame; NaN for pixels that are NaN, that the distortion never reaches, or
        whose rays miss the port.

    Raises
    ------
    InputError
        Where ``image_px`` is not (N, 2).

    References
    ----------
    docs/explanation/physics.md, section 6.

    Examples
    --------
    >>> import numpy as np
    >>> from lscan.camera import CameraModel, rays
    >>> rays(CameraModel(800.0, (319.5, 239.5)), np.array([[319.5, 239.5]])).direction
    array([[0., 0., 1.]])
    """
    pixels = require_columns(image_px, "image_px", 2)
    distorted = (pixels - np.array(camera.centre_px)) / camera.focal_px
    return rays_of(camera, undistort(camera, distorted))


def rays_of(camera: CameraModel, tangents: Floats) -> Rays:
    """The rays in the water that leave the lens in given directions.

    Parameters
    ----------
    camera : CameraModel, its port
    tangents : (N, 2) array, x/z and y/z of directions in air, camera frame; as ``undistort`` gives
    """
    ahead = np.column_stack([tangents, np.ones(len(tangents))])
    air = ahead / np.linalg.norm(ahead, axis=1)[:, None]
    if camera.port is None:
        return Rays(np.where(np.isnan(air), np.nan, 0.0), air)
    return Rays(*leave_port(camera.port, air))


def project(camera: CameraModel, points_mm: Floats) -> Floats:
    """The pixels at which a camera sees points.

    Parameters
    ----------
    camera : CameraModel, in air or behind a port
    points_mm : (N, 3) array, mm, camera frame

    Returns
    -------
    array
        (N, 2) pixels (u, v), some of which may lie outside the picture.  NaN where the camera forms
        no image: points not beyond the port's glass (or not ahead of the pinhole), or so far off
        the axis that the distortion folds back.

    Raises
    ------
    InputError
        Where ``points_mm`` is not (N, 3).

    References
    ----------
    docs/explanation/physics.md, section 6.

    Examples
    --------
    >>> import numpy as np
    >>> from lscan.camera import CameraModel, project
    >>> project(CameraModel(800.0, (319.5, 239.5)), np.array([[50.0, 0.0, 1000.0]]))
    array([[359.5, 239.5]])
    """
    points = require_columns(points_mm, "points_mm", 3)
    direction = points if camera.port is None else aim_through_port(camera.port, points)
    ahead = np.where(direction[:, 2] > 0, direction[:, 2], np.nan)
    tangents = direction[:, :2] / ahead[:, None]
    return camera.focal_px * distort(camera, tangents) + np.array(camera.centre_px)


def meet_plane(seen: Rays, normal: Floats, place_mm: Floats) -> Floats:
    """(N, 3) mm where rays meet a plane; NaN if it is not ahead of them.

    Parameters
    ----------
    seen : Rays, N of them
    normal : (3,) array, of the plane, in the frame of the rays
    place_mm : (3,) array, mm, a point of the plane, in the frame of the rays
    """
    along = seen.direction @ normal
    distance = ((place_mm - seen.origin_mm) @ normal) / np.where(along != 0, along, np.nan)
    ahead = np.where(distance > 0, distance, np.nan)
    return seen.origin_mm + ahead[:, None] * seen.direction


def require_columns(array: Floats, name: str, columns: int) -> Floats:
    """(N, columns) floats, the array itself.

    Parameters
    ----------
    array : (N, columns) array
    name : str, of the argument, for the message
    columns : int, how many it must have

    Raises
    ------
    InputError
        Where it has another shape.
    """
    values = np.asarray(array, dtype=float)
    if values.ndim != 2 or values.shape[1] != columns:
        raise InputError("bad shape", where=name, value=values.shape, allowed=f"(N, {columns})")
    return values
