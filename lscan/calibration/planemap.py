"""What a plane map is: found by name, evaluated with its uncertainty, kept as a record.

A solver is registered under the entry-point group ``lscan.planemaps``.  A map's full name is
the solver's name and, after a hyphen, its variant: ``graticule-2-norulers`` is solved by
``graticule`` with the variant ``2-norulers``, ``projective`` by ``projective`` with "".
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from pydantic import Field, PrivateAttr

from lscan.calibration.fields import NotNegative, Number, Pair, Place
from lscan.calibration.marks import Region, all_marks, found_marks
from lscan.camera.optics import require_columns, stated_port, stated_water
from lscan.camera.posedboards import PortKind
from lscan.config.documents import Strict, check
from lscan.config.plugins import find_plugin
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.records import BoardReading, Floats, Mask, PlanePoints, Status

# What a plane map is, and how one is found by name.

NOTHING_KNOWN = OpticsSection()


@runtime_checkable
class PlaneMap(Protocol):
    """A solved map from the picture to the laser sheet.

    Examples
    --------
    >>> import lscan, numpy as np
    >>> plane_map = lscan.load_calibration("calibration.json").plane_map
    >>> points = plane_map.to_plane(np.array([[320.0, 240.0]]), sigma_px=np.array([0.1]))
    >>> points.xz_mm.shape, points.status.tolist()
    ((1, 2), [0])
    """

    @property
    def name(self) -> str:
        """Full name, solver and variant."""
        ...

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm in the plane frame, of pixels; vectorised over N.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        sigma_px : (N,) array, optional, px, standard uncertainty of each pixel coordinate; 0 by
            default

        Returns
        -------
        PlanePoints
            Its uncertainty combines that of the pixels with that of the map.  A pixel that is NaN
            has no value and the status NO_DATA (only the caller knows why it is NaN); one outside
            the covered region (marks.py) has the status OUT_OF_BOARD and no number.

        Raises
        ------
        InputError
            For arrays of wrong shape, and for a sigma_px that is negative or NaN beside a pixel
            that is neither.
        """
        ...

    def parameters(self) -> dict[str, Any]:
        """What the map is made of, in plain JSON types; ``restore`` takes it back."""
        ...


class PlaneMapSolver(Protocol):
    """Solves plane maps of one family.

    One with a method ``check_variant(variant)``, which raises the InputError of ``solve`` for an
    unknown variant without data, has a rig file that asks for it refused before the scan.

    One whose search is long may have a method ``near(solved)``: the solver that begins it at a map
    of almost the same marks.  Cross-validation then begins each solution at that from all marks.
    """

    def solve(self, reading: BoardReading, variant: str, optics: OpticsSection) -> PlaneMap:
        """The map fitted to the marks that were found.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, second part of the map's name, "" where there is none
        optics : OpticsSection, what is known of the camera beforehand; a solver may do without

        Raises
        ------
        InputError
            For an unknown variant.
        BoardNotFound
            For too few marks.
        """
        ...

    def restore(self, variant: str, parameters: dict[str, Any]) -> PlaneMap:
        """The map that parameters came from.

        Parameters
        ----------
        variant : str, second part of the map's name, "" where there is none
        parameters : dict, as ``PlaneMap.parameters`` gave them

        Raises
        ------
        InputError
            Where they do not fit.
        """
        ...


@dataclass(frozen=True)
class NamedSolver:
    """A solver together with the full name it was asked for.

    Attributes
    ----------
    name : str, full name of the map, family and variant
    solver : PlaneMapSolver, of the family
    variant : str, second part of the name, "" where there is none
    """

    name: str
    solver: PlaneMapSolver
    variant: str

    @property
    def searches(self) -> bool:
        """Whether the solver can begin its search at another map."""
        return hasattr(self.solver, "near")

    def near(self, solved: PlaneMap) -> "NamedSolver":
        """The solver of this name that begins its search at a map of almost the same marks.

        Parameters
        ----------
        solved : PlaneMap, of this name

        Raises
        ------
        AttributeError
            Where it cannot (``searches``).
        """
        return replace(self, solver=self.solver.near(solved))  # type: ignore[attr-defined]

    def solve(self, reading: BoardReading, optics: OpticsSection | None = None) -> PlaneMap:
        """The map of this name fitted to a reading.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        optics : OpticsSection, optional, what is known of the camera beforehand; by default what an
            empty section says

        Raises
        ------
        InputError
            For an unknown variant.
        BoardNotFound
            For too few marks.
        """
        return self.solver.solve(reading, self.variant, optics or NOTHING_KNOWN)

    def bare(self, reading: BoardReading, optics: OpticsSection | None = None) -> PlaneMap:
        """The map of this name, its uncertainty left out where that saves time.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        optics : OpticsSection, optional, as ``solve``

        Raises
        ------
        InputError, BoardNotFound
            As ``solve``.
        """
        quick = getattr(self.solver, "bare", self.solver.solve)
        return quick(reading, self.variant, optics or NOTHING_KNOWN)

    def restore(self, parameters: dict[str, Any]) -> PlaneMap:
        """The map of this name that parameters came from.

        Parameters
        ----------
        parameters : dict, as ``PlaneMap.parameters`` gave them

        Raises
        ------
        InputError
            Where they do not fit.
        """
        return self.solver.restore(self.variant, parameters)


def find_solver(name: str) -> NamedSolver:
    """The solver for a full map name.

    Parameters
    ----------
    name : str, family and, after a hyphen, variant

    Raises
    ------
    InputError
        For an unknown family; it lists those there are.

    Examples
    --------
    >>> find_solver("graticule-2-norulers").variant
    '2-norulers'
    """
    family, _, variant = name.partition("-")
    return NamedSolver(name, find_plugin("lscan.planemaps", family, where="plane map"), variant)


# The estimate that a plane map gives for pixels, and how its uncertainty is put together.


@dataclass(frozen=True)
class Estimate:
    """The points of N pixels; NaN where there is no value.

    Attributes
    ----------
    xz_mm : (N, 2) array, mm, plane frame
    variance_mm2 : (N, 2) array, mm², all noise, the pixel's and the calibration's
    modes_mm : (N, 2, M) array or None, mm, a square root of the calibration's part, as in
        PlanePoints; None where the map keeps no account of what its points have in common
    """

    xz_mm: Floats
    variance_mm2: Floats
    modes_mm: Floats | None = None


def estimate_of(
    xz_mm: Floats, jacobian: Floats, modes_mm: Floats, variance_px2: Floats
) -> Estimate:
    """The estimate of a map whose parameters give its modes; NaN where the variance is.

    Parameters
    ----------
    xz_mm : (N, 2) array, mm, plane frame
    jacobian : (N, 2, 2) array, mm per px, the last axis by u and by v
    modes_mm : (N, 2, M) array, mm
    variance_px2 : (N,) array, px², of the pixels
    """
    variance = variance_px2[:, None] * (jacobian**2).sum(axis=2) + (modes_mm**2).sum(axis=2)
    return Estimate(np.where(np.isfinite(variance), xz_mm, np.nan), variance, modes_mm)


def square_root(covariance: Floats) -> Floats:
    """(K, K) L with L @ L.T the covariance, which may be singular.

    From the eigenvalues, with those that rounding took below 0 set to 0.

    Parameters
    ----------
    covariance : (K, K) array, symmetric
    """
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def separate_modes(of_x: Floats, of_z: Floats) -> Floats:
    """(N, 2, P + Q) modes of maps whose x and z have no parameter in common, mm.

    Parameters
    ----------
    of_x : (N, P) array, mm, of x alone
    of_z : (N, Q) array, mm, of z alone
    """
    modes = np.zeros((len(of_x), 2, of_x.shape[1] + of_z.shape[1]))
    modes[:, 0, : of_x.shape[1]] = of_x
    modes[:, 1, of_x.shape[1] :] = of_z
    return modes


# A change of scale and of origin made to the points that a plane map gives.


MOST_SCALE = 0.5  # more is a picture of another board, not a rig that has changed


class SheetCorrection(Strict):
    """What a later picture of the board showed to be wrong with a map's points, and is taken off.

    Attributes
    ----------
    middle_mm : (2,) array, mm, (x, z), about which lengths are scaled
    scale, scale_sigma : float, lengths as they were mapped over true lengths, less 1; at most
        MOST_SCALE either way
    shift_mm, shift_sigma_mm : (2,) array, mm, of the middle as it was mapped from where it is
    """

    middle_mm: Place
    scale: Annotated[float, Field(ge=-MOST_SCALE, le=MOST_SCALE)] = 0.0
    scale_sigma: NotNegative = 0.0
    shift_mm: Place = np.zeros(2)
    shift_sigma_mm: Pair = np.zeros(2)

    def apply(self, estimate: Estimate) -> Estimate:
        """The estimate without those errors; the uncertainty of the correction is added.

        Parameters
        ----------
        estimate : Estimate, mm, of N pixels
        """
        factor = 1 / (1 + self.scale)
        arm = factor * (estimate.xz_mm - self.middle_mm - self.shift_mm)
        own = np.zeros((len(arm), 2, 3))
        own[:, :, 0] = -factor * self.scale_sigma * arm
        own[:, [0, 1], [1, 2]] = factor * self.shift_sigma_mm
        variance = factor**2 * estimate.variance_mm2 + (own**2).sum(axis=2)
        before = own[:, :, :0] if estimate.modes_mm is None else factor * estimate.modes_mm
        modes = np.concatenate([before, own], axis=2)  # what it adds, all points have in common
        return Estimate(self.middle_mm + arm, variance, modes)


# What the plane maps of this package share: a record that is its file, and a solver's frame.


class SolvedMap(Strict, ABC):
    """Base of the plane maps: the fields are what a calibration file holds of one.

    Attributes
    ----------
    region : Region, px, where the map holds
    lack_of_fit_mm : (2,) array, mm, standard uncertainty of x and z that noise does not account for
    stated_water : tuple of float or None, the water's index and its standard uncertainty as they
        were stated when the map was solved; None where they were not
    stated_port : str or None, likewise of the port, "flat" or "none"; None in older files
    corrections : tuple of SheetCorrection, made to the points one after the other
    """

    region: Region
    lack_of_fit_mm: Pair
    stated_water: tuple[Number, NotNegative] | None = None
    stated_port: PortKind | None = None
    corrections: tuple[SheetCorrection, ...] = ()
    _name: str = PrivateAttr("")
    _smooth: Callable[[Floats, Floats], Estimate] | None = PrivateAttr(None)
    _board: Callable[[Floats], Floats] | None = PrivateAttr(None)
    """What the smooth map through the same marks estimates, and (N, 2 K) by which errors of the
    board displace points (spline.with_hidden_errors)."""

    def __repr__(self) -> str:
        return f"<PlaneMap {self.name}>"

    @property
    def name(self) -> str:
        """Full name, family and variant."""
        return self._name

    @abstractmethod
    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """The points of pixels that the region covers.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        variance_px2 : (N,) array, px², of either pixel coordinate
        """

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm in the plane frame, of pixels, as PlaneMap promises.

        sigma_mm combines the pixel's uncertainty, that of the map's parameters, and the map's
        mean lack of fit.  A NaN pixel has the status NO_DATA.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        sigma_px : (N,) array, optional, px, standard uncertainty of u and of v; 0 by default

        Raises
        ------
        InputError
            Where an array has the wrong shape, or sigma_px is negative or NaN beside a pixel that
            is neither.
        """
        image_px = require_columns(image_px, "image_px", 2)
        sigma = _sigma_or_zero(image_px, sigma_px)
        finite = np.isfinite(image_px).all(axis=1)
        covered = np.zeros(len(image_px), dtype=bool)
        covered[finite] = self.region.covers(image_px[finite])
        xz, variance = np.full((2, len(image_px), 2), np.nan)
        estimate = self._estimate(image_px[covered], sigma[covered] ** 2)
        for correction in self.corrections:
            estimate = correction.apply(estimate)
        xz[covered] = estimate.xz_mm
        variance[covered] = estimate.variance_mm2 + self.lack_of_fit_mm**2
        valued = np.isfinite(xz).all(axis=1)
        missing = np.isnan(image_px).any(axis=1)
        status = np.where(valued, Status.OK, np.where(missing, Status.NO_DATA, Status.OUT_OF_BOARD))
        xz[~valued], variance[~valued] = np.nan, np.nan
        modes = _modes(estimate, covered, valued)
        return PlanePoints(xz, np.sqrt(variance), status.astype(np.int64), modes)

    def _estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels, their error taken from the smooth map where there is one.

        The map errs by what it differs from the smooth map, which is known and common to points
        that lie near each other, by what the smooth map errs by, and with the board.
        """
        known = (self._smooth or self.estimate)(image_px, variance_px2)
        xz_mm, more = known.xz_mm, np.zeros((len(image_px), 2, 0))
        if self._smooth is not None:
            xz_mm = self.points(image_px)
            more = (xz_mm - known.xz_mm)[:, :, None]
        if self._board is not None:
            board = self._board(image_px)
            board = board.reshape(*xz_mm.shape, board.shape[1] // 2)
            more = np.concatenate([more, board], axis=2)
        if known.modes_mm is None:  # of a graticule by itself
            return known
        modes = np.concatenate([known.modes_mm, more], axis=2)
        return Estimate(xz_mm, known.variance_mm2 + (more**2).sum(axis=2), modes)

    def locate(self, image_px: Floats) -> Floats:
        """(N, 2) mm, the points of ``to_plane`` without their uncertainties, in less time.

        NaN where the region does not cover a pixel, and where it is NaN.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        if self.corrections:
            return self.to_plane(image_px).xz_mm
        covered = np.flatnonzero(np.isfinite(image_px).all(axis=1))
        covered = covered[self.region.covers(image_px[covered])]
        xz = np.full((len(image_px), 2), np.nan)
        xz[covered] = self.points(image_px[covered])
        return xz

    def points(self, image_px: Floats) -> Floats:
        """World points (N, 2) mm, x and z, of pixels that the region covers, without their sigma.

        Parameters
        ----------
        image_px : (N, 2) array, u and v in px
        """
        return self.estimate(image_px, np.zeros(len(image_px))).xz_mm

    def parameters(self) -> dict[str, Any]:
        """The fields as JSON types."""
        return self.model_dump(mode="json")


Solved = TypeVar("Solved", bound=SolvedMap)


class MapSolver(ABC, Generic[Solved]):
    """Base of the solvers of one family of maps.

    Attributes
    ----------
    family : str, first part of a map's name
    model : type, of the map
    what : str, the family in words, for messages
    variants : tuple of str, second parts there are
    """

    family: ClassVar[str]
    model: type[Solved]
    what: ClassVar[str]
    variants: ClassVar[tuple[str, ...]] = ("",)

    def check_variant(self, variant: str) -> None:
        """Refuse a variant that there is not; nothing is solved.

        Parameters
        ----------
        variant : str, second part of the map's name, "" where there is none

        Raises
        ------
        InputError
            For a variant that there is not.
        """
        if variant not in self.variants:
            raise InputError(
                f"no such {self.what}",
                where="plane map",
                value=full_name(self.family, variant),
                allowed=", ".join(full_name(self.family, there) for there in self.variants),
            )

    def solve(
        self, reading: BoardReading, variant: str, optics: OpticsSection = NOTHING_KNOWN
    ) -> Solved:
        """The map fitted to the marks that were found.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, second part of the map's name, "" where there is none
        optics : OpticsSection, what is known of the camera beforehand

        Raises
        ------
        InputError
            For an unknown variant.
        BoardNotFound
            Where the marks found do not determine the map.
        """
        self.check_variant(variant)
        return self._with_name(with_medium(self.fit(reading, variant, optics), optics), variant)

    def bare(
        self, reading: BoardReading, variant: str, optics: OpticsSection = NOTHING_KNOWN
    ) -> Solved:
        """As ``solve``, but for the map's uncertainty, which may be missing: in less time.

        For those who solve thousands of maps and look at the points alone (``locate``).

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, second part of the map's name, "" where there is none
        optics : OpticsSection, what is known of the camera beforehand

        Raises
        ------
        InputError, BoardNotFound
            As ``solve``.
        """
        self.check_variant(variant)
        solved = self.fit_points(reading, variant, optics)
        return self._with_name(with_medium(solved, optics), variant)

    def fit_points(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Solved:
        """As ``fit``; a family whose uncertainty takes time of its own leaves it out.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, one of ``variants``
        optics : OpticsSection, what is known of the camera beforehand
        """
        return self.fit(reading, variant, optics)

    @abstractmethod
    def fit(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Solved:
        """As ``solve``, of a variant that there is.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, one of ``variants``
        optics : OpticsSection, what is known of the camera beforehand
        """

    def restore(self, variant: str, parameters: dict[str, Any]) -> Solved:
        """The map that parameters came from.

        Parameters
        ----------
        variant : str, second part of the map's name, "" where there is none
        parameters : dict, as ``SolvedMap.parameters`` gave them

        Raises
        ------
        InputError
            Where they do not fit.
        """
        MapSolver.check_variant(self, variant)  # a metric map can be restored, though not solved
        read = check(self.model, parameters, where=None, prefix="parameters")
        return self._with_name(read, variant)

    def _with_name(self, solved: Solved, variant: str) -> Solved:
        solved._name = full_name(self.family, variant)
        return solved


def with_medium(solved: Solved, optics: OpticsSection) -> Solved:
    """The map with the water and the port that it was solved for, as they were stated.

    Parameters
    ----------
    solved : SolvedMap, of any family
    optics : OpticsSection, what was known of the camera beforehand
    """
    medium = {"stated_water": stated_water(optics), "stated_port": stated_port(optics)}
    return solved.model_copy(update=medium)


def with_lack_of_fit(solved: Solved, reading: BoardReading) -> Solved:
    """The map with what its form, not noise, adds to the uncertainty of x and of z, in mm rms.

    The map is applied to the marks of the board; the mean square of the residuals less the
    mean square that the marks' and the map's noise explain, never below 0.  The control
    points check both coordinates.  A ruler checks the one that is fixed on it, which no map
    reads from it: the marks of the vertical rulers, half-way between control points, check
    x.  Without rulers only the fit to the control points themselves can be judged, and what
    happens between them stays unseen.

    Parameters
    ----------
    solved : SolvedMap, of any family
    reading : BoardReading, px and mm, the map was solved from
    """
    checked = [[True, True]]
    checked += [[of.direction == "vertical", of.direction == "horizontal"] for of in reading.rulers]
    several = all_marks(reading)
    judged = np.repeat(checked, [int(marks.found.sum()) for marks in several], axis=0)
    known, image, sigma = found_marks(several)
    covered = solved.region.covers(image)
    estimate = solved.estimate(image[covered], sigma[covered] ** 2)
    residual = estimate.xz_mm - known[covered]
    judged = judged[covered] & np.isfinite(residual)
    count = np.maximum(judged.sum(axis=0), 1)
    excess = np.where(judged, residual**2, 0).sum(axis=0) / count
    excess -= np.where(judged, estimate.variance_mm2, 0).sum(axis=0) / count
    return solved.model_copy(update={"lack_of_fit_mm": np.sqrt(np.maximum(excess, 0.0))})


def _modes(estimate: Estimate, covered: Mask, valued: Mask) -> Floats | None:
    """(N, 2, M) the modes of the covered pixels among all, NaN where there is no value."""
    if estimate.modes_mm is None:
        return None
    modes = np.full((len(covered), *estimate.modes_mm.shape[1:]), np.nan)
    modes[covered] = estimate.modes_mm
    modes[~valued] = np.nan
    return modes


def _sigma_or_zero(image_px: Floats, sigma_px: Floats | None) -> Floats:
    if sigma_px is None:
        return np.zeros(len(image_px))
    sigma = np.asarray(sigma_px, dtype=float)
    if sigma.shape != image_px.shape[:1]:
        what = "bad shape"
        raise InputError(what, where="sigma_px", value=sigma.shape, allowed=f"({len(image_px)},)")
    bad = np.isfinite(image_px).all(axis=1) & ~((sigma >= 0) & np.isfinite(sigma))
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        where, allowed = f"sigma_px[{first}]", "a finite number not below 0"
        raise InputError("bad uncertainty", where=where, value=float(sigma[first]), allowed=allowed)
    return sigma


def full_name(family: str, variant: str) -> str:
    """The full name of a map.

    Parameters
    ----------
    family, variant : str, its two parts; the second may be ""

    Examples
    --------
    >>> full_name("polynomial", "3"), full_name("projective", "")
    ('polynomial-3', 'projective')
    """
    return f"{family}-{variant}" if variant else family
