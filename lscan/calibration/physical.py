"""What the plane maps share that are a camera, its port and a plane: they know the physics.

Such a map can be carried to other water, and can say what a change of the rig since the
calibration does to its points.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.polynomial.chebyshev import chebpts1, chebvander, chebvander2d
from pydantic import PrivateAttr

from lscan.calibration.marks import Region
from lscan.calibration.planemap import Estimate, SolvedMap, estimate_of
from lscan.camera import rays
from lscan.camera.optics import meet_plane
from lscan.camera.posedboards import CAMERA, PortKind, camera_of, rotation
from lscan.camera.resection import MODE_STEP, pixel_derivatives
from lscan.config.documents import check
from lscan.config.rig import Known, SinceSection
from lscan.records import BoardReading, Floats, Marks

# A smooth function of the pixel, computed once at few pixels and looked up at many.


SHARE = 1e-7
"""Of the function's largest value: farthest that a table may be from it, well below what the
finite differences leave that it is made from."""
ORDERS = 4, 8, 10, 12, 14, 17, 20, 24
"""Coefficients along u and along v that are tried, each judged at the nodes of the next."""
BLOCK = 512  # pixels: their products of polynomials stay in the processor's cache


@dataclass(frozen=True)
class PixelTable:
    """Chebyshev series in u and v over a rectangle of the picture.

    Attributes
    ----------
    middle_px, half_px : (2,) array, px, of (u, v), the rectangle's middle and half its size
    coefficients : (n, n, K) array, of the products of polynomials in u and in v, for K values
    """

    middle_px: Floats
    half_px: Floats
    coefficients: Floats

    def look_up(self, image_px: Floats) -> Floats:
        """(N, K) values.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v) in the rectangle
        """
        order, _, count = self.coefficients.shape
        matrix = self.coefficients.reshape(order**2, count)
        # In blocks of one size, for the same bytes however many pixels are asked for at once.
        blocks = -(-len(image_px) // BLOCK)
        places = np.zeros((blocks * BLOCK, 2))
        places[: len(image_px)] = (image_px - self.middle_px) / self.half_px
        values = np.empty((blocks * BLOCK, count))
        for first in range(0, len(places), BLOCK):
            block = slice(first, first + BLOCK)
            u, v = places[block].T
            values[block] = chebvander2d(u, v, [order - 1, order - 1]) @ matrix
        return values[: len(image_px)]


def pixel_table(function: Callable[[Floats], Floats], region: Region) -> PixelTable | None:
    """The table of a function over a region of the picture; None where it is not so smooth.

    Parameters
    ----------
    function : callable, from (N, 2) px, of (u, v), to (N, K) values, all of one unit
    region : Region, px; the function is computed in all of the rectangle about it

    References
    ----------
    Trefethen, Approximation Theory and Approximation Practice (2013), ch. 3 and 8: interpolation
    in Chebyshev's nodes, whose error falls exponentially for an analytic function.
    """
    low, high = region.bounds_px
    middle, half, table = (low + high) / 2, (high - low) / 2, None
    for order in ORDERS:
        nodes = chebpts1(order)
        grid = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
        pixels = middle + half * grid
        values = function(pixels)
        if not np.isfinite(values).all():
            return None
        if table is not None:
            error = np.abs(table.look_up(pixels) - values).max(initial=0.0)
            if error <= SHARE * np.abs(values).max(initial=0.0):
                return table
        # The polynomials are orthogonal over their own nodes.
        inverse = chebvander(nodes, order - 1).T * np.where(np.arange(order) > 0, 2, 1)[:, None]
        inverse /= order
        values = values.reshape(order, order, values.shape[1])
        table = PixelTable(middle, half, np.einsum("iu,jv,uvk->ijk", inverse, inverse, values))
    return None


# What the plane maps share that are a camera, its port and a plane: they know the physics.


@dataclass(frozen=True)
class SheetGeometry:
    """A camera, a plane before it, and the frame in which the plane's points are read.

    The frame stays where the calibration had it, and y is not read: where the plane has moved out
    of y = 0 of the frame, a point is read where it is seen, at its own x and z.

    Attributes
    ----------
    theta : (14,) array, the camera (parameters.CAMERA)
    port : str, "flat", or "none" for a camera in air
    axes : (3, 3) array, the frame's axes x, y, z as columns, camera frame
    place_mm : (3,) array, mm, camera frame, a point of the frame's plane y = 0
    at_mm : (2,) array, mm, (x, z) of that point
    shift_mm : float, mm, of the plane along y from y = 0
    turn_rad : (2,) array, rad, by which the plane is turned about x and about z through that point
    """

    theta: Floats
    port: PortKind
    axes: Floats
    place_mm: Floats
    at_mm: Floats
    shift_mm: float = 0.0
    turn_rad: tuple[float, float] = (0.0, 0.0)

    def locate(self, image_px: Floats) -> Floats:
        """(N, 2) of (x, z) mm where the rays of pixels meet the plane; NaN where not.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        about_x, about_z = self.turn_rad
        normal = self.axes @ rotation(np.array([about_x, 0.0, about_z]))[:, 1]
        place = self.place_mm + self.shift_mm * self.axes[:, 1]
        points = meet_plane(rays(camera_of(self.theta, self.port), image_px), normal, place)
        return (points - self.place_mm) @ self.axes[:, [0, 2]] + self.at_mm

    def with_camera_turned(self, turn_rad: Floats) -> "SheetGeometry":
        """The same with the camera turned about its pinhole.

        Parameters
        ----------
        turn_rad : (3,) array, rad, rotation vector, camera frame
        """
        back = rotation(-turn_rad)
        return replace(self, axes=back @ self.axes, place_mm=back @ self.place_mm)

    def with_camera(self, **changes: float) -> "SheetGeometry":
        """The same with parameters of the camera changed by so much.

        Parameters
        ----------
        **changes : float, by the names of parameters.CAMERA
        """
        theta = self.theta.copy()
        for name, change in changes.items():
            theta[CAMERA.index(name)] += change
        return replace(self, theta=theta)


class PhysicalMap(SolvedMap):
    """Base of the maps that are a camera behind a port, or in air, and the sheet before it."""

    _since: SinceSection | None = PrivateAttr(None)
    _tables: tuple[PixelTable | None, PixelTable | None] | None = PrivateAttr(None)
    """Of the pixel's and of the errors' displacements, which all pictures of a scan ask for."""

    @property
    @abstractmethod
    def geometry(self) -> SheetGeometry:
        """Camera and sheet."""

    @abstractmethod
    def in_water(self, known: Known) -> Self:
        """The map of the same rig in water of another index.

        Camera, port and sheet stay where they are in space: a sheet is not displaced by the water
        where it leaves its own window squarely.

        Parameters
        ----------
        known : tuple of float, index of the water relative to air, and its standard uncertainty
        """

    @abstractmethod
    def error_modes(self, image_px: Floats) -> Floats:
        """(N, 2, M) mm, by which one standard deviation of each error moves the points of pixels.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        variance_px2 : (N,) array, px², of either pixel coordinate
        """
        if self._tables is None:
            self._tables = (
                pixel_table(self._jacobian, self.region),
                pixel_table(self._all_modes, self.region),
            )
        by_pixel, by_error = self._tables
        jacobian = by_pixel.look_up(image_px) if by_pixel else self._jacobian(image_px)
        modes = by_error.look_up(image_px) if by_error else self._all_modes(image_px)
        xz_mm, shape = self.geometry.locate(image_px), (len(image_px), 2)
        return estimate_of(
            xz_mm,
            jacobian.reshape(*shape, 2),
            modes.reshape(*shape, modes.shape[1] // 2),
            variance_px2,
        )

    def _jacobian(self, image_px: Floats) -> Floats:
        """(N, 2 * 2) mm per px, of x and of z, by u and by v."""
        return pixel_derivatives(self.geometry.locate, image_px).reshape(-1, 4)

    def _all_modes(self, image_px: Floats) -> Floats:
        """(N, 2 * M) mm, of x and of z, by each error of the map and each change since."""
        modes = self.error_modes(image_px)
        if self._since is not None:
            changed = change_modes(self.geometry, self._since, image_px)
            modes = np.concatenate([modes, changed], axis=2)
        return modes.reshape(len(image_px), -1)

    def points(self, image_px: Floats) -> Floats:
        """World points (N, 2) mm, x and z, by the ray of each and the sheet.

        Parameters
        ----------
        image_px : (N, 2) array, u and v in px
        """
        return self.geometry.locate(image_px)

    def with_changes_since(self, since: SinceSection) -> Self:
        """The map with what may have changed in its uncertainty.

        Parameters
        ----------
        since : SinceSection, standard uncertainties
        """
        changed: Self = self.model_copy()
        changed._since = since
        return changed

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy, as pydantic makes it, without the tables of the old fields.

        Parameters
        ----------
        update : mapping, optional, fields that are to differ
        deep : bool, whether the fields are copied too
        """
        other = super().model_copy(update=update, deep=deep)
        other._tables = None
        return other

    def _with_fields(self, **fields: Any) -> Self:
        """A map with other fields, and nothing computed from the old ones (model_copy keeps it).

        InputError where the fields make no map, as where nothing is seen through the other water.
        """
        own = {name: getattr(self, name) for name in type(self).model_fields}
        other = check(type(self), own | fields, where=f"plane map {self.name!r} in other water")
        other._name, other._since = self._name, self._since
        return other


def change_modes(geometry: SheetGeometry, since: SinceSection, image_px: Floats) -> Floats:
    """(N, 2, K) mm by which one standard deviation of each change moves the points of pixels.

    Parameters
    ----------
    geometry : SheetGeometry, at the calibration
    since : SinceSection, standard uncertainties of what may have changed
    image_px : (N, 2) array, px, of (u, v)
    """
    modes = [
        (after.locate(image_px) - before.locate(image_px)) / (2 * MODE_STEP)
        for after, before in zip(
            _geometries_after(geometry, since, MODE_STEP),
            _geometries_after(geometry, since, -MODE_STEP),
            strict=True,
        )
    ]
    return np.stack(modes, axis=2) if modes else np.zeros((len(image_px), 2, 0))


def _geometries_after(
    geometry: SheetGeometry, since: SinceSection, share: float
) -> Iterator[SheetGeometry]:
    """The geometry after each change that may be, by a share of its standard uncertainty."""
    if since.sheet_shift_mm:
        yield replace(geometry, shift_mm=share * since.sheet_shift_mm)
    if since.sheet_tilt_deg:
        turn = share * np.radians(since.sheet_tilt_deg)
        yield replace(geometry, turn_rad=(turn, 0.0))
        yield replace(geometry, turn_rad=(0.0, turn))
    if since.camera_tilt_deg:
        for axis in np.eye(3):
            yield geometry.with_camera_turned(share * np.radians(since.camera_tilt_deg) * axis)
    changes: dict[str, Any] = {"focal_px": since.focal_percent / 100 * geometry.theta[0]}
    if geometry.port == "flat":
        changes |= dict.fromkeys(("tilt_x_deg", "tilt_y_deg"), since.port_tilt_deg)
        changes["water_index"] = since.water_index
    for name, sigma in changes.items():
        if sigma:
            yield geometry.with_camera(**{name: share * sigma})


# The lack of fit of a map whose marks' noise is known only roughly.
#
# Noise differs from mark to mark; what the form of a map cannot follow varies slowly over the
# board, so that neighbouring marks share it.  The mean product of neighbours' residuals is
# therefore the mean square of the lack of fit, whatever the noise.


SURE = 2.0  # standard errors by which a mean product must exceed 0: noise does in 1 of 40


def unexplained_mm(solved: SolvedMap, reading: BoardReading) -> Floats:
    """(2,) rms in mm of what the residuals of x and of z share with their neighbours'.

    Neighbours are control points one pitch apart and adjacent marks of a ruler, all of which
    the map was fitted to.  A share that noise alone could well make is 0.

    Parameters
    ----------
    solved : SolvedMap, the map
    reading : BoardReading, px and mm, the map was solved from
    """
    grid = _residuals(solved, reading.grid).reshape(*reading.shape, 2)
    several = [grid[1:] * grid[:-1], grid[:, 1:] * grid[:, :-1]]
    for ruler in reading.rulers:
        along = _residuals(solved, ruler.marks)
        several.append(along[1:] * along[:-1])
    products = np.vstack([some.reshape(-1, 2) for some in several])
    products = products[np.isfinite(products).all(axis=1)]
    if len(products) < 2:
        return np.zeros(2)
    mean, error = products.mean(axis=0), products.std(axis=0, ddof=1) / np.sqrt(len(products))
    return np.sqrt(np.where(mean > SURE * error, mean, 0.0))


def _residuals(solved: SolvedMap, marks: Marks) -> Floats:
    """(N, 2) mm of marks; NaN of those that were not found."""
    return solved.points(marks.image_px) - marks.board_mm
