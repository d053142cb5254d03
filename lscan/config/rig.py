"""The rig file: its sections, read and checked, and the drivers and methods that it names."""

from dataclasses import dataclass
from math import cos, degrees, hypot, pi, radians
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from lscan.config.board import Board
from lscan.config.documents import Document, Strict, check, merge, read_document
from lscan.config.plugins import find_plugin, find_plugin_or_function
from lscan.config.targets import Workpiece
from lscan.errors import InputError

# The sections of a rig file: camera, track, scan plan, board, how the pictures are read.

Channel = Literal["red", "green", "blue", "grey"]
Excess = Literal["red-excess", "green-excess", "blue-excess", "cyan-excess", "magenta-excess"]
LineChannel = Literal[Channel, Excess, "auto"]
MOST_SIDE_PX = 8192
Pixels = Annotated[int, Field(ge=16, le=MOST_SIDE_PX)]


class CameraSection(Strict):
    """Which camera, and how it is set.  ``options`` go to the driver, which checks them.

    bits: of a grey value.  From 10 on pictures are uint16, as ``records`` says; thresholds and
    noise stay in DN, of which the range has 256 for any number of bits.
    """

    driver: str
    width_px: Pixels = 640
    height_px: Pixels = 480
    # Files made with pictures of 8 bits are as they were without the key.
    bits: Literal[8, 10, 12, 14, 16] = Field(default=8, exclude_if=lambda bits: bits == 8)
    exposure_ms: Annotated[float, Field(gt=0, le=60_000)] = 20.0
    options: dict[str, Any] = Field(default_factory=dict)

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""
        return self.width_px, self.height_px

    @property
    def step_dn(self) -> float:
        """From one grey value to the next, DN."""
        return 2.0 ** (8 - self.bits)

    @property
    def bytes_a_value(self) -> int:
        """Of a grey value in a picture's array, or in its file: 1, or 2 for more than 8 bits."""
        return 1 if self.bits == 8 else 2


class TrackSection(Strict):
    """Which track.  ``options`` go to the driver, which checks them."""

    driver: str
    options: dict[str, Any] = Field(default_factory=dict)


class Plan(Strict):
    """The scan: ``frames`` pictures, ``step_mm`` apart, the first at ``start_mm``.

    About a ``[shaft]`` start_mm and step_mm are arcs.
    laser: what the track's laser output does.  "untouched": nothing is sent to it.  "on": lit
    from before the first picture until the scan ends.  "pairs": at each position one picture
    with the laser on and one with it off, the background.
    """

    start_mm: float = 0.0
    step_mm: float = 0.5
    frames: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    # Run folders are as they were without the key where the laser is left untouched.
    laser: Literal["untouched", "on", "pairs"] = Field(
        default="untouched", exclude_if=lambda laser: laser == "untouched"
    )

    @property
    def paired(self) -> bool:
        """Whether each frame has a background, taken with the laser off."""
        return self.laser == "pairs"

    def positions_mm(self) -> list[float]:
        """Commanded track position of each frame, mm."""
        return [self.start_mm + index * self.step_mm for index in range(self.frames)]


class NoiseSection(Strict):
    """What is known of the sensor's noise; without it, noise is estimated from each picture.

    read_dn: standard deviation of a dark pixel, rounding included.  dn_per_electron: the
    gain, so that light of I DN has the shot variance ``dn_per_electron · I`` DN².
    speckle: contrast of the laser's speckle in one pixel; 0 where there is none.
    """

    read_dn: Annotated[float, Field(gt=0, le=100)]
    dn_per_electron: Annotated[float, Field(ge=0, le=100)] = 0.0
    speckle: Annotated[float, Field(ge=0, le=1)] = 0.0


Gamma = Annotated[float, Field(ge=1, le=3)] | Literal["srgb"]


class StripeSection(Strict):
    """How the laser line is found; by maximum likelihood, whose error does not follow the pixels.

    channel: the grey values that are read.  "red-excess": red less the brighter of the two other
    colours, in which white and grey surfaces are dark and a red laser's line is bright;
    "cyan-excess", "magenta-excess": the darker of the two colours that make it up less the third,
    for lasers that the camera shows turquoise or violet; "auto": the excess of the colour whose
    line stands out most from the picture, and a lower threshold_dn where that line is faint.
    returns: which line is meant where a column holds several.  line_width_px: full width of the
    line at half its height, by which it is told from texture; from 4.7 px on its speckle is
    smoothed over half of that before its peak is looked for, and span_px is no less; None: found
    from each picture.
    smooth_px: standard deviation, along the line, of a robust smoothing; 0 leaves every column to
    itself.  blur_px: standard deviation of the camera's point spread, with which the shift that
    blur gives to a curved line of uneven brightness is corrected for; None: not corrected.
    gamma: the camera's tone curve, whose grey value goes with the light to the power 1 / gamma, or
    "srgb" (IEC 61966-2-1); it is undone before the line is read, and threshold_dn and noise are of
    what is left.  1: a linear camera.  A webcam has about 2.2; where it is not stated, the line's
    skirts are lifted and the line ends too late at an edge.

    Examples
    --------
    >>> import lscan
    >>> lscan.StripeSection(extractor="gaussian", threshold_dn=15.0).span_px
    2
    """

    extractor: str = "ml"
    channel: LineChannel = "red"
    axis: Literal["columns", "rows"] = "columns"
    threshold_dn: Annotated[float, Field(ge=0, le=255)] = 40.0
    span_px: Annotated[int, Field(ge=1, le=100)] = 2
    returns: Literal["brightest", "first", "last"] = "brightest"
    line_width_px: Annotated[float, Field(ge=1, le=60)] | None = None
    smooth_px: Annotated[float, Field(ge=0, le=100)] = 0.0
    blur_px: Annotated[float, Field(gt=0, le=20)] | None = None
    gamma: Gamma = 1.0
    noise: NoiseSection | None = None

    @property
    def colour(self) -> Channel:
        """The channel of the sensor whose grey values the line has; grey for "auto"."""
        usual = {"auto": "grey", "cyan-excess": "green", "magenta-excess": "blue"}
        return cast(Channel, usual.get(self.channel, self.channel.removesuffix("-excess")))


Uncertainty = Annotated[float, Field(ge=0, le=1e9)]
Known = tuple[Annotated[float, Field(ge=-1e6, le=1e6)], Uncertainty]
"""A number and its standard uncertainty, as in ``gap_mm = [10.0, 2.0]``; 0: known exactly."""
KnownFocal = tuple[Annotated[float, Field(ge=1, le=100_000)], Uncertainty]
KnownCentre = tuple[Annotated[float, Field(ge=-100_000, le=100_000)], Uncertainty]
KnownLength = tuple[Annotated[float, Field(ge=0, le=10_000)], Uncertainty]
KnownIndex = tuple[Annotated[float, Field(ge=1, le=4)], Uncertainty]
KnownTilt = tuple[Annotated[float, Field(ge=-45, le=45)], Uncertainty]


def _of_formula(most: float) -> AfterValidator:
    """The rule for a state of water: 0 to what the formula of its index was made for."""

    def check(value: float) -> float:
        if not 0 <= value <= most:
            what = f"must be 0 to {most:g}, where the index has a formula; of other water state"
            raise ValueError(f"{what} water_index = [index, sigma] in its place")
        return value

    return AfterValidator(check)


KnownTemperature = tuple[Annotated[float, _of_formula(30)], Uncertainty]
KnownSalinity = tuple[Annotated[float, _of_formula(35)], Uncertainty]
KnownDepth = tuple[Annotated[float, _of_formula(9900)], Uncertainty]


LensKind = Literal["brown", "rational", "fisheye"]
"""Which model of a lens: Brown's, OpenCV's rational one, or Kannala and Brandt's."""

LensChoice = LensKind | Literal["auto"]
BENDS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # coefficients of a lens's distortion


class OpticsSection(Strict):
    """What is known of the camera and its port before calibration, each with its uncertainty.

    focal_px, centre_u_px, centre_v_px, k1, k2, p1, p2: pinhole and distortion in air, as
    OpenCV writes them; None: next to nothing is known.
    gap_mm: air between pinhole and glass; thickness_mm, glass_index: the flat glass;
    water_index: what lies behind it, all indices relative to air; or, in its place, temperature_c
    and, where they are not 0, salinity_psu and depth_m, which give it at wavelength_nm.
    tilt_x_deg, tilt_y_deg: the glass against the camera's axis, 2 degrees where they are not
    given, for a window mounted by hand: a camera set square to it by eye within 3 degrees, a seal
    that is 1 mm thinner on one side of 60 mm and a lens 1 degree askew in its case, each taken as
    anywhere within its limits (GUM 4.3.7), make sqrt(3^2 + 1^2 + 1^2) / sqrt(3) = 1.9 degrees.
    port = "none": a camera in air without a window.
    board_offset_mm, board_tilt_deg, board_bend_mm, board_scale_percent: standard uncertainties of
    how far the board lay off the laser sheet, of its tilt against it about either axis, of how far
    its rim is bent off its middle, and of its scale.  Each taken as anywhere within the limits of
    a careful maker (GUM 4.3.7): the sheet grazes the board to 1 mm at either end of 200 mm, no two
    sheets of paper go between it and a straight edge, 0.05 mm of a calliper over 150 mm.
    """

    port: Literal["flat", "none"] = "flat"
    focal_px: KnownFocal | None = None
    centre_u_px: KnownCentre | None = None
    centre_v_px: KnownCentre | None = None
    k1: Known = (0.0, 0.5)
    k2: Known = (0.0, 0.5)
    p1: Known = (0.0, 0.001)
    p2: Known = (0.0, 0.001)
    gap_mm: KnownLength = (10.0, 5.0)
    thickness_mm: KnownLength = (5.0, 3.0)
    glass_index: KnownIndex = (1.49, 0.02)
    water_index: KnownIndex | None = None
    temperature_c: KnownTemperature | None = None
    salinity_psu: KnownSalinity | None = None
    depth_m: KnownDepth | None = None
    wavelength_nm: Annotated[float, Field(ge=400, le=700)] = 650.0
    tilt_x_deg: KnownTilt = (0.0, 2.0)
    tilt_y_deg: KnownTilt = (0.0, 2.0)
    board_offset_mm: Annotated[float, Field(ge=0, le=100)] = 0.6
    board_tilt_deg: Annotated[float, Field(ge=0, le=20)] = 0.25
    board_bend_mm: Annotated[float, Field(ge=0, le=100)] = 0.1
    board_scale_percent: Annotated[float, Field(ge=0, le=10)] = 0.02

    @model_validator(mode="after")
    def _one_statement_of_the_water(self) -> Self:
        if self.water_index is not None and self.temperature_c is not None:
            raise ValueError("water_index and temperature_c: give one of them")
        if self.temperature_c is None and (self.salinity_psu or self.depth_m):
            raise ValueError("salinity_psu and depth_m need temperature_c beside them")
        return self


class SinceSection(Strict):
    """What may have changed between calibration and scan: standard uncertainties, 0: nothing.

    sheet_shift_mm: of the laser sheet along its normal.  sheet_tilt_deg: about x and about z, both
    through the middle of what was calibrated.  camera_tilt_deg: of the camera against the sheet,
    about each of its axes.  focal_percent: of the focal length.  port_tilt_deg: of the glass, about
    x and about y.  water_index: of the water's index, beyond what [optics] says of it.
    """

    sheet_shift_mm: Annotated[float, Field(ge=0, le=100)] = 0.0
    sheet_tilt_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    camera_tilt_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    focal_percent: Annotated[float, Field(ge=0, le=50)] = 0.0
    port_tilt_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    water_index: Annotated[float, Field(ge=0, le=1)] = 0.0


class SheetSection(Strict):
    """The laser sheet's thickness and from where it is lit and seen, by ruler, to a cm.

    thickness_mm: its 1/e² half thickness at the target, twice the standard deviation of the
    irradiance.  camera_mm, apex_mm: the camera's pinhole and where the fan opens, in the head
    frame.  What the thickness does goes with the angles of sight and incidence: 10 mm in 900 mm
    change a correction of 0.1 mm by 0.001 mm.
    """

    thickness_mm: Annotated[float, Field(gt=0, le=100)]
    camera_mm: tuple[float, Annotated[float, Field(lt=0)], float]
    apex_mm: tuple[float, float, float]


Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
OffsetSigma = Annotated[float, Field(ge=0, le=1000)]
TiltSigma = Annotated[float, Field(ge=0, le=20)]
Correlation = Annotated[float, Field(ge=-1, le=1)]

LEAST_ANGLE_DEG = 1.0
"""A shaft nearer than this to the sheet's normal turns the sheet within its own plane."""


class ShaftSection(Strict):
    """A rotating shaft: what the track driver moves turns the head instead of shifting it.

    A position is the arc in mm that a point ``arc_radius_mm`` off the shaft has turned by: the
    angle is position / arc_radius_mm, right-handed about ``direction``.  The default makes a
    millimetre of the track driver a degree.
    point_mm, direction: a point of the shaft and its direction, in the frame of the head at
    position 0; the direction may have any length and is kept as a unit vector.

    How well the shaft is known: two axes are normal to it, the first the sheet's normal y less
    its part along the shaft, the second direction x first.  offset_sigma_mm: standard
    uncertainties of the point along them; tilt_sigma_deg: of the direction's lean towards them.
    scale_sigma: relative, of the angle.  correlation: of these five, the upper triangle row by
    row; none if left out.  0: known exactly.
    """

    arc_radius_mm: Annotated[float, Field(gt=0, le=1e6)] = 180 / pi
    point_mm: tuple[Coordinate, Coordinate, Coordinate]
    direction: tuple[Coordinate, Coordinate, Coordinate]
    offset_sigma_mm: tuple[OffsetSigma, OffsetSigma] = (0.0, 0.0)
    tilt_sigma_deg: tuple[TiltSigma, TiltSigma] = (0.0, 0.0)
    scale_sigma: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    correlation: Annotated[tuple[Correlation, ...], Field(min_length=10, max_length=10)] = (
        0.0,
    ) * 10

    @model_validator(mode="after")
    def _usable(self) -> Self:
        length = hypot(*self.direction)
        if length < 1e-9:
            raise ValueError("direction must not be zero")
        if abs(self.direction[1]) > length * cos(radians(LEAST_ANGLE_DEG)):
            raise ValueError(
                "direction is normal to the sheet, which it would turn within its own plane and "
                f"scan nothing; it must be at least {LEAST_ANGLE_DEG:g} degree from y"
            )
        if np.linalg.eigvalsh(self.correlation_matrix()).min() < -1e-6:
            raise ValueError("correlation must be that of five quantities: none is below nought")
        return self

    def correlation_matrix(self) -> np.ndarray:
        """(5, 5) correlation of the two offsets, the two tilts and the scale."""
        matrix = np.eye(5)
        matrix[np.triu_indices(5, 1)] = self.correlation
        return matrix + np.triu(matrix, 1).T


class CalibrationSection(Strict):
    """Which plane map is solved from the board picture, and from which colour channel."""

    plane_map: str = "auto"
    channel: Channel = "grey"


class Rig(Strict):
    """A whole rig file without the sections that belong to drivers."""

    name: str = "unnamed"
    camera: CameraSection
    track: TrackSection
    plan: Plan = Plan()
    stripe: StripeSection = StripeSection()
    calibration: CalibrationSection = CalibrationSection()
    optics: OpticsSection = OpticsSection()
    since_calibration: SinceSection | None = None
    sheet: SheetSection | None = None
    shaft: ShaftSection | None = None
    board: Board | None = None
    workpiece: Workpiece | None = None

    @property
    def curve_is_unknown(self) -> bool:
        """Whether the camera is one that mostly has a tone curve, and none is stated."""
        return self.camera.driver == "opencv" and "gamma" not in self.stripe.model_fields_set


# The rig file, read and checked: its sections, and the drivers, extractor and map it names.
#
# A rig file is TOML (documents.py).  Sections that belong to a driver (the tank's lens, water and
# laser, say) may stand in the same file: each driver names the sections it owns and checks them
# itself, so a scene file of the tank is a rig file too.


@dataclass(frozen=True)
class RigFile:
    """A rig as read: the model, the whole merged document it came from, and from where.

    Attributes
    ----------
    rig : Rig, all that does not belong to drivers
    document : Document, all sections, the drivers' included, with the board's file read in, so that
        it stands alone: it is what a run folder keeps
    source : str, the file, for errors

    Examples
    --------
    >>> import lscan
    >>> rig_file = lscan.load_rig("paper/sandwave")
    >>> rig_file.rig.plan.frames, rig_file.rig.plan.step_mm
    (400, 0.5)
    """

    rig: Rig
    document: Document
    source: str

    def __repr__(self) -> str:
        return f"<RigFile {self.source!r}: {self.rig.name!r}>"

    def section(self, name: str) -> Document:
        """A driver's own section of the document, {} where the file has none.

        Parameters
        ----------
        name : str, of the section
        """
        return self.document.get(name, {})


def load_rig(path: Path | str) -> RigFile:
    """The rig, or scene, described by the TOML file at ``path``, or the scene of that name.

    Parameters
    ----------
    path : Path or str
        A file of that path comes before a scene of that name.

    Raises
    ------
    InputError
        Where the file cannot be read, holds an unknown key, driver, extractor or plane map,
        where a driver refuses a section of its own, or where the drivers cannot do with the
        laser what the plan says.

    Examples
    --------
    >>> import lscan
    >>> lscan.load_rig("paper/sandwave").rig.camera.driver
    'sim'
    """
    return checked_rig(read_document(path), source=str(path))


def checked_rig(document: Document, source: str) -> RigFile:
    """The rig in a document, checked as ``load_rig`` does.

    Parameters
    ----------
    document : Document, as ``read_document`` gives it
    source : str, the document's own file, for messages

    Raises
    ------
    InputError
        As ``load_rig``.
    """
    rig_file = parse_rig(inline_board(document, source), source)
    for driver in drivers_of(rig_file.rig, rig_file.source):
        driver.validate(rig_file)
    _check_names(rig_file)
    _check_laser(rig_file)
    return rig_file


def parse_rig(document: Document, source: str, trusted: bool = False) -> RigFile:
    """The rig in an already merged document.

    Parameters
    ----------
    document : dict
        Its includes merged, the board's file read in.
    source : str
        Where it came from, for messages.
    trusted : bool
        Its driver sections need no check, as those of a run folder, which were checked when it
        was written; the drivers then need not be installed.

    Raises
    ------
    InputError
        Where it is not a rig, or holds an unknown key.
    """
    own = {key: value for key, value in document.items() if key in Rig.model_fields}
    if not {"camera", "track"} & own.keys():
        what = "is no rig: it has neither [camera] nor [track]"
        allowed = "a rig file, or a scene; `lscan scenes` lists those that come with lscan"
        raise InputError(what, where=source, allowed=allowed)
    rig = check(Rig, own, where=source)
    if not trusted and len(own) < len(document):
        known = set(Rig.model_fields).union(*(one.sections for one in drivers_of(rig, source)))
        if unknown := sorted(set(document) - known):
            what, value = f"{unknown[0]}: unknown section", document[unknown[0]]
            raise InputError(what, where=source, value=value, allowed=", ".join(sorted(known)))
    _check_shaft(rig, source)
    return RigFile(rig=rig, document=document, source=source)


def _check_shaft(rig: Rig, source: str) -> None:
    """Refuse more than a full turn about a shaft, and a sheet's thickness together with one."""
    if rig.shaft is None:
        return
    plan = rig.plan
    turn_deg = degrees((plan.frames - 1) * abs(plan.step_mm) / rig.shaft.arc_radius_mm)
    if turn_deg > 360 * (1 + 1e-9):
        what = "plan: turns the head by more than a full turn about [shaft]"
        raise InputError(what, where=source, value=f"{turn_deg:g} deg", allowed="360 deg or less")
    if rig.sheet is not None:
        what = "sheet: its thickness is corrected for on a linear track only"
        raise InputError(what, where=source, allowed="[sheet] or [shaft], not both")


def inline_board(document: Document, source: str) -> Document:
    """The document with ``[board] file = ...`` replaced by what that file holds.

    Parameters
    ----------
    document : Document, as ``read_document`` gives it
    source : str, the document's own file, for the error

    Raises
    ------
    InputError
        The board's file cannot be read.
    """
    board = document.get("board")
    if not isinstance(board, dict) or "file" not in board:
        return document
    if not isinstance(board["file"], str):
        raise InputError("board.file: must be a path", where=source, value=board["file"])
    rest = {key: value for key, value in board.items() if key != "file"}
    try:
        read = read_document(Path(board["file"]))
    except InputError as error:
        raise InputError(f"board.file: must be a file of a board: {error}", where=source) from error
    return {**document, "board": merge(read, rest)}


def _check_names(rig_file: RigFile) -> None:
    """Refuse an unknown extractor or plane map before a scan, not after it."""
    extractor, source = rig_file.rig.stripe.extractor, rig_file.source
    find_plugin_or_function("lscan.extractors", extractor, where=f"{source}: stripe.extractor")
    name, where = rig_file.rig.calibration.plane_map, f"{source}: calibration.plane_map"
    family, _, variant = name.partition("-")
    solver = find_plugin("lscan.planemaps", family, where=where)
    # A solver from elsewhere may lack the check; it then refuses when it is called.
    if (check_variant := getattr(solver, "check_variant", None)) is None:
        return
    try:
        check_variant(variant)
    except InputError as error:
        raise InputError(error.what, where=where, value=name, allowed=error.allowed) from error


def _check_laser(rig_file: RigFile) -> None:
    """Refuse a plan for the laser that the drivers cannot carry out."""
    rig, plan = rig_file.rig, rig_file.rig.plan
    camera, track = drivers_of(rig, rig_file.source)
    where = f"{rig_file.source}: plan.laser"
    if plan.laser != "untouched" and not getattr(track, "switches_laser", False):
        what = f"track driver {rig.track.driver!r} switches no laser"
        raise InputError(what, where=where, value=plan.laser, allowed="untouched")
    if plan.paired and not getattr(camera, "takes_dark", False):
        what = f"camera driver {rig.camera.driver!r} takes no pictures with the laser off"
        raise InputError(what, where=where, value=plan.laser, allowed="untouched, on")


def drivers_of(rig: Rig, source: str) -> tuple[Any, Any]:
    """The rig's camera driver and its track driver.

    Parameters
    ----------
    rig : Rig, its ``camera.driver`` and ``track.driver`` name the drivers
    source : str, the rig's file, for the error

    Raises
    ------
    InputError
        There is no such driver.
    """
    return (
        find_plugin("lscan.cameras", rig.camera.driver, where=f"{source}: camera.driver"),
        find_plugin("lscan.tracks", rig.track.driver, where=f"{source}: track.driver"),
    )
