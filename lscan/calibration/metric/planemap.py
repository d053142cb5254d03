"""The plane map of the metric route: a pixel's ray, through the port, to the laser's plane.

Frame: the sheet's own.  x is the camera's u axis laid into the sheet, y the sheet's normal
away from the camera, z = x cross y, up; the origin is the point of the sheet seen in the middle
of the picture, a pixel, so that no uncertainty of the lens's centre displaces it.  With a camera
that is not rolled against the horizon, x is horizontal.  Of a sheet that runs down the picture,
seen almost edge on, z is the camera's upward direction laid into the sheet.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Any, NoReturn, Self

import numpy as np
from pydantic import AfterValidator, PrivateAttr, model_validator

from lscan.calibration.fields import Matrix, Number, Pair, Place, Vector, check_theta, of_length
from lscan.calibration.marks import Region
from lscan.calibration.physical import PhysicalMap, SheetGeometry
from lscan.calibration.planemap import MapSolver, full_name
from lscan.camera import project, rays
from lscan.camera.optics import meet_plane
from lscan.camera.posedboards import CAMERA, COUNT, NEWER, WATER, PortKind, camera_of, with_newer
from lscan.camera.resection import Locate, compact_root
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.records import BoardReading, Floats

EDGE_ON = np.cos(np.radians(10.0))
"""Of the angle between the sheet's normal and the camera's u axis: nearer to it, the direction of
that axis laid into the sheet is six times as uncertain as the normal and more; ours."""


@dataclass(frozen=True)
class SheetView:
    """A camera and the laser's sheet before it.

    Attributes
    ----------
    theta : (18,) array, the camera (parameters.CAMERA)
    port : str, "flat", or "none" for a camera in air
    q_per_mm : (3,) array, 1/mm; the sheet is the plane q . X = 1 of the camera frame
    origin_px : (2,) array, px, the pixel that sees the origin
    """

    theta: Floats
    port: PortKind
    q_per_mm: Floats
    origin_px: Floats

    @property
    def axes(self) -> Floats:
        """(3, 3) the sheet's axes x, y, z as columns, camera frame."""
        away = self.q_per_mm / np.linalg.norm(self.q_per_mm)
        if abs(away[0]) > EDGE_ON:
            z = np.array([0.0, -1.0, 0.0]) + away[1] * away
            z /= np.linalg.norm(z)
            return np.column_stack([np.cross(away, z), away, z])
        away = away * (1.0 if away[2] >= 0 else -1.0)
        x = np.array([1.0, 0.0, 0.0]) - away[0] * away
        x /= np.linalg.norm(x)
        return np.column_stack([x, away, np.cross(x, away)])

    def locate(self, image_px: Floats) -> Floats:
        """(N, 2) of (x, z) mm where the rays of pixels meet the sheet; NaN where not.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        points = self.meet(np.vstack([self.origin_px, image_px]))
        return (points[1:] - points[0]) @ self.axes[:, [0, 2]]

    def meet(self, image_px: Floats) -> Floats:
        """(N, 3) mm, camera frame, where the rays of pixels meet the sheet; NaN where not.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        foot = self.q_per_mm / (self.q_per_mm @ self.q_per_mm)  # a point of the plane
        seen = rays(camera_of(self.theta, self.port), image_px)
        return meet_plane(seen, self.axes[:, 1], foot)

    def slopes(self, image_px: Floats) -> Floats:
        """(N, 2) mm of x and of z that the rays of pixels run for each mm of y.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        direction = rays(camera_of(self.theta, self.port), image_px).direction @ self.axes
        return direction[:, [0, 2]] / direction[:, 1:2]


def _with_origin(modes: Floats) -> Floats:
    """Modes of 23 parameters; older files hold those of 21, with the origin exact, or less."""
    modes = with_newer(modes, *(COUNT - len(NEWER) + more for more in (3, 5)))
    return np.pad(modes, ((0, 2), (0, 0))) if len(modes) == COUNT + 3 else modes


class Metric(PhysicalMap):
    """A solved metric map.

    Attributes
    ----------
    port : str, "flat", or "none" for a camera in air
    theta : dict of float, the camera, by name (parameters.CAMERA)
    q_per_mm : (3,) array, 1/mm; the sheet is the plane q . X = 1 of the camera frame
    origin_px : (2,) array, px, the pixel that sees the origin
    modes : (23, M) array, the covariance of camera, sheet and origin (theta, q, origin_px) is
        modes @ modes.T; the origin is exact but in other water, where it stays the same point
    region : Region, px, where the map holds
    """

    port: PortKind
    theta: Annotated[dict[str, Number], AfterValidator(partial(check_theta, names=CAMERA))]
    q_per_mm: Annotated[Vector, of_length(3)]
    origin_px: Place
    modes: Annotated[Matrix, AfterValidator(_with_origin), of_length(COUNT + 5)]
    lack_of_fit_mm: Pair = np.zeros(2)  # not in older files: the modes account for all
    _name: str = PrivateAttr("metric")

    @model_validator(mode="after")
    def _is_a_plane(self) -> Self:
        if not self.q_per_mm.any():
            raise ValueError("q_per_mm must be three numbers, not all 0")
        return self

    @cached_property
    def view(self) -> SheetView:
        """Camera and sheet."""
        return self._view_of(self.vector)

    @cached_property
    def geometry(self) -> SheetGeometry:
        """Camera and sheet."""
        view = self.view
        place = view.meet(view.origin_px[None])[0]
        return SheetGeometry(view.theta, self.port, view.axes, place, np.zeros(2))

    @property
    def vector(self) -> Floats:
        """(23,) theta, q_per_mm and origin_px."""
        return np.concatenate([[*self.theta.values()], self.q_per_mm, self.origin_px])

    def _view_of(self, vector: Floats) -> SheetView:
        theta, q_per_mm, origin_px = np.split(vector, [COUNT, COUNT + 3])
        return SheetView(theta, self.port, q_per_mm, origin_px)

    def map_of(self, vector: Floats) -> Locate:
        """The map of other parameters.

        Parameters
        ----------
        vector : (23,) array, as ``vector``
        """
        return self._view_of(vector).locate

    def vector_in_water(self, vector: Floats, index: float) -> Floats:
        """(23,) parameters of the same rig, its origin the same point, in water of another index.

        Parameters
        ----------
        vector : (23,) array, as ``vector``
        index : float, of the water, relative to air
        """
        view, there = self._view_of(vector), vector.copy()
        there[WATER] = index
        there[-2:] = project(camera_of(there, self.port), view.meet(view.origin_px[None]))[0]
        return there

    def _fields_of(self, vector: Floats) -> dict[str, Any]:
        view = self._view_of(vector)
        return {
            "theta": dict(zip(CAMERA, view.theta.tolist(), strict=True)),
            "q_per_mm": view.q_per_mm,
            "origin_px": view.origin_px,
        }


def metric_map(view: SheetView, root: Floats, region: Region) -> Metric:
    """The map of a camera and a sheet.

    Parameters
    ----------
    view : SheetView, camera and sheet
    root : (21, P) array, root @ root.T is the covariance of theta and q
    region : Region, px, where the map is to hold
    """
    return Metric(
        port=view.port,
        theta=dict(zip(CAMERA, view.theta.tolist(), strict=True)),
        q_per_mm=view.q_per_mm,
        origin_px=view.origin_px,
        modes=_with_origin(compact_root(root)),
        all_modes=True,
        region=region,
    )


class MetricSolver(MapSolver[Metric]):
    """Restores metric maps; they are solved from several pictures, not from one."""

    family, model, what = "metric", Metric, "metric map"

    def check_variant(self, variant: str) -> NoReturn:
        """Refuse any variant: one picture of the board does not give this map.

        Parameters
        ----------
        variant : str, not used

        Raises
        ------
        InputError
            Always; it says how a metric map is solved.
        """
        what = "a metric map is solved from pictures of a board in several poses"
        where = "plane map"
        allowed = "lscan calibrate-metric VIEWS.toml -o FILE"
        raise InputError(what, where=where, value=full_name("metric", variant), allowed=allowed)

    def fit(self, reading: BoardReading, variant: str, optics: OpticsSection) -> NoReturn:
        """Refuse: one picture of the board does not hold what a metric map needs.

        Parameters
        ----------
        reading : BoardReading, not used
        variant : str, not used
        optics : OpticsSection, not used

        Raises
        ------
        InputError
            Always.
        """
        self.check_variant(variant)


solver = MetricSolver()
