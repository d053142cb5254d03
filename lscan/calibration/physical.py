"""What the plane maps share that are a camera, its port and a plane: they know the physics.

Such a map can be carried to other water, and can say what a change of the rig since the
calibration does to its points.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import numpy as np
from numpy.polynomial.chebyshev import chebpts1, chebvander, chebvander2d
from pydantic import PrivateAttr

from lscan.calibration.fields import Matrix, Number
from lscan.calibration.marks import Region
from lscan.calibration.planemap import Estimate, SolvedMap, estimate_of
from lscan.camera import rays
from lscan.camera.optics import UNKNOWN_WATER, meet_plane
from lscan.camera.posedboards import CAMERA, PortKind, PosedBoards, camera_of, rotation
from lscan.camera.resection import (
    MODE_STEP,
    Locate,
    displacements,
    ordered_modes,
    pixel_derivatives,
)
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
    theta : (18,) array, the camera (parameters.CAMERA)
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
        return self.locate_with_slopes(image_px)[0]

    def locate_with_slopes(self, image_px: Floats) -> tuple[Floats, Floats]:
        """As ``locate``, and (N, 2) by how much the points move, over how far the plane does.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        about_x, about_z = self.turn_rad
        normal = self.axes @ rotation(np.array([about_x, 0.0, about_z]))[:, 1]
        place = self.place_mm + self.shift_mm * self.axes[:, 1]
        seen = rays(camera_of(self.theta, self.port), image_px)
        points = meet_plane(seen, normal, place) - self.place_mm
        slopes = seen.direction * (self.axes[:, 1] @ normal / (seen.direction @ normal))[:, None]
        in_plane = self.axes[:, [0, 2]]
        return points @ in_plane + self.at_mm, np.where(
            np.isfinite(points), slopes, np.nan
        ) @ in_plane

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


def sheet_of(view: PosedBoards) -> SheetGeometry:
    """Camera and first board, in whose plane the sheet lies.

    Parameters
    ----------
    view : PosedBoards
    """
    return SheetGeometry(
        view.theta[: len(CAMERA)], view.port, view.axes[0], view.places_mm[0], view.centre_mm
    )


INDEX_STEP = 1e-5  # for differences by the water's index: 0.01 px, of rounding of 1e-9


class PhysicalMap(SolvedMap):
    """Base of the maps that are a camera behind a port, or in air, and the sheet before it.

    Attributes
    ----------
    theta : dict of float, camera, port and what else there is, by name
    modes : (K, M) array, the covariance of ``vector`` is modes @ modes.T
    all_modes : bool, whether the modes are all there are.  Older files hold those alone that move
        the map as it is, and do not say so
    """

    theta: dict[str, Number]
    modes: Matrix
    all_modes: bool = False
    _ordered: tuple[Floats, int] | None = PrivateAttr(None)
    _since: SinceSection | None = PrivateAttr(None)
    _tables: tuple[PixelTable | None, PixelTable | None] | None = PrivateAttr(None)
    """Of the pixel's and of the errors' displacements, which all pictures of a scan ask for."""

    @property
    @abstractmethod
    def geometry(self) -> SheetGeometry:
        """Camera and sheet."""

    @property
    @abstractmethod
    def vector(self) -> Floats:
        """(K,) the parameters that have errors, theta first."""

    @abstractmethod
    def map_of(self, vector: Floats) -> Locate:
        """The map of other parameters.

        Parameters
        ----------
        vector : (K,) array, as ``vector``
        """

    @abstractmethod
    def vector_in_water(self, vector: Floats, index: float) -> Floats:
        """(K,) parameters of the same rig, where it is in space, in water of another index.

        Parameters
        ----------
        vector : (K,) array, as ``vector``
        index : float, of the water, relative to air
        """

    @abstractmethod
    def _fields_of(self, vector: Floats) -> dict[str, Any]:
        """The fields that hold parameters."""

    def quantities(self) -> dict[str, Known]:
        """Camera, port and sheet, by name, each with its standard uncertainty.

        sheet_distance_mm: from the pinhole to the sheet.  sheet_angle_deg: between the camera's
        axis and the sheet's normal.  What was known exactly is left out.
        """
        sigma = np.linalg.norm(self.modes, axis=1)
        known = {
            name: (value, float(sigma[index]))
            for index, (name, value) in enumerate(self.theta.items())
            if name in CAMERA and sigma[index] > 0
        }

        def sheet(vector: Floats) -> Floats:  # also where it is just off the limits
            there = self.model_construct(**(dict(self) | self._fields_of(vector))).geometry
            normal = there.axes[:, 1]
            return np.array([abs(normal @ there.place_mm), np.degrees(np.arccos(abs(normal[2])))])

        ways = [sheet(self.vector + m) - sheet(self.vector - m) for m in MODE_STEP * self.modes.T]
        spread = np.linalg.norm([np.zeros(2), *ways], axis=0) / (2 * MODE_STEP)
        pairs = zip(sheet(self.vector).tolist(), spread.tolist(), strict=True)
        return known | dict(zip(("sheet_distance_mm", "sheet_angle_deg"), pairs, strict=True))

    @property
    def _water_sigma(self) -> float:
        """Of the index in the water of the calibration; as stated where its modes are not kept."""
        if self.all_modes:
            return float(np.linalg.norm(self.modes[list(self.theta).index("water_index")]))
        return (self.stated_water or UNKNOWN_WATER)[1]

    def _by_index(self, index: float) -> Floats:
        """(K,) how the parameters change with the index of the water about the rig."""
        above, below = (
            self.vector_in_water(self.vector, index + step) for step in (INDEX_STEP, -INDEX_STEP)
        )
        return (above - below) / (2 * INDEX_STEP)

    def in_water(self, known: Known) -> Self:
        """The map of the same rig in water of another index.

        Camera, port and sheet stay where they are in space: a sheet is not displaced by the water
        where it leaves its own window squarely.  All that is uncertain of them counts, also what
        does not move the map in the water of the calibration: a focal length too long beside an
        index too low shows in other water alone.  An older file does not hold that; the uncertainty
        of the calibration's water, along which most of it lies, stands in for it.

        Parameters
        ----------
        known : tuple of float, index of the water relative to air, and its standard uncertainty
        """
        index, sigma = known
        fields = self._fields_of(self.vector_in_water(self.vector, index))
        there = self._with_fields(**fields, stated_water=known)
        ways = [
            self.vector_in_water(self.vector + mode, index)
            - self.vector_in_water(self.vector - mode, index)
            for mode in MODE_STEP * self.modes.T
        ]
        lost = 0.0 if self.all_modes else self._water_sigma
        by_index = np.hypot(sigma, lost) * self._by_index(index)
        modes = np.column_stack([*(way / (2 * MODE_STEP) for way in ways), by_index])
        return there._with_fields(modes=modes)

    def beside_water(self, known: Known) -> Self:
        """The map as it is, with the error that it has where the water is another than its own.

        For a calibration that states no water.  Whether it was made in this water nobody knows;
        if not, the map errs by the difference of the two indices, of which the rms is stated.

        Parameters
        ----------
        known : tuple of float, index of the water relative to air, and its standard uncertainty
        """
        own = self.theta["water_index"]
        differs = np.sqrt((known[0] - own) ** 2 + known[1] ** 2 + self._water_sigma**2)
        return self._with_fields(modes=np.column_stack([self.modes, differs * self._by_index(own)]))

    def with_index_error(self, of_modes: Floats, sigma: float) -> Self:
        """The map in water whose index was found by this map.

        Parameters
        ----------
        of_modes : (P,) array, by how much one standard deviation of each of ``error_modes``, or of
            the first of them, puts the index off
        sigma : float, standard uncertainty of the index from all other causes
        """
        modes, count = self._modes_by_effect()
        by_index = self._by_index(self.theta["water_index"])
        shared = np.zeros(modes.shape[1])
        shared[:count] = of_modes[:count]
        other = np.hypot(sigma, np.linalg.norm(of_modes[count:]))
        modes = np.column_stack([modes + np.outer(by_index, shared), other * by_index])
        return self._with_fields(modes=modes)

    def _modes_by_effect(self) -> tuple[Floats, int]:
        """``ordered_modes`` on the region's outline and half-way to its middle."""
        if self._ordered is None:
            corners = self.region.outline_px
            places = np.vstack([corners, (corners + corners.mean(axis=0)) / 2])
            self._ordered = ordered_modes(self.map_of, self.vector, self.modes, places)
        return self._ordered

    def error_modes(self, image_px: Floats) -> Floats:
        """(N, 2, M) mm, by which one standard deviation of each error moves the points of pixels.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        modes, count = self._modes_by_effect()
        return displacements(self.map_of, self.vector, modes[:, :count], image_px)

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
        """A copy, as pydantic makes it, without what was computed from the old fields.

        Parameters
        ----------
        update : mapping, optional, fields that are to differ
        deep : bool, whether the fields are copied too
        """
        other = super().model_copy(update=update, deep=deep)
        other._tables = other._ordered = None
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


class BoardKnown(Protocol):
    """How well it is known how the board lay and how it is made, as OpticsSection has it."""

    board_offset_mm: float
    board_tilt_deg: float
    board_bend_mm: float
    board_scale_percent: float


def board_modes(
    geometry: SheetGeometry, board: BoardKnown, region: Region, image_px: Floats
) -> Floats:
    """(N, 2, K) mm by which one standard deviation of each error of the board moves points.

    The board's errors that its picture does not show: where it stands h behind the sheet, a point
    of the sheet is taken for one that lies by h times the slope of the line of sight beside it.
    h is even, tilted about x or z, or bent as x^2, x z or z^2 over the half size of the board.

    Parameters
    ----------
    geometry : SheetGeometry, of the map, whose plane is the board's
    board : BoardKnown, standard uncertainties
    region : Region, px, that the board covers
    image_px : (N, 2) array, px, of (u, v)
    """
    corners = len(region.outline_px)
    places, slopes = geometry.locate_with_slopes(np.vstack([region.outline_px, image_px]))
    half_mm = np.abs(places[:corners] - geometry.at_mm).max(axis=0)
    arm = places[corners:] - geometry.at_mm
    x, z = (arm / half_mm).T
    tilt_x, tilt_z = np.radians(board.board_tilt_deg) * half_mm[::-1]
    sigmas = [board.board_offset_mm, tilt_x, tilt_z, *[board.board_bend_mm] * 3]
    heights = np.stack([np.ones_like(x), z, x, x * x, x * z, z * z], axis=1) * sigmas
    beside = slopes[corners:, :, None] * heights[:, None]
    scale = arm[:, :, None] * board.board_scale_percent / 100
    return np.concatenate([beside, scale], axis=2)[:, :, [*map(bool, sigmas), bool(scale.any())]]


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
