"""The records that pass between the stages, and the conventions they all follow.

Units: lengths mm, wavelengths nm, power mW, time s, exposure ms, angles rad (degrees
only in files and on screen).  A scalar's name carries its unit.

World frame: x to the right as the camera sees it, y along the track and away from the
camera, z up; right-handed.  The head frame moves along the track with the scanner; its
laser sheet is the plane y = 0, so with the sheet square to the track the sheet of the head
at track position s is the world plane y = s.  On a rotating shaft (rig.ShaftSection) the head
turns instead; its scan is given in the frame of the head at position 0.

Plane frame: (x, z) in the laser sheet, in mm.  The calibration board lies in it: origin at
control point O (upper left), x right, z up, so points beneath O have negative z.

Pixels: (u, v), u right, v down, the centre of the top-left pixel is (0, 0).

Grey values: in DN, of which the range has 256 whatever the camera's bits, so that thresholds and
noise are of one unit.  A picture of 8 bits is uint8, in DN; a deeper one uint16, with 256 steps to
the DN, of which a camera of 12 bits uses every sixteenth.

Every point has a :class:`Status`; a point whose status is not ``OK`` (or ``SATURATED``,
which has a value of lesser quality) holds NaN.  Nothing is dropped in silence.
Every measured coordinate has a standard uncertainty (one sigma) beside it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from html import escape
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Picture = NDArray[np.uint8 | np.uint16]
Mask = NDArray[np.bool_]
GreyValues = NDArray[np.integer[Any] | np.floating[Any]]
Record = TypeVar("Record")
Axis = Literal["columns", "rows"]

Progress = Callable[[int, int], None]
"""What long work calls with the number of its steps that are done and the number of all."""


class Status(IntEnum):
    """Why a point has, or has not, a value.

    Examples
    --------
    >>> import lscan
    >>> lscan.Status(7).name
    'OCCLUDED'
    """

    OK = 0
    NO_PEAK = 1  # nothing above the threshold in this column
    SATURATED = 2  # a value, but the peak is clipped: expect bias
    AT_BORDER = 3  # the peak is cut by the edge of the picture
    OUT_OF_BOARD = 4  # outside the calibrated part of the plane
    NOT_FOUND = 5  # a mark of the board that was looked for and is not there
    OUT_OF_VIEW = 6  # a mark of the board that lies outside the picture
    OCCLUDED = 7  # hidden from the camera or from the laser
    NO_DATA = 8  # no measurement near a grid cell or slice point; a column not looked at
    AMBIGUOUS = 9  # several lines or places of one in this column: not known which is meant


_OK, _SATURATED = int(Status.OK), int(Status.SATURATED)


def has_value(status: NDArray[np.integer]) -> Mask:
    """Mask, same shape, of the points that hold a number: OK or SATURATED.

    Parameters
    ----------
    status : integer array, of Status
    """
    return (status == _OK) | (status == _SATURATED)


def status_counts(status: NDArray[np.integer]) -> dict[str, int]:
    """Number of points of each status by its name, those alone that occur.

    Parameters
    ----------
    status : integer array, of Status

    Examples
    --------
    >>> status_counts(np.array([0, 0, 7]))
    {'OK': 2, 'OCCLUDED': 1}
    """
    return {code.name: int((status == code).sum()) for code in Status if code in status}


def select(record: Record, wanted: Mask | Ints | slice) -> Record:
    """The record with a part of each of its arrays; itself where a mask keeps all of them.

    Parameters
    ----------
    record : dataclass, whose arrays all have N entries
    wanted : (N,) mask, array of indices or slice, of the entries kept
    """
    if isinstance(wanted, np.ndarray) and wanted.dtype == np.bool_:
        if wanted.all():
            return record
        wanted = np.flatnonzero(wanted)  # to take entries by index is quicker
    parts = vars(record).items()
    return type(record)(**{k: v[wanted] if isinstance(v, np.ndarray) else v for k, v in parts})


# How records say in a line, or in a notebook's table, what they hold.


def plus_minus(value: float, sigma: float, unit: str = "") -> str:
    """A value with its standard uncertainty, both to the second digit of the uncertainty.

    Parameters
    ----------
    value, sigma : float, of ``unit``; sigma NaN where it is not known
    unit : str, "" for none

    References
    ----------
    JCGM 100:2008, "Guide to the expression of uncertainty in measurement", 7.2.6.

    Examples
    --------
    >>> plus_minus(19.9312, 0.2381, "mm"), plus_minus(1234.5, 123.4)
    ('19.93 ± 0.24 mm', '1230 ± 120')
    """
    if not 0 < sigma < np.inf:
        known = "unknown" if np.isnan(sigma) else f"{sigma:g}"
        return f"{value:z.3f} ± {known} {unit}".rstrip()
    place = 1 - int(f"{sigma:.1e}".partition("e")[2])  # of the second digit, after the point
    digits = f"z.{max(place, 0)}f"
    return f"{round(value, place):{digits}} ± {round(sigma, place):{digits}} {unit}".rstrip()


def html_table(rows: Iterable[Sequence[object]], headings: Sequence[str] = ()) -> str:
    """A table as notebooks show it, in HTML.

    Parameters
    ----------
    rows : iterable, cells, one a column
    headings : sequence, one a column, or none
    """
    lines = [("td", row) for row in rows]
    if headings:
        lines.insert(0, ("th", headings))
    cells = ("".join(f"<{tag}>{escape(str(one))}</{tag}>" for one in line) for tag, line in lines)
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in cells)}</table>"


def _in_words(status: NDArray[np.integer], sigma: Mapping[str, Floats], unit: str) -> str:
    """How many points there are of each status, and the median of their sigmas by name."""
    words = ", ".join(f"{count} {name}" for name, count in status_counts(status).items())
    if not (valued := has_value(status)).any():
        return words or "none"
    medians = ", ".join(f"{name} ± {np.median(of[valued]):.2g}" for name, of in sigma.items())
    return f"{words}; {medians} {unit} (median)"


@dataclass(frozen=True)
class Frame:
    """One picture and where the head stood when it was taken.

    Attributes
    ----------
    image : (H, W) or (H, W, 3) array, uint8 or uint16, colour as RGB
    index : int, place in the run, from 0
    commanded_mm : float, mm, track position asked for
    position_mm : float, mm, track position reported by the track
    time_s : float, s, by the camera's clock
    exposure_ms : float, ms, as reported by the camera
    background : array or None, same shape as ``image``, the view with the laser off; None where the
        plan asks for none

    Examples
    --------
    >>> import lscan
    >>> frame = lscan.open_run("runs/groove").frame(1)
    >>> frame.image.shape, frame.position_mm
    ((480, 640, 3), 1.0)
    """

    image: Picture
    index: int
    commanded_mm: float
    position_mm: float
    time_s: float
    exposure_ms: float
    background: Picture | None = None

    def __repr__(self) -> str:
        size = f"{self.image.shape[1]} x {self.image.shape[0]} px, {self.image.dtype}"
        return f"<Frame {self.index} at {self.position_mm:g} mm: {size}, {self.exposure_ms:g} ms>"


@dataclass(frozen=True)
class Marks:
    """Marks of the board with their place in the picture.

    Attributes
    ----------
    board_mm : (N, 2) array, mm, nominal (x, z) in the plane frame
    image_px : (N, 2) array, px, centre (u, v); NaN where status is not OK
    sigma_px : (N,) array, px, standard uncertainty of u and of v; NaN where not OK
    status : (N,) array, of Status
    """

    board_mm: Floats
    image_px: Floats
    sigma_px: Floats
    status: Ints

    def __repr__(self) -> str:
        return f"<Marks: {_in_words(self.status, {'u and v': self.sigma_px}, 'px')}>"

    @property
    def found(self) -> Mask:
        """(N,) mask of the marks that have a place in the picture."""
        return self.status == Status.OK


@dataclass(frozen=True)
class RulerReading:
    """One auxiliary ruler as seen: a straight line of marks on the board.

    Attributes
    ----------
    direction : str, "vertical" (marks along z at fixed x) or "horizontal" (along x at fixed z)
    at_mm : float, mm, the fixed coordinate
    marks : Marks, in the order of the board file
    """

    direction: Literal["vertical", "horizontal"]
    at_mm: float
    marks: Marks


@dataclass(frozen=True)
class Mark:
    """One named mark of the board.

    Attributes
    ----------
    image_px : (2,) array, px, centre (u, v); NaN where status is not OK
    sigma_px : float, px, standard uncertainty of u and of v; NaN where not OK
    status : Status, OK or why there is no place
    """

    image_px: Floats
    sigma_px: float
    status: Status


@dataclass(frozen=True)
class RingPoints:
    """Points picked on the centre line of a milled circle.

    Attributes
    ----------
    image_px : (K, 2) array, px, of (u, v)
    sigma_px : (K,) array, px, standard uncertainty across the line
    """

    image_px: Floats
    sigma_px: Floats


@dataclass(frozen=True)
class BoardReading:
    """All that was found of the calibration board in one picture.

    Attributes
    ----------
    image_size : tuple of int, (width, height) of the picture, px
    pitch_mm : float, mm, spacing of the grid
    shape : tuple of int, (rows, columns) of the grid
    grid : Marks, the control points row by row, the top row first, so that
        ``grid.image_px.reshape(rows, columns, 2)`` is the lattice
    rulers : tuple of RulerReading, the auxiliary rulers, in the order of the board file
    dots : dict of Mark, single dots by name
    rings : dict of RingPoints, the milled circles by name

    Examples
    --------
    >>> import lscan
    >>> reading = lscan.load_calibration("calibration.json").reading
    >>> reading.shape, int(reading.grid.found.sum())
    ((10, 10), 100)
    """

    image_size: tuple[int, int]
    pitch_mm: float
    shape: tuple[int, int]
    grid: Marks
    rulers: tuple[RulerReading, ...] = ()
    dots: dict[str, Mark] = field(default_factory=dict)
    rings: dict[str, RingPoints] = field(default_factory=dict)

    def __repr__(self) -> str:
        (width, height), found = self.image_size, self.grid.found
        named = f"{len(self.dots)} named, {len(self.rings)} rings"
        return f"<BoardReading, {width} x {height} px: {found.sum()} of {len(found)} dots, {named}>"


@dataclass(frozen=True)
class Stripe:
    """The laser line in one picture: one entry per column (or row) of the picture.

    Attributes
    ----------
    axis : str, "columns": entry i is column u = i and centre_px is v; "rows": entry i is row v = i
        and centre_px is u
    centre_px : (N,) array, px, centre of the line across it; NaN where there is none
    sigma_px : (N,) array, px, standard uncertainty of centre_px
    peak : (N,) array, DN, highest grey value of the line above the background
    status : (N,) array, of Status
    flux : (N,) array or None, DN, light of the line's core summed across it; NaN where there is no
        line.  None where an extractor was called by itself.

    Examples
    --------
    >>> import lscan
    >>> run = lscan.open_run("runs/groove")
    >>> stripe = lscan.extract_stripe(run.frame(0).image, run.rig_file.rig.stripe)
    >>> stripe.axis, stripe.image_px.shape
    ('columns', (640, 2))
    """

    axis: Axis
    centre_px: Floats
    sigma_px: Floats
    peak: Floats
    status: Ints
    flux: Floats | None = None

    def __repr__(self) -> str:
        return f"<Stripe, {self.axis}: {_in_words(self.status, {'centre': self.sigma_px}, 'px')}>"

    @property
    def image_px(self) -> Floats:
        """(N, 2) of (u, v) in px, NaN where there is no line."""
        along = np.arange(len(self.centre_px), dtype=float)
        pair = (along, self.centre_px) if self.axis == "columns" else (self.centre_px, along)
        return np.column_stack(pair)


@dataclass(frozen=True)
class PlanePoints:
    """Points in the laser sheet.

    Attributes
    ----------
    xz_mm : (N, 2) array, mm, (x, z) in the plane frame; NaN where status gives no value
    sigma_mm : (N, 2) array, mm, standard uncertainty of x and of z, all causes together
    status : (N,) array, of Status
    modes_mm : (N, 2, M) array or None, mm, the part of sigma_mm that the calibration gives to all
        points in common: M independent errors, each as it displaces every point when it is one
        standard deviation large.  The covariance of points i and j is modes[i] @ modes[j].T; what
        is left of sigma_mm² is each point's own.  None: nothing is known to be common.
    """

    xz_mm: Floats
    sigma_mm: Floats
    status: Ints
    modes_mm: Floats | None = None

    def __repr__(self) -> str:
        return f"<PlanePoints: {_in_words(self.status, self._sigma_mm, 'mm')}>"

    @property
    def _sigma_mm(self) -> dict[str, Floats]:
        return dict(zip("xz", self.sigma_mm.T, strict=True))


@dataclass(frozen=True)
class Profile:
    """One scan line in the laser sheet of the head at ``position_mm``.

    Attributes
    ----------
    position_mm : float, mm, of the track; of a shaft, the arc turned by
    points : PlanePoints, one per column (or row) of the picture, in the picture's order
    brightness : (N,) array, DN, of the line at each point, to find its ends by: the flux of the
        stripe, or its peak where there is none; NaN where there is no line

    Examples
    --------
    >>> import lscan
    >>> from lscan.pipeline import read_profiles
    >>> plane_map = lscan.load_calibration("calibration.json").plane_map
    >>> profiles = read_profiles(lscan.open_run("runs/groove"), plane_map)
    >>> [(profile.position_mm, len(profile.points.status)) for profile in profiles]
    [(0.0, 640), (1.0, 640)]
    """

    position_mm: float
    points: PlanePoints
    brightness: Floats

    def __repr__(self) -> str:
        points = _in_words(self.points.status, self.points._sigma_mm, "mm")
        return f"<Profile at {self.position_mm:g} mm: {points}>"


@dataclass(frozen=True)
class Provenance:
    """What a surface was made from.

    Attributes
    ----------
    rig : str, name of the rig
    pictures : int, number of pictures
    extractor : str, by which the line was found; with its package where it is not lscan's
    plane_map : str, name of the plane map, likewise
    calibration_sha256 : str, in hexadecimal, SHA-256 of the map's parameters and of what it was
        carried to: the water, and what may have changed since
    """

    rig: str
    pictures: int
    extractor: str
    plane_map: str
    calibration_sha256: str


@dataclass(frozen=True)
class Surface:
    """All profiles of a run, stacked: F frames of N columns.

    Attributes
    ----------
    xyz_mm : (F, N, 3) array, mm, points in the frame that ``frame`` says
    sigma_x_mm, sigma_z_mm : (F, N) array, mm, standard uncertainties of x and of z
    status : (F, N) array, of Status
    position_mm : (F,) array, mm, track positions; of a shaft, the arc turned by
    frame : str, "head" as scanned (x and z in the sheet, y the track position; about a shaft, the
        frame of the head at position 0), "workpiece" once aligned
    modes_mm : (F, N, 3, M) array or None, mm, single precision, what the calibration displaces all
        points by in common, as in PlanePoints; part of the sigmas.  None: nothing is known to be
        common.
    brightness : (F, N) array or None, DN, as in Profile; None where it is not known
    sigma_y_mm : (F, N) array or None, mm, standard uncertainty of y; None: it is the track's, taken
        for exact
    corrections : tuple of str, what its points have been corrected for, in words
    yaw_rad, yaw_sigma_rad : float or None, rad, angle of the sheet against the track that it was
        aligned with, and its standard uncertainty; None where none is known
    provenance : Provenance or None, what it was made from; None where that is not known

    Examples
    --------
    >>> import lscan
    >>> surface = lscan.load_surface("surface.nc")
    >>> surface.xyz_mm.shape, surface.frame
    ((2, 640, 3), 'head')
    """

    xyz_mm: Floats
    sigma_x_mm: Floats
    sigma_z_mm: Floats
    status: Ints
    position_mm: Floats
    frame: Literal["head", "workpiece"] = "head"
    modes_mm: NDArray[np.float32] | None = None
    brightness: Floats | None = None
    sigma_y_mm: Floats | None = None
    corrections: tuple[str, ...] = ()
    yaw_rad: float | None = None
    yaw_sigma_rad: float | None = None
    provenance: Provenance | None = None

    def __repr__(self) -> str:
        return f"<Surface, {self._size}: {_in_words(self.status, self._sigma_mm, 'mm')}>"

    def _repr_html_(self) -> str:
        valued, made = has_value(self.status), self.provenance
        rows = [("size", self._size), *status_counts(self.status).items()]
        for name, of in zip("xyz", np.moveaxis(self.xyz_mm[valued], -1, 0), strict=True):
            if of.size:
                sigma = self._sigma_mm.get(name)
                about = "" if sigma is None else f", ± {np.median(sigma[valued]):.2g} mm (median)"
                rows.append((name, f"{of.min():.2f} to {of.max():.2f} mm{about}"))
        rows += [("corrected for", what) for what in self.corrections]
        if self.yaw_rad is not None and self.yaw_sigma_rad is not None:
            yaw_deg, sigma_deg = np.degrees([self.yaw_rad, self.yaw_sigma_rad]).tolist()
            rows.append(("yaw", plus_minus(yaw_deg, sigma_deg, "deg")))
        if made is not None:
            what = f"{made.pictures} pictures of {made.rig}, {made.extractor}, {made.plane_map}"
            rows.append(("made from", what))
        return html_table(rows)

    @property
    def _size(self) -> str:
        profiles, columns = self.status.shape
        return f"{profiles} profiles x {columns} columns, frame of the {self.frame}"

    @property
    def _sigma_mm(self) -> dict[str, Floats]:
        of = {"x": self.sigma_x_mm, "y": self.sigma_y_mm, "z": self.sigma_z_mm}
        return {name: sigma for name, sigma in of.items() if sigma is not None}


@dataclass(frozen=True)
class Length:
    """A measured length and its nominal value; NaN where a number is not known.

    Attributes
    ----------
    nominal_mm, measured_mm : float, mm
    sigma_mm : float, mm, standard uncertainty of measured_mm, all causes together

    Examples
    --------
    >>> round(Length(nominal_mm=20.0, measured_mm=20.1, sigma_mm=0.05).percent, 3)
    0.5
    """

    nominal_mm: float
    measured_mm: float
    sigma_mm: float

    def __str__(self) -> str:
        """Measured and nominal length in words, sigma with two digits."""
        measured = plus_minus(self.measured_mm, self.sigma_mm, "mm")
        return f"{measured}, nominal {self.nominal_mm:g} mm"

    def __repr__(self) -> str:
        return f"<Length {self}>"

    @property
    def error_mm(self) -> float:
        """Measured minus nominal, mm."""
        return self.measured_mm - self.nominal_mm

    @property
    def percent(self) -> float:
        """The error in percent of the nominal length."""
        return 100 * self.error_mm / self.nominal_mm

    def as_json(self) -> dict[str, float]:
        """The four numbers under the keys results.json uses."""
        return {
            "nominal_mm": self.nominal_mm,
            "measured_mm": self.measured_mm,
            "error_mm": self.error_mm,
            "sigma_mm": self.sigma_mm,
        }
